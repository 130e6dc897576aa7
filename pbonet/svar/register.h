/* A register: the newest whole value of a group of bytes, for one writer and any number
 * of readers in different processes, without a lock.
 *
 * There are four slots. `head` names the newest complete commit: its number, its slot, and
 * how many commits before it are certain to stay whole until the next but one begins
 * ("kept"). The writer never waits. A writer that is killed at any point leaves `head` and
 * the slots that it covers unchanged. A reader copies the newest slot and loads `head`
 * again: its copy is whole if that is still the same commit, or if the commit was kept.
 *
 * If readers are slower than the writer ("crowded"), the writer uses all four slots in turn,
 * and two commits are kept. Otherwise it alternates between two, which stay in its cache;
 * then none is kept, and a reader that meets a commit copies again.
 * docs/svar.md gives the whole argument.
 */
#ifndef PBONET_REGISTER_H
#define PBONET_REGISTER_H

#include <stdatomic.h>
#include <stdbool.h>
#include <stddef.h>
#include <stdint.h>
#include <string.h>

#ifndef PBONET_STEP /* a test build inserts a hook between any two steps of a change */
#define PBONET_STEP(n) ((void)0)
#endif

enum { PB_SLOTS = 4, PB_LINE = 64, PB_STREAM = 16384 };

/* The line before the data of every slot. */
struct pb_stamp {
    int64_t time_ns; /* CLOCK_MONOTONIC; 0: never written */
    uint64_t cycle;  /* with PB_PASSED_ON: the time is that of older data */
};

#define PB_PASSED_ON (UINT64_C(1) << 63)

/* The one copy that may race, with the writer of a slot that is being overwritten. The
 * reader's second load discards the result, so exactly this function is exempt from the
 * thread sanitizer; its loop is a memcpy that the sanitizer cannot intercept. */
#if defined(__SANITIZE_THREAD__)
#define PB_TSAN 1
#elif defined(__has_feature)
#if __has_feature(thread_sanitizer)
#define PB_TSAN 1
#endif
#endif
#ifdef PB_TSAN
__attribute__((no_sanitize_thread, noinline, unused)) static void
pb_copy(void *to, const void *from, size_t bytes) {
    volatile uint8_t *out = to;
    const volatile uint8_t *in = from;
    while (bytes--) *out++ = *in++;
}
#else
static inline void pb_copy(void *to, const void *from, size_t bytes) {
    memcpy(to, from, bytes);
}
#endif

/* The same towards shared memory; a test build stops between any two words of it.
 * Blocks of PB_STREAM bytes or more may be copied by non-temporal stores, which bypass the
 * cache. On x86-64 those may also overtake earlier stores, the head among them: only a full
 * fence prevents that, and SYNC POINT R1 relies on it. The C library puts its own fence
 * after them. */
static inline void pb_copy_out(void *to, const void *from, size_t bytes) {
    if (bytes >= PB_STREAM) atomic_thread_fence(memory_order_seq_cst);
#ifdef PBONET_STEP_WORDS
    size_t done = 0;
    for (; done < bytes; done += 8) {
        pb_copy((uint8_t *)to + done, (const uint8_t *)from + done,
                bytes - done < 8 ? bytes - done : 8);
        PBONET_STEP(1);
    }
#else
    pb_copy(to, from, bytes);
#endif
}

static inline uint64_t pb_round(uint64_t bytes, uint64_t unit) {
    return (bytes + unit - 1) / unit * unit;
}

/* Distance in bytes between slots for a group of `bytes` bytes. */
static inline uint64_t pb_stride(uint64_t bytes) {
    return PB_LINE + pb_round(bytes, PB_LINE);
}

/* A head: number << 8 | last move << 4 | kept << 2 | slot; a move is what the slot's number
 * is xored with, 1 or 2. */
static inline uint64_t pb_number(uint64_t head) { return head >> 8; }
static inline uint64_t pb_kept(uint64_t head) { return head >> 2 & 3; }

/* The slot that a head names: its stamp; the data begin PB_LINE bytes later. */
static inline uint8_t *pb_slot(uint8_t *slots, uint64_t stride, uint64_t head) {
    return slots + head % PB_SLOTS * stride;
}

/* The head as its only writer stored it. */
static inline uint64_t pb_write_last(const _Atomic uint64_t *head) {
    return atomic_load_explicit(head, memory_order_relaxed);
}

/* Begin a commit; returns its head without `kept`. Only the one writer calls this. The slot
 * is one that the current head does not cover: moves 1, 2, 1, 2 ... visit all four slots,
 * moves 1, 1, 1 ... only two. */
static inline uint64_t pb_write_begin(const _Atomic uint64_t *head) {
    uint64_t last = pb_write_last(head);
    uint64_t move = pb_kept(last) ? 3 - (last >> 4 & 3) : 1;
    /* SYNC POINT R1, partner R4 in pb_read_fence: a reader of a byte that this commit
     * writes also sees the head stored before it, which does not cover that slot. */
    atomic_thread_fence(memory_order_release);
    PBONET_STEP(2);
    return (pb_number(last) + 1) << 8 | move << 4 | ((last ^ move) & 3);
}

/* Publish a commit. With `crowded` one more commit than before is kept, at most two. */
static inline void pb_write_end(_Atomic uint64_t *head, uint64_t next, bool crowded) {
    uint64_t kept = crowded ? pb_kept(pb_write_last(head)) + 1 : 0;
    PBONET_STEP(3);
    /* SYNC POINT R2, partner R3 in pb_read_begin: a reader that sees this head sees every
     * byte of the commit. */
    atomic_store_explicit(head, next | (kept < 2 ? kept : 2) << 2, memory_order_release);
    PBONET_STEP(4);
}

/* The head of the newest commit. */
static inline uint64_t pb_read_begin(const _Atomic uint64_t *head) {
    /* SYNC POINT R3, partner R2 in pb_write_end. */
    return atomic_load_explicit(head, memory_order_acquire);
}

/* To be called once between the copies and the second load. */
static inline void pb_read_fence(void) {
    /* SYNC POINT R4, partner R1 in pb_write_begin; the loads of pb_read_end follow. */
    atomic_thread_fence(memory_order_acquire);
}

/* The second load of the head. */
static inline uint64_t pb_read_end(const _Atomic uint64_t *head) {
    /* SYNC POINT R4 (continued): ordered by the fence, so relaxed suffices. */
    return atomic_load_explicit(head, memory_order_relaxed);
}

/* Whether a copy made under `head` is whole when the second load returned `again`. */
static inline bool pb_whole(uint64_t head, uint64_t again) {
    return pb_number(again) - pb_number(head) <= pb_kept(again);
}

#endif
