/* The dispatcher's thread: lead or stand by, sleep, take a turn, act on it.
 *
 * The thread belongs to no interpreter. Leadership is a robust mutex held for life: when
 * the leader's process dies, the kernel gives the mutex to a standby, which finds all it
 * needs in the table. Under `fifo` the thread has a higher priority than its tasks on their
 * own core, so what it does is atomic to them; under `park` it runs on another core.
 */
#ifndef PBONET_LOOP_H
#define PBONET_LOOP_H

#include "looker.h"
#include "table.h"

#include <sys/prctl.h>

/* The safe values of a task, which the dispatcher commits when a cycle fails. The fields
 * after `life` do not change while that is not 0. */
struct rt_safe_values {
    _Atomic uint32_t life;              /* 0: none */
    const struct pb_table *table;
    const void *data;
    uint64_t bytes;
};

struct rt_loop {
    struct rt_table *table;
    struct rt_looker looker;
    pthread_t thread;
    int backend;                /* RT_FIFO or RT_PARK */
    _Atomic int stop, leading;
    int running;
    _Atomic uint32_t busy;              /* the thread uses values[busy - 1]; 0: none */
    struct rt_safe_values values[RT_SLOTS];
};

/* Keep the safe values of the task in slot i; the memory stays until rt_drop_values. */
static inline void rt_keep_values(struct rt_loop *loop, int i, const struct pb_table *table,
                                  const void *data, uint64_t bytes)
{
    struct rt_safe_values *v = &loop->values[i];
    v->table = table;
    v->data = data;
    v->bytes = bytes;
    /* SYNC POINT: rt_make_safe loads `life` before it reads the others. */
    atomic_store(&v->life, atomic_load(&loop->table->slots[i].config.life));
}

/* Forget them; the dispatcher uses them no more when this returns. */
static inline void rt_drop_values(struct rt_loop *loop, int i)
{
    atomic_store(&loop->values[i].life, 0);
    /* SYNC POINT: rt_make_safe stores `busy` before it loads `life`. */
    while (atomic_load(&loop->busy) == (uint32_t)i + 1)
        sched_yield();
}

static inline void rt_refused(struct rt_table *t, int i, int error)
{
    struct rt_slot *slot = &t->slots[i];
    atomic_fetch_add(&slot->errors, 1);
    atomic_fetch_add(&t->errors, 1);
    if (error == ESRCH)         /* gone before its parent reported it */
        atomic_store(&slot->config.dead, slot->state.life);
}

static inline void rt_signal(struct rt_table *t, int i, int signal)
{
    pid_t pid = t->slots[i].state.pid;
    if (pid > 0 && syscall(SYS_tgkill, pid, pid, signal))
        rt_refused(t, i, errno);
}

/* Notify the task of a failure: first its kind and grant, then the signal. One of the same
 * kind, or of an earlier grant, that still waits has no call of its own: it is counted. */
static inline void rt_tell(struct rt_table *t, int i, const struct rt_event *e)
{
    struct rt_grant *g = &t->slots[i].grant;
    uint32_t bit = UINT32_C(1) << (e->arg & 3), grant = rt_number(&t->slots[i].state) << 3;
    uint32_t old = atomic_load(&g->failed), word;
    do {
        word = (old & ~UINT32_C(7)) == grant ? old | bit : grant | bit;
    } while (!atomic_compare_exchange_weak(&g->failed, &old, word));
    uint32_t gone = (old & ~UINT32_C(7)) == grant ? old & bit : old & 7;
    if (gone)
        atomic_fetch_add(&g->merged, (uint64_t)__builtin_popcount(gone));
    atomic_store(&g->failed_ns, e->a);
    atomic_store(&g->told, t->slots[i].state.told);
    rt_signal(t, i, RT_FAIL_SIGNAL);
}

