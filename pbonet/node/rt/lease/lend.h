/* The dispatcher's side of a lease: the sole ready task of a core releases itself.
 *
 * While one cycle of a core is under way, or none, there is nothing to rank, and a release
 * needs no turn. So after a turn the dispatcher lends the tasks of its core their releases
 * of about RT_LEND_NS and sleeps until they have passed. Every task sleeps until its own
 * next release and takes it (take.h), and the core wakes up once a cycle instead of twice.
 *
 * One word stands for the core: the number of the lease, and the cycle under way. A task
 * takes a release by exchanging "none" for itself, so two cycles are never under way unless
 * a turn has ranked them. The timer of the dispatcher's checks (look.h) is set to the instant
 * at which ranks or limits could matter first: when another release comes before the cycle
 * has ended, or when the cycle would need a check. Every cycle that ends moves it. So a
 * task that hangs, dies or is stopped is found by the dispatcher.
 *
 * A turn, whatever its reason, first takes the number out of the word, and no task takes a
 * release then. How many a task has taken follows from numbers of grants: that in the word,
 * if it is the task's, otherwise that of its last cycle. The journaled state has the number
 * up to which a turn has read; so a new leader neither forgets nor counts twice.
 */
#ifndef PBONET_LEASE_LEND_H
#define PBONET_LEASE_LEND_H

#include "../watch.h"
#include "take.h"

#define RT_LEND_NS INT64_C(50000000)
#define RT_APART_NS INT64_C(100000)     /* a release nearer to the last one needs a turn */
#define RT_LENT_MAX 64                  /* releases of a lease */
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

/* The number of the last grant that the task of slot i has given itself. */
static inline uint32_t rt_last_taken(const struct rt_table *t, int i)
{
    /* SYNC POINT: rt_take stores the CPU time before it writes the word, and a cycle ends
     * before it is taken out of the word. */
    uint64_t cycle = rt_under_way(atomic_load(&t->lease));
    return cycle >> 32 == (uint64_t)i + 1 ? (uint32_t)cycle
                                          : atomic_load(&t->slots[i].post.done);
}

/* How many of them no turn has read. */
static inline uint32_t rt_news_taken(const struct rt_table *t, int i)
{
    const struct rt_state *s = &t->slots[i].state;
    int32_t news = (int32_t)(rt_last_taken(t, i) - s->seq);
    int same = atomic_load(&t->slots[i].config.life) == s->life;   /* else it counts from 0 */
    return same && s->kind == RT_PERIODIC && s->armed && news > 0 ? (uint32_t)news : 0;
}

/* Whether the word has a cycle of slot i that no turn has read. */
static inline int rt_runs_taken(const struct rt_table *t, int i)
{
    uint64_t cycle = rt_under_way(atomic_load(&t->lease));
    return cycle >> 32 == (uint64_t)i + 1 && rt_news_taken(t, i);
}

/* Another task has the slot: its grants have other numbers. */
static inline void rt_forget_taken(struct rt_table *t, int i)
{
    if (rt_under_way(atomic_load(&t->lease)) >> 32 == (uint64_t)i + 1)
        atomic_store(&t->lease, 0);
    atomic_store(&t->next_ns[i], 0);
}

