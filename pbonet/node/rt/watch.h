/* What a task cannot detect about itself: missed deadlines, used reserves, silence.
 *
 * The timing failures of Stewart 1994, section 6.3, and the reserves of soft tasks and
 * servers (6.4, 6.5), which are built on them. A failure is first contained, by a change of
 * criticality in the same turn, and then reported. CPU time is read lazily: it passes
 * no faster than time itself, so a reserve is checked at the earliest time at which it
 * could be used up, and then again. A cycle stands still during a turn and on its way back
 * from it, so the check of a cycle's reserve comes later by RT_TAKEN_NS: at the earliest time it
 * would mostly find a few microseconds left, and need another check RT_MARGIN_NS later.
 * `tests/oracles/plain_dispatcher/watch.py` has the same rules.
 */
#ifndef PBONET_WATCH_H
#define PBONET_WATCH_H

#include "state.h"

/* The CPU clock of a slot's task, or of its main thread alone, in nanoseconds. */
typedef int64_t (*rt_cpu_fn)(const struct rt_slot *, int main);

static inline int64_t rt_sooner(int64_t a, int64_t b)
{
    return !a ? b : !b ? a : a < b ? a : b;
}

static inline int64_t rt_later(int64_t now, int64_t ns)
{
    return now + (ns > RT_MARGIN_NS ? ns : RT_MARGIN_NS);
}

static inline int rt_is_server(const struct rt_state *s)
{
    return s->kind == RT_DEFERRABLE || s->kind == RT_SPORADIC;
}

/* Whether a cycle is under way to which failures can be delivered. */
static inline int rt_runs(const struct rt_state *s)
{
    return s->kind == RT_SYNCHRONOUS ? s->active : s->begun;
}

/* The number of that cycle: of its grant, or of its device's event. */
static inline uint32_t rt_number(const struct rt_state *s)
{
    return s->kind == RT_SYNCHRONOUS ? s->heard : s->seq;
}

/* Whether anything about the task depends on its CPU time. */
static inline int rt_limited(const struct rt_state *s)
{
    return s->maxc || s->minc || s->handler;
}

/* The time of the next check of an armed slot; 0: none before there is news. */
static inline int64_t rt_due(const struct rt_state *s)
{
    int64_t due = rt_sooner(s->next_ns, s->check_ns);
    if (s->kind == RT_PERIODIC && s->ready && !s->late && s->dl_ns < s->next_ns)
        due = rt_sooner(due, s->dl_ns);
    return due;
}

/* The part of rt_due that does not depend on whether cycles end earlier. The dispatcher
 * sleeps for other times only while a cycle or an event is under way: see looker.h. */
static inline int64_t rt_sure(const struct rt_state *s)
{
    return s->next_ns;
}

static inline void rt_set_rank(struct rt_table *t, int i, struct rt_state *s, int32_t rank)
{
    if (s->rank == rank)
        return;
    s->rank = rank;
    rt_emit(t, RT_CRIT, i, (uint32_t)rank, 0, 0);
}

/* A cycle has used up its period, or a server's event the capacity; `clock` is the CPU
 * clock now. A cycle continues with the deadline of the next period, for it may have been
 * delayed by others. If it uses the CPU time of another whole period it goes last among
 * equally critical tasks, and once it has used `hang`, it hangs. */
static inline void rt_overruns(struct rt_state *s, int64_t clock)
{
    if (s->overrun)
        return;
    s->overrun = RT_OVER;
    s->overrun_mark = clock;
}

/* Count a failure. If a cycle is under way, send it to the module's handler, and have the
 * out-vars made safe, as far as the task has either. */
static inline void rt_fail(struct rt_table *t, int i, struct rt_state *s, int kind,
                           int64_t now, int reachable)
{
    int tell = reachable && (s->tells & RT_TELLS);
    int safe = rt_runs(s) && (s->tells & RT_SAFE_AT(kind)) != 0;
    s->failures[kind]++;
    rt_emit(t, RT_FAIL, i, (uint32_t)kind | (uint32_t)tell << 8 | (uint32_t)safe << 9, now,
            0);
    if (!tell)
        return;
    s->told++;
    if (s->handler > s->rank) {
        s->handling = 1;
        s->handler_mark = s->clock;
        rt_set_rank(t, i, s, s->handler);
    }
}

/* Count periods in a row in which a server uses up its capacity. If they last for
 * RT_WAIT_SPAN times `hang`, and are at least three, events come without end: beyond its
 * capacity the server then has no level, until a period in which some is left. One event
 * that hangs is no event without end. */