/* Make the out-vars of a failed cycle safe; 0: the task must do it itself, by a signal. */
static inline int rt_make_safe(struct rt_loop *loop, const struct rt_event *e)
{
    struct rt_slot *slot = &loop->table->slots[e->slot];
    struct rt_safe_values *v = &loop->values[e->slot];
    uint32_t number = rt_number(&slot->state), life;
    int64_t deadline = slot->state.kind == RT_PERIODIC ? atomic_load(&slot->grant.dl_ns) : 0;
    int passed = (e->arg & 3) == RT_DEADLINE && deadline && deadline < e->a;
    int done = 0;
    pb_safe_want(&slot->safe, number, passed ? deadline : e->a);
    atomic_store(&loop->busy, (uint32_t)e->slot + 1);
    life = atomic_load(&v->life);
    if (life && life == slot->state.life)
        done = pb_safe_commit(v->table, &slot->safe, number, v->data, v->bytes);
    atomic_store(&loop->busy, 0);
    return done;
}

/* Act on a failure: first the out-vars, then the task's handler. */
static inline void rt_act_on_failure(struct rt_loop *loop, const struct rt_event *e)
{
    int safe = e->arg >> 9 & 1, tell = e->arg >> 8 & 1;
    if (safe && rt_make_safe(loop, e))
        safe = 0;
    if (tell)
        rt_tell(loop->table, e->slot, e);
    else if (safe)
        rt_signal(loop->table, e->slot, RT_FAIL_SIGNAL);
}

static inline int64_t rt_task_cpu(const struct rt_slot *slot, int main)
{
    pid_t pid = slot->state.pid;
    if (pid <= 0)
        return 0;
    return main ? rt_cpu_of(pid, pid) : rt_process_cpu(pid);
}

/* Carry out one record. */
static inline void rt_act(struct rt_loop *loop, const struct rt_event *e)
{
    struct rt_table *t = loop->table;
    struct rt_slot *slot = &t->slots[e->slot];
    switch (e->kind) {
    case RT_LEVEL:
        if (loop->backend == RT_FIFO && slot->state.pid > 0) {
            int error = e->arg ? rt_set_level(slot->state.pid, (int)e->arg)
                               : rt_take_level(slot->state.pid);
            atomic_fetch_add_explicit(&t->level_changes, 1, memory_order_relaxed);
            if (error)
                rt_refused(t, e->slot, error);
        }
        break;
    case RT_WAKE:
        rt_futex_wake(&slot->grant.bell);
        break;
    case RT_PARKED:
        rt_signal(t, e->slot, RT_PARK_SIGNAL);
        break;
    case RT_RESUME:
        rt_futex_wake(&slot->grant.parked);
        break;
    case RT_FAIL:
        rt_act_on_failure(loop, e);
        break;
    case RT_FORCE:
        rt_signal(t, e->slot, RT_FAIL_SIGNAL);
        break;
    case RT_RELEASE:
        atomic_fetch_add_explicit(&t->releases, 1, memory_order_relaxed);
        break;
    case RT_EVENT:              /* the end of one has an even number */
        atomic_fetch_add_explicit(&t->releases, e->arg & 1, memory_order_relaxed);
        break;
    default:
        break;
    }
}

/* Whether the task that delays others ended its cycle while the turn was taken. */
static inline int rt_top_done(struct rt_table *t)
{
    if (!atomic_load(&t->waiting))
        return 0;
    for (uint32_t i = 0; i < atomic_load(&t->high); i++) {
        struct rt_state *s = &t->slots[i].state;
        if (s->granted && !s->parked && atomic_load(&t->slots[i].post.done) == s->seq)
            return 1;
    }
    return 0;
}