/* Read which releases the task has taken since the last turn; an input. */
static inline void rt_latch_lease(struct rt_table *t, int i, struct rt_state *s)
{
    struct rt_slot *slot = &t->slots[i];
    uint32_t news = rt_news_taken(t, i), seq = s->seq + news;
    if (!news)
        return;
    int64_t release = s->next_ns + (news - 1) * s->period;
    int64_t clock = rt_limited(s) ? atomic_load(&slot->post.lease_cpu_ns[seq & 1]) : 0;
    rt_emit(t, RT_DONE, i, news, release, clock);
    rt_over(s);
    s->seq = seq;
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

/* Call the lease back. The cycle under way stays in the word until the next one. */
static inline void rt_recall(struct rt_table *t)
{
    atomic_fetch_and(&t->lease, RT_CYCLE);
}

/* Whether tasks of the core may release themselves. */
static inline int rt_is_lent(const struct rt_table *t)
{
    return rt_is_open(atomic_load(&t->lease));
}

/* Whether nothing about the state of a periodic task needs a turn. */
static inline int rt_is_plain(const struct rt_state *s)
{
    int odd = s->dead || s->late || s->spent || s->owed || s->handling || s->overrun || s->skip;
    /* A release off the grid, after a change of the period, leads back to it: rt_following. */
    return s->kind == RT_PERIODIC && (s->word & 3) == RT_ON && !odd && s->armed &&
           s->rank == s->crit && s->level > 0 && s->seq < RT_LEND_SEQ_MAX &&
           s->next_ns % s->period == 0;
}

/* Whether the task of slot i may release itself: it has run what was granted, or runs it,
 * and can move the timer of this leader's checks. */
static inline int rt_may_lend(const struct rt_table *t, int i)
{
    const struct rt_slot *slot = &t->slots[i];
    const struct rt_state *s = &slot->state;
    int runs = atomic_load(&slot->post.done) != s->seq;
    return rt_is_plain(s) && s->ready == s->granted && s->ready == runs &&
           atomic_load(&slot->post.meets) == atomic_load(&t->look_life);
}

/* The cycle under way, as in the word; 0: none; -1: there is no lease now. */
static inline int64_t rt_sole_cycle(const struct rt_table *t)
{
    int64_t cycle = 0;
    int high = (int)atomic_load(&t->high);
    for (int i = 0; i < high; i++) {
        const struct rt_state *s = &t->slots[i].state;
        if (!s->armed && !s->ready)
            continue;
        if (!rt_may_lend(t, i) || (s->ready && cycle))
            return -1;
        if (s->ready)
            cycle = (int64_t)rt_cycle(i, s->seq);
    }
    return cycle;
}

/* Until when there are leases: the first two releases that come nearly at once, or a release
 * after a while. `*first` is the next one. */
static inline int64_t rt_lent_until(const struct rt_table *t, int64_t cycle, int64_t *first)
{
    int64_t at[RT_SLOTS], horizon = 0, last = 0;
    int high = (int)atomic_load(&t->high);
    if (cycle)
        last = t->slots[(cycle >> 32) - 1].state.rel_ns;
    for (int i = 0; i < high; i++)
        at[i] = atomic_load_explicit(&t->next_ns[i], memory_order_relaxed);
    for (int n = 0;; n++) {
        int next = -1;
        for (int i = 0; i < high; i++)
            if (at[i] && (next < 0 || at[i] < at[next]))
                next = i;
        if (next < 0)
            return 0;
        if (!n) {
            *first = at[next];
            horizon = at[next] + RT_LEND_NS;
        }
        if (at[next] - last < RT_APART_NS || at[next] >= horizon || n == RT_LENT_MAX)
            return at[next] < horizon ? at[next] : horizon;
        last = at[next];
        at[next] += t->slots[next].state.period;
    }
}

/* Write what a task uses of its lease. */
static inline void rt_lend_to(struct rt_slot *slot)
{
    struct rt_grant *g = &slot->grant;
    const struct rt_state *s = &slot->state;
    int64_t length = s->deadline ? s->deadline : s->period;
    atomic_store_explicit(&g->lent_period_ns, s->period, memory_order_relaxed);
    atomic_store_explicit(&g->lent_length_ns, length, memory_order_relaxed);
    atomic_store_explicit(&g->lent_check_ns, rt_first_check(s), memory_order_relaxed);
    atomic_store_explicit(&g->lent_metered, (uint32_t)rt_limited(s), memory_order_relaxed);
    /* Of leases that follow one another without a grant: the task is never far ahead. */
    atomic_store_explicit(&g->seq, s->seq, memory_order_relaxed);
}

/* Write when each task of the core is released next: it sleeps until then. A task that woke up
 * amid the turn saw no lease, or ended its cycle before this, and sleeps until it is woken. So
 * unless its cycle is under way it is woken here. */
static inline void rt_publish_next(struct rt_table *t)
{
    int high = (int)atomic_load(&t->high);
    for (int i = 0; i < high; i++) {
        struct rt_slot *slot = &t->slots[i];
        const struct rt_state *s = &slot->state;
        int64_t next = s->armed && s->kind == RT_PERIODIC ? s->next_ns : 0;
        if (atomic_load_explicit(&t->next_ns[i], memory_order_relaxed) == next)
            continue;
        /* SYNC POINT: a cycle is marked as ended before its task loads the release, and the bell
         * is loaded before that: the task reads this release, or this sees the end and wakes it. */
        atomic_store(&t->next_ns[i], next);
        if (next && !(s->ready && atomic_load(&slot->post.done) != s->seq))
            rt_ring(slot);
    }
}

/* Open the word until `end`, with the cycle that is under way. */
static inline void rt_open(struct rt_table *t, uint64_t cycle, int64_t end)
{
    t->leases += (t->leases + 1) & RT_LEASES ? 1 : 2;   /* 0 means none */
    uint64_t number = (uint64_t)(t->leases & RT_LEASES) << 40, word = number | cycle;
    atomic_store(&t->lent_end_ns, end);
    atomic_store(&t->sure_ns, end);
    /* SYNC POINT: rt_take loads the word before it reads the rest. A cycle is marked as ended
     * before its task reads the word: the task sees the word, or this sees the end. */
    atomic_store(&t->lease, word);
    if (cycle && atomic_load(&t->slots[(cycle >> 32) - 1].post.done) == (uint32_t)cycle)
        atomic_compare_exchange_strong(&t->lease, &word, number);
}

/* After a turn whose next event is at `due`: lend the tasks their next releases, if at most
 * one cycle is under way. Returns when a check is needed, or else until when to sleep. */
static inline int64_t rt_lend(struct rt_table *t, int64_t due)
{
    rt_publish_next(t);
    int64_t first = 0, cycle = rt_sole_cycle(t);
    int64_t end = cycle < 0 ? 0 : rt_lent_until(t, cycle, &first);
    if (end <= first)
        return due;
    int high = (int)atomic_load(&t->high);
    for (int i = 0; i < high; i++)
        if (t->slots[i].state.armed)
            rt_lend_to(&t->slots[i]);
    rt_open(t, (uint64_t)cycle, end);
    /* SYNC POINT: a task whose release has come meanwhile may have seen no lease: rt_take. */
    if (rt_now() >= first)
        return first;
    int k;
    if (!cycle)
        due = rt_next_check(t, end, &k);
    return due && due < end ? due : end;
}

#endif
