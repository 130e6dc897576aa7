/* directory.h, owner.h, cut.h: two variables x and y go from owner to owner while a reader
 * takes cuts; whoever claims them may be killed at every step.
 *
 * Register 0 is the keeper's, and y stands there; x stands in register 1. Task 0 and task 1
 * compete: each takes a register, claims x and y, and then commits once more (task 0) or not.
 *   - Without -DRECLAIM x belongs to a third task that was killed in or behind a commit; what
 *     it stored is still pending. Task 0 has register 2 already. A dead owner's variable is
 *     taken over, and register 1, or its place in the arena, is used again by task 1.
 *   - With -DRECLAIM register 1 is task 0's, which is off (and meanwhile somebody set y): it
 *     is turned on again, and behind its second commit it gives everything up and leaves.
 *
 * A word tells variable, register and commit number. Proved for one attempt of the reader,
 * begun at any time, with or without a plan that was made earlier in the same generation:
 *   - a plan that is accepted is that of its generation (no address is made of a mixture);
 *   - a cut called consistent stood in memory when its last first look was made; its words,
 *     and those of a cut called whole, are what the owners committed, whatever was reused;
 *   - x and y change hands, and get the new owner's first values, together;
 *   - no task gets what a live task owns; nobody waits for ever, whoever was killed.
 *
 * -DHINTS lets a writer heed that readers are slow (head.pml); else it always goes to and
 * fro, which spoils most copies.
 *
 * Mutations of the writers: NO_RELEASE (R2 on the generation), NO_REUSE_FENCE (O1),
 * NO_HANDOVER (L1), NO_LOCK, NO_RECOVERY (of a dead holder's lock), NO_REFUSAL, PUBLISH_FIRST
 * (before the commit), ONE_BY_ONE (two generations), IN_PLACE (the present directory is
 * changed), SWEEP_NAMED, SWEEP_HELD (registers are freed too early), RECLAIM_IN_PLACE (the
 * first commit goes into a register where variables stand); of the reader: NO_ACQUIRE (C2),
 * NO_PLAN_FENCE, NO_PLAN_CHECK (C1), NO_GENERATION_CHECK (C4).
 */
#define X 0
#define Y 1
#define GEN 0
#define DIR(slot, v) (1 + (slot) * 2 + (v))
#define HEAD(r) (9 + (r))
#define BASE(r) (13 + (r))
#define WORD(b, slot, v) (17 + (b) * 8 + (slot) * 2 + (v))
#include "head.pml"
#define LOCATIONS 49
#define REGS 4
#define CPUS 3 /* task 0, task 1, and the third task */
#define THIRD 2
#define POOLS 1
#define POOL_OF(cpu) 0
#define PERFORMED(at) skip
#define VALUE(v, r, seq) ((v) << 7 | (r) << 4 | (seq))
#define LIVE 4
#define REG(entry) ((entry) & 3)

/* Ghosts. */
#define GENS 8
byte own[GENS * 2];     /* register and place of x and of y in each generation */
byte shared_from[REGS]; /* the first commit of a register that holds x and y together */
bool owns[CPUS];
#define OWNER(g, v) (own[(g) * 2 + (v)] & 3)
#define PLACE(g, v) (own[(g) * 2 + (v)] >> 2)
#define STANDS(v) (OWNER(NUMBER(mem[GEN]), v) == reg[v] && mem[HEAD(reg[v])] == head[v])

#include "weak.pml"

/* What only lock holders use. */
#define NOBODY CPUS
#define FREE 0
#define HELD 1
#define LEFT 2
byte holder = NOBODY;
bool alive[CPUS], gone[CPUS]; /* gone: has done all that it had to do */
byte state[REGS], task[REGS], base[REGS];
hidden byte e_, named_;

/* A step, or death before it. Of two tasks the last that is left need not die: it may be
 * scheduled no more, and nobody is there who could tell the difference. */
