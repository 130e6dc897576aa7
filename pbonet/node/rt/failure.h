/* Timing failures in the failing task's own context: signal, critical sections, bounds.
 *
 * The dispatcher contains a failure and sends a signal. The C handler below decides
 * whether it may be delivered now: within a cycle (or within `sync`), outside critical
 * sections, and not while the module's handler runs. Then the interpreter calls
 * Python code in the main thread, between two instructions. A timer of the task
 * repeats the signal until an abort has taken effect, and bounds the handler. One
 * process is one task, so the state is static.
 */
#ifndef PBONET_FAILURE_H
#define PBONET_FAILURE_H

#include "slot.h"       /* first: it chooses the features of the C library */
#include "../../cmodule/running.h"

enum { RT_OUTSIDE = 0, RT_IN_CYCLE = 1, RT_IN_SYNC = 2 };
#define RT_AGAIN_NS INT64_C(500000)     /* repetition interval of an abort */

struct rt_failing {
    struct rt_task *task;
    struct pbo_running *in_c;   /* the method in C that runs, and what has failed */
    void (*make_safe)(void *);  /* commits safe values if the cycle has failed; or NULL */
    void *safe_of;
    int (*interrupt)(int);      /* makes the interpreter call the signal's Python code */
    timer_t timer;
    int has_timer;
    int64_t bound_ns;           /* longest time of a handler before it is aborted */
    volatile sig_atomic_t where;        /* RT_OUTSIDE ... */
    volatile sig_atomic_t locked;       /* depth of critical sections */
    volatile sig_atomic_t pending;      /* a signal came while locked or handling */
    volatile sig_atomic_t handling;     /* the module's handler runs */
    volatile sig_atomic_t aborting;     /* the cycle is being unwound */
    volatile sig_atomic_t overdue;      /* timer ticks since the bound */
    int wish_crit;              /* requests of the running handler; -1 and 0: none */
    int64_t wish_dl_ns;
};

static struct rt_failing rt_failing = {.wish_crit = -1};

/* Set the timer's first expiry and its interval; 0, 0 stops it. */
static inline void rt_set_timer(int64_t first_ns, int64_t every_ns)
{
    struct itimerspec at = {.it_value = rt_timespec(first_ns),
                            .it_interval = rt_timespec(every_ns)};
    if (rt_failing.has_timer)
        timer_settime(rt_failing.timer, 0, &at, NULL);
}

/* Failures of the current grant, as bits; those of an earlier one do not count. */
static inline uint32_t rt_failures_now(const struct rt_task *task)
{
    uint32_t word = atomic_load(&task->slot->grant.failed);
    return (word & ~UINT32_C(7)) == rt_number_of(task) << 3 ? word & 7 : 0;
}

/* The handler exceeded its bound; end the process if it is overdue by the bound again. */
static inline void rt_overdue(struct rt_failing *f)
{
    f->overdue++;
    if (f->overdue * RT_AGAIN_NS > f->bound_ns) {
        atomic_store(&f->task->slot->post.locked, RT_HANDLER_HANGS);
        kill(getpid(), SIGKILL);
    }
}

static inline void rt_on_failure(int signal, siginfo_t *info, void *context)
{
    struct rt_failing *f = &rt_failing;
    int saved = errno;
    (void)context;
    if (!f->task)
        return;
    /* Wherever the task is, but in its own thread: a timer's signal may come to another. */
    if (f->make_safe && info->si_code == SI_TKILL)
        f->make_safe(f->safe_of);
    if (info->si_code == SI_TIMER) {
        if (f->handling)
            rt_overdue(f);
        if (f->handling || f->aborting)
            f->interrupt(signal);
    } else if (f->where != RT_OUTSIDE) {
        struct rt_grant *g = &f->task->slot->grant;
        uint32_t came = rt_failures_now(f->task);
        volatile uint32_t *must_end = f->in_c->must_end;
        f->in_c->failed |= came;
        if (must_end)
            *must_end |= came;
        int forced = atomic_load(&g->forced) == rt_number_of(f->task);
        if (f->handling || (f->locked && !forced))
            f->pending = 1;
        else
            f->interrupt(signal);
    }
    errno = saved;
}

