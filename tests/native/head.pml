/* A register's head, as register.h packs it: number, last move, commits kept, slot.
 *
 * Whether readers are slow ("crowded") is a hint from them that nothing may depend on: the
 * models leave it open at every commit, and have no other trace of it.
 *
 * Mutations: KEEP_MORE (three commits promised), KEEP_AT_ONCE (two, from the first crowded
 * commit on), ONE_MOVE (to and fro whatever was promised), SAME_SLOT (over the published
 * commit), NO_SECOND_LOOK, LATE_LOOK (one commit more passes than was promised).
 */
#define NUMBER(head) ((head) >> 8)
#define MOVE(head) ((head) >> 4 & 3)
#define KEPT(head) ((head) >> 2 & 3)
#define SLOT(head) ((head) & 3)

#ifdef KEEP_MORE
#define MOST 3
#else
#define MOST 2
#endif
#ifdef KEEP_AT_ONCE
#define KEEP(head) MOST
#else
#define KEEP(head) (KEPT(head) < MOST -> KEPT(head) + 1 : MOST)
#endif
#if defined(ONE_MOVE)
#define NEXT_MOVE(head) 1
#elif defined(SAME_SLOT)
#define NEXT_MOVE(head) 0
#else
#define NEXT_MOVE(head) (KEPT(head) -> 3 - MOVE(head) : 1)
#endif
#define NEXT(head) \
    ((NUMBER(head) + 1) << 8 | NEXT_MOVE(head) << 4 | (SLOT(head) ^ NEXT_MOVE(head)))
#define CROWDED(last, next) ((next) | KEEP(last) << 2)

#if defined(NO_SECOND_LOOK)
#define WHOLE(head, again) true
#elif defined(LATE_LOOK)
#define WHOLE(head, again) (NUMBER(again) - NUMBER(head) <= KEPT(again) + 1)
#else
#define WHOLE(head, again) (NUMBER(again) - NUMBER(head) <= KEPT(again))
#endif