#define or_die(step) if :: step :: atomic { alive[1 - p] && !gone[1 - p] -> goto killed } fi

inline lock(p) {
    atomic {
#if defined(NO_LOCK)
        true;
#elif defined(NO_RECOVERY)
        holder == NOBODY;
#else
        holder == NOBODY || !alive[holder];
#endif
#ifndef NO_HANDOVER
        before[p] = before[p] | handed; /* L1 */
        if
        :: holder < NOBODY -> before[p] = before[p] | before[holder]
        :: else
        fi;
#endif
        holder = p
    }
}

inline unlock(p) { d_step { handed = before[p]; holder = NOBODY } }

/* Whether the holder of a register is dead; if so, what it did happened before. */
#define dead(r) (!alive[task[r]])
inline learn(p, r) { before[p] = before[p] | before[task[r]] }

/* pb_sweep */
inline sweep(p) {
    d_step {
        load(p, GEN, h);
        load(p, DIR(SLOT(h), X), e_);
        named_ = 1 << REG(e_);
        load(p, DIR(SLOT(h), Y), e_);
#ifdef SWEEP_NAMED
        named_ = 0;
#else
        named_ = named_ | (1 << REG(e_));
#endif
        r = 1;
        do
        :: r < REGS ->
            if
            :: named_ & (1 << r) -> skip
            :: else ->
                if
                :: state[r] == LEFT -> state[r] = FREE
#ifdef SWEEP_HELD
                :: state[r] == HELD -> state[r] = FREE
#else
                :: state[r] == HELD && dead(r) -> learn(p, r); state[r] = FREE
#endif
                :: else
                fi
            fi;
            r++
        :: else -> break
        od;
        r = 0; h = 0
    }
}

/* pb_enter: the first free register, and any place of the arena that is free. */
#define taken(b, r) (state[r] != FREE && base[r] == b)
#define in_use(b) (taken(b, 0) || taken(b, 1) || taken(b, 2) || taken(b, 3))

inline enter(p) {
    or_die(atomic {
        lock(p);
        sweep(p);
        r = 1;
        do
        :: r < REGS && state[r] != FREE -> r++
        :: else -> break
        od;
        assert(r < REGS);
        if
        :: !in_use(1) -> b = 1
        :: !in_use(2) -> b = 2
        :: !in_use(3) && in_use(2) -> b = 3
        fi;
#ifndef NO_REUSE_FENCE
        release_fence(p) /* O1 */
#endif
    });
    or_die(atomic { store(p, BASE(r), b); base[r] = b });
    or_die(atomic { state[r] = HELD; task[r] = p; unlock(p) })
}

/* pb_commit_group */
inline commit(p) {
    d_step { load(p, HEAD(r), h); n = NEXT(h); release_fence(p) }; /* R1 */
    or_die(store(p, WORD(b, SLOT(n), X), VALUE(X, r, NUMBER(n))));
    store(p, WORD(b, SLOT(n), Y), VALUE(Y, r, NUMBER(n)));
    or_die(atomic {
#ifdef HINTS
        if :: n = CROWDED(h, n) :: true fi;
#endif
        store_release(p, HEAD(r), n); /* R2 */
        if :: !shared_from[r] -> shared_from[r] = NUMBER(n) :: else fi;
        h = 0; n = 0
    })
}

/* pb_next and pb_publish: the next directory, with these two entries. */
#ifdef NO_RELEASE
#define publish(p, at, what) store(p, at, what)
#else
#define publish(p, at, what) store_release(p, at, what)
#endif
#ifdef IN_PLACE
#define INTO SLOT(h)
#else
#define INTO SLOT(n)
#endif

