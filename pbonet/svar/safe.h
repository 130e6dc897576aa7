/* Safe values at a timing failure: one word decides which process commits.
 *
 * A task may declare that its out-vars get safe values as soon as a cycle fails in time.
 * The dispatcher commits them, whatever the task is doing; where it cannot, the task's
 * handler of the signal does. A register has one writer at a time, so these two and the
 * cycle's own commit exclude each other by `word`: the number of a cycle, and a phase.
 *
 *   CLOSED   no cycle, or it cannot commit: nothing is written for it
 *   OPEN     the cycle is under way (task: from CLOSED)
 *   COMMITS  the task commits the cycle's outputs (task: from OPEN)
 *   TAKEN    safe values are being committed (by the process that took it from OPEN)
 *   MADE_SAFE  they have been: the cycle's outputs are discarded (the same: from TAKEN)
 *
 * Each step away from OPEN is a compare-and-exchange, so one of them happens. A failure
 * that is found amid COMMITS is in `wanted`: the task reads it after it has closed the
 * cycle, and commits the safe values then. The dispatcher holds the table's lock from
 * before TAKEN until after MADE_SAFE: the register cannot be given to another task meanwhile,
 * and a task that finds TAKEN gets the lock when the dispatcher has finished or is dead.
 */
#ifndef PBONET_SAFE_H
#define PBONET_SAFE_H

#include "directory.h"

enum { PB_CLOSED, PB_OPEN, PB_COMMITS, PB_TAKEN, PB_MADE_SAFE };

/* Shared by a task and its dispatcher; zeros are valid. */
struct pb_safe {
    _Atomic uint64_t word;   /* number of the cycle << 3 | phase */
    _Atomic uint64_t wanted; /* of the cycle that failed last: its number; 0: none */
    _Atomic int64_t since_ns; /* when that was due: its deadline, or its reserve's end */
    _Atomic uint64_t uid;    /* the task's register ... */
    _Atomic uint32_t reg;    /* ... and its index */
    _Atomic uint32_t count;  /* safe commits, and their delays after `since_ns` */
    _Atomic int64_t last_ns, max_ns;
};

/* Begin cycle `number`, which commits to register `reg`. */
static inline void pb_safe_open(struct pb_safe *s, uint64_t number, uint32_t reg,
                                uint64_t uid) {
    atomic_store_explicit(&s->reg, reg, memory_order_relaxed);
    atomic_store_explicit(&s->uid, uid, memory_order_relaxed);
    /* SYNC POINT S1, partner S2: the taker of the cycle knows its register. Partner S5: a
     * failure that came before is seen by the task, which loads `wanted` after this. */
    atomic_store(&s->word, number << 3 | PB_OPEN);
}

/* Go from OPEN to `phase`; false if the cycle is no longer open. */
static inline bool pb_safe_take(struct pb_safe *s, uint64_t number, int phase) {
    uint64_t open = number << 3 | PB_OPEN;
    PBONET_STEP(40);
    /* SYNC POINT S2, partners S1 and S3: the last writer of the register has finished. */
    return atomic_compare_exchange_strong(&s->word, &open, number << 3 | (uint64_t)phase);
}

/* The safe values are published. */
static inline void pb_safe_done(struct pb_safe *s, uint64_t number, int64_t now_ns) {
    const int64_t since = atomic_load_explicit(&s->since_ns, memory_order_relaxed);
    const int64_t took = now_ns > since ? now_ns - since : 0;
    atomic_store_explicit(&s->last_ns, took, memory_order_relaxed);
    if (took > atomic_load_explicit(&s->max_ns, memory_order_relaxed))
        atomic_store_explicit(&s->max_ns, took, memory_order_relaxed);
    atomic_fetch_add_explicit(&s->count, 1, memory_order_relaxed);
    PBONET_STEP(41);
    /* SYNC POINT S3, partner S2 and the load in pb_safe_close. */
    atomic_store(&s->word, number << 3 | PB_MADE_SAFE);
}

/* End the cycle. Returns PB_CLOSED: its outputs stand; PB_MADE_SAFE: safe values do; PB_COMMITS:
 * the caller must commit safe values; PB_TAKEN: another process began to, see above. */
static inline int pb_safe_close(struct pb_safe *s, uint64_t number) {
    uint64_t word = atomic_load(&s->word);
    while ((word & 7) == PB_OPEN || (word & 7) == PB_COMMITS) {
        if (!atomic_compare_exchange_strong(&s->word, &word, number << 3 | PB_CLOSED))
            continue;
        PBONET_STEP(42);
        /* SYNC POINT S4, partner S5: a failure that found COMMITS is seen here. */
        return atomic_load(&s->wanted) == number ? PB_COMMITS : PB_CLOSED;
    }
    if ((word & 7) == PB_TAKEN) return PB_TAKEN;
    atomic_store(&s->word, number << 3 | PB_CLOSED);
    return PB_MADE_SAFE;
}

/* The cycle has failed. To be called before it is taken. */
static inline void pb_safe_want(struct pb_safe *s, uint64_t number, int64_t since_ns) {
    if (atomic_load_explicit(&s->wanted, memory_order_relaxed) == number) return;
    atomic_store_explicit(&s->since_ns, since_ns, memory_order_relaxed);
    atomic_store(&s->wanted, number); /* SYNC POINT S5, partners S4 and S1 */
}

/* The stamp of safe values: they are new, and belong to the last cycle that committed. */
static inline struct pb_stamp pb_safe_stamp(uint8_t *slots, uint64_t stride, uint64_t head,
                                            int64_t now_ns) {
    struct pb_stamp stamp;
    pb_copy(&stamp, pb_slot(slots, stride, head), sizeof stamp);
    return (struct pb_stamp){now_ns, stamp.cycle & ~PB_PASSED_ON};
}

/* Commit safe values for the cycle of another process, if that is open; never waits.
 * False: not committed here. */
static inline bool pb_safe_commit(const struct pb_table *t, struct pb_safe *s,
                                  uint64_t number, const void *data, uint64_t bytes) {
    const uint32_t r = atomic_load_explicit(&s->reg, memory_order_relaxed);
    bool done = false;
    int error;
    if ((atomic_load(&s->word) != (number << 3 | PB_OPEN)) || r >= t->fixed->n_regs ||
        !pb_guarded(t->live))
        return false;
    error = pthread_mutex_trylock(&t->live->lock);
    if (error == EOWNERDEAD) error = pthread_mutex_consistent(&t->live->lock);
    if (error) return false;
    {
        struct pb_reg *reg = t->regs + r;
        const struct pb_place at = pb_place_of(reg);
        const uint64_t head = pb_read_begin(&reg->head);
        /* One that is not held may have been given up: its slots are others' by then. */
        if (at.uid == atomic_load_explicit(&s->uid, memory_order_relaxed) &&
            atomic_load(&reg->state) == PB_HELD && pb_inside(t, &at) && bytes + PB_LINE <= at.stride && pb_is_head(head) &&
            pb_safe_take(s, number, PB_TAKEN)) {
            uint8_t *slots = t->base + at.slots;
            pb_commit_raw(reg, slots, at.stride, data, bytes,
                          pb_safe_stamp(slots, at.stride, head, pb_now()));
            pb_safe_done(s, number, pb_now());
            done = true;
        }
    }
    pb_unlock(t);
    return done;
}

#endif
