/* register.h: one writer, killed anywhere, its successor, and readers.
 *
 * Proved for COMMITS commits and READERS readers that read READS times each: no torn and no
 * wrong group passes the second look, no reader goes back in time, and nobody waits for
 * anybody (no end state in which a process stands still).
 *
 * Mutations: NO_WRITE_FENCE (R1), NO_RELEASE (R2), NO_ACQUIRE (R3), NO_READ_FENCE (R4), and
 * those of head.pml.
 */
#ifndef COMMITS
#define COMMITS 5
#endif
#ifndef READS
#define READS 2
#endif
#ifndef READERS
#define READERS 1
#endif
#define WORDS 2
#define LOCATIONS 9
#define CPUS 1
#define POOLS 1
#define POOL_OF(cpu) 0
#define PERFORMED(at) skip
#include "weak.pml"

#include "head.pml"

#define HEAD 8
#define WORD(slot, w) ((slot) * WORDS + (w))

/* Ghost: who made commit n; its words hold n and that. */
byte by[COMMITS + 1];
#define VALUE(n, who) ((n) + 16 * (who))

/* pb_write_begin, pb_copy_out, pb_write_end. Once, at any step, the writer is killed; who
 * writes from then on (as the keeper's register, every lock holder may) begins anew. Later
 * deaths need no step: a dead writer is one that is scheduled no more. */
active proctype Writer() {
    short last, next;
    bool life;
again:
    do
    :: NUMBER(last) < COMMITS ->
        atomic {
            next = NEXT(last);
#ifndef NO_WRITE_FENCE
            release_fence(0) /* R1 */
#endif
        };
        if :: store(0, WORD(SLOT(next), 0), VALUE(NUMBER(next), life)) :: !life -> goto killed fi;
        if :: store(0, WORD(SLOT(next), 1), VALUE(NUMBER(next), life)) :: !life -> goto killed fi;
        if
        :: !life -> goto killed
        :: atomic {
            if :: next = CROWDED(last, next) :: true fi;
#ifdef NO_RELEASE
            store(0, HEAD, next); /* R2 */
#else
            store_release(0, HEAD, next); /* R2 */
#endif
            by[NUMBER(next)] = life;
            last = next;
            next = 0 }
        fi
    :: else -> goto end
    od;
killed:
    atomic { life = true; load(0, HEAD, last); next = 0; goto again };
end:
    atomic { last = 0; life = false }
}

/* The loads of one read, and which of them each waits for. */
#define LOOK 1
#define COPY0 2
#define COPY1 4
#define AGAIN 8
#ifdef NO_ACQUIRE /* then a copy may be made from a slot that is only guessed */
#define COPY_WAITS 0
#else
#define COPY_WAITS LOOK /* R3 */
#endif
#ifdef NO_READ_FENCE
#define AGAIN_WAITS LOOK /* loads of one location stay in order */
#else
#define AGAIN_WAITS (LOOK | COPY0 | COPY1) /* R4 */
#endif
#define ALL (LOOK | COPY0 | COPY1 | AGAIN)
#define can(load, waits) !(done & load) && (done & (waits)) == (waits)

#define RIGHT VALUE(NUMBER(head), by[NUMBER(head)])

inline forget() {
    done = 0; head = 0; again = 0; slot = 0; word[0] = 0; word[1] = 0
}

active [READERS] proctype Reader() {
    byte reads, done, newest, slot, word[WORDS];
    short head, again;
    do
    :: reads < READS ->
#ifdef NO_ACQUIRE
        if :: slot = 0 :: slot = 1 :: slot = 2 :: slot = 3 fi;
#endif
        do
        :: atomic { can(LOOK, 0) -> head = mem[HEAD]; done = done | LOOK;
#ifdef NO_ACQUIRE
            if :: slot != SLOT(head) -> goto wrong :: else fi /* guessed wrong */
#else
            slot = SLOT(head)
#endif
           }
        :: atomic { can(COPY0, COPY_WAITS) -> word[0] = mem[WORD(slot, 0)]; done = done | COPY0 }
        :: atomic { can(COPY1, COPY_WAITS) -> word[1] = mem[WORD(slot, 1)]; done = done | COPY1 }
        :: atomic { can(AGAIN, AGAIN_WAITS) -> again = mem[HEAD]; done = done | AGAIN }
        :: atomic { done == ALL ->
            assert(NUMBER(head) >= newest);
            newest = NUMBER(head);
            if
            :: WHOLE(head, again) -> assert(word[0] == RIGHT && word[1] == RIGHT)
            :: else
            fi;
            forget();
            reads++;
            break }
        od
    :: else -> break
    od;
#ifdef NO_ACQUIRE
wrong:
#endif
    atomic { forget(); newest = 0; reads = 0 }
}
