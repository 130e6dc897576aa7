/* Tasks that stand by: they wait, OFF and with everything ready, until others end.
 *
 * A slot in mode RT_STANDS names the slots that it comes after. A *fallback* is engaged
 * when one of them has gone to ERROR or has died while it was armed; the heir of a
 * *handover* when all of them have been turned off in order. Engaging is a grant of its
 * own, ranked like the task's cycles: the task runs `on` in it and then arms; rt_first
 * says when its first cycle is released. Nobody but the dispatcher takes part: neither the
 * RTPU process's interpreter nor its agent.
 */
#ifndef PBONET_STANDBY_H
#define PBONET_STANDBY_H

#include "state.h"

static inline int rt_stands(const struct rt_state *s)
{
    return (s->word & 3) == RT_STANDS && s->after_kind && !s->engaged && !s->dead;
}

/* Whether a task that stands by comes on now, or will as soon as those have ended that it
 * takes over from in order, or one of other cores has ended and called it: if it dies now,
 * nobody writes what they wrote. */
static inline int rt_comes(const struct rt_slot *slot)
{
    return (atomic_load(&slot->post.word) & 3) == RT_STANDS &&
           (atomic_load(&slot->grant.seq) != atomic_load(&slot->post.done) ||
            atomic_load(&slot->config.after_kind) == RT_HANDOVER ||
            atomic_load(&slot->config.called));
}

/* Whether the slots that `s` comes after have ended as it waits for. */
static inline int rt_called(const struct rt_table *t, const struct rt_state *s)
{
    int all = 1;
    for (int i = 0; i < RT_SLOTS; i++) {
        if (!(s->after[i / 64] >> i % 64 & 1))
            continue;
        const struct rt_state *one = &t->slots[i].state;
        if (s->after_kind == RT_FALLBACK && one->fell)
            return 1;
        all &= !one->armed && !one->fell;
    }
    return s->after_kind == RT_HANDOVER && all;
}

/* Grant the task its `on`, if it is time. */
static inline void rt_engage(struct rt_table *t, int i, struct rt_state *s, int64_t now)
{
    if (!rt_called(t, s))
        return;
    s->engaged = s->ready = 1;
    s->rel_ns = now;
    s->dl_ns = now + (s->deadline ? s->deadline : s->period);
    rt_emit(t, RT_ENGAGE, i, 0, now, s->dl_ns);
}

/* Take over whose end the slot waits for; an input. */
static inline void rt_latch_after(struct rt_table *t, int i, struct rt_state *s,
                                  int32_t kind, const uint64_t *after)
{
    if (kind == s->after_kind && !memcmp(after, s->after, sizeof s->after))
        return;
    s->after_kind = kind;
    memcpy(s->after, after, sizeof s->after);
    rt_emit(t, RT_AFTER, i, (uint32_t)kind, (int64_t)after[0], (int64_t)after[1]);
}

/* Whether a task with that mode has fallen, armed or not as far as a turn has seen. */
static inline int rt_has_fallen(const struct rt_slot *slot, uint32_t mode)
{
    return mode == RT_OFF && atomic_load(&slot->post.fell) == RT_FELL_ARMED;
}

/* Whether the task of a slot fell in that life, or died ON, though nobody looked
 * meanwhile. */
static inline int rt_fell_in(const struct rt_slot *slot, uint32_t life)
{
    uint32_t mode = atomic_load(&slot->post.word) & 3;
    int died = atomic_load(&slot->config.dead) == life;
    return (died && (mode == RT_ON || mode == RT_COMMAND)) || rt_has_fallen(slot, mode);
}

/* Whether a task that fell is OFF in order again, as its new mode says. */
static inline int rt_has_recovered(const struct rt_slot *slot, const struct rt_state *s,
                                   uint32_t mode)
{
    return mode == RT_OFF && !s->dead && !rt_has_fallen(slot, mode);
}

#endif