static inline void rt_count_spent(struct rt_state *s, int64_t now)
{
    int64_t since = now - s->early_from_ns;
    if ((s->early && since < s->period / 2) || (s->overrun == RT_HUNG && !s->flooded))
        return;
    if (!s->early || since > 3 * s->period)
        s->early = s->flooded = 0;
    s->early++;
    s->early_from_ns = now;
    s->flooded |= s->early >= 3 && s->early * s->period >= RT_WAIT_SPAN * s->hang;
}

/* The reserve is used up. In a critical section the drop waits for the section's end. */
static inline void rt_exhaust(struct rt_table *t, int i, struct rt_state *s, int64_t now,
                              int locked)
{
    s->spent = 1;
    s->overruns++;
    if (locked) {
        s->owed = 1;
        s->locked_ns = now + RT_HOLD_OFF_NS;
        atomic_store(&t->slots[i].grant.owed, 1);
    } else if (!s->handling) {
        rt_set_rank(t, i, s, rt_contained(s));
    }
    if (rt_is_server(s))
        rt_count_spent(s, now);
    else
        rt_fail(t, i, s, RT_MAXEXEC, now, rt_runs(s));
}

/* The section has ended, or has lasted too long. */
static inline void rt_settle_debt(struct rt_table *t, int i, struct rt_state *s)
{
    s->owed = 0;
    atomic_store(&t->slots[i].grant.owed, 0);
    if (!s->handling)
        rt_set_rank(t, i, s, rt_contained(s));
}

/* The guaranteed CPU time can no longer be provided before the deadline. */
static inline void rt_give_up(struct rt_table *t, int i, struct rt_state *s, int64_t now)
{
    s->sure = 1;
    if (rt_runs(s)) {
        rt_fail(t, i, s, RT_MINEXEC, now, 1);
    } else if (s->granted) {    /* it has its release: it must not begin */
        s->skip = 1;
        atomic_store(&t->slots[i].grant.skip, s->seq);
        rt_emit(t, RT_SKIP, i, s->seq, 0, 0);
        rt_fail(t, i, s, RT_MINEXEC, now, 1);
    } else {
        rt_fail(t, i, s, RT_MINEXEC, now, 0);
        rt_over(s);
        s->missed++;
        rt_emit(t, RT_MISS, i, 1, 0, 0);
    }
}

/* Bound the CPU time of a handler at its own priority; returns the next check's time. */
static inline int64_t rt_bound_handler(struct rt_table *t, int i, struct rt_state *s,
                                       int64_t now)
{
    int64_t left = RT_HANDLER_NS - (s->clock - s->handler_mark);
    if (left > 0)
        return rt_later(now, left);
    s->handling = 0;
    rt_set_rank(t, i, s, rt_contained(s));
    return 0;
}

/* Check the reserves of a cycle; returns the next check's time. */
static inline int64_t rt_look(struct rt_table *t, int i, struct rt_state *s, int64_t now,
                              int locked)
{
    int64_t used = rt_runs(s) ? s->clock - s->mark : 0, next = 0;
    if (s->maxc && !s->spent) {
        if (used >= s->maxc)
            rt_exhaust(t, i, s, now, locked);
        else
            next = rt_later(now, s->maxc - used + RT_TAKEN_NS);
    }
    if (s->owed) {
        if (s->locked_ns <= now) {
            s->held_off++;
            rt_settle_debt(t, i, s);
            atomic_store(&t->slots[i].grant.forced, rt_number(s));
            rt_emit(t, RT_FORCE, i, rt_number(s), 0, 0);
        } else {
            next = rt_sooner(next, s->locked_ns);
        }
    }
    if (s->handling)
        next = rt_sooner(next, rt_bound_handler(t, i, s, now));
    if (s->minc && !s->sure) {
        int64_t rest = s->minc - used;
        if (rest <= 0)
            s->sure = 1;
        else if (now + rest > s->dl_ns)
            rt_give_up(t, i, s, now);
        else
            next = rt_sooner(next, rt_later(now, s->dl_ns - rest + 1 - now));
    }
    return s->ready ? next : 0;
}

/* Grant a handler's wish until the next release, limited to what it is entitled to. A
 * deadline that has already passed is not reported again. */
static inline void rt_grant_wish(struct rt_table *t, int i, struct rt_state *s,
                                 int32_t crit, int64_t dl_ns, int64_t now)
{
    int32_t most = s->handler > s->crit ? s->handler : s->crit;
    if (crit >= 0) {
        s->handling = 0;
        rt_set_rank(t, i, s, crit < most ? crit : most);
    }
    if (dl_ns > 0 && (s->kind == RT_PERIODIC || (s->kind == RT_SYNCHRONOUS && s->active))) {
        s->dl_ns = dl_ns;
        s->late = s->late && dl_ns <= now;
    }
}

