/* Tickets: a successor stands by until all its predecessors have called; see standby.h.
 *
 * The caller is a task that has ended, on the successor's core or another one of the
 * machine, or the agent for tasks of other machines. The word of the callers holds the
 * ticket (which distinguishes this wait from others), whether one has called, and a bit for
 * each caller that has not. A call changes only that word: it takes no lock and never
 * waits, and a caller that is killed in it either has called or has not.
 */
#ifndef PBONET_CALL_H
#define PBONET_CALL_H

#include "layout.h"

#define RT_CALLED (UINT64_C(1) << 32)   /* one has ended and depends on the successor */

static inline uint32_t rt_ticket_of(uint64_t callers)
{
    return (uint32_t)(callers >> 33);
}

/* The word of a slot that waits for `n` callers, with a ticket from 1 to 2^31 - 1. */
static inline uint64_t rt_callers(uint32_t ticket, int n)
{
    return (uint64_t)ticket << 33 | ((UINT64_C(1) << n) - 1);
}

static inline int rt_one_has_called(const struct rt_config *c)
{
    return (atomic_load(&c->callers) & RT_CALLED) != 0;
}

static inline int rt_all_have_called(const struct rt_config *c, uint32_t ticket)
{
    return ticket && atomic_load(&c->callers) == ((uint64_t)ticket << 33 | RT_CALLED);
}

/* Whether a live task waits for that caller, with that ticket. */
static inline int rt_expects(const struct rt_config *c, uint64_t callers, uint32_t life,
                             uint32_t ticket, int caller)
{
    return atomic_load(&c->life) == life && atomic_load(&c->dead) != life &&
           ticket && rt_ticket_of(callers) == ticket && (callers >> caller & 1);
}

/* Record that a caller has ended; the successor's dispatcher sees it in its next turn.
 * Returns whether the successor waited for this caller and is alive. */
static inline int rt_call(struct rt_config *c, uint32_t life, uint32_t ticket, int caller)
{
    uint64_t callers = atomic_load(&c->callers);
    do
        if (!rt_expects(c, callers, life, ticket, caller))
            return 0;
    while (!atomic_compare_exchange_weak(&c->callers, &callers,
                                         (callers | RT_CALLED) & ~(UINT64_C(1) << caller)));
    /* SYNC POINT: rt_mourn marks the death first and then checks for a call. So either this
     * caller learns that the successor is dead, or the death raises the flag. */
    return atomic_load(&c->dead) != life && atomic_load(&c->life) == life;
}

#endif
