/* The line of waiters for an object: highest priority first, then first come.
 *
 * Nothing is ever handed to a waiter. It is called, and then takes for itself; until then
 * the object keeps what the waiter was called for, reserved for as many as are called. So a
 * waiter that dies, called or not, takes nothing with it: the next check of the line counts
 * again. Every thread that leaves or joins makes that check, and every sleeper once in
 * XM_PATROL_NS.
 */
#ifndef PBONET_XM_LINE_H
#define PBONET_XM_LINE_H

#include "object.h"

#include <linux/futex.h>
#include <limits.h>
#include <sys/syscall.h>

#define XM_PATROL_NS INT64_C(50000000)

struct xm_tally {
    uint32_t waiting, called;
    struct xm_slot *best;
};

static inline uint32_t xm_state(const struct xm_slot *slot)
{
    return atomic_load(&slot->state);
}

static inline bool xm_before(const struct xm_slot *a, const struct xm_slot *b)
{
    return a->priority != b->priority ? a->priority > b->priority : a->ticket < b->ticket;
}

/* Count the waiters of one role and find the first; the caller holds the lock. */
static inline struct xm_tally xm_tally(struct xm_object *o, uint32_t role)
{
    struct xm_tally t = {0, 0, NULL};
    for (uint32_t i = 0; i < atomic_load(&o->high) && i < XM_SLOTS; i++) {
        struct xm_slot *slot = o->slots + i;
        uint32_t state = xm_state(slot);
        if (slot->role != role)
            continue;
        t.called += state == XM_CALLED;
        t.waiting += state == XM_WAITING;
        if (state == XM_WAITING && (!t.best || xm_before(slot, t.best)))
            t.best = slot;
    }
    return t;
}

/* The number of waiters in the line, of all roles; needs no lock. */
static inline uint32_t xm_waiting(const struct xm_object *o)
{
    uint32_t n = 0;
    for (uint32_t i = 0; i < atomic_load(&o->high) && i < XM_SLOTS; i++)
        n += xm_state(o->slots + i) == XM_WAITING || xm_state(o->slots + i) == XM_CALLED;
    return n;
}

/* Free the slots of waiters that left; returns whether any is in use. Under the lock. */
static inline bool xm_sweep(struct xm_object *o)
{
    uint32_t high = 0;
    for (uint32_t i = 0; i < atomic_load(&o->high) && i < XM_SLOTS; i++) {
        if (xm_state(o->slots + i) == XM_LEFT)
            atomic_store(&o->slots[i].state, XM_FREE);
        if (xm_state(o->slots + i) != XM_FREE)
            high = i + 1;
    }
    PBONET_STEP(34);
    atomic_store(&o->high, high);
    return high;
}

/* SYNC POINT X3, partner X4 in xm_sleep: the called thread sees the caller's changes. */
static inline void xm_call(struct xm_slot *slot)
{
    uint32_t state = XM_WAITING;
    PBONET_STEP(35);
    if (!atomic_compare_exchange_strong(&slot->state, &state, XM_CALLED))
        return;
    PBONET_STEP(36);
    syscall(SYS_futex, (uint32_t *)&slot->state, FUTEX_WAKE, INT_MAX, NULL, NULL, 0);
}

/* Refuse all operations from now on; sleepers are woken to find out.
 * SYNC POINT X2, partner X1 in xm_destroyed. */
static inline void xm_destroy(struct xm_object *o)
{
    atomic_store_explicit(&o->destroyed, 1, memory_order_release);
    for (uint32_t i = 0; i < XM_SLOTS; i++)
        xm_call(o->slots + i);
}

/* Join the line; under the lock. Returns the slot's index or XM_CROWDED. */
static inline int xm_queue_up(struct xm_object *o, uint32_t me, uint32_t role,
                              int32_t priority, uint32_t need)
{
    int i = 0;
    while (i < XM_SLOTS && xm_state(o->slots + i) != XM_FREE)
        i++;
    if (i == XM_SLOTS)
        return XM_CROWDED;
    struct xm_slot *slot = o->slots + i;
    slot->priority = priority;
    slot->role = role;
    slot->need = need;
    slot->ticket = ++o->tickets;
    atomic_store(&slot->member, me);
    PBONET_STEP(37);
    if (atomic_load(&o->high) <= (uint32_t)i)
        atomic_store(&o->high, (uint32_t)i + 1);
    PBONET_STEP(38);
    atomic_store(&slot->state, XM_WAITING);
    PBONET_STEP(39);
    return i;
}

/* Sleep until called, for at most one patrol interval. Returns 0 (called), XM_SIGNAL,
 * XM_TIMED_OUT (CLOCK_MONOTONIC `until` has passed) or XM_AGAIN (patrol, and go on). */
static inline int xm_sleep(struct xm_slot *slot, int64_t until)
{
    int64_t slice = pb_now() + XM_PATROL_NS;
    int64_t stop = until != XM_FOREVER && until < slice ? until : slice;
    struct timespec at = {.tv_sec = stop / 1000000000, .tv_nsec = stop % 1000000000};
    long slept = 0;
    PBONET_STEP(40);
    if (stop > 0)
        slept = syscall(SYS_futex, (uint32_t *)&slot->state, FUTEX_WAIT_BITSET, XM_WAITING,
                        &at, NULL, FUTEX_BITSET_MATCH_ANY);
    int error = slept ? errno : 0;
    /* SYNC POINT X4, partner X3: what was done before the call is visible. */
    if (atomic_load_explicit(&slot->state, memory_order_acquire) != XM_WAITING)
        return 0;
    if (error == EINTR)
        return XM_SIGNAL;
    return until != XM_FOREVER && pb_now() >= until ? XM_TIMED_OUT : XM_AGAIN;
}

/* Free the slots of a member that has ended; under the lock. */
static inline void xm_forget(struct xm_object *o, uint32_t m)
{
    for (uint32_t i = 0; i < XM_SLOTS; i++)
        if (xm_state(o->slots + i) != XM_FREE && atomic_load(&o->slots[i].member) == m)
            atomic_store(&o->slots[i].state, XM_FREE);
}

/* A member that has ended and is still in the line, or XM_NONE; needs no lock. */
static inline int xm_dead_in_line(const struct xm_object *o, uint32_t me)
{
    for (uint32_t i = 0; i < atomic_load(&o->high) && i < XM_SLOTS; i++) {
        uint32_t m = atomic_load(&o->slots[i].member);
        if (m != me && xm_state(o->slots + i) != XM_FREE && xm_dead(o, m))
            return (int)m;
    }
    return XM_NONE;
}

#endif
