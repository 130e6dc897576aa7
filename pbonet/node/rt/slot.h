/* The task's side of its slot: arm, wait for a release, stop when held, account.
 *
 * Nothing here allocates, logs or takes a lock. The task writes `post` and `stats`, the
 * dispatcher writes `grant`; see layout.h.
 */
#ifndef PBONET_SLOT_H
#define PBONET_SLOT_H

#include "layout.h"
#include "lease/take.h"
#include "look.h"
#include "sys.h"
#include "table.h"

#include <sys/resource.h>

enum rt_wait { RT_RELEASED = 0, RT_WAIT_COMMAND = 1, RT_WAIT_ORPHAN = 2, RT_WAIT_SIGNAL = 3,
               RT_WAIT_IDLE = 7 };

struct rt_task {
    struct rt_table *table;
    struct rt_slot *slot;
    int kind;                   /* unless periodic, a grant lasts until OFF */
    uint32_t seq;               /* of the current release */
    int64_t rel_ns, dl_ns;
    struct rt_look look;
};

static inline void rt_add(_Atomic uint64_t *to, uint64_t n)
{
    atomic_store_explicit(to, atomic_load_explicit(to, memory_order_relaxed) + n,
                          memory_order_relaxed);
}

static inline void rt_put(_Atomic uint64_t *to, uint64_t n)
{
    atomic_store_explicit(to, n, memory_order_relaxed);
}

static inline uint64_t rt_get(const _Atomic uint64_t *from)
{
    return atomic_load_explicit(from, memory_order_relaxed);
}

/* The log-linear bin of a time: 16 below 1 us, then 16 an octave. */
static inline int rt_bin(int64_t ns)
{
    uint64_t v = ns < 0 ? 0 : (uint64_t)ns;
    if (v >= UINT64_C(33554432000))
        return RT_BINS - 1;
    v = v * 16 / 1000;
    if (v < 16)
        return (int)v;
    int octave = 59 - __builtin_clzll(v);
    return 16 * octave + (int)(v >> octave);
}

static inline uint64_t rt_faults(void)
{
    struct rusage use;
    return getrusage(RUSAGE_THREAD, &use) ? 0 : (uint64_t)use.ru_minflt;
}

/* SYNC POINT: readers of the stats (rt_snapshot) read `seq` before and after. */
static inline void rt_stats_begin(struct rt_stats *s)
{
    atomic_store_explicit(&s->seq, s->seq + 1, memory_order_relaxed);
    atomic_thread_fence(memory_order_release);
}

static inline void rt_stats_end(struct rt_stats *s)
{
    atomic_store_explicit(&s->seq, s->seq + 1, memory_order_release);
}

/* The number of the current cycle, by which failures refer to it. */
static inline uint32_t rt_number_of(const struct rt_task *task)
{
    return task->kind == RT_SYNCHRONOUS ? atomic_load(&task->slot->post.events)
                                        : task->seq;
}

/* End the event that is served; returns whether there was one. */
static inline int rt_end_event(struct rt_task *task)
{
    uint32_t odd = atomic_load(&task->slot->post.events) & 1;
    if (odd)
        atomic_fetch_add(&task->slot->post.events, 1);
    return (int)odd;
}

/* Return the word of a new arming, and mark all earlier grants as done. */
static inline uint32_t rt_anew(struct rt_task *task, uint32_t word)
{
    struct rt_slot *slot = task->slot;
    uint32_t seq = atomic_load(&slot->grant.seq);
    atomic_store(&slot->post.begun, seq);
    atomic_store(&slot->post.done, seq);
    return (word & ~UINT32_C(0x1ffff)) | (((word >> 2) + 1) & 0x7fff) << 2;
}

/* Stand by until the dispatcher engages the task; see standby.h. */
static inline void rt_stand_by_for(struct rt_task *task)
{
    uint32_t word = rt_anew(task, atomic_load(&task->slot->post.word));
    atomic_store(&task->slot->post.word, word | RT_STANDS);
    rt_kick(task->table);
}

