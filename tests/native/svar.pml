/* The protocol of the state variable table under reordered stores and loads.
 *
 * Checked by tests/integration/test_svar_model.py, which also takes out one fence or check
 * at a time (-DNO_...) and wants an error each time. Three parts, one per build:
 *
 *   -DREGISTER  one writer, one reader: is what the reader calls whole, whole? (register.h)
 *   -DCUT       two writers that see each other: is a cut that is called consistent one
 *               that an instant has seen? (cut.h)
 *   -DOWNER     claims that move a group to another register and use the former one again:
 *               does the reader get one owner's values? (directory.h, owner.h)
 *
 * A store goes into its processor's buffer and reaches memory at any later time and in any
 * order, except that two stores to one place keep theirs, and that no store overtakes a
 * fence: a release store is a fence and a store. Loads of the reader are made in any order
 * that its fences and acquire loads leave open. A killed writer stops between two steps;
 * what it has stored still arrives, and its successor goes on from there.
 *
 * The names of the places and of the fences are those of the headers' SYNC POINTs. */

#ifdef CUT
#define PENDING 2 /* stores that a processor may hold back */
#else
#define PENDING 3
#endif

typedef Buffer {
    byte n, epoch;
    byte place[PENDING], era[PENDING];
    short value[PENDING]
}

short memory[14];
Buffer buffer[2];

/* Put a store into the buffer of processor p. */
inline store(p, a, v) {
    atomic {
        buffer[p].n < PENDING;
        buffer[p].place[buffer[p].n] = a;
        buffer[p].value[buffer[p].n] = v;
        buffer[p].era[buffer[p].n] = buffer[p].epoch;
        buffer[p].n++
    }
}

/* What is stored later may not overtake what was stored before. */
inline fence(p) { d_step { if :: buffer[p].n -> buffer[p].epoch++ :: else fi } }

#define AT(i) buffer[p].place[i]
#define MAY0 (buffer[p].n > 0)
#define MAY1 (buffer[p].n > 1 && buffer[p].era[0] == buffer[p].era[1] && AT(0) != AT(1))
#if PENDING > 2
#define MAY2 (buffer[p].n > 2 && buffer[p].era[0] == buffer[p].era[2] && \
              AT(0) != AT(2) && AT(1) != AT(2))
#else
#define MAY2 false
#endif

/* The memory side of processor p: lets stores arrive. */
proctype arrivals(byte p) {
    byte i;
end:
    do
    :: atomic {
        MAY0;
        if :: i = 0 :: MAY1 -> i = 1 :: MAY2 -> i = 2 fi;
        memory[AT(i)] = buffer[p].value[i];
        do
        :: i + 1 < buffer[p].n ->
            AT(i) = AT(i + 1);
            buffer[p].value[i] = buffer[p].value[i + 1];
            buffer[p].era[i] = buffer[p].era[i + 1];
            i++
        :: else -> break
        od;
        buffer[p].n--;
        AT(i) = 0; buffer[p].value[i] = 0; buffer[p].era[i] = 0;
        if :: buffer[p].n == 0 -> buffer[p].epoch = 0 :: else fi;
        i = 0
    }
    od
}

/* A head, as in register.h. */
#define NUMBER(h) ((h) >> 8)
#define MOVE(h)   ((h) >> 4 & 3)
#define KEPT(h)   ((h) >> 2 & 3)
#define SLOT(h)   ((h) & 3)
#ifdef KEEP_MORE /* mutation: promises a commit too many */
#define MOST 3
#else
#define MOST 2
#endif
#ifdef ONE_MOVE /* mutation: goes to and fro whatever it has promised */
#define STEP(h) 1
#else
#define STEP(h) (KEPT(h) -> 3 - MOVE(h) : 1)
#endif
#define KEEP(h) (KEPT(h) < MOST -> KEPT(h) + 1 : MOST)
#ifdef NO_LOOK /* mutation: does not look again */
#define WHOLE(h, again) true
#else
#define WHOLE(h, again) (NUMBER(again) - NUMBER(h) <= KEPT(again))
#endif