/* Take one turn and act on it; returns when to wake up (0: on news only). */
static inline int64_t rt_once(struct rt_loop *loop, int lead)
{
    struct rt_table *t = loop->table;
    int backend = loop->backend;
    int64_t now = rt_now(), due = t->due_ns;
    if (backend == RT_FIFO && due) {        /* a check may be cancelled, or moved on */
        int64_t looked = atomic_exchange(&t->looked_ns, 0);
        due = rt_sooner(looked ? looked : atomic_load(&t->look_ns), atomic_load(&t->sure_ns));
    }
    if (due && now - due > atomic_load_explicit(&t->late_max_ns, memory_order_relaxed))
        atomic_store_explicit(&t->late_max_ns, now - due, memory_order_relaxed);
    if (due && now - due > RT_STALL_NS) {
        /* SYNC POINT: rt_core_snapshot loads the count before the time. */
        atomic_store(&t->stall_end_ns, now);
        atomic_fetch_add(&t->stalled_ns, (uint64_t)(now - due));
        atomic_fetch_add(&t->stalls, 1);
    }
    lead |= atomic_load(&t->relevel) && atomic_exchange(&t->relevel, 0);
    due = rt_turn(t, now, backend == RT_PARK, lead, rt_task_cpu);
    t->due_ns = due;
    uint64_t from = atomic_load_explicit(&t->trace_end, memory_order_relaxed);
    rt_turn_end(t);
    for (; from < t->trace_next; from++)
        rt_act(loop, &t->trace[from & (RT_TRACE - 1)]);
    atomic_fetch_add_explicit(&t->turns, 1, memory_order_relaxed);
    return due;
}

/* Wake every task: a dead leader may not have acted on its last decisions. */
static inline void rt_wake_all(struct rt_table *t)
{
    for (uint32_t i = 0; i < atomic_load(&t->high); i++) {
        if (!(t->slots[i].state.life & 1))
            continue;
        rt_futex_wake(&t->slots[i].grant.bell);
        if (t->slots[i].state.parked)
            rt_signal(t, (int)i, RT_PARK_SIGNAL);
        else
            rt_futex_wake(&t->slots[i].grant.parked);
    }
}

static inline void rt_lead(struct rt_loop *loop)
{
    struct rt_table *t = loop->table;
    int lead = 1;
    rt_recover(t);
    rt_wake_all(t);
    t->due_ns = 0;
    loop->looker = (struct rt_looker){.table = t};
    if (loop->backend == RT_FIFO)
        rt_looker_start(&loop->looker, t);
    while (!atomic_load(&loop->stop)) {
        /* SYNC POINT: rt_kick adds to the mailbox after its news; anything that comes after
         * this load changes the word that the sleep compares. */
        uint32_t mail = atomic_load(&t->mailbox);
        int64_t due = rt_once(loop, lead);
        lead = 0;
        if (loop->looker.running)
            due = rt_lend(t, due);
        if (!rt_top_done(t) && !atomic_load(&loop->stop))
            rt_sleep(&loop->looker, mail, due);
    }
    rt_looker_stop(&loop->looker);
    if (rt_is_lent(t))          /* no task keeps a lease without a leader */
        rt_once(loop, 0);
    for (uint32_t i = 0; i < RT_SLOTS; i++) {   /* no task stays held without a leader */
        t->slots[i].state.parked = 0;
        atomic_store(&t->slots[i].grant.parked, 0);
        rt_futex_wake(&t->slots[i].grant.parked);
    }
}

/* Become the leader; 0 when asked to stop instead. Checks ten times a second. */
static inline int rt_stand_by(struct rt_loop *loop, int *died)
{
    struct rt_table *t = loop->table;
    while (!atomic_load(&loop->stop)) {
        struct timespec until = rt_timespec(rt_now() + 100000000);
        int error = pthread_mutex_clocklock(&t->leader, CLOCK_MONOTONIC, &until);
        if (error == EOWNERDEAD)
            pthread_mutex_consistent(&t->leader);
        *died = error == EOWNERDEAD;
        if (error == 0 || error == EOWNERDEAD)
            return 1;
    }
    return 0;
}

