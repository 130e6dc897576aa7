/* The illegal-configuration flag (thesis, section 3.10): a set of causes, up while any of
 * them stands. Looking at it is one load; changing it takes the lock. */
#ifndef PBONET_FLAG_H
#define PBONET_FLAG_H

#include "directory.h"

static inline uint64_t pb_illegal(const struct pb_table *t) {
    /* SYNC POINT F1, partner F2: who sees the bit sees the cause behind it. */
    return atomic_load_explicit(&t->live->illegal, memory_order_acquire);
}

static inline bool pb_same(const struct pb_cause *a, const struct pb_cause *b) {
    return !strncmp(a->cause, b->cause, PB_TEXT) && !strncmp(a->raiser, b->raiser, PB_NAME) &&
           !strncmp(a->machine, b->machine, PB_NAME);
}

/* Add a cause; adding it again changes nothing. PB_FULL when PB_CAUSES others stand. */
static inline int pb_raise(const struct pb_table *t, const struct pb_cause *cause) {
    uint64_t up;
    int free = -1;
    if (pb_lock(t->live)) return PB_STUCK;
    up = pb_illegal(t);
    for (int i = PB_CAUSES - 1; i >= 0; i--) {
        if (!(up >> i & 1)) {
            free = i;
        } else if (pb_same(t->live->causes + i, cause)) {
            pb_unlock(t->live);
            return 0;
        }
    }
    if (free >= 0) {
        pb_copy_out(t->live->causes + free, cause, sizeof *cause);
        PBONET_STEP(10);
        /* SYNC POINT F2, partner F1. */
        atomic_fetch_or_explicit(&t->live->illegal, UINT64_C(1) << free, memory_order_release);
    }
    pb_unlock(t->live);
    return free < 0 ? PB_FULL : 0;
}

/* Take away what `raiser` raised on `machine`, all of it or only one cause; an empty text
 * stands for all. Returns how many causes went. */
static inline int pb_clear(const struct pb_table *t, const struct pb_cause *which) {
    int count = 0;
    uint64_t up;
    if (pb_lock(t->live)) return PB_STUCK;
    up = pb_illegal(t);
    for (int i = 0; i < PB_CAUSES; i++) {
        const struct pb_cause *c = t->live->causes + i;
        if (!(up >> i & 1) || strncmp(c->raiser, which->raiser, PB_NAME)) continue;
        if (*which->machine && strncmp(c->machine, which->machine, PB_NAME)) continue;
        if (*which->cause && strncmp(c->cause, which->cause, PB_TEXT)) continue;
        /* SYNC POINT F3, partner F1: what was put right is seen by who sees the flag down. */
        atomic_fetch_and_explicit(&t->live->illegal, ~(UINT64_C(1) << i), memory_order_release);
        count++;
    }
    pb_unlock(t->live);
    return count;
}

static inline struct pb_cause pb_cause_of(const char *cause, const char *raiser,
                                          const char *machine) {
    struct pb_cause c = {.time_ns = pb_now()};
    snprintf(c.cause, sizeof c.cause, "%s", cause);
    snprintf(c.raiser, sizeof c.raiser, "%s", raiser);
    snprintf(c.machine, sizeof c.machine, "%s", machine);
    return c;
}

/* Copy a cause that stands; false when it does not (any more). */
static inline bool pb_cause_at(const struct pb_table *t, int i, struct pb_cause *cause) {
    if (pb_lock(t->live)) return false;
    *cause = t->live->causes[i];
    pb_unlock(t->live);
    return pb_illegal(t) >> i & 1;
}

#endif
