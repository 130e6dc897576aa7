/* Tasks that stand by: they wait, OFF and with everything ready, until others end.
 *
 * A *fallback* names the slots that it comes after; it is engaged when one of them has gone
 * to ERROR or has died while it was armed. A *successor* is engaged when all who hand over
 * to it have called (call.h). Engaging is a grant of its own, ranked like the task's
 * cycles: the task runs `on` in it and then arms; rt_first says when its first cycle is
 * released. No process waits for a message in between.
 */
#ifndef PBONET_STANDBY_H
#define PBONET_STANDBY_H

#include "call.h"
#include "state.h"

static inline int rt_stands(const struct rt_state *s)
{
    return (s->word & 3) == RT_STANDS && s->after_kind && !s->engaged && !s->dead;
}

/* Whether a task that stands by comes on now, or one that hands over to it has ended: if
 * it dies now, nobody writes what that one wrote. */
static inline int rt_comes(const struct rt_slot *slot)
{
    return (atomic_load(&slot->post.word) & 3) == RT_STANDS &&
           (atomic_load(&slot->grant.seq) != atomic_load(&slot->post.done) ||
            rt_one_has_called(&slot->config));
}

/* Whether one of the slots that a fallback comes after has fallen. */
static inline int rt_one_fell(const struct rt_table *t, const struct rt_state *s)
{
    for (int i = 0; i < RT_SLOTS; i++)
        if ((s->after[i / 64] >> i % 64 & 1) && t->slots[i].state.fell)
            return 1;
    return 0;
}

/* Grant the task its `on`, if it is time. */
static inline void rt_engage(struct rt_table *t, int i, struct rt_state *s, int64_t now)
{
    if (s->after_kind == RT_FALLBACK && !rt_one_fell(t, s))
        return;
    s->engaged = s->ready = 1;
    s->rel_ns = now;
    s->dl_ns = now + (s->deadline ? s->deadline : s->period);
    rt_emit(t, RT_ENGAGE, i, 0, now, s->dl_ns);
}

/* Take over whose end the slot waits for; an input. It waits for a handover until all
 * have called: then it comes after nobody any more. */
static inline void rt_latch_after(struct rt_table *t, int i, struct rt_state *s,
                                  int32_t kind, const uint64_t *after)
{
    if (kind == RT_HANDOVER && !rt_all_have_called(&t->slots[i].config, s->ticket))
        kind = RT_ALONE;
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
