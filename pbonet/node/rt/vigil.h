/* The death watch: detects at once, without polling, that a task has died.
 *
 * Every task holds a robust lock in its slot for life. When it dies, whatever the cause,
 * the kernel marks the lock's word and wakes its waiters, long before the process is
 * gone and its parent notified. One thread of the RTPU process, just below the dispatcher,
 * waits for all of these words at once. It notifies the dispatcher, which engages a fallback
 * in its next turn, and raises the illegal-configuration flag in the task's table, so that
 * critical tasks run `stable` from the next cycle on. A task that goes to ERROR wakes the
 * same thread. The RTPU process's interpreter learns of both later and does the rest.
 *
 * Kernels before 5.16 cannot wait for several words; then the interpreter learns first,
 * some milliseconds later.
 */
#ifndef PBONET_VIGIL_H
#define PBONET_VIGIL_H

#include "loop.h"
#include "../../svar/flag.h"

#ifndef SYS_futex_waitv
#define SYS_futex_waitv 449         /* the same on every architecture */
#endif

enum { RT_VIGIL_LEVEL = RT_DISPATCHER_LEVEL - 1, RT_VIGIL_WORDS = 128, RT_WORD_32 = 2,
       RT_CAUSE = PB_TEXT, RT_RAISER = PB_NAME };

struct rt_futex_word {                  /* as the kernel's struct futex_waitv */
    uint64_t value, address;
    uint32_t flags, reserved;
};

/* One watched task. The fields after `busy` do not change while `life` is not 0. */
struct rt_watched {
    _Atomic uint32_t life;              /* 0: no task */
    _Atomic uint32_t busy;              /* the thread uses the fields */
    const struct pb_table *table;       /* NULL: no task depends on this one */
    char died[RT_CAUSE], fell[RT_CAUSE], raiser[RT_RAISER], machine[RT_RAISER];
};

struct rt_vigil {
    struct rt_table *table;
    pthread_t thread;
    int running, backend;
    _Atomic uint32_t news;              /* futex: changes when the watched set changes */
    _Atomic int stop;
    _Atomic uint64_t deaths, falls;
    uint32_t told[RT_SLOTS];            /* the life whose fall was reported */
    struct rt_watched watched[RT_SLOTS];
};

static inline _Atomic uint32_t *rt_life_word(struct rt_slot *slot)
{
    return (_Atomic uint32_t *)(void *)&slot->alive;    /* as in every Linux C library */
}

/* Lock it for life; an errno value when that fails. */
static inline int rt_vow(struct rt_slot *slot)
{
    int error = pthread_mutex_trylock(&slot->alive);
    return error == EOWNERDEAD ? pthread_mutex_consistent(&slot->alive) : error;
}

/* Unlock it: the task leaves in order. */
static inline void rt_release_vow(struct rt_slot *slot)
{
    pthread_mutex_unlock(&slot->alive);
}

static inline uint64_t rt_deaths(const struct rt_vigil *v)
{
    return atomic_load(&v->deaths);
}

static inline uint64_t rt_falls(const struct rt_vigil *v)
{
    return atomic_load(&v->falls);
}

static inline void rt_raise(const struct rt_watched *w, const char *cause)
{
    if (!w->table)
        return;
    struct pb_cause c = pb_cause_of(cause, w->raiser, w->machine);
    pb_raise(w->table, &c);             /* no room: other causes keep the flag up */
}

/* Raise the flag for a death if other tasks depend on it; returns whether they do. */
static inline int rt_alarm(struct rt_vigil *v, int i, const struct rt_watched *w)
{
    const struct rt_slot *slot = &v->table->slots[i];
    uint32_t mode = atomic_load(&slot->post.word) & 3;
    if (mode != RT_ON && mode != RT_COMMAND && !rt_comes(slot))
        return 0;
    atomic_fetch_add(&v->deaths, 1);
    rt_raise(w, w->died);
    return 1;
}

/* Report a death; the flag is raised first, so that the next released task sees it. */
static inline void rt_mourn(struct rt_vigil *v, int i, struct rt_watched *w)
{
    struct rt_slot *slot = &v->table->slots[i];
    int32_t pid = atomic_load(&slot->config.pid);
    if (v->backend == RT_FIFO && pid > 0)
        rt_take_level(pid);     /* first: otherwise released tasks wait for its exit */
    int raised = rt_alarm(v, i, w);
    atomic_store(&slot->config.dead, atomic_load(&w->life));
    /* SYNC POINT: rt_call marks its call first and then checks for a death. */
    if (!raised)
        rt_alarm(v, i, w);
    atomic_store(&w->life, 0);
    rt_kick(v->table);
}

