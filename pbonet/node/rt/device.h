/* Tasks that a device times: sporadic ones, as the schedulability tests see them.
 *
 * A cycle belongs to an event, and its deadline lies one period behind that. A device may
 * come early: the deadline is then what it would be had the event come in its time, so
 * that in no stretch the task asks for more than a periodic one of its period would. An
 * event more than half a period early is none that was reckoned with. Its cycle has the
 * criticality of one that has used up its reserve.
 *
 * While the task waits it keeps the deadline that is over by the time at which the next
 * event is expected, so it goes first among its equals when it wakes up. Who has been
 * silent goes last. `tests/oracles/plain_dispatcher/watch.py` is the twin.
 */
#ifndef PBONET_DEVICE_H
#define PBONET_DEVICE_H

#include "watch.h"

/* An event has come: a new cycle, with reserves of its own. */
static inline void rt_attend(struct rt_table *t, int i, struct rt_state *s, int64_t event)
{
    int64_t expected = s->rel_ns + s->period;
    s->event_ns = event;
    s->late = s->sure = s->handling = s->owed = 0;
    atomic_store(&t->slots[i].grant.owed, 0);
    s->mark = -1;               /* where its clock stands is not known yet */
    s->spent = expected - event > s->period / 2;
    if (s->spent)
        s->overruns++;
    else
        s->rel_ns = event > expected ? event : expected;
    s->dl_ns = s->period + (s->spent ? expected : s->rel_ns);
    if (s->deadline)
        s->next_ns = event + s->deadline;
    rt_set_rank(t, i, s, rt_contained(s));
}

/* The cycle has ended; the device may be silent from now on if it took too long. */
static inline void rt_attended(struct rt_table *t, int i, struct rt_state *s, int64_t now)
{
    if (s->late && s->deadline)
        s->next_ns = now + s->deadline;
    s->late = s->spent = s->handling = s->owed = 0;
    atomic_store(&t->slots[i].grant.owed, 0);
    rt_set_rank(t, i, s, s->crit);
}

/* Take in that a cycle has begun or ended. */
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
    s->fresh = 1;
}

/* The cycle is past its deadline, and goes on with the next one. */
static inline void rt_overtake(struct rt_table *t, int i, struct rt_state *s, int64_t now)
{
    s->dl_ns += ((now - s->dl_ns) / s->period + 1) * s->period;
    s->late = 1;
    rt_fail(t, i, s, RT_DEADLINE, now, 1);
}

/* Look after the task; a device that should have been heard of is a failure, too, once in
 * each limit. */
static inline void rt_listen(struct rt_table *t, int i, struct rt_state *s, int64_t now,
                             int locked)
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
            rt_overtake(t, i, s, now);
        if (rt_limited(s))
            look = rt_look(t, i, s, now, locked);
        look = rt_sooner(look, s->dl_ns);
    } else if (s->handling) {
        look = rt_bound_handler(t, i, s, now);
    }
    s->check_ns = look;
}

#endif