/* Install the signal handler for `task`; an errno value when the kernel refuses. */
static inline int rt_guard_failures(struct rt_task *task, int64_t bound_ns,
                                    int (*interrupt)(int),
                                    struct pbo_running *in_c)
{
    struct sigaction action = {.sa_sigaction = rt_on_failure, .sa_flags = SA_SIGINFO};
    struct sigevent event = {.sigev_notify = SIGEV_SIGNAL, .sigev_signo = RT_FAIL_SIGNAL};
    sigemptyset(&action.sa_mask);
    rt_failing.task = task;
    rt_failing.bound_ns = bound_ns;
    rt_failing.interrupt = interrupt;
    rt_failing.in_c = in_c;
    if (!rt_failing.has_timer) {
        if (timer_create(CLOCK_MONOTONIC, &event, &rt_failing.timer))
            return errno;
        rt_failing.has_timer = 1;
    }
    return sigaction(RT_FAIL_SIGNAL, &action, NULL) ? errno : 0;
}

/* Have the signal's handler call this function; NULL: none. */
static inline void rt_use_safe(void (*make_safe)(void *), void *of)
{
    rt_failing.make_safe = NULL;
    atomic_signal_fence(memory_order_seq_cst);
    rt_failing.safe_of = of;
    atomic_signal_fence(memory_order_seq_cst);
    rt_failing.make_safe = make_safe;
}

static inline void rt_unguard_failures(const struct rt_task *task)
{
    if (rt_failing.task != task)
        return;
    rt_set_timer(0, 0);
    rt_failing.task = NULL;
    rt_failing.make_safe = NULL;
}

/* Set where the task is; later signals are delivered there. Returns whether a failure came
 * since the grant began (during a copy, or while the task was held) whose signal was
 * dropped: it must be delivered now. */
static inline int rt_enter(int where)
{
    struct rt_failing *f = &rt_failing;
    f->pending = 0;
    if (f->task)
        f->in_c->failed = 0;
    f->where = where;
    atomic_signal_fence(memory_order_seq_cst);  /* a signal from here on is delivered */
    if (!f->task || !(atomic_load(&f->task->slot->grant.failed) & 7))
        return 0;
    __atomic_fetch_or(&f->in_c->failed, rt_failures_now(f->task), __ATOMIC_RELAXED);
    return 1;
}

/* Whether a failure of the current grant is not handled yet. */
static inline int rt_has_failed(const struct rt_task *task)
{
    return (atomic_load(&task->slot->grant.failed) & 7) != 0;
}

/* The cycle has returned or was unwound: nothing is delivered from here on. */
static inline void rt_exit(void)
{
    rt_failing.where = RT_OUTSIDE;
    if (rt_failing.locked) {    /* unwound out of a section */
        rt_failing.locked = 0;
        atomic_store(&rt_failing.task->slot->post.locked, 0);
    }
    if (rt_failing.aborting || rt_failing.handling) {
        rt_failing.aborting = rt_failing.handling = rt_failing.overdue = 0;
        rt_set_timer(0, 0);
    }
}

/* The kinds of failure of the current grant, as bits; stale ones are counted. */
static inline unsigned rt_take_failures(struct rt_task *task)
{
    struct rt_grant *g = &task->slot->grant;
    rt_failing.pending = 0;
    uint32_t word = atomic_exchange(&g->failed, 0);
    if (!(word & 7))
        return 0;
    if ((word & ~UINT32_C(7)) != rt_number_of(task) << 3) {
        rt_add(&task->slot->stats.stale_failures, (uint64_t)__builtin_popcount(word & 7));
        return 0;
    }
    return word & 7;
}

/* Before the module's handler is called: set its bound, record the delivery time. */
static inline uint32_t rt_begin_handler(struct rt_task *task)
{
    struct rt_stats *s = &task->slot->stats;
    int64_t took = rt_now() - atomic_load(&task->slot->grant.failed_ns);
    rt_failing.overdue = 0;
    rt_failing.wish_crit = -1;
    rt_failing.wish_dl_ns = 0;
    rt_failing.handling = 1;
    rt_set_timer(rt_failing.bound_ns, RT_AGAIN_NS);
    rt_add(&s->handlers, 1);
    rt_put(&s->delivery_last_ns, took > 0 ? (uint64_t)took : 0);
    if (took > 0 && (uint64_t)took > rt_get(&s->delivery_max_ns))
        rt_put(&s->delivery_max_ns, (uint64_t)took);
    return atomic_load(&task->slot->grant.told);
}

