/* safe.h: cycles, their failures, a dispatcher that is killed anywhere, the task's handler
 * of the signal, and a reader.
 *
 * Proved: no two write the register at once, no reader copies a torn set, a cycle whose
 * failure was found before it was closed ends with safe values in the table, no outputs of
 * a cycle come after its safe values, and nobody waits for ever. All words here change by
 * operations that have one order for all (C11's default), so plain memory will do; the
 * register's own fences are proved in register.pml. The task may be on another core than
 * the dispatcher, and the signal comes between any two of its steps.
 *
 * Mutations: COMMIT_UNASKED (the cycle's commit takes nothing), NO_LOOK_BEFORE (S1),
 * NO_LOOK_AFTER (S4), NO_TAKEOVER (the work of a dead dispatcher is not finished), and
 * TAKE_UNLOCKED (the dispatcher has let go the lock before it publishes).
 */
#ifndef CYCLES
#define CYCLES 4
#endif
#define SAFE_OF(n) (2 * (n) + 1)
#define OUTPUTS_OF(n) (2 * (n))

mtype = { CLOSED, OPEN, COMMITS, TAKEN, MADE_SAFE };

/* safe.h: the word, and what is wanted; the table's lock; the signal. */
mtype phase = CLOSED;
byte number, wanted;
bool locked, gone, sent;
byte begun; /* the cycle to which failures can be found */

/* The register: two words in each of four slots. */
byte a[4], b[4], head;

/* Ghosts: who writes the register, and the cycle made safe last. */
byte writers, safe;

#define TAKE wanted && number == wanted && phase == OPEN

inline enter() { atomic { writers++; assert(writers == 1) } }
inline leave(value) {
    head++;
    assert(value % 2 || value / 2 > safe);
    if :: value % 2 -> safe = value / 2 :: else fi;
    writers--
}

inline publish(value) {
    enter();
    a[(head + 1) % 4] = value;
    b[(head + 1) % 4] = value;
    atomic { leave(value) }
}

/* pb_make_safe, if the signal has come. */
inline interrupted() {
    if
    :: atomic { sent -> sent = false };
        if
        :: atomic { TAKE -> phase = TAKEN };
            publish(SAFE_OF(number));
            phase = MADE_SAFE
        :: else
        fi
    :: true
    fi
}

/* The same where nothing can be taken. */
inline disturbed() {
    if :: atomic { sent -> sent = false; assert(!(TAKE)) } :: true fi
}

active proctype Task() {
    bool mine, must, owed;
    do
    :: begun < CYCLES ->
        begun++;
        disturbed();
        atomic { number = begun; phase = OPEN; owed = wanted == begun };
#ifndef NO_LOOK_BEFORE
        if /* S1 */
        :: atomic { TAKE -> phase = TAKEN }; publish(SAFE_OF(begun)); phase = MADE_SAFE
        :: else -> atomic { if :: wanted != begun -> wanted = 0 :: else fi }
        fi;
#endif
        assert(!owed || phase != OPEN);
        interrupted();
        atomic {
#ifdef COMMIT_UNASKED
            mine = true;
            phase = COMMITS
#else
            if :: phase == OPEN -> mine = true; phase = COMMITS :: else -> mine = false fi
#endif
        };
        if
        :: mine ->
            enter();
            a[(head + 1) % 4] = OUTPUTS_OF(begun);
            disturbed();
            b[(head + 1) % 4] = OUTPUTS_OF(begun);
            atomic { leave(OUTPUTS_OF(begun)) };
            disturbed()
        :: else
        fi;
        if
        :: atomic { phase == OPEN || phase == COMMITS ->
                phase = CLOSED; owed = wanted == begun; must = false };
#ifndef NO_LOOK_AFTER
            must = wanted == begun /* S4 */
#endif
        :: atomic { phase == TAKEN && (!locked || gone) -> locked = true; owed = true };
#ifdef NO_TAKEOVER
            must = false;
#else
            must = phase == TAKEN;
#endif
            locked = false
        :: atomic { phase == MADE_SAFE -> owed = true; must = false }
        fi;
        if :: must -> publish(SAFE_OF(begun)) :: else fi;
        assert(!owed || safe == begun);
        atomic { phase = CLOSED; mine = false; must = false; owed = false }
    :: else -> break
    od
}

/* rt_make_safe and pb_safe_commit. It finds a failure of any cycle, once for each. */
active proctype Dispatcher() {
    byte cycle;
    bool amid;
    do
    :: atomic { begun > wanted -> cycle = begun };
        if :: wanted = cycle /* S5 */ :: goto killed fi;
        if
        :: atomic { !locked -> locked = true };
            if
            :: atomic { TAKE && number == cycle -> phase = TAKEN };
#ifdef TAKE_UNLOCKED
                locked = false;
#endif
                if :: enter(); amid = true :: goto killed fi;
                if :: a[(head + 1) % 4] = SAFE_OF(cycle) :: goto killed fi;
                if :: b[(head + 1) % 4] = SAFE_OF(cycle) :: goto killed fi;
                if :: atomic { leave(SAFE_OF(cycle)); amid = false } :: goto killed fi;
                if :: phase = MADE_SAFE :: goto killed fi
            :: else -> sent = true
            fi;
            locked = false
        :: sent = true /* a claimer has the lock, or there is no dispatcher of the task's own */
        fi;
        cycle = 0
    :: atomic { begun == CYCLES && wanted == CYCLES -> goto end }
    :: true -> goto killed
    od;
killed:
    atomic { if :: amid -> writers-- :: else fi; gone = true };
end:
    atomic { amid = false; cycle = 0 }
}

active proctype Reader() {
    byte first, x, y, seen;
    do
    :: atomic { first = head; x = a[first % 4] };
        y = b[first % 4];
        if
        :: atomic { head == first -> assert(x == y); assert(x >= seen);
            seen = x; x = 0; y = 0; first = 0 }
        :: else -> atomic { x = 0; y = 0; first = 0 }
        fi
    :: begun == CYCLES -> break
    od
}
