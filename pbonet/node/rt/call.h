/* Heirs that wait for tasks of other cores, which call them; see standby.h. */
#ifndef PBONET_CALL_H
#define PBONET_CALL_H

#include "table.h"

/* Have an heir wait for tasks of other cores, each of which calls when it has ended; a
 * ticket tells this wait from others. Until the last call nothing engages the heir. */
static inline void rt_expect(struct rt_table *t, int i, uint32_t ticket, uint32_t callers)
{
    static const uint64_t nobody[RT_MASKS];
    rt_follow(t, i, RT_ALONE, nobody);
    rt_edit_lock(t);
    atomic_store(&t->slots[i].config.callers, (uint64_t)ticket << 32 | callers);
    pthread_mutex_unlock(&t->edit);
}

/* Whether a task that lives waits there for that caller, with that ticket. */
static inline int rt_expects(const struct rt_table *t, int i, uint32_t life,
                             uint32_t ticket, int caller)
{
    const struct rt_config *c = &t->slots[i].config;
    uint64_t callers = atomic_load(&c->callers);
    return atomic_load(&c->life) == life && atomic_load(&c->dead) != life &&
           callers >> 32 == ticket && (callers >> caller & 1);
}

/* Say to an heir of another core that the caller has ended; behind the last of them it
 * comes after nobody any more, so the next turn of its dispatcher engages it. A caller
 * that is killed in here has not called, or the heir's config is whole again by the next
 * edit. Returns whether the heir waited for it, and lives. */
static inline int rt_call(struct rt_table *t, int i, uint32_t life, uint32_t ticket,
                          int caller)
{
    struct rt_config *c = &t->slots[i].config;
    rt_edit_lock(t);
    int awaited = rt_expects(t, i, life, ticket, caller);
    if (awaited) {
        /* SYNC POINT: rt_mourn marks the death first and looks at `called` then. So either
         * this caller is told that nobody comes, or the death raises the flag. */
        atomic_store(&c->called, 1);
        awaited = atomic_load(&c->dead) != life;
    }
    uint64_t left = atomic_load(&c->callers) & ~(UINT64_C(1) << caller);
    if (awaited && !(uint32_t)left) {
        uint32_t gen = rt_config_begin(c);
        atomic_store_explicit(&c->after_kind, RT_HANDOVER, memory_order_relaxed);
        rt_config_end(c, gen);
    }
    if (awaited)
        atomic_store(&c->callers, left);
    pthread_mutex_unlock(&t->edit);
    if (awaited)
        rt_kick(t);
    return awaited;
}

#endif
