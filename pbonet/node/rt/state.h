/* A slot's state and how it changes: trace records and whole replacements. */
#ifndef PBONET_STATE_H
#define PBONET_STATE_H

#include "layout.h"

#include <string.h>

static inline void rt_emit(struct rt_table *t, int kind, int slot, uint32_t arg, int64_t a,
                           int64_t b)
{
    t->trace[t->trace_next++ & (RT_TRACE - 1)] = (struct rt_event){
        .a = a, .b = b, .arg = arg, .slot = (uint16_t)slot, .kind = (uint16_t)kind};
}

/* Copy the parts of a slot's state that others read to where they read them. */
static inline void rt_show(struct rt_grant *g, const struct rt_state *s)
{
    atomic_store_explicit(&g->missed, s->missed, memory_order_relaxed);
    atomic_store_explicit(&g->level, s->level > 0 ? s->level : 0, memory_order_relaxed);
    atomic_store_explicit(&g->life, s->life, memory_order_relaxed);
    atomic_store_explicit(&g->fell, s->fell, memory_order_relaxed);
    atomic_store_explicit(&g->flooded, s->flooded, memory_order_relaxed);
    atomic_store_explicit(&g->hung, s->overrun == RT_HUNG, memory_order_relaxed);
    atomic_store_explicit(&g->crit, s->rank, memory_order_relaxed);
    for (int k = 0; k < RT_FAILURES; k++)
        atomic_store_explicit(&g->failures[k], s->failures[k], memory_order_relaxed);
    atomic_store_explicit(&g->overruns, s->overruns, memory_order_relaxed);
    atomic_store_explicit(&g->held_off, s->held_off, memory_order_relaxed);
}

/* Replace a slot's state so that a kill at any point leaves the old or the new one. */
static inline void rt_commit(struct rt_table *t, int i, const struct rt_state *next)
{
    t->journal = *next;
    t->journal_slot = (uint32_t)i;
    /* SYNC POINT: rt_recover reads the journal only if this is 1. */
    atomic_store_explicit(&t->journal_valid, 1, memory_order_release);
    atomic_signal_fence(memory_order_seq_cst);
    t->slots[i].state = *next;
    atomic_store_explicit(&t->journal_valid, 0, memory_order_release);
    rt_show(&t->slots[i].grant, next);
}

/* The criticality of the task when its handler is not counted. */
static inline int32_t rt_contained(const struct rt_state *s)
{
    return s->spent && !s->owed && s->drop < s->crit ? s->drop : s->crit;
}

static inline void rt_disarm(struct rt_state *s)
{
    s->armed = s->ready = s->granted = s->begun = s->parked = 0;
    s->spent = s->late = s->sure = s->skip = s->handling = s->owed = 0;
    s->fresh = s->active = s->n_pieces = s->engaged = 0;
    s->overrun = s->flooded = 0;
    s->early = 0;
    s->level = 0;
    s->rank = s->crit;
    s->next_ns = s->check_ns = s->wait_ns = 0;
}

/* End the cycle, and with it what was watched about it. */
static inline void rt_over(struct rt_state *s)
{
    s->ready = s->granted = s->begun = s->parked = 0;
    s->skip = s->handling = s->owed = 0;
    s->overrun = 0;
    s->check_ns = 0;
}

#endif