/* Ask for releases: with a new arming after OFF, otherwise with the old one. */
static inline void rt_arm(struct rt_task *task)
{
    struct rt_slot *slot = task->slot;
    struct rt_stats *s = &slot->stats;
    uint32_t word = atomic_load(&slot->post.word);
    task->kind = atomic_load(&slot->config.kind);
    rt_end_event(task);
    if ((word & 3) == RT_ON)
        return;
    if ((word & 3) == RT_OFF || (word & 3) == RT_STANDS) {
        word = rt_anew(task, word);
        atomic_store(&slot->post.fell, 0);
        rt_stats_begin(s);
        rt_put(&s->on_ns, (uint64_t)rt_time(task->table));
        rt_put(&s->on_cycles, rt_get(&s->cycles));
        rt_put(&s->on_missed, rt_get(&slot->grant.missed) + rt_get(&s->failed) +
                                  rt_get(&s->skipped));
        rt_put(&s->on_failed, rt_get(&s->failed));
        rt_put(&s->on_cpu_ns, rt_get(&s->cpu_total_ns));
        rt_put(&s->on_faults, rt_get(&s->faults));
        atomic_store_explicit(&s->restart, RT_SINCE_ON, memory_order_relaxed);
        rt_put(&s->cpu_min_ns, 0);
        rt_put(&s->cpu_max_ns, 0);
        rt_put(&s->cpu_first_ns, 0);
        rt_put(&s->last_rel_ns, 0);
        rt_stats_end(s);
    } else {
        word += UINT32_C(1) << 17;
    }
    /* SYNC POINT: rt_latch loads the word with acquire. */
    atomic_store(&slot->post.word, (word & ~UINT32_C(3)) | RT_ON);
    rt_kick(task->table);
}

/* Go to the priority of commands, below every cycle; an errno value if refused. Commands
 * share it by time slices, so that one that does not return blocks no other. A real-time
 * priority from an earlier dispatcher is lowered even if none leads any more. */
static inline int rt_command_level(const struct rt_task *task)
{
    int policy = sched_getscheduler(0) & ~SCHED_RESET_ON_FORK;
    if (policy == SCHED_RR)
        return 0;
    if (atomic_load(&task->table->backend) != RT_FIFO && policy != SCHED_FIFO)
        return 0;
    return rt_schedule(0, SCHED_RR, RT_COMMAND_LEVEL);
}

/* Leave the cycles for a command, or for good; the priority is lowered first. */
static inline int rt_leave(struct rt_task *task, int mode)
{
    struct rt_slot *slot = task->slot;
    uint32_t word = atomic_load(&slot->post.word);
    if ((word & 3) == (uint32_t)mode || (word & 3) == RT_OFF)
        return 0;
    atomic_store(&slot->post.word, (word & ~UINT32_C(3)) | (uint32_t)mode);
    int error = rt_command_level(task);
    if (mode == RT_OFF)
        rt_kick(task->table);
    return error;
}

/* Put the task in ERROR: its standby is engaged, and the flag is raised. The task itself
 * records whether it was armed, because the dispatcher may not have seen that. A second
 * ERROR in a row keeps the first record: the task has not been armed since. */
static inline int rt_fall(struct rt_task *task)
{
    struct rt_post *post = &task->slot->post;
    uint32_t mode = atomic_load(&post->word) & 3;
    if (mode == RT_ON || mode == RT_COMMAND)
        atomic_store(&post->fell, RT_FELL_ARMED);
    else if (!atomic_load(&post->fell))
        atomic_store(&post->fell, RT_FELL);
    int error = rt_leave(task, RT_OFF);
    atomic_fetch_add(&task->table->fallen, 1);
    rt_futex_wake(&task->table->fallen);
    return error;
}

/* Go OFF in order. A task that leaves ERROR no longer counts as fallen: a standby that is
 * assigned from now on is not engaged by the earlier failure. */
static inline int rt_rest(struct rt_task *task)
{
    struct rt_post *post = &task->slot->post;
    uint32_t word = atomic_load(&post->word);
    if ((word & 3) != RT_OFF || !atomic_load(&post->fell))
        return rt_leave(task, RT_OFF);
    atomic_store(&post->fell, 0);
    atomic_store(&post->word, rt_anew(task, word));
    rt_kick(task->table);
    return 0;
}

/* Whether the cycle that has just ended was to be the last one; true only once. */
static inline int rt_was_last(struct rt_task *task)
{
    _Atomic uint32_t *ask = &task->slot->grant.ask;
    if (!(atomic_load_explicit(ask, memory_order_relaxed) & RT_ASK_LAST))
        return 0;
    return (atomic_fetch_and(ask, ~(uint32_t)RT_ASK_LAST) & RT_ASK_LAST) != 0;
}

/* Wait for a release, a command, or the parent's end. `served`: a cycle has run since
 * the last command, so a waiting command goes first now. Also returns on signals, and at
 * once in virtual time, which the caller does not advance. */