/* A release has come, whether the last cycle has ended or not: reserves are full again. */
static inline void rt_renew(struct rt_table *t, int i, struct rt_state *s)
{
    s->mark = s->clock;
    s->spent = s->late = s->sure = 0;
    if (s->skip && !s->begun) {
        s->skip = 0;
        atomic_store(&t->slots[i].grant.skip, 0);
    }
    if (s->owed)
        rt_settle_debt(t, i, s);
    if (!s->handling)
        rt_set_rank(t, i, s, s->crit);
}

/* Charge a server for what it has used; a sporadic one gets it back later. */
static inline void rt_charge(struct rt_state *s, int64_t now)
{
    int64_t used = s->clock - s->mark, at = now - used + s->period;
    int armed_just_now = s->mark < 0;
    s->mark = s->clock;
    if ((s->spent && !s->owed) || used <= 0 || armed_just_now)
        return;
    s->left -= used;
    if (s->kind != RT_SPORADIC)
        return;
    struct rt_piece *last = s->n_pieces ? &s->pieces[s->n_pieces - 1] : NULL;
    if (last && (s->n_pieces == RT_PIECES || at - last->at_ns <= 10 * RT_MARGIN_NS)) {
        last->ns += used;       /* both are replenished at the later of the two times */
        last->at_ns = at > last->at_ns ? at : last->at_ns;
    } else {
        s->pieces[s->n_pieces++] = (struct rt_piece){.at_ns = at, .ns = used};
    }
    s->next_ns = s->pieces[0].at_ns;
}

/* Replenish the capacity that is due. */
static inline void rt_refill(struct rt_table *t, int i, struct rt_state *s, int64_t now)
{
    int64_t before = s->left;
    if (s->kind == RT_DEFERRABLE) {
        if (!s->spent)
            s->early = s->flooded = 0;
        s->left = s->maxc + (s->left < 0 ? s->left : 0);
        s->next_ns = (now / s->period + 1) * s->period;
        s->dl_ns = s->next_ns;
    } else {
        int n = 0;
        while (n < s->n_pieces && s->pieces[n].at_ns <= now)
            s->left += s->pieces[n++].ns;
        s->n_pieces = (uint8_t)(s->n_pieces - n);
        for (int k = 0; k < s->n_pieces; k++)
            s->pieces[k] = s->pieces[k + n];
        s->next_ns = s->n_pieces ? s->pieces[0].at_ns : 0;
    }
    rt_emit(t, RT_REFILL, i, 0, s->left - before, s->left);
    if (s->left <= 0)
        return;
    s->spent = 0;
    if (s->owed)
        rt_settle_debt(t, i, s);
    rt_set_rank(t, i, s, s->crit);
}

/* Have a server without a level while events come without end and its capacity is used
 * up; its level is back in the turn in which there is capacity again. */
static inline void rt_level_flood(struct rt_table *t, int i, struct rt_state *s)
{
    int hangs = s->overrun == RT_HUNG, excess = s->spent && !s->owed;
    if (!s->flooded || excess == hangs)
        return;
    s->overrun = excess ? RT_HUNG : RT_IN_TIME;
    if (!excess)
        rt_overruns(s, s->clock);
    rt_emit(t, RT_BEGUN, i, s->overrun, 0, 0);
}

/* Check a server. In a critical section it keeps its criticality, and what it uses there
 * beyond its capacity is deducted later. */
static inline void rt_serve(struct rt_table *t, int i, struct rt_state *s, int64_t now,
                            int locked)
{
    rt_charge(s, now);
    if (s->next_ns && s->next_ns <= now)
        rt_refill(t, i, s, now);
    if (!s->spent && s->left <= 0)
        rt_exhaust(t, i, s, now, locked);
    if (s->owed && (!locked || s->locked_ns <= now)) {
        s->held_off += (uint64_t)(locked != 0);
        rt_settle_debt(t, i, s);
    }
    if (s->spent && s->active)
        rt_overruns(s, s->clock);
    rt_level_flood(t, i, s);
    s->check_ns = s->owed ? s->locked_ns
                  : s->active && !s->spent ? rt_later(now, s->left) : 0;
}

/* Read the task's CPU clock, and whether it is in a critical section; an input. */
static inline int rt_read_cpu(struct rt_table *t, int i, struct rt_state *s, rt_cpu_fn cpu)
{
    struct rt_slot *slot = &t->slots[i];
    int64_t clock = cpu(slot, 0);
    int locked = atomic_load(&slot->post.locked) != 0;
    if (clock > s->clock)
        s->clock = clock;
    rt_emit(t, RT_USED, i, (uint32_t)locked, s->clock, 0);
    return locked;
}

#endif