static inline void *rt_thread(void *arg)
{
    struct rt_loop *loop = arg;
    struct rt_table *t = loop->table;
    int died = 0;
    prctl(PR_SET_TIMERSLACK, 1L);
    pthread_setname_np(pthread_self(), "dispatcher");
    if (!rt_stand_by(loop, &died))
        return NULL;
    if (died)
        atomic_fetch_add(&t->takeovers, 1);
    atomic_store(&t->backend, loop->backend);
    atomic_store(&t->since_ns, rt_now());
    /* SYNC POINT: rt_stall_age loads `leader_tid` first. This leader is not late for what the
     * one before was to do. */
    atomic_store(&t->sure_ns, 0);
    atomic_store(&t->leader_tid, (int32_t)syscall(SYS_gettid));
    atomic_store(&t->leader_pid, getpid());
    atomic_store(&loop->leading, 1);
    rt_lead(loop);
    atomic_store(&loop->leading, 0);
    atomic_store(&t->leader_pid, 0);
    atomic_store(&t->leader_tid, 0);
    atomic_store(&t->backend, RT_NONE);
    pthread_mutex_unlock(&t->leader);
    return NULL;
}

/* The core for the thread: its tasks' own under `fifo`, otherwise any other one. */
static inline void rt_choose_core(int backend, int core, cpu_set_t *set)
{
    cpu_set_t own;
    CPU_ZERO(set);
    CPU_SET((size_t)core, set);
    if (backend == RT_FIFO || sched_getaffinity(0, sizeof own, &own))
        return;
    CPU_CLR((size_t)core, &own);
    if (CPU_COUNT(&own))
        *set = own;
}

/* Start a thread, under `fifo` at priority `level`; an errno value when refused. */
static inline int rt_spawn_thread(pthread_t *thread, int backend, int core, int level,
                                  void *(*run)(void *), void *arg)
{
    pthread_attr_t attr;
    struct sched_param param = {.sched_priority = backend == RT_FIFO ? level : 0};
    cpu_set_t set;
    sigset_t all, old;
    rt_choose_core(backend, core, &set);
    pthread_attr_init(&attr);
    pthread_attr_setstacksize(&attr, 1 << 18);
    pthread_attr_setinheritsched(&attr, PTHREAD_EXPLICIT_SCHED);
    pthread_attr_setschedpolicy(&attr, backend == RT_FIFO ? SCHED_FIFO : SCHED_OTHER);
    pthread_attr_setschedparam(&attr, &param);
    pthread_attr_setaffinity_np(&attr, sizeof set, &set);
    sigfillset(&all);           /* signals are for the interpreter's threads, */
    sigdelset(&all, SIGBUS);    /* except for a truncated table: survive.h */
    pthread_sigmask(SIG_SETMASK, &all, &old);
    int error = pthread_create(thread, &attr, run, arg);
    pthread_sigmask(SIG_SETMASK, &old, NULL);
    pthread_attr_destroy(&attr);
    return error;
}

/* Start the dispatcher's thread; an errno value when the kernel refuses. */
static inline int rt_start(struct rt_loop *loop)
{
    atomic_store(&loop->stop, 0);
    int error = rt_spawn_thread(&loop->thread, loop->backend, loop->table->core,
                                RT_DISPATCHER_LEVEL, rt_thread, loop);
    loop->running = !error;
    return error;
}

static inline void rt_stop(struct rt_loop *loop)
{
    if (!loop->running)
        return;
    atomic_store(&loop->stop, 1);
    rt_kick(loop->table);
    pthread_join(loop->thread, NULL);
    loop->running = 0;
}

static inline int rt_leading(const struct rt_loop *loop)
{
    return atomic_load(&loop->leading);
}

static inline void *rt_nothing(void *arg)
{
    return arg;
}

/* Whether the kernel grants a thread the dispatcher's priority: 0, or an errno value. */
static inline int rt_try_fifo(void)
{
    pthread_attr_t attr;
    pthread_t thread;
    struct sched_param param = {.sched_priority = RT_DISPATCHER_LEVEL};
    pthread_attr_init(&attr);
    pthread_attr_setinheritsched(&attr, PTHREAD_EXPLICIT_SCHED);
    pthread_attr_setschedpolicy(&attr, SCHED_FIFO);
    pthread_attr_setschedparam(&attr, &param);
    int error = pthread_create(&thread, &attr, rt_nothing, NULL);
    pthread_attr_destroy(&attr);
    if (!error)
        pthread_join(thread, NULL);
    return error;
}

#endif