static inline int rt_wait(struct rt_task *task, int served)
{
    struct rt_grant *g = &task->slot->grant;
    for (;;) {
        /* SYNC POINT: every writer rings the bell after changing what is read here. */
        uint32_t bell = atomic_load(&g->bell);
        uint32_t ask = atomic_load(&g->ask);
        if (ask & RT_ASK_ORPHAN)
            return RT_WAIT_ORPHAN;
        uint32_t seq = atomic_load_explicit(&g->seq, memory_order_acquire);
        uint32_t done = atomic_load_explicit(&task->slot->post.done, memory_order_relaxed);
        int due = (int32_t)(seq - done) > 0;    /* the task may be ahead: take.h */
        int64_t until;
        if ((ask & RT_ASK_COMMAND) && (served || !due)) {
            atomic_fetch_and(&g->ask, ~(uint32_t)RT_ASK_COMMAND);
            return RT_WAIT_COMMAND;
        }
        if (due) {
            task->seq = seq;
            return RT_RELEASED;
        }
        if (rt_is_virtual(task->table))
            return RT_WAIT_IDLE;
        if (rt_take(task->table, task->slot, &task->seq, &until))
            return RT_RELEASED;
        if (rt_futex_wait(&g->bell, bell, until) == EINTR)
            return RT_WAIT_SIGNAL;
    }
}

/* Wait while the dispatcher holds the task; async-signal-safe. */
static inline void rt_hold_still(struct rt_slot *slot)
{
    if (!atomic_load(&slot->grant.parked))
        return;
    int64_t since = rt_now();
    while (atomic_load(&slot->grant.parked))
        rt_futex_wait(&slot->grant.parked, 1, 0);
    rt_add(&slot->stats.held_ns, (uint64_t)(rt_now() - since));
}

/* Begin to serve an external event: a server's capacity and the deadline of a task with a
 * device count from here. */
static inline void rt_begin_event(struct rt_task *task)
{
    struct rt_post *post = &task->slot->post;
    task->rel_ns = rt_time(task->table);
    task->dl_ns = RT_NEVER;
    if (task->kind == RT_SYNCHRONOUS)
        task->dl_ns = task->rel_ns + atomic_load(&task->slot->config.period_ns);
    atomic_store_explicit(&post->event_ns, task->rel_ns, memory_order_relaxed);
    if (task->kind != RT_BACKGROUND) {
        /* SYNC POINT: rt_latch_event and rt_latch_device load it with acquire. */
        atomic_fetch_add_explicit(&post->events, 1, memory_order_release);
        rt_kick(task->table);
    }
}

/* Begin the granted cycle; 0 when it must not begin any more. */
static inline int rt_begin(struct rt_task *task)
{
    struct rt_slot *slot = task->slot;
    if (task->kind != RT_PERIODIC) {
        rt_begin_event(task);
        return 1;
    }
    atomic_store(&slot->post.begun, task->seq);
    rt_hold_still(slot);
    task->rel_ns = atomic_load_explicit(&slot->grant.rel_ns, memory_order_relaxed);
    task->dl_ns = atomic_load_explicit(&slot->grant.dl_ns, memory_order_relaxed);
    return atomic_load(&slot->grant.skip) != task->seq;
}

/* Whether the dispatcher must be woken when an event has been served: to charge a
 * sporadic server, or to restore the rank of a synchronous task, or a level. */
static inline int rt_awaited(const struct rt_task *task)
{
    const struct rt_slot *slot = task->slot;
    return task->kind == RT_SPORADIC || atomic_load(&slot->grant.hung) ||
           (task->kind == RT_SYNCHRONOUS &&
            atomic_load(&slot->grant.crit) != atomic_load(&slot->config.crit));
}

/* End the cycle; under `park` the dispatcher is woken if other tasks wait. */
static inline void rt_end(struct rt_task *task)
{
    if (task->kind != RT_PERIODIC) {
        if (rt_end_event(task) && rt_awaited(task))
            rt_kick(task->table);
        rt_spare(task->table, task->slot, &task->look);
        return;
    }
    rt_own_up(task->table, task->slot, task->dl_ns);
    /* SYNC POINT: pairs with rt_rank (waiting) and rt_top_done: either this sees that
     * others wait, or the dispatcher sees that the cycle has ended. With rt_publish_next as
     * well: either the next sleep sees the new release, or the dispatcher sees the end. */
    atomic_store(&task->slot->post.done, task->seq);
    if (atomic_load(&task->table->waiting))
        rt_kick(task->table);
    rt_spare(task->table, task->slot, &task->look);
    rt_give_back(task->table, task->slot, task->seq, &task->look);
}

/* Take hold of the timer of the dispatcher's checks. Later the process may lack the right. */
static inline void rt_meet_dispatcher(struct rt_task *task)
{
    rt_look_fd(&task->look, task->table, task->slot);
}

