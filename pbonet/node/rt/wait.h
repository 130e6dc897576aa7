/* A `sync` that computes instead of waiting.
 *
 * A task timed by events keeps its rank while it waits, so that its cycle begins as soon as
 * the event comes. If `sync` computes without end, less urgent tasks and commands would never
 * run. So the CPU clock of a task that has waited for a while is read, at most once in each
 * `hang`: a wait that has used that much of CPU time, within RT_WAIT_SPAN times as much time,
 * hangs, as a cycle does, until an event comes. The clock of the process is read first, since
 * that is cheap; if that says so, the one of the main thread, because threads that the module
 * has started may compute while it waits. Nothing is read for a task whose events come more
 * often than that. Background tasks compute as long as they want.
 */
#ifndef PBONET_WAIT_H
#define PBONET_WAIT_H

#include "watch.h"

/* A wait begins. */
static inline void rt_waits(struct rt_state *s, int64_t now)
{
    s->wait_ns = s->kind == RT_BACKGROUND ? 0 : now + s->hang;
    s->wait_mark = -1;
    s->wait_main = 0;
}

static inline void rt_measure_wait(struct rt_state *s, int64_t now, int64_t clock)
{
    s->wait_from_ns = now;
    s->wait_mark = clock;
    s->wait_ns = now + s->hang;
}

/* Read how much CPU time a wait has used. */
static inline void rt_latch_wait(struct rt_table *t, int i, struct rt_state *s, int64_t now,
                                 rt_cpu_fn cpu)
{
    s->wait_ns = 0;
    if (s->active || s->overrun)
        return;
    uint32_t events = atomic_load(&t->slots[i].post.events);
    if (events != s->wait_events) {     /* one came and went between two turns */
        s->wait_events = events;
        rt_waits(s, now);
        return;
    }
    int64_t clock = cpu(&t->slots[i], s->wait_main), used = clock - s->wait_mark;
    if (s->wait_mark < 0) {
        rt_measure_wait(s, now, clock);
    } else if (used < s->hang) {
        if (now - s->wait_from_ns >= RT_WAIT_SPAN * s->hang)
            rt_measure_wait(s, now, clock);
        else
            s->wait_ns = rt_later(now, s->hang - used);
    } else if (!s->wait_main) {
        s->wait_main = 1;
        rt_measure_wait(s, now, cpu(&t->slots[i], 1));
    } else {
        s->overrun = RT_HUNG;
        rt_emit(t, RT_BEGUN, i, RT_HUNG, 0, 0);
    }
}

#endif
