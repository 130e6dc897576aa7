/* The leader's side of look.h: the timer, and the thread that waits for it. */
#ifndef PBONET_LOOKER_H
#define PBONET_LOOKER_H

#include "dispatch.h"
#include "look.h"

struct rt_looker {
    struct rt_table *table;
    pthread_t thread;
    int running, fd;
    _Atomic int stop;
};

/* Whether the slot has a cycle or event under way whose end counts against a check. */
static inline int rt_busy(struct rt_slot *slot)
{
    const struct rt_state *s = &slot->state;
    if (!s->armed)
        return 0;
    if (rt_is_server(s) || s->kind == RT_SYNCHRONOUS)
        return (int)(atomic_load(&slot->post.events) & 1);
    return s->ready && !(s->granted && atomic_load(&slot->post.done) == s->seq);
}

/* Number the check, and count the cycles that must end to make it unnecessary. Under a
 * lease none: every cycle that ends moves the timer. */
static inline void rt_count_looked(struct rt_table *t)
{
    uint32_t number = (uint32_t)(atomic_load(&t->look) >> 32) + 1;
    uint64_t count = 0;
    number += !number;          /* 0 means none */
    int lent = rt_is_lent(t);
    for (uint32_t i = 0; i < atomic_load(&t->high); i++)
        if (!lent && rt_busy(&t->slots[i])) {
            atomic_store_explicit(&t->slots[i].grant.look, number, memory_order_relaxed);
            count++;
        }
    atomic_store(&t->look, (uint64_t)number << 32 | count);
}

static inline void rt_set_look(struct rt_looker *looker, int64_t at)
{
    struct itimerspec when = {.it_value = rt_timespec(at)};
    atomic_store(&looker->table->look_ns, at);
    timerfd_settime(looker->fd, TFD_TIMER_ABSTIME, &when, NULL);
}

/* Sleep until mail or `due`; the timer handles a check before the next certain event. */
static inline void rt_sleep(struct rt_looker *looker, uint32_t mail, int64_t due)
{
    struct rt_table *t = looker->table;
    int64_t sure = atomic_load(&t->sure_ns), set = atomic_load(&t->look_ns);
    if (!looker->running || due == sure) {
        if (set)
            rt_set_look(looker, 0);
        rt_futex_wait(&t->mailbox, mail, due);
        return;
    }
    rt_count_looked(t);
    rt_set_look(looker, due);
    rt_futex_wait(&t->mailbox, mail, sure);
}

static inline void *rt_looker_thread(void *arg)
{
    struct rt_looker *looker = arg;
    struct rt_table *t = looker->table;
    uint64_t times;
    pthread_setname_np(pthread_self(), "looker");
    atomic_store(&t->look_tid, (int32_t)syscall(SYS_gettid));
    while (read(looker->fd, &times, sizeof times) > 0 && !atomic_load(&looker->stop)) {
        atomic_store(&t->looked_ns, atomic_exchange(&t->look_ns, 0));
        rt_kick(t);
    }
    return NULL;
}

/* Start the timer's thread beside a dispatcher under `fifo`; without it the dispatcher
 * itself wakes up for checks. */
static inline void rt_looker_start(struct rt_looker *looker, struct rt_table *t)
{
    pthread_attr_t attr;
    looker->table = t;
    looker->running = 0;
    atomic_store(&looker->stop, 0);
    atomic_store(&t->look_ns, 0);
    atomic_store(&t->looked_ns, 0);
    looker->fd = timerfd_create(CLOCK_MONOTONIC, TFD_CLOEXEC);
    if (looker->fd < 0)
        return;
    pthread_attr_init(&attr);   /* level, core, blocked signals are the dispatcher's own */
    pthread_attr_setstacksize(&attr, 1 << 17);
    looker->running = !pthread_create(&looker->thread, &attr, rt_looker_thread, looker);
    pthread_attr_destroy(&attr);
    if (!looker->running) {
        close(looker->fd);
        return;
    }
    atomic_store(&t->look_fd, looker->fd);
    atomic_fetch_add(&t->look_life, 1);
}

static inline void rt_looker_stop(struct rt_looker *looker)
{
    if (!looker->running)
        return;
    atomic_store(&looker->stop, 1);
    rt_set_look(looker, 1);
    pthread_join(looker->thread, NULL);
    atomic_store(&looker->table->look_tid, 0);
    close(looker->fd);
    looker->running = 0;
}

#endif
