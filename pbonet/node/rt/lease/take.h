/* The task's side of a lease; lend.h explains it. */
#ifndef PBONET_LEASE_TAKE_H
#define PBONET_LEASE_TAKE_H

#include "../look.h"

#define RT_CYCLE ((UINT64_C(1) << 40) - 1)  /* in the word: slot + 1 and grant, or none */
#define RT_LEASES ((UINT32_C(1) << 24) - 1) /* numbers of leases */

static inline int rt_is_open(uint64_t lease)
{
    return lease >> 40 != 0;
}

/* The cycle under way, as in the word; 0: none. */
static inline uint64_t rt_under_way(uint64_t lease)
{
    return lease & RT_CYCLE;
}

static inline uint64_t rt_cycle(int i, uint32_t seq)
{
    return (uint64_t)(i + 1) << 32 | seq;
}

/* When ranks or limits could matter first, if no cycle is under way: at the second of the
 * next releases, or at the first check of the cycle that begins with the first one, whose
 * slot is `*first`; 0: not before the lease ends. */
static inline int64_t rt_next_check(const struct rt_table *t, int64_t end, int *first)
{
    int64_t release = RT_NEVER, at = RT_NEVER, check;
    int high = (int)atomic_load(&t->high);
    *first = -1;
    for (int i = 0; i < high; i++) {
        int64_t next = atomic_load_explicit(&t->next_ns[i], memory_order_relaxed);
        if (!next || next >= at)
            continue;
        if (next < release) {
            at = release;
            release = next;
            *first = i;
        } else {
            at = next;
        }
    }
    if (*first < 0)
        return 0;
    check = atomic_load_explicit(&t->slots[*first].grant.lent_check_ns, memory_order_relaxed);
    if (check && release + check < at)
        at = release + check;
    return release < end && at < end ? at : 0;
}

/* Have the dispatcher take a turn, whose task has slept through a release. */
static inline void rt_overslept(struct rt_table *t, int64_t release)
{
    atomic_store(&t->looked_ns, release);       /* the core may have stood still */
    rt_kick(t);
}

/* Whether the task of slot i may take a release that is due. If it may not because another
 * task's cycle is under way, the dispatcher has to rank the two. */
static inline int rt_may_take(struct rt_table *t, int i, uint64_t lease, int64_t release)
{
    const struct rt_slot *slot = &t->slots[i];
    uint64_t cycle = rt_under_way(lease);
    if (!rt_is_open(lease) || release >= atomic_load(&t->lent_end_ns))
        return 0;               /* it is the dispatcher's */
    if ((atomic_load_explicit(&slot->post.word, memory_order_relaxed) & 3) != RT_ON)
        return 0;               /* and no dispatcher has seen it go OFF */
    if (cycle && cycle >> 32 != (uint64_t)i + 1)
        rt_kick(t);
    return !cycle;
}

/* Take the release that is due: 1, its grant is `*seq`. Otherwise 0; the task may sleep
 * until `*until` (0: until it is woken). A release that was slept through is the
 * dispatcher's, who counts what was missed. */