inline directory(p, x_entry, y_entry) {
    d_step {
        load(p, GEN, h);
        n = NEXT(h);
        n = CROWDED(h, n);
        assert(NUMBER(n) < GENS);
        release_fence(p) /* R1 */
    };
    or_die(store(p, DIR(INTO, X), x_entry));
    or_die(store(p, DIR(INTO, Y), y_entry));
#ifdef IN_PLACE
    release_fence(p);
    store(p, DIR(SLOT(n), X), x_entry);
    store(p, DIR(SLOT(n), Y), y_entry);
#endif
    or_die(atomic {
        publish(p, GEN, n); /* R2 */
        own[NUMBER(n) * 2] = REG(x_entry) | base[REG(x_entry)] << 2;
        own[NUMBER(n) * 2 + 1] = REG(y_entry) | base[REG(y_entry)] << 2;
        h = 0; n = 0
    })
}

/* pb_may */
inline refused(p, v) {
    load(p, DIR(SLOT(h), v), e_);
    if
    :: !(e_ & LIVE) || REG(e_) == r -> skip
    :: else ->
        if
        :: dead(REG(e_)) -> learn(p, REG(e_))
        :: else -> no = 1
        fi
    fi
}

/* pb_claim */
inline claim(p) {
    or_die(atomic {
        lock(p);
        load(p, GEN, h);
        refused(p, X);
        refused(p, Y);
#ifdef NO_REFUSAL
        no = 0;
#endif
        h = 0
    });
    if
    :: no -> no = 0; unlock(p); goto out
    :: else
    fi;
    assert(!(alive[1 - p] && owns[1 - p]));
#ifndef PUBLISH_FIRST
    commit(p);
#endif
#ifdef ONE_BY_ONE
    d_step { load(p, GEN, h); load(p, DIR(SLOT(h), Y), no); h = 0 };
    directory(p, r | LIVE, no);
    no = 0;
#endif
    directory(p, r | LIVE, r | LIVE);
    owns[p] = 1;
#ifdef RECLAIM
    if
    :: p == 0 && r != 1 -> or_die(state[1] = LEFT) /* what stood there stands no more */
    :: else
    fi;
#endif
#ifdef PUBLISH_FIRST
    commit(p);
#endif
    or_die(unlock(p))
}

/* pb_let_go, for good */
inline let_go(p) {
    owns[p] = 0;
    or_die(lock(p));
    directory(p, r, r);
    or_die(state[r] = LEFT);
    or_die(unlock(p))
}

/* The register that task 0 has from the beginning. */
#ifdef RECLAIM
#define OLD 1
#else
#define OLD 2
#endif

proctype Task(byte p) {
    byte r, b, no;
    short h, n;
#if !defined(RECLAIM) || defined(RECLAIM_IN_PLACE)
    if
    :: p == 0 -> r = OLD; b = OLD
    :: else -> enter(p)
    fi;
#else
    enter(p);
#endif
    claim(p);
    if
#ifdef RECLAIM
    :: p == 0 -> commit(p); let_go(p)
#else
    :: p == 0 -> commit(p)
#endif
    :: else
    fi;
    goto out;
killed:
    alive[p] = false;
out:
    atomic { gone[p] = true; r = 0; b = 0; no = 0; h = 0; n = 0 }
}