/* After the handler, however it ended; the dispatcher takes its priority back. */
static inline void rt_end_handler(struct rt_task *task, uint32_t told)
{
    rt_failing.handling = rt_failing.overdue = 0;
    rt_set_timer(0, 0);
    atomic_store(&task->slot->post.handled, told);
    if (atomic_load(&task->slot->config.handler))
        rt_kick(task->table);
}

/* Begin to abort the cycle; the signal is repeated until the cycle is unwound. */
static inline void rt_begin_abort(void)
{
    rt_failing.aborting = 1;
    rt_set_timer(RT_AGAIN_NS, RT_AGAIN_NS);
}

/* Enter a critical section: signals and the drop in criticality wait for its end. */
static inline void rt_lock(void)
{
    if (rt_failing.locked++ == 0 && rt_failing.task)
        atomic_store_explicit(&rt_failing.task->slot->post.locked, 1,
                              memory_order_relaxed);
}

/* Leave it; returns whether a failure came meanwhile that must be delivered now. */
static inline int rt_unlock(void)
{
    struct rt_task *task = rt_failing.task;
    if (rt_failing.locked == 0 || --rt_failing.locked > 0 || !task)
        return 0;
    atomic_store(&task->slot->post.locked, 0);
    if (atomic_load(&task->slot->grant.owed))
        rt_kick(task->table);
    return rt_failing.pending && !rt_failing.handling;
}

/* Post a wish that holds until the next release; -1 and 0 mean no wish. */
static inline void rt_post_wish(struct rt_task *task, int crit, int64_t dl_ns)
{
    struct rt_post *post = &task->slot->post;
    atomic_store_explicit(&post->wish_crit, crit, memory_order_relaxed);
    atomic_store_explicit(&post->wish_dl_ns, dl_ns, memory_order_relaxed);
    /* SYNC POINT: rt_latch_watch loads `wish` with acquire. */
    atomic_fetch_add_explicit(&post->wish, 1, memory_order_release);
    rt_kick(task->table);
}

/* Add a wish of the running handler. Each post repeats all wishes of this call, because
 * there may be no turn between two of them. */
static inline void rt_wish(struct rt_task *task, int crit, int64_t dl_ns)
{
    struct rt_failing *f = &rt_failing;
    if (crit >= 0)
        f->wish_crit = crit;
    if (dl_ns)
        f->wish_dl_ns = dl_ns;
    rt_post_wish(task, f->wish_crit, f->wish_dl_ns);
}

/* Count a skipped release; its CPU time belongs to no cycle. */
static inline void rt_skipped(struct rt_task *task, uint64_t cpu_ns)
{
    struct rt_stats *s = &task->slot->stats;
    rt_stats_begin(s);
    rt_add(&s->skipped, 1);
    rt_add(&s->cpu_total_ns, cpu_ns);
    rt_stats_end(s);
}

static inline int rt_handles(void)
{
    return rt_failing.handling;
}

static inline int rt_is_overdue(void)
{
    return rt_failing.overdue > 0;
}

static inline int rt_is_aborting(void)
{
    return rt_failing.aborting;
}

static inline int rt_is_outside(void)
{
    return rt_failing.where == RT_OUTSIDE;
}

/* -- timed sections -- */

/* The index of the section of that name, added if there is room; -1: no room. */
static inline int rt_section(struct rt_slot *slot, const char *name)
{
    uint32_t n = atomic_load(&slot->n_sections);
    for (uint32_t k = 0; k < n; k++)
        if (!strncmp(slot->sections[k].name, name, RT_SECTION_NAME))
            return (int)k;
    if (n == RT_SECTIONS)
        return -1;
    struct rt_section *s = &slot->sections[n];
    memset(s, 0, sizeof *s);
    strncpy(s->name, name, RT_SECTION_NAME - 1);
    atomic_store(&slot->n_sections, n + 1);
    return (int)n;
}

static inline void rt_time_section(struct rt_slot *slot, int k, uint64_t ns)
{
    struct rt_section *s = &slot->sections[k];
    rt_add(&s->count, 1);
    rt_add(&s->total_ns, ns);
    if (ns > rt_get(&s->max_ns))
        rt_put(&s->max_ns, ns);
    if (ns < rt_get(&s->min_ns) || rt_get(&s->count) == 1)
        rt_put(&s->min_ns, ns);
}

#endif
