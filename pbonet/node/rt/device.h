/* Tasks timed by a device: sporadic tasks, as the schedulability tests treat them.
 *
 * A cycle belongs to an event, and its deadline is one period later. A device may be
 * early: the deadline is then computed as if the event had come on time, so that in no
 * interval does the task demand more than a periodic one of its period. An event more than
 * half a period early was not accounted for in the analysis: its cycle gets the criticality
 * of a task that has used up its reserve. If RT_FLOOD times as many come as were declared,
 * the device is not the one that was declared, or `sync` returns without an event: then the
 * task has no level, as one that hangs, until fewer come.
 *
 * While the task waits it keeps its last deadline, which has passed when the next event is
 * expected, so it goes first among its equals when it wakes up. A task whose device has
 * been silent goes last. `tests/oracles/plain_dispatcher/watch.py` has the same rules.
 */
#ifndef PBONET_DEVICE_H
#define PBONET_DEVICE_H

#include "wait.h"

/* Count an early event. A task is judged by the last ten periods, or `hang` if that is
 * longer. */
static inline void rt_count_early(struct rt_state *s, int64_t event)
{
    int64_t window = s->period * 10 > s->hang ? s->period * 10 : s->hang;
    int64_t most = window / s->period * RT_FLOOD, took = event - s->early_from_ns;
    if (s->early && took < window) {
        s->early++;
        s->flooded |= s->early >= most;
        return;
    }
    s->flooded = s->flooded && s->early >= most && took < 2 * window;
    s->early = 1;
    s->early_from_ns = event;
}

/* An event has come: a new cycle, with reserves of its own. */
static inline void rt_attend(struct rt_table *t, int i, struct rt_state *s, int64_t event)
{
    int64_t expected = s->rel_ns + s->period;
    s->event_ns = event;
    s->late = s->sure = s->handling = s->owed = s->overrun = 0;
    atomic_store(&t->slots[i].grant.owed, 0);
    s->mark = -1;               /* its CPU clock at this point is not known yet */
    s->spent = expected - event > s->period / 2;
    if (s->spent) {
        s->overruns++;
        rt_count_early(s, event);
    } else {
        s->rel_ns = event > expected ? event : expected;
        if (event - s->early_from_ns > 20 * s->period + 2 * s->hang)
            s->flooded = 0;
    }
    s->dl_ns = s->period + (s->spent ? expected : s->rel_ns);
    if (s->deadline)
        s->next_ns = event + s->deadline;
    rt_set_rank(t, i, s, rt_contained(s));
}

/* End the cycle; if it was late, the limit for the device's silence starts again now. */
static inline void rt_attended(struct rt_table *t, int i, struct rt_state *s, int64_t now)
{
    if (s->late && s->deadline)
        s->next_ns = now + s->deadline;
    s->late = s->spent = s->handling = s->owed = s->overrun = 0;
    atomic_store(&t->slots[i].grant.owed, 0);
    rt_set_rank(t, i, s, s->crit);
    rt_waits(s, now);
}

/* Read whether a cycle has begun or ended. */
static inline void rt_latch_device(struct rt_table *t, int i, struct rt_state *s,
                                   int64_t now)
{
    struct rt_post *post = &t->slots[i].post;
    /* SYNC POINT: pairs with rt_begin_event, which stores the instant first. */
    uint32_t heard = atomic_load_explicit(&post->events, memory_order_acquire);
    int64_t event = atomic_load_explicit(&post->event_ns, memory_order_relaxed);
    if (heard == s->heard)
        return;
    rt_emit(t, RT_EVENT, i, heard, event, 0);
    if (event != s->event_ns)
        rt_attend(t, i, s, event);
    s->heard = heard;
    s->active = heard & 1;
    if (!s->active)
        rt_attended(t, i, s, now);
    if (s->flooded) {
        s->overrun = RT_HUNG;
        rt_emit(t, RT_BEGUN, i, RT_HUNG, 0, 0);
    }
    s->fresh = 1;
}

/* The cycle is past its deadline and continues with the next one. */
static inline void rt_overtake(struct rt_table *t, int i, struct rt_state *s, int64_t now,
                               rt_cpu_fn cpu)
{
    if (!s->overrun)
        rt_overruns(s, cpu(&t->slots[i], 0));
    s->dl_ns += ((now - s->dl_ns) / s->period + 1) * s->period;
    s->late = 1;
    rt_fail(t, i, s, RT_DEADLINE, now, 1);
}

/* Check the task. A device that has been silent for too long is also a failure, once per
 * limit. */
static inline void rt_listen(struct rt_table *t, int i, struct rt_state *s, int64_t now,
                             int locked, rt_cpu_fn cpu)
{
    int64_t look = 0;
    if (s->mark < 0)
        s->mark = s->clock;
    if (s->next_ns && s->next_ns <= now) {
        s->next_ns = now + s->deadline;
        if (!s->active) {
            s->dl_ns = RT_NEVER;
            rt_fail(t, i, s, RT_DEADLINE, now, 1);
        }
    }
    if (s->active) {
        if (s->dl_ns <= now)
            rt_overtake(t, i, s, now, cpu);
        if (rt_limited(s))
            look = rt_look(t, i, s, now, locked);
        look = rt_sooner(look, s->dl_ns);
    } else if (s->handling) {
        look = rt_bound_handler(t, i, s, now);
    }
    s->check_ns = look;
}

#endif