/* pb_replan and pb_cut: the loads of one attempt, and which of them each waits for. */
#define LOOK_GEN 1
#define ENTRY_X 2
#define ENTRY_Y 4
#define BASE_X 8
#define BASE_Y 16
#define AGAIN_PLAN 32
#define LOOK_X 64
#define LOOK_Y 128
#define COPY_X 256
#define COPY_Y 512
#define AGAIN_X 1024
#define AGAIN_Y 2048
#define AGAIN_GEN 4096
#define ALL 8191
#define ENTRIES (ENTRY_X | ENTRY_Y | BASE_X | BASE_Y)
#ifdef NO_ACQUIRE /* then entries may come from a slot of the directory that is guessed */
#define ENTRY_WAITS 0
#else
#define ENTRY_WAITS LOOK_GEN /* C2 */
#endif
#ifdef NO_PLAN_FENCE
#define AGAIN_PLAN_WAITS LOOK_GEN
#define LOOK_X_WAITS (LOOK_GEN | ENTRY_X)
#define LOOK_Y_WAITS (LOOK_X | ENTRY_Y)
#else
#define AGAIN_PLAN_WAITS (LOOK_GEN | ENTRIES) /* C1 */
#define LOOK_X_WAITS AGAIN_PLAN /* the processor may look earlier, but gains no other plan */
#define LOOK_Y_WAITS LOOK_X
#endif
#define COPY_X_WAITS (LOOK_X | LOOK_Y | BASE_X)
#define COPY_Y_WAITS (LOOK_X | LOOK_Y | BASE_Y)
#define AGAIN_WAITS (LOOK_X | LOOK_Y | AGAIN_PLAN | COPY_X | COPY_Y) /* C3 */
#define PLAN (ENTRIES | AGAIN_PLAN)
#ifdef NO_GENERATION_CHECK
#define DOOMED false
#else /* C4 will find another generation: the attempt is dropped at once, to save states */
#define DOOMED ((done & PLAN) == PLAN && !(done & AGAIN_GEN) && mem[GEN] != gen)
#endif
#define can(load, waits) !DOOMED && !(done & (load)) && (done & (waits)) == (waits)

/* Who computes addresses from a plan must have that of its generation. */
inline check_plan() {
    assert(reg[X] == OWNER(NUMBER(gen), X) && place[X] == PLACE(NUMBER(gen), X));
    assert(reg[Y] == OWNER(NUMBER(gen), Y) && place[Y] == PLACE(NUMBER(gen), Y))
}

inline second_look(v) {
    again = mem[HEAD(reg[v])];
    if
    :: !WHOLE(head[v], again) -> check_plan(); goto finished
    :: WHOLE(head[v], again) && again != head[v] -> same = same && (v == Y || reg[X] == reg[Y])
    :: else
    fi;
    again = 0
}

