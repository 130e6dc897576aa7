/* A register: the newest whole value of a group of bytes, for one writer and any number
 * of readers in different processes, without a lock.
 *
 * Four slots stand side by side; commit number `seq` goes into slot seq % 4, and `head`
 * names the newest complete commit. The writer never waits. A writer that is killed
 * anywhere leaves `head` and the slot behind it alone. A reader copies the newest slot and
 * looks at `head` again: commit seq + 4 is the first that writes over slot seq % 4, and it
 * begins only after head == seq + 3 is stored. The whole argument stands in docs/svar.md.
 */
#ifndef PBONET_REGISTER_H
#define PBONET_REGISTER_H

#include <stdatomic.h>
#include <stdbool.h>
#include <stddef.h>
#include <stdint.h>
#include <string.h>

#ifndef PBONET_STEP /* a test build puts a hook between any two steps of a change */
#define PBONET_STEP(n) ((void)0)
#endif

enum { PB_SLOTS = 4, PB_LINE = 64 };

/* Stands in the line before the data of every slot. */
struct pb_stamp {
    int64_t time_ns; /* CLOCK_MONOTONIC; 0: never written */
    uint64_t cycle;
};

/* The one copy that may race: with the writer of a slot that is being lapped. The reader's
 * second look throws the result away, so exactly this function is exempt from the thread
 * sanitizer; its loop is the memcpy that the sanitizer cannot intercept. */
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

/* The same towards shared memory; a test build stops between any two words of it. */
static inline void pb_copy_out(void *to, const void *from, size_t bytes) {
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

/* Bytes from one slot to the next when a group has `bytes` bytes. */
static inline uint64_t pb_stride(uint64_t bytes) {
    return PB_LINE + pb_round(bytes, PB_LINE);
}

/* The slot of commit `seq`: its stamp; the data begin PB_LINE behind it. */
static inline uint8_t *pb_slot(uint8_t *slots, uint64_t stride, uint64_t seq) {
    return slots + seq % PB_SLOTS * stride;
}

/* Begin a commit; returns its number. Only the one writer calls this. */
static inline uint64_t pb_write_begin(const _Atomic uint64_t *head) {
    uint64_t seq = atomic_load_explicit(head, memory_order_relaxed) + 1;
    /* SYNC POINT R1, partner R4 in pb_read_end: whoever reads a byte that this commit
     * writes also sees the head stored before it, and so knows that it was lapped. */
    atomic_thread_fence(memory_order_release);
    PBONET_STEP(2);
    return seq;
}

/* Publish commit `seq`. */
static inline void pb_write_end(_Atomic uint64_t *head, uint64_t seq) {
    PBONET_STEP(3);
    /* SYNC POINT R2, partner R3 in pb_read_begin: whoever sees this head sees every byte
     * of the commit. */
    atomic_store_explicit(head, seq, memory_order_release);
    PBONET_STEP(4);
}

/* The number of the newest commit. */
static inline uint64_t pb_read_begin(const _Atomic uint64_t *head) {
    /* SYNC POINT R3, partner R2 in pb_write_end. */
    return atomic_load_explicit(head, memory_order_acquire);
}

/* To be called once between the copies and the second look. */
static inline void pb_read_fence(void) {
    /* SYNC POINT R4, partner R1 in pb_write_begin; the loads of pb_read_end follow. */
    atomic_thread_fence(memory_order_acquire);
}

/* The second look. */
static inline uint64_t pb_read_end(const _Atomic uint64_t *head) {
    /* SYNC POINT R4 (continued): ordered by the fence, so relaxed suffices. */
    return atomic_load_explicit(head, memory_order_relaxed);
}

/* Whether a copy of commit `seq` is whole when `head` was `again` after it. */
static inline bool pb_whole(uint64_t seq, uint64_t again) {
    return again - seq < PB_SLOTS - 1;
}

#endif
