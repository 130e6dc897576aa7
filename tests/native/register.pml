/* register.h: one writer, killed anywhere, and readers that are killed anywhere.
 *
 * Each word of commit n holds n. Proved for COMMITS commits and READERS readers that read
 * READS times each: no torn and no wrong group passes the second look, no reader goes back
 * in time, and nobody waits for anybody (no end state in which a process stands still).
 *
 * Mutations: NO_WRITE_FENCE (R1), NO_RELEASE (R2), NO_ACQUIRE (R3), NO_READ_FENCE (R4),
 * NO_SECOND_LOOK, LATE_LOOK (a lap too many passes), THREE_SLOTS (same look), ONE_SLOT.
 */
#ifndef COMMITS
#define COMMITS 6
#endif
#ifndef READS
#define READS 1
#endif
#ifndef READERS
#define READERS 2
#endif
#define WORDS 2
#define LOCATIONS 9
#define CPUS 1
#define POOLS 1
#define POOL_OF(cpu) 0
#define PERFORMED(at) skip
#include "weak.pml"

#if defined(THREE_SLOTS)
#define SLOTS 3
#elif defined(ONE_SLOT)
#define SLOTS 1
#else
#define SLOTS 4
#endif
#define HEAD 8
#define WORD(seq, w) ((seq) % SLOTS * WORDS + (w))

#if defined(NO_SECOND_LOOK)
#define WHOLE(seq, again) true
#elif defined(LATE_LOOK)
#define WHOLE(seq, again) (again - seq < 4)
#elif defined(ONE_SLOT)
#define WHOLE(seq, again) (again == seq)
#else
#define WHOLE(seq, again) (again - seq < 3)
#endif

/* pb_write_begin, pb_copy_out, pb_write_end; any step may be the last. */
active proctype Writer() {
    byte seq = 1;
    do
    :: seq <= COMMITS ->
#ifndef NO_WRITE_FENCE
        release_fence(0); /* R1 */
#endif
        if :: store(0, WORD(seq, 0), seq) :: goto killed fi;
        if :: store(0, WORD(seq, 1), seq) :: goto killed fi;
#ifdef NO_RELEASE
        if :: store(0, HEAD, seq) :: goto killed fi; /* R2 */
#else
        if :: store_release(0, HEAD, seq) :: goto killed fi; /* R2 */
#endif
        seq++
    :: else -> break
    od;
killed:
    skip
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

inline forget() {
    done = 0; seq = 0; again = 0; slot = 0; word[0] = 0; word[1] = 0
}

active [READERS] proctype Reader() {
    byte reads, done, seq, again, newest, slot, word[WORDS];
    do
    :: reads < READS ->
#ifdef NO_ACQUIRE
        if :: slot = 0 :: slot = 1 :: slot = 2 :: slot = 3 fi;
#endif
        do
        :: atomic { can(LOOK, 0) -> seq = mem[HEAD]; done = done | LOOK;
#ifdef NO_ACQUIRE
            if :: slot != seq % SLOTS -> goto killed :: else fi /* guessed wrong */
#else
            slot = seq % SLOTS
#endif
           }
        :: atomic { can(COPY0, COPY_WAITS) -> word[0] = mem[WORD(slot, 0)]; done = done | COPY0 }
        :: atomic { can(COPY1, COPY_WAITS) -> word[1] = mem[WORD(slot, 1)]; done = done | COPY1 }
        :: atomic { can(AGAIN, AGAIN_WAITS) -> again = mem[HEAD]; done = done | AGAIN }
        :: done && done != ALL -> goto killed
        :: atomic { done == ALL ->
            assert(seq >= newest);
            newest = seq;
            if
            :: WHOLE(seq, again) -> assert(word[0] == seq && word[1] == seq)
            :: else
            fi;
            forget();
            reads++;
            break }
        od
    :: else -> break
    od;
killed:
    atomic { forget(); newest = 0; reads = 0 }
}
