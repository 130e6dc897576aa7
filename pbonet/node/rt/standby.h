/* Standbys: tasks that are OFF with everything ready, until others end.
 *
 * A *fallback* names the slots that it replaces; it is engaged when one of them has gone
 * to ERROR or has died while it was armed. A *successor* is engaged when all its
 * predecessors have called (call.h). Engaging is a grant of its own, ranked like the task's
 * cycles: the task runs `on` in it and then arms; rt_first computes the release of its
 * first cycle. No process waits for a message in between.
 */
#ifndef PBONET_STANDBY_H
#define PBONET_STANDBY_H

#include "call.h"
#include "state.h"

static inline int rt_stands(const struct rt_state *s)
{
    return (s->word & 3) == RT_STANDS && s->after_kind && !s->engaged && !s->dead;
}

/* Whether a standby is being engaged, or one of its predecessors has ended: if it dies
 * now, the predecessor's variables have no writer. */
static inline int rt_comes(const struct rt_slot *slot)
{
    return (atomic_load(&slot->post.word) & 3) == RT_STANDS &&
           (atomic_load(&slot->grant.seq) != atomic_load(&slot->post.done) ||
            rt_one_has_called(&slot->config));
}

/* Whether one of the slots that a fallback replaces has fallen. */
static inline int rt_one_fell(const struct rt_table *t, const struct rt_state *s)
{
    for (int i = 0; i < RT_SLOTS; i++)
        if ((s->after[i / 64] >> i % 64 & 1) && t->slots[i].state.fell)
            return 1;
    return 0;
}

/* Grant the task its `on`, if its condition is met. */
static inline void rt_engage(struct rt_table *t, int i, struct rt_state *s, int64_t now)
{
    if (s->after_kind == RT_FALLBACK && !rt_one_fell(t, s))
        return;
    s->engaged = s->ready = 1;
    s->rel_ns = now;
    s->dl_ns = now + (s->deadline ? s->deadline : s->period);
    rt_emit(t, RT_ENGAGE, i, 0, now, s->dl_ns);
}

/* Take over what the slot waits for; an input. For a hand-over it waits until all have
 * called; until then it counts as waiting for nothing. */
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

/* Whether a task with that mode has fallen while armed, though no turn may have seen it. */
static inline int rt_has_fallen(const struct rt_slot *slot, uint32_t mode)
{
    return mode == RT_OFF && atomic_load(&slot->post.fell) == RT_FELL_ARMED;
}

/* Whether the task of a slot fell in that life, or died while ON, even if no turn was
 * taken meanwhile. */
static inline int rt_fell_in(const struct rt_slot *slot, uint32_t life)
{
    uint32_t mode = atomic_load(&slot->post.word) & 3;
    int died = atomic_load(&slot->config.dead) == life;
    return (died && (mode == RT_ON || mode == RT_COMMAND)) || rt_has_fallen(slot, mode);
}

/* Whether a task that fell is OFF in order again, according to its new mode. */
static inline int rt_has_recovered(const struct rt_slot *slot, const struct rt_state *s,
                                   uint32_t mode)
{
    return mode == RT_OFF && !s->dead && !rt_has_fallen(slot, mode);
}

#endif