#ifdef NO_R1 /* mutations: fences that are not there */
#define FENCE_R1(p) skip
#else
#define FENCE_R1(p) fence(p)
#endif
#ifdef NO_R2
#define FENCE_R2(p) skip
#else
#define FENCE_R2(p) fence(p)
#endif

/* Publish the commit prepared in `next`: in a crowd always, or whenever readers asked. */
inline publish(p, a, last, next) {
    FENCE_R2(p);
    if
    :: next = next | KEEP(last) << 2
#ifdef REGISTER
    :: skip
#endif
    fi;
    store(p, a, next);
    last = next
}
#define NEXT(h) ((NUMBER(h) + 1) << 8 | STEP(h) << 4 | (SLOT(h) ^ STEP(h)))

#ifdef REGISTER
#define COMMITS 5
#define HEAD    0
#define FIRST(h)  (1 + SLOT(h)) /* the group's two words, both hold the commit's number */
#define SECOND(h) (5 + SLOT(h))

proctype writer() {
    short last, next;
    bool killed;
again:
    do
    :: NUMBER(last) < COMMITS ->
        next = NEXT(last);
        FENCE_R1(0);
        store(0, FIRST(next), NUMBER(next));
        if :: !killed -> killed = true; goto dead :: skip fi;
        store(0, SECOND(next), NUMBER(next));
        if :: !killed -> killed = true; goto dead :: skip fi;
        publish(0, HEAD, last, next)
    :: else -> goto end
    od;
dead: /* the successor sees all that the dead one stored */
    atomic { buffer[0].n == 0; last = memory[HEAD]; next = 0; goto again }
end:
    skip
}

proctype reader() {
    short h, again, first, second;
    bool ahead;
#ifdef NO_R3 /* mutation: words may be loaded before the head, from a guessed slot */
    byte guess;
    if :: guess = 0 :: guess = 1 :: guess = 2 :: guess = 3 fi;
    first = memory[1 + guess];
    second = memory[5 + guess];
    h = memory[HEAD];
    if :: SLOT(h) == guess -> skip :: else -> goto end fi;
    ahead = true;
#else
    h = memory[HEAD]; /* R3: acquire */
#endif
    if
    :: ahead
    :: !ahead -> first = memory[FIRST(h)]; second = memory[SECOND(h)]
    :: !ahead -> second = memory[SECOND(h)]; first = memory[FIRST(h)]
#ifdef NO_R4 /* mutation: the second look may come before the words */
    :: !ahead -> again = memory[HEAD]; first = memory[FIRST(h)];
        second = memory[SECOND(h)]; goto judge
    :: !ahead -> first = memory[FIRST(h)]; again = memory[HEAD];
        second = memory[SECOND(h)]; goto judge
#endif
    fi;
    again = memory[HEAD]; /* R4 */
judge:
    assert(!WHOLE(h, again) || (first == NUMBER(h) && second == NUMBER(h)));
end:
    skip
}

init { atomic { run arrivals(0); run writer(); run reader() } }
#endif

#ifdef CUT
#define COMMITS 2
#define HEAD(w)    (w)
#define SEEN(w, h) (2 + 4 * (w) + SLOT(h)) /* the other's number before this commit */

proctype writer(byte w) {
    short last, next;
    byte seen;
    do
    :: NUMBER(last) < COMMITS ->
        seen = NUMBER(memory[HEAD(1 - w)]);
        next = NEXT(last);
        FENCE_R1(w);
        store(w, SEEN(w, next), seen);
        publish(w, HEAD(w), last, next)
    :: else -> break
    od
}

