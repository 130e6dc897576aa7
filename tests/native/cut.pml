/* cut.h: two registers with a writer each, killed anywhere, and one reader of both.
 *
 * The word of commit n holds n. Proved for COMMITS_P and COMMITS_Q commits and one attempt:
 * a cut called consistent existed at one instant between the beginning and the end of the
 * attempt; its groups, and those of a cut that is merely called whole, are the ones that the
 * first looks named; and nobody waits for anybody.
 * One reader stands for many: readers write nothing but hints (head.pml), on which nothing
 * depends, so none can tell that others exist.
 *
 * Mutations: NO_WRITE_FENCE (R1), NO_RELEASE (R2), NO_ACQUIRE (R3), NO_CUT_FENCE (C3),
 * WHOLE_WILL_DO (no group need be unchanged), HALF_LOOK (the group looked at first need not),
 * LOOK_EACH (each register is looked at again before the next one is looked at).
 */
#ifndef COMMITS_P
#define COMMITS_P 3
#endif
#ifndef COMMITS_Q
#define COMMITS_Q 2
#endif
#define P 0
#define Q 1
#define LOCATIONS 10
#define CPUS 2
#define POOLS 2
#define POOL_OF(cpu) (cpu)
#define PERFORMED(at) if :: at >= HEAD(P) -> witness() :: else fi
#define HEAD(r) (8 + (r))
#define WORD(r, slot) ((r) * 4 + (slot))
#include "head.pml"

/* Ghost: which pairs of heads stood in memory together since the attempt began. */
int seen;
#define CUT(p, q) (1 << (NUMBER(p) * (COMMITS_Q + 1) + NUMBER(q)))
#define PAIR CUT(mem[HEAD(P)], mem[HEAD(Q)])
#define witness() if :: seen -> seen = seen | PAIR :: else fi

#include "weak.pml"

/* A killed writer is one that is scheduled no more: nobody waits for it. */
inline write_all(r, commits) {
    do
    :: NUMBER(last) < commits ->
        atomic {
            next = NEXT(last);
#ifndef NO_WRITE_FENCE
            release_fence(r); /* R1 */
#endif
            store(r, WORD(r, SLOT(next)), NUMBER(next))
        };
        atomic {
            if :: next = CROWDED(last, next) :: true fi;
#ifdef NO_RELEASE
            store(r, HEAD(r), next); /* R2 */
#else
            store_release(r, HEAD(r), next); /* R2 */
#endif
            last = next;
            next = 0
        }
    :: else -> break
    od;
    last = 0
}

active proctype WriterP() { short last, next; write_all(P, COMMITS_P) }
active proctype WriterQ() { short last, next; write_all(Q, COMMITS_Q) }

/* The loads of one attempt, and which of them each waits for. */
#define LOOK_P 1
#define LOOK_Q 2
#define COPY_P 4
#define COPY_Q 8
#define AGAIN_P 16
#define AGAIN_Q 32
#define ALL 63
#ifdef NO_ACQUIRE /* then looks are not ordered, and copies come from a guessed slot */
#define LOOK_Q_WAITS 0
#define COPY_P_WAITS 0
#define COPY_Q_WAITS 0
#else
#define LOOK_Q_WAITS LOOK_P
#define COPY_P_WAITS (LOOK_P | LOOK_Q)
#define COPY_Q_WAITS (LOOK_P | LOOK_Q)
#endif
#ifdef NO_CUT_FENCE
#define AGAIN_WAITS (LOOK_P | LOOK_Q)
#else
#define AGAIN_WAITS (LOOK_P | LOOK_Q | COPY_P | COPY_Q)
#endif
#ifdef LOOK_EACH
#undef LOOK_Q_WAITS
#undef COPY_P_WAITS
#define LOOK_Q_WAITS AGAIN_P
#define COPY_P_WAITS LOOK_P
#define AGAIN_P_WAITS (LOOK_P | COPY_P)
#else
#define AGAIN_P_WAITS AGAIN_WAITS
#endif
#define can(load, waits) !(done & (load)) && (done & (waits)) == (waits)
#define whole(r) WHOLE(head[r], again[r])
#define same(r) (again[r] == head[r])
#if defined(WHOLE_WILL_DO)
#define SAME (whole(P) && whole(Q))
#elif defined(HALF_LOOK)
#define SAME (whole(P) && same(Q))
#else /* q is looked at last: at the instant of that look both stand */
#define SAME (same(P) && whole(Q))
#endif

inline forget() {
    done = 0; seen = 0;
    head[P] = 0; again[P] = 0; slot[P] = 0; word[P] = 0;
    head[Q] = 0; again[Q] = 0; slot[Q] = 0; word[Q] = 0
}

inline look(r) {
    head[r] = mem[HEAD(r)];
#ifdef NO_ACQUIRE
    if :: slot[r] != SLOT(head[r]) -> goto wrong :: else fi /* guessed wrong */
#else
    slot[r] = SLOT(head[r])
#endif
}

#define copy(r) word[r] = mem[WORD(r, slot[r])]

active proctype Reader() {
    byte done, slot[2], word[2];
    short head[2], again[2];
#ifdef NO_ACQUIRE
    if :: slot[P] = 0 :: slot[P] = 1 :: slot[P] = 2 :: slot[P] = 3 fi;
    if :: slot[Q] = 0 :: slot[Q] = 1 :: slot[Q] = 2 :: slot[Q] = 3 fi;
#endif
    seen = PAIR;
    do
    :: atomic { can(LOOK_P, 0) -> look(P); done = done | LOOK_P }
    :: atomic { can(LOOK_Q, LOOK_Q_WAITS) -> look(Q); done = done | LOOK_Q }
    :: atomic { can(COPY_P, COPY_P_WAITS) -> copy(P); done = done | COPY_P }
    :: atomic { can(COPY_Q, COPY_Q_WAITS) -> copy(Q); done = done | COPY_Q }
    :: atomic { can(AGAIN_P, AGAIN_P_WAITS) -> again[P] = mem[HEAD(P)]; done = done | AGAIN_P }
    :: atomic { can(AGAIN_Q, AGAIN_WAITS) -> again[Q] = mem[HEAD(Q)]; done = done | AGAIN_Q }
    :: atomic { done == ALL ->
        if
        :: SAME -> assert(seen & CUT(head[P], head[Q]))
        :: else
        fi;
        if
        :: SAME || whole(P) && whole(Q) ->
            assert(word[P] == NUMBER(head[P]) && word[Q] == NUMBER(head[Q]))
        :: else
        fi;
        break }
    od;
#ifdef NO_ACQUIRE
wrong:
#endif
    atomic { forget() }
}