static inline int rt_take(struct rt_table *t, struct rt_slot *slot, uint32_t *seq,
                          int64_t *until)
{
    struct rt_grant *g = &slot->grant;
    int i = (int)(slot - t->slots);
    /* SYNC POINT: rt_lend writes the word last. */
    uint64_t lease = atomic_load(&t->lease);
    int64_t release = atomic_load(&t->next_ns[i]);
    int64_t late = release ? rt_now() - release : 0;
    *until = late < 0 ? release : 0;
    if (!release || late < 0)
        return 0;
    if (!rt_may_take(t, i, lease, release)) {
        /* SYNC POINT: rt_lend reads the time after it writes the word. Either this sees that
         * there is a lease now, or the dispatcher sees that the release has come. */
        if (atomic_load(&t->lease) != lease)
            *until = release;   /* which has passed: try again */
        return 0;
    }
    int64_t period = atomic_load_explicit(&g->lent_period_ns, memory_order_relaxed);
    if (late >= period) {
        rt_overslept(t, release);
        return 0;
    }
    uint32_t grant = atomic_load_explicit(&slot->post.done, memory_order_relaxed) + 1;
    int64_t length = atomic_load_explicit(&g->lent_length_ns, memory_order_relaxed);
    if (atomic_load_explicit(&g->lent_metered, memory_order_relaxed))
        atomic_store_explicit(&slot->post.lease_cpu_ns[grant & 1],
                              rt_clock(CLOCK_PROCESS_CPUTIME_ID), memory_order_relaxed);
    /* SYNC POINT: a turn in between has changed the word, and the release is not taken. If
     * the turn came before the release, it has not granted it either: try again. */
    if (!atomic_compare_exchange_strong(&t->lease, &lease, lease | rt_cycle(i, grant))) {
        *until = release;
        return 0;
    }
    *seq = grant;
    atomic_store_explicit(&g->rel_ns, release, memory_order_relaxed);
    atomic_store_explicit(&g->dl_ns, release + length, memory_order_relaxed);
    /* A turn since then has written the same. If it has written a later one, the cycle has
     * overrun: there is no lease until it has ended, and rt_lend writes the release again. */
    atomic_store_explicit(&t->next_ns[i], release + period, memory_order_relaxed);
    return 1;
}

/* Before a cycle counts as ended: if it ran past its deadline or the next release, the
 * dispatcher has to see that. */
static inline void rt_own_up(struct rt_table *t, struct rt_slot *slot, int64_t deadline)
{
    int64_t next = atomic_load_explicit(&t->next_ns[slot - t->slots], memory_order_relaxed);
    int64_t bound = next < deadline ? next : deadline;
    if (rt_is_open(atomic_load(&t->lease)) && rt_now() >= bound)
        rt_kick(t);
}

/* Set the timer of the process's own to the next release. No thread reads it. It is the core's
 * next event while the check's timer is moved and while the task falls asleep, so that neither
 * sets the hardware, which costs more on a virtual machine than the calls. */
static inline void rt_hold_release(struct rt_look *look, int64_t at)
{
    struct itimerspec when = {.it_value = rt_timespec(at)};
    if (!look->release_fd)
        look->release_fd = timerfd_create(CLOCK_MONOTONIC, TFD_CLOEXEC);
    timerfd_settime(look->release_fd, TFD_TIMER_ABSTIME, &when, NULL);
}

/* Set the dispatcher's check for the cycles to come. The cycle of the caller, in slot i, is
 * still in the word, so no task takes a release meanwhile. If the first to come is the
 * caller's own, its sleep until then is not the core's next event yet. */
static inline void rt_move_check(struct rt_table *t, int i, struct rt_look *look)
{
    int first;
    int64_t at = rt_next_check(t, atomic_load(&t->lent_end_ns), &first);
    struct itimerspec when = {.it_value = rt_timespec(at)};
    if (at == atomic_load(&t->look_ns))
        return;
    if (at && first == i)
        rt_hold_release(look, atomic_load_explicit(&t->next_ns[i], memory_order_relaxed));
    atomic_store(&t->look_ns, at);
    timerfd_settime(look->fd, TFD_TIMER_ABSTIME, &when, NULL);
    atomic_fetch_add_explicit(&t->spared, 1, memory_order_relaxed);
}

/* The cycle `seq` has ended: set the next check, and let others take their releases. */
static inline void rt_give_back(struct rt_table *t, struct rt_slot *slot, uint32_t seq,
                                struct rt_look *look)
{
    int i = (int)(slot - t->slots), fd = rt_look_fd(look, t, slot);
    uint64_t lease = atomic_load(&t->lease);
    if (!rt_is_open(lease) || rt_under_way(lease) != rt_cycle(i, seq) || fd < 0)
        return;
    rt_move_check(t, i, look);
    /* SYNC POINT: a turn in between has changed the word. Its timer may be changed, too. */
    if (!atomic_compare_exchange_strong(&t->lease, &lease, lease & ~RT_CYCLE))
        rt_kick(t);
}

#endif
