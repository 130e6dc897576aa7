/* The task's side of a lease; lend.h explains it. */
#ifndef PBONET_LEASE_TAKE_H
#define PBONET_LEASE_TAKE_H

#include "../look.h"

/* What a task uses of its lease: the next release that it may take. */
struct rt_lent {
    uint64_t lease;             /* as in the slot; 0: none */
    int64_t release_ns;
};

static inline struct rt_lent rt_lent(const struct rt_grant *g)
{
    struct rt_lent lent = {.lease = atomic_load(&g->lease)};
    uint32_t taken = (uint32_t)lent.lease;
    if (!lent.lease)
        return lent;
    int64_t period = atomic_load_explicit(&g->lent_period_ns, memory_order_relaxed);
    lent.release_ns =
        atomic_load_explicit(&g->lent_ns, memory_order_relaxed) + taken * period;
    if (lent.release_ns >= atomic_load_explicit(&g->lent_end_ns, memory_order_relaxed))
        lent.lease = 0;         /* that one is the dispatcher's */
    return lent;
}

/* Whether the task is ON and has run all that comes before the lease's next release. It
 * has not if a turn has granted a cycle since it looked, and is not ON if no dispatcher has
 * seen it go OFF. */
static inline int rt_is_next(const struct rt_slot *slot, struct rt_lent lent)
{
    uint32_t before = atomic_load_explicit(&slot->grant.lent_seq, memory_order_relaxed) +
                      (uint32_t)lent.lease;
    return atomic_load_explicit(&slot->post.done, memory_order_relaxed) == before &&
           (atomic_load_explicit(&slot->post.word, memory_order_relaxed) & 3) == RT_ON;
}

/* Take the release that is due: 1, its grant is `*seq`. Otherwise 0; the task may sleep
 * until `*until` (0: until it is woken). A release that was slept through is the
 * dispatcher's, who counts what was missed. */
static inline int rt_take(struct rt_table *t, struct rt_slot *slot, uint32_t *seq,
                          int64_t *until)
{
    struct rt_grant *g = &slot->grant;
    struct rt_lent lent = rt_lent(g);
    *until = 0;
    if (!lent.lease || !rt_is_next(slot, lent))
        return 0;
    int64_t late = rt_now() - lent.release_ns;
    if (late < 0) {
        *until = lent.release_ns;
        return 0;
    }
    if (late >= atomic_load_explicit(&g->lent_period_ns, memory_order_relaxed)) {
        atomic_store(&t->looked_ns, lent.release_ns);   /* the core may have stood still */
        rt_kick(t);
        return 0;
    }
    uint32_t taken = (uint32_t)lent.lease + 1;
    int64_t length = atomic_load_explicit(&g->lent_length_ns, memory_order_relaxed);
    *seq = atomic_load_explicit(&g->lent_seq, memory_order_relaxed) + taken;
    if (atomic_load_explicit(&g->lent_metered, memory_order_relaxed))
        atomic_store_explicit(&slot->post.lease_cpu_ns[taken & 1],
                              rt_clock(CLOCK_PROCESS_CPUTIME_ID), memory_order_relaxed);
    /* SYNC POINT: a turn in between has changed the word, and the release is not taken. */
    if (!atomic_compare_exchange_strong(&g->lease, &lent.lease, lent.lease + 1))
        return 0;
    atomic_store_explicit(&g->rel_ns, lent.release_ns, memory_order_relaxed);
    atomic_store_explicit(&g->dl_ns, lent.release_ns + length, memory_order_relaxed);
    return 1;
}

/* Before a cycle counts as ended: if it ran past its deadline or the next release, the
 * dispatcher has to see that. */
static inline void rt_own_up(struct rt_table *t, struct rt_slot *slot, int64_t deadline)
{
    struct rt_lent lent = rt_lent(&slot->grant);
    int64_t bound = lent.release_ns < deadline ? lent.release_ns : deadline;
    if (lent.release_ns && rt_now() >= bound)
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

/* The cycle has ended: set the dispatcher's check to the next one that the task may take. */
static inline void rt_check_next(struct rt_table *t, struct rt_slot *slot,
                                 struct rt_look *look)
{
    struct rt_grant *g = &slot->grant;
    int fd = rt_look_fd(look, t, slot);
    uint64_t lease = atomic_load(&g->lease);
    int64_t first = atomic_load_explicit(&g->lent_check_ns, memory_order_relaxed);
    if (!lease || !first || fd < 0)
        return;
    struct rt_lent lent = rt_lent(g);
    int64_t at = lent.lease ? lent.release_ns + first : 0;
    struct itimerspec when = {.it_value = rt_timespec(at)};
    if (at)
        rt_hold_release(look, lent.release_ns);
    if (timerfd_settime(fd, TFD_TIMER_ABSTIME, &when, NULL))
        return;
    atomic_store(&t->look_ns, at);
    if (atomic_load(&g->lease) != lease)
        rt_kick(t);             /* a turn came between: its timer may be changed */
}

#endif