proctype Reader() {
    short done, gen, head[2], again;
    byte slot, reg[2], place[2];
    short word[2];
    bool same = true, stood;
#ifdef NO_ACQUIRE
    if :: slot = 0 :: slot = 1 :: slot = 2 :: slot = 3 fi;
#endif
    do
    :: atomic { DOOMED -> check_plan(); goto finished }
    :: atomic { can(LOOK_GEN, 0) ->
        gen = mem[GEN];
        done = done | LOOK_GEN;
#ifdef NO_ACQUIRE
        if :: slot != SLOT(gen) -> goto finished :: else fi; /* guessed wrong */
#else
        slot = SLOT(gen);
#endif
        if
        :: !(done & ENTRIES) -> /* the plan was made earlier */
            reg[X] = OWNER(NUMBER(gen), X); place[X] = PLACE(NUMBER(gen), X);
            reg[Y] = OWNER(NUMBER(gen), Y); place[Y] = PLACE(NUMBER(gen), Y);
            done = done | ENTRIES | AGAIN_PLAN
        :: true
        fi }
    :: atomic { can(ENTRY_X, ENTRY_WAITS) -> reg[X] = REG(mem[DIR(slot, X)]); done = done | ENTRY_X }
    :: atomic { can(ENTRY_Y, ENTRY_WAITS) -> reg[Y] = REG(mem[DIR(slot, Y)]); done = done | ENTRY_Y }
    :: atomic { can(BASE_X, ENTRY_X) -> place[X] = mem[BASE(reg[X])]; done = done | BASE_X }
    :: atomic { can(BASE_Y, ENTRY_Y) -> place[Y] = mem[BASE(reg[Y])]; done = done | BASE_Y }
    :: atomic { can(AGAIN_PLAN, AGAIN_PLAN_WAITS) ->
        done = done | AGAIN_PLAN;
#ifndef NO_PLAN_CHECK
        if :: mem[GEN] != gen -> goto finished :: else fi
#endif
       }
    :: atomic { can(LOOK_X, LOOK_X_WAITS) -> head[X] = mem[HEAD(reg[X])]; done = done | LOOK_X;
        if
        :: done & ENTRY_Y && reg[Y] == reg[X] -> /* one register for both: one look */
            head[Y] = head[X]; stood = STANDS(X) && STANDS(Y); done = done | LOOK_Y
        :: else
        fi }
    :: atomic { can(LOOK_Y, LOOK_Y_WAITS) ->
        head[Y] = mem[HEAD(reg[Y])]; stood = STANDS(X) && STANDS(Y); done = done | LOOK_Y }
    :: atomic { can(COPY_X, COPY_X_WAITS) ->
        word[X] = mem[WORD(place[X], SLOT(head[X]), X)]; done = done | COPY_X }
    :: atomic { can(COPY_Y, COPY_Y_WAITS) ->
        word[Y] = mem[WORD(place[Y], SLOT(head[Y]), Y)]; done = done | COPY_Y }
    :: atomic { can(AGAIN_X, AGAIN_WAITS) -> second_look(X); done = done | AGAIN_X;
        if :: reg[Y] == reg[X] -> done = done | AGAIN_Y :: else fi }
    :: atomic { can(AGAIN_Y, AGAIN_WAITS) && reg[Y] != reg[X] -> second_look(Y); done = done | AGAIN_Y }
    :: atomic { can(AGAIN_GEN, AGAIN_WAITS) ->
        check_plan();
#ifndef NO_GENERATION_CHECK
        if :: mem[GEN] != gen -> goto finished :: else fi; /* C4 */
#endif
        done = done | AGAIN_GEN }
    :: atomic { done == ALL ->
        assert(!same || stood);
        assert(word[X] == VALUE(X, reg[X], NUMBER(head[X])));
        assert(word[Y] == VALUE(Y, reg[Y], NUMBER(head[Y])));
        assert(reg[X] == reg[Y] || /* together, or as they stood at first */
               reg[X] == 1 && reg[Y] == 0 &&
               !(shared_from[1] && shared_from[1] <= NUMBER(head[X])));
        break }
    od;
finished:
    atomic {
        done = 0; gen = 0; slot = 0; again = 0; same = true; stood = false;
        reg[X] = 0; place[X] = 0; head[X] = 0; word[X] = 0;
        reg[Y] = 0; place[Y] = 0; head[Y] = 0; word[Y] = 0
    }
}

#define FIRST (1 << 8 | 1 << 4 | 1) /* the head behind the first commit */

init {
    d_step {
        alive[0] = true; alive[1] = true;
        mem[GEN] = FIRST;
        base[1] = 1; mem[BASE(1)] = 1;
        state[0] = HELD; task[0] = NOBODY;
        state[1] = HELD;
#ifdef RECLAIM
        task[1] = 0; mem[DIR(1, X)] = 1;
#else
        task[1] = THIRD; mem[DIR(1, X)] = 1 | LIVE;
        state[2] = HELD; task[2] = 0; base[2] = 2; mem[BASE(2)] = 2;
#endif
        own[2] = 1 | 1 << 2; /* generation 1: x in register 1, y in the keeper's */
        mem[HEAD(0)] = FIRST; mem[WORD(0, 1, Y)] = VALUE(Y, 0, 1);
        mem[HEAD(1)] = FIRST; mem[WORD(1, 1, X)] = VALUE(X, 1, 1);
        mem[WORD(1, 1, Y)] = VALUE(Y, 1, 1) /* of no meaning: y does not stand here */
    };
    atomic {
#ifndef RECLAIM /* the third task died in or behind a commit; what it stored is pending */
        if
        :: true
        :: store(THIRD, WORD(1, SLOT(NEXT(FIRST)), X), VALUE(X, 1, 2));
            if
            :: true
            :: store_release(THIRD, HEAD(1), NEXT(FIRST))
            fi
        fi;
#endif
        run Task(0);
        run Task(1);
        run Reader()
    }
}