/* Tell the task that a command or another request waits for it. */
static inline void rt_request(struct rt_slot *slot, uint32_t ask)
{
    atomic_fetch_or(&slot->grant.ask, ask);
    rt_ring(slot);
}

/* Ask the task to let its extremes begin with its next cycle; `on` does it, too. */
static inline void rt_ask_restart(struct rt_slot *slot)
{
    atomic_store_explicit(&slot->stats.restart, RT_RESTART, memory_order_relaxed);
}

/* Nanoseconds since the release of the last executed cycle: the `dt` of this one. */
static inline int64_t rt_step(const struct rt_task *task)
{
    const struct rt_slot *slot = task->slot;
    int64_t last = (int64_t)rt_get(&slot->stats.last_rel_ns);
    if (last)
        return task->rel_ns - last;
    if (task->kind != RT_PERIODIC)
        return task->rel_ns - (int64_t)rt_get(&slot->stats.on_ns);
    return atomic_load(&slot->config.period_ns);
}

/* Let the extremes begin with the cycle that is being accounted. */
static inline void rt_restart_extremes(struct rt_stats *s)
{
    atomic_store_explicit(&s->restart, RT_RESTARTED, memory_order_relaxed);
    rt_put(&s->cpu_min_ns, 0);
    rt_put(&s->cpu_max_ns, 0);
}

/* The cost of one cycle; times of CLOCK_MONOTONIC, cpu of the thread. */
struct rt_cost {
    int64_t start_ns, called_ns, returned_ns, end_ns;
    uint64_t cpu_ns;
    int failed, stable, torn, stale, lost, aborted;
};

static inline void rt_account(struct rt_task *task, const struct rt_cost *cost)
{
    struct rt_stats *s = &task->slot->stats;
    uint64_t jitter = cost->called_ns > task->rel_ns
                          ? (uint64_t)(cost->called_ns - task->rel_ns) : 0;
    int first = rt_get(&s->cpu_first_ns) == 0;
    rt_stats_begin(s);
    rt_add(cost->failed ? &s->failed : &s->cycles, 1);
    rt_add(&s->aborted, (uint64_t)cost->aborted);
    rt_add(&s->late, cost->end_ns > task->dl_ns);
    rt_add(&s->stable, (uint64_t)cost->stable);
    rt_add(&s->torn, (uint64_t)cost->torn);
    rt_add(&s->stale, (uint64_t)cost->stale);
    rt_add(&s->ring_lost, (uint64_t)cost->lost);
    rt_add(&s->cpu_total_ns, cost->cpu_ns);
    rt_add(&s->wall_total_ns, (uint64_t)(cost->end_ns - cost->start_ns));
    rt_put(&s->cpu_last_ns, cost->cpu_ns);
    if (first) {                /* counted apart from the others: Stewart 1994, 6.7.1 */
        rt_put(&s->cpu_first_ns, cost->cpu_ns);
    } else {
        if (atomic_load_explicit(&s->restart, memory_order_relaxed) == RT_RESTART)
            rt_restart_extremes(s);
        if (cost->cpu_ns > rt_get(&s->cpu_max_ns))
            rt_put(&s->cpu_max_ns, cost->cpu_ns);
        if (cost->cpu_ns < rt_get(&s->cpu_min_ns) || !rt_get(&s->cpu_min_ns))
            rt_put(&s->cpu_min_ns, cost->cpu_ns);
        rt_add(&s->cpu[rt_bin((int64_t)cost->cpu_ns)], 1);
    }
    rt_add(&s->copy_in_ns, (uint64_t)(cost->called_ns - cost->start_ns));
    rt_add(&s->copy_out_ns, (uint64_t)(cost->end_ns - cost->returned_ns));
    rt_add(&s->jitter[rt_bin((int64_t)jitter)], 1);
    if (jitter > rt_get(&s->jitter_max_ns))
        rt_put(&s->jitter_max_ns, jitter);
    if (!cost->failed)
        rt_put(&s->last_rel_ns, (uint64_t)task->rel_ns);
    rt_stats_end(s);
}

/* Count the thread's CPU time for the next cycle from here on; returns the clock, which
 * is 0 in virtual time. */
static inline uint64_t rt_mark_cpu(struct rt_task *task)
{
    uint64_t cpu = rt_is_virtual(task->table) ? 0 : rt_thread_cpu();
    rt_put(&task->slot->stats.cpu_mark_ns, cpu);
    return cpu;
}

static inline void rt_count_faults(struct rt_slot *slot, uint64_t n)
{
    rt_stats_begin(&slot->stats);
    rt_add(&slot->stats.faults, n);
    rt_stats_end(&slot->stats);
}

#endif