/* Check one task; returns 1 with its lock's word in `to` if it is alive. */
static inline int rt_look_after(struct rt_vigil *v, int i, struct rt_watched *w,
                                struct rt_futex_word *to)
{
    struct rt_slot *slot = &v->table->slots[i];
    _Atomic uint32_t *at = rt_life_word(slot);
    if (atomic_load(&slot->config.life) != atomic_load(&w->life))
        return 0;
    if (atomic_load(&slot->post.fell) && v->told[i] != atomic_load(&w->life)) {
        v->told[i] = atomic_load(&w->life);
        atomic_fetch_add(&v->falls, 1);
        rt_raise(w, w->fell);
    } else if (!atomic_load(&slot->post.fell)) {
        v->told[i] = 0;
    }
    uint32_t word = atomic_load(at);
    while (word && !(word & (FUTEX_OWNER_DIED | FUTEX_WAITERS)))
        if (atomic_compare_exchange_weak(at, &word, word | FUTEX_WAITERS))
            word |= FUTEX_WAITERS;
    if (word & FUTEX_OWNER_DIED)
        rt_mourn(v, i, w);
    if (!word || word & FUTEX_OWNER_DIED)
        return 0;               /* 0: it left in order */
    *to = (struct rt_futex_word){word, (uint64_t)(uintptr_t)at, RT_WORD_32, 0};
    return 1;
}

static inline void *rt_keep_vigil(void *arg)
{
    struct rt_vigil *v = arg;
    struct rt_futex_word words[RT_VIGIL_WORDS];
    pthread_setname_np(pthread_self(), "vigil");
    while (!atomic_load(&v->stop)) {
        unsigned n = 2;
        words[0] = (struct rt_futex_word){atomic_load(&v->news),
                                          (uint64_t)(uintptr_t)&v->news, RT_WORD_32, 0};
        words[1] = (struct rt_futex_word){atomic_load(&v->table->fallen),
                                          (uint64_t)(uintptr_t)&v->table->fallen,
                                          RT_WORD_32, 0};
        for (int i = 0; i < RT_SLOTS && n < RT_VIGIL_WORDS; i++) {
            struct rt_watched *w = &v->watched[i];
            /* SYNC POINT: rt_unwatch clears `life` first and then waits for `busy`. */
            atomic_store(&w->busy, 1);
            if (atomic_load(&w->life))
                n += (unsigned)rt_look_after(v, i, w, &words[n]);
            atomic_store(&w->busy, 0);
        }
        if (atomic_load(&v->stop))
            break;
        if (syscall(SYS_futex_waitv, words, n, 0, NULL, CLOCK_MONOTONIC) < 0 &&
            errno != EAGAIN && errno != EINTR)
            break;              /* not supported by this kernel */
    }
    return NULL;
}

static inline void rt_ring_vigil(struct rt_vigil *v)
{
    atomic_fetch_add(&v->news, 1);
    rt_futex_wake(&v->news);
}

/* Stop watching; on return the thread no longer uses the entry's table. */
static inline void rt_unwatch(struct rt_vigil *v, int i)
{
    struct rt_watched *w = &v->watched[i];
    atomic_store(&w->life, 0);
    while (v->running && atomic_load(&w->busy))
        sched_yield();
    rt_ring_vigil(v);
}

/* Watch the task that holds slot `i` now; its entry has been filled in. */
static inline void rt_watch_life(struct rt_vigil *v, int i)
{
    atomic_store(&v->watched[i].life, atomic_load(&v->table->slots[i].config.life));
    rt_ring_vigil(v);
}

/* Start the thread beside the dispatcher of `loop`; an errno value when refused. */
static inline int rt_start_vigil(struct rt_vigil *v, const struct rt_loop *loop)
{
    v->table = loop->table;
    v->backend = loop->backend;
    atomic_store(&v->stop, 0);
    int error = rt_spawn_thread(&v->thread, loop->backend, loop->table->core,
                                RT_VIGIL_LEVEL, rt_keep_vigil, v);
    v->running = !error;
    return error;
}

static inline void rt_end_vigil(struct rt_vigil *v)
{
    if (!v->running)
        return;
    atomic_store(&v->stop, 1);
    rt_ring_vigil(v);
    pthread_join(v->thread, NULL);
    v->running = 0;
}

#endif