proctype reader() {
    short h[2], again[2];
    byte seen[2];
    bool same;
#ifdef LOOK_EACH /* mutation: look, copy, look again at one register after the other */
    h[0] = memory[HEAD(0)];
    seen[0] = memory[SEEN(0, h[0])];
    again[0] = memory[HEAD(0)];
    h[1] = memory[HEAD(1)];
    seen[1] = memory[SEEN(1, h[1])];
    again[1] = memory[HEAD(1)];
#else
#ifdef NO_R3 /* mutation: a first look may come as late as the other's second one */
    if
    :: h[0] = memory[HEAD(0)]; seen[0] = memory[SEEN(0, h[0])];
        again[0] = memory[HEAD(0)]; h[1] = memory[HEAD(1)]; goto late
    :: skip
    fi;
#endif
    if
    :: h[0] = memory[HEAD(0)]; h[1] = memory[HEAD(1)]
    :: h[1] = memory[HEAD(1)]; h[0] = memory[HEAD(0)]
    fi;
    seen[0] = memory[SEEN(0, h[0])];
    seen[1] = memory[SEEN(1, h[1])];
    again[0] = memory[HEAD(0)]; /* C3 */
    again[1] = memory[HEAD(1)];
    goto judge;
#ifdef NO_R3
late:
    seen[1] = memory[SEEN(1, h[1])];
    again[1] = memory[HEAD(1)];
#endif
#endif
judge:
#ifdef WHOLE_ENOUGH /* mutation: whole groups are called a cut */
    same = WHOLE(h[0], again[0]) && WHOLE(h[1], again[1]);
#else
    same = h[0] == again[0] && h[1] == again[1];
#endif
    assert(!same || (seen[0] <= NUMBER(h[1]) && seen[1] <= NUMBER(h[0])))
}

init {
    atomic { run arrivals(0); run arrivals(1); run writer(0); run writer(1); run reader() }
}
#endif

#ifdef OWNER
#define CLAIMS 6
#define GENERATION 0
#define ENTRY_X(h) (1 + SLOT(h)) /* which claim x belongs to, and y */
#define ENTRY_Y(h) (5 + SLOT(h))
#define VALUE_X(n) (9 + 2 * ((n) % 2)) /* claim n uses what claim n - 1 has freed */
#define VALUE_Y(n) (10 + 2 * ((n) % 2))
#ifdef NO_O1 /* mutation: a register is used again before all see that it was freed */
#define FENCE_O1(p) skip
#else
#define FENCE_O1(p) fence(p)
#endif

proctype claimer() {
    short last, next, now;
    bool killed;
again:
    do
    :: NUMBER(last) < CLAIMS ->
        now = NUMBER(last) + 1;
        FENCE_O1(0);
        store(0, VALUE_X(now), now);
        store(0, VALUE_Y(now), now);
        if :: !killed -> killed = true; goto dead :: skip fi;
        next = NEXT(last);
#ifdef IN_PLACE /* mutation: the present directory is changed, not a copy beside it */
        next = (next & ~3) | SLOT(last);
#endif
        FENCE_R1(0);
        store(0, ENTRY_X(next), now);
        if :: !killed -> killed = true; goto dead :: skip fi;
        store(0, ENTRY_Y(next), now);
        if :: !killed -> killed = true; goto dead :: skip fi;
        publish(0, GENERATION, last, next)
    :: else -> goto end
    od;
dead: /* the kernel gives the lock on */
    atomic {
        buffer[0].n == 0; last = memory[GENERATION]; next = 0; now = 0; goto again
    }
end:
    skip
}

proctype reader() {
    short g, x, y;
    byte rx, ry;
    g = memory[GENERATION]; /* C2 */
    if
    :: rx = memory[ENTRY_X(g)]; ry = memory[ENTRY_Y(g)]
    :: ry = memory[ENTRY_Y(g)]; rx = memory[ENTRY_X(g)]
    fi;
#ifndef NO_C1 /* mutation: entries are used before it is known that they belong together */
    if :: memory[GENERATION] == g -> skip :: else -> goto end fi;
#endif
    assert(rx == NUMBER(g) && ry == rx); /* addresses are computed from these */
    if
    :: x = memory[VALUE_X(rx)]; y = memory[VALUE_Y(ry)]
    :: y = memory[VALUE_Y(ry)]; x = memory[VALUE_X(rx)]
    fi;
#ifndef NO_C4 /* mutation: the generation is not looked at again */
    if :: memory[GENERATION] == g -> skip :: else -> goto end fi;
#endif
    assert(x == NUMBER(g) && y == NUMBER(g));
end:
    skip
}

init { atomic { run arrivals(0); run claimer(); run reader() } }
#endif
