/* Signals from a task to its master, counted so that none is lost.
 *
 * The task adds, the RTPU process reads and masks; neither waits. A counter is incremented
 * with one atomic addition, because a module may have threads of its own.
 */
#ifndef PBONET_SIGNALS_H
#define PBONET_SIGNALS_H

#include "layout.h"

/* Count the signals that are not masked, and return them. */
static inline uint32_t rt_send_signal(struct rt_slot *slot, uint32_t bits)
{
    struct rt_signals *s = &slot->signals;
    uint32_t wanted = bits & ~atomic_load_explicit(&s->mask, memory_order_relaxed);
    for (uint32_t left = wanted; left; left &= left - 1)
        /* SYNC POINT: rt_signal_count loads it with acquire. */
        atomic_fetch_add_explicit(&s->counts[__builtin_ctz(left)], 1,
                                  memory_order_release);
    return wanted;
}

static inline uint64_t rt_signal_count(const struct rt_slot *slot, int k)
{
    return atomic_load_explicit(&slot->signals.counts[k], memory_order_acquire);
}

static inline void rt_mask_signals(struct rt_slot *slot, uint32_t bits)
{
    atomic_store_explicit(&slot->signals.mask, bits, memory_order_relaxed);
}

static inline uint32_t rt_signal_mask(const struct rt_slot *slot)
{
    return atomic_load_explicit(&slot->signals.mask, memory_order_relaxed);
}

#endif
