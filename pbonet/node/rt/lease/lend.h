/* The dispatcher's side of a lease: a task that is alone on its core releases itself.
 *
 * While no other slot of the core is armed, there is nothing to rank, and a release needs no
 * turn. So in the turn that grants the task a cycle, the dispatcher lends it the releases of
 * the next RT_LEND_NS and sleeps until they have passed. The task sleeps on a timer of its
 * own, takes each release when it is due (take.h), and the core wakes up once a cycle
 * instead of twice.
 *
 * What could fail is still watched. A task with a failure handler or a reserve is checked to
 * the instant: the timer of the dispatcher's checks (look.h) is set to the time at which the
 * cycle under way would first need one, and the task sets it further when that cycle has
 * ended. A task that hangs, dies or is stopped does not, so the dispatcher looks. Moving
 * that timer costs a third of a cycle on a virtual machine, so any other task is checked when
 * a cycle ends after its deadline, which wakes the dispatcher before it counts as ended, or
 * when the lease ends: no other task waits for the core.
 *
 * Every turn, whatever its reason, first reads how many releases were taken and calls the
 * rest back. The word of the lease has a number, so a task that a turn has interrupted
 * cannot take a release of an old one. `taken` is part of the journaled state: a new leader
 * neither forgets nor counts twice what was taken under the last one.
 */
#ifndef PBONET_LEASE_LEND_H
#define PBONET_LEASE_LEND_H

#include "../watch.h"

#define RT_LEND_NS INT64_C(50000000)
#define RT_LEND_SEQ_MAX (UINT32_MAX - UINT32_C(1000000))  /* no lease passes over 0 */

/* When a cycle needs a check at the earliest, counted from its release; 0: none to the
 * instant. */
static inline int64_t rt_first_check(const struct rt_state *s)
{
    if (!s->tells && !rt_limited(s))
        return 0;
    int64_t length = s->deadline ? s->deadline : s->period;
    int64_t first = length < s->period ? length : s->period;
    if (s->maxc && s->maxc < first)
        first = s->maxc;
    if (s->minc && length - s->minc + 1 < first)
        first = length - s->minc + 1;
    return first > RT_MARGIN_NS ? first : RT_MARGIN_NS;
}

/* Read how many releases the task has taken, and whose cycle it runs; an input. */
static inline void rt_latch_lease(struct rt_table *t, int i, struct rt_state *s)
{
    struct rt_slot *slot = &t->slots[i];
    /* SYNC POINT: rt_take stores the CPU time before it counts the release. */
    uint32_t taken = (uint32_t)atomic_load_explicit(&slot->grant.lease, memory_order_acquire);
    uint32_t news = taken - s->taken;
    if (!taken || !news)
        return;
    int64_t release = s->next_ns + (news - 1) * s->period;
    int64_t clock = rt_limited(s) ? atomic_load(&slot->post.lease_cpu_ns[taken & 1]) : 0;
    rt_emit(t, RT_DONE, i, news, release, clock);
    rt_over(s);
    s->taken = taken;
    s->seq += news;
    s->ready = s->granted = s->begun = 1;
    s->rel_ns = release;
    s->dl_ns = release + (s->deadline ? s->deadline : s->period);
    s->next_ns = release + s->period;
    s->late = s->sure = 0;
    s->fresh = rt_limited(s);
    if (clock > s->clock)
        s->clock = clock;
    s->mark = s->clock;
    atomic_fetch_add_explicit(&t->releases, news, memory_order_relaxed);
}

/* Call the lease back; 0 if a release was taken that the state does not have yet. */
static inline int rt_recall(struct rt_slot *slot)
{
    uint64_t lease = atomic_load(&slot->grant.lease);
    if (!lease)
        return 1;
    uint32_t taken = (uint32_t)lease;
    return (!taken || taken == slot->state.taken) &&
           atomic_compare_exchange_strong(&slot->grant.lease, &lease, 0);
}

/* Whether the task of slot i may release itself, if it is alone: it runs a cycle in which
 * nothing has failed, and can move the timer of this leader's checks. */
static inline int rt_may_lend(const struct rt_table *t, int i)
{
    const struct rt_slot *slot = &t->slots[i];
    const struct rt_state *s = &slot->state;
    return s->kind == RT_PERIODIC && (s->word & 3) == RT_ON && s->granted && !s->dead &&
           !s->late && !s->spent && !s->owed && !s->handling && !s->overrun && !s->skip &&
           s->rank == s->crit && s->seq < RT_LEND_SEQ_MAX &&
           atomic_load(&slot->post.done) != s->seq &&
           atomic_load(&slot->post.meets) == atomic_load(&t->look_life);
}

/* The only slot whose task is armed or engaged; -1: none, or several. */
static inline int rt_alone(const struct rt_table *t)
{
    int alone = -1, high = (int)atomic_load(&t->high);
    for (int i = 0; i < high; i++) {
        const struct rt_state *s = &t->slots[i].state;
        if (!s->armed && !s->ready)
            continue;
        if (alone >= 0)
            return -1;
        alone = i;
    }
    return alone;
}

/* Whether a task has a lease. */
static inline int rt_is_lent(const struct rt_table *t)
{
    int i = rt_alone(t);
    return i >= 0 && atomic_load(&t->slots[i].grant.lease) != 0;
}

/* After a turn: lend the lone task its next releases, and sleep until they have passed. */
static inline void rt_lend(struct rt_table *t)
{
    int i = rt_alone(t);
    if (i < 0 || !rt_may_lend(t, i))
        return;
    struct rt_grant *g = &t->slots[i].grant;
    struct rt_state *s = &t->slots[i].state;
    int64_t end = s->next_ns + RT_LEND_NS / s->period * s->period;
    if (end == s->next_ns)
        return;
    s->taken = 0;               /* one word, and there is no lease now: needs no journal */
    s->leases++;
    atomic_store_explicit(&g->lent_ns, s->next_ns, memory_order_relaxed);
    atomic_store_explicit(&g->lent_end_ns, end, memory_order_relaxed);
    atomic_store_explicit(&g->lent_period_ns, s->period, memory_order_relaxed);
    atomic_store_explicit(&g->lent_length_ns, s->deadline ? s->deadline : s->period,
                          memory_order_relaxed);
    atomic_store_explicit(&g->lent_check_ns, rt_first_check(s), memory_order_relaxed);
    atomic_store_explicit(&g->lent_metered, (uint32_t)rt_limited(s), memory_order_relaxed);
    atomic_store_explicit(&g->lent_seq, s->seq, memory_order_relaxed);
    /* Of leases that follow one another without a grant: the task is never far ahead. */
    atomic_store_explicit(&g->seq, s->seq, memory_order_relaxed);
    /* SYNC POINT: rt_take loads the lease with acquire before it reads the rest. */
    atomic_store(&g->lease, (uint64_t)(s->leases | 1u << 31) << 32);
    atomic_store(&t->sure_ns, end);
}

#endif
