/* The dispatcher's turn: a pure function over the core table.
 *
 * tests/oracles/plain_dispatcher/dispatch.py states the rules in Python, and
 * docs/realtime.md gives the reasons. A turn reads what tasks and RTPU processes wrote
 * since the last one, decides, and writes both to the trace, inputs first. It makes no
 * system call: `loop.h` acts on the decisions.
 *
 * A leader may be killed at any instruction. So each slot's state is replaced as a whole,
 * through a journal: a standby that finds it valid completes the replacement.
 */
#ifndef PBONET_DISPATCH_H
#define PBONET_DISPATCH_H

#include "device.h"
#include "lease/lend.h"
#include "muf.h"
#include "standby.h"

/* Read a changed configuration; one that is half written waits for its writer's kick.
 * Returns 0: no change, 1: new settings, 2: a new process as well, without a priority. */
static inline int rt_latch_config(struct rt_table *t, int i, struct rt_config *c,
                                  struct rt_state *s)
{
    /* SYNC POINT: pairs with the two writes of `gen` around a change in table.h. */
    uint32_t gen = atomic_load_explicit(&c->gen, memory_order_acquire);
    if (gen == s->gen || (gen & 1))
        return 0;
    int32_t pid = atomic_load_explicit(&c->pid, memory_order_relaxed);
    int32_t kind = atomic_load_explicit(&c->kind, memory_order_relaxed);
    int32_t crit = atomic_load_explicit(&c->crit, memory_order_relaxed);
    int32_t priority = atomic_load_explicit(&c->priority, memory_order_relaxed);
    int64_t period = atomic_load_explicit(&c->period_ns, memory_order_relaxed);
    int64_t deadline = atomic_load_explicit(&c->deadline_ns, memory_order_relaxed);
    int64_t minc = atomic_load_explicit(&c->minc_ns, memory_order_relaxed);
    int64_t maxc = atomic_load_explicit(&c->maxc_ns, memory_order_relaxed);
    int64_t hang = atomic_load_explicit(&c->hang_ns, memory_order_relaxed);
    int32_t drop = atomic_load_explicit(&c->drop, memory_order_relaxed);
    int32_t handler = atomic_load_explicit(&c->handler, memory_order_relaxed);
    int32_t tells = atomic_load_explicit(&c->tells, memory_order_relaxed);
    int32_t after_kind = atomic_load_explicit(&c->after_kind, memory_order_relaxed);
    uint64_t after[RT_MASKS];
    for (int k = 0; k < RT_MASKS; k++)
        after[k] = atomic_load_explicit(&c->after[k], memory_order_relaxed);
    uint64_t callers = atomic_load_explicit(&c->callers, memory_order_relaxed);
    /* SYNC POINT, continued: the second load of `gen` comes after all of these. */
    atomic_thread_fence(memory_order_acquire);
    if (atomic_load_explicit(&c->gen, memory_order_relaxed) != gen)
        return 0;
    int news = pid == s->pid ? 1 : 2;
    if (news == 2)
        s->level = 0, s->clock = s->mark = 0;
    s->gen = gen;
    s->pid = pid;
    s->kind = kind;
    s->crit = crit;
    s->priority = priority;
    s->period = period;
    s->deadline = deadline;
    s->minc = minc;
    s->maxc = maxc;
    s->hang = hang;
    s->drop = drop;
    s->handler = handler;
    s->tells = (uint8_t)tells;
    s->ticket = after_kind == RT_HANDOVER ? rt_ticket_of(callers) : 0;
    rt_latch_after(t, i, s, after_kind, after);
    if (!s->handling)
        s->rank = rt_contained(s);
    return news;
}

/* The first release of a task that arms now: at once for a fallback, since a cycle was
 * lost; on the grid for all others. */
static inline int64_t rt_first(const struct rt_state *s, int64_t now, int replaces)
{
    int64_t grid = (now + RT_LEAD_NS + s->period - 1) / s->period * s->period;
    return replaces ? now : grid;
}

/* The release after `release`: the next point of the grid that is more than half a
 * period away. So a first release in the second half of a period replaces the point that
 * follows it, and no task has two cycles in much less than a period. */
static inline int64_t rt_following(const struct rt_state *s, int64_t release)
{
    return ((release + s->period / 2) / s->period + 1) * s->period;
}

static inline void rt_latch_mode(struct rt_table *t, int i, struct rt_state *s,
                                 uint32_t word, int64_t now)
{
    int replaces = s->engaged && s->after_kind == RT_FALLBACK;
    uint32_t changed = word ^ s->word;
    uint32_t mode = word & 3;
    int armed_anew = (changed >> 2 & 0x7fff) != 0;
    /* The last word of a dead task shows what it did when it died. */
    uint8_t fell = mode == RT_ON || mode == RT_COMMAND ? s->dead
                   : armed_anew && rt_has_recovered(&t->slots[i], s, mode) ? 0
                   : s->fell || rt_has_fallen(&t->slots[i], mode);
    s->word = word;
    s->fell = fell;
    rt_emit(t, RT_MODE, i, word, fell, 0);
    if (armed_anew || mode == RT_OFF)
        rt_disarm(s);
    if (changed >> 17 || mode != RT_ON)
        s->level = 0;
    s->fresh = mode != RT_OFF && mode != RT_STANDS && rt_limited(s);
    if (mode == RT_OFF || mode == RT_STANDS || s->armed || s->dead)
        return;
    s->armed = 1;
    if (s->kind == RT_PERIODIC) {
        s->next_ns = rt_first(s, now, replaces);
        return;
    }
    s->ready = 1;               /* timed by events: stays ready */
    s->rel_ns = s->event_ns = now;
    s->dl_ns = RT_NEVER;
    s->left = s->maxc;
    s->mark = -1;
    rt_waits(s, now);
    if (s->kind == RT_SYNCHRONOUS) {
        s->rel_ns = now - s->period;    /* an event may come at once */
        s->next_ns = s->deadline ? now + s->deadline : 0;
    }
    if (s->kind == RT_DEFERRABLE)
        s->dl_ns = s->next_ns = (now / s->period + 1) * s->period;
    rt_emit(t, RT_RELEASE, i, 0, now, s->dl_ns);
}

/* Read what the task reports about itself during a cycle. */
static inline void rt_latch_watch(struct rt_table *t, int i, struct rt_state *s, int64_t now)
{
    struct rt_post *post = &t->slots[i].post;
    uint32_t handled = atomic_load(&post->handled);
    if (handled != s->handled) {
        s->handled = handled;
        rt_emit(t, RT_HANDLED, i, handled, 0, 0);
        if (s->handling && handled == s->told) {
            s->handling = 0;
            rt_set_rank(t, i, s, rt_contained(s));
        }
    }
    /* SYNC POINT: rt_post_wish stores the two wishes before it counts. */
    uint32_t wish = atomic_load_explicit(&post->wish, memory_order_acquire);
    if (wish != s->wish) {
        int32_t crit = atomic_load_explicit(&post->wish_crit, memory_order_relaxed);
        int64_t dl_ns = atomic_load_explicit(&post->wish_dl_ns, memory_order_relaxed);
        s->wish = wish;
        rt_emit(t, RT_WISH, i, (uint32_t)crit & 0xff, dl_ns, 0);
        rt_grant_wish(t, i, s, crit, dl_ns, now);
    }
    if (s->owed && !atomic_load(&post->locked)) {
        rt_emit(t, RT_UNLOCKED, i, 0, 0, 0);
        if (rt_is_server(s))
            s->fresh = 1;       /* first charge what it used meanwhile */
        else
            rt_settle_debt(t, i, s);
    }
}

/* Read whether a server has begun or ended an event. */
static inline void rt_latch_event(struct rt_table *t, int i, struct rt_state *s,
                                  int64_t now)
{
    struct rt_post *post = &t->slots[i].post;
    /* SYNC POINT: pairs with rt_begin_event, which stores the time first. */
    uint8_t active = atomic_load_explicit(&post->events, memory_order_acquire) & 1;
    int64_t event = atomic_load_explicit(&post->event_ns, memory_order_relaxed);
    if (active == s->active && (!active || event == s->event_ns))
        return;
    rt_emit(t, RT_EVENT, i, active, event, 0);
    s->active = active;
    s->event_ns = event;
    s->overrun = 0;
    s->fresh = 1;
    if (!active)
        rt_waits(s, now);
    if (s->kind == RT_SPORADIC)
        s->dl_ns = event + s->period;
}

/* Whether all callers of a task have called and no turn has seen it yet. */
static inline int rt_is_called(const struct rt_slot *slot)
{
    const struct rt_state *s = &slot->state;
    return s->after_kind == RT_ALONE && rt_all_have_called(&slot->config, s->ticket);
}

/* Whether slot i has anything to read; most have not, most of the time. */
static inline int rt_news(const struct rt_table *t, int i)
{
    const struct rt_slot *slot = &t->slots[i];
    const struct rt_state *s = &slot->state;
    const struct rt_config *c = &slot->config;
    return rt_news_taken(t, i) ||
           atomic_load_explicit(&c->life, memory_order_relaxed) != s->life ||
           atomic_load_explicit(&c->gen, memory_order_relaxed) != s->gen ||
           atomic_load_explicit(&slot->post.word, memory_order_relaxed) != s->word ||
           s->granted || (s->armed && s->kind != RT_PERIODIC) || rt_is_called(slot) ||
           atomic_load_explicit(&c->dead, memory_order_relaxed) == s->life;
}

/* Read how much CPU time a cycle has used since it used up its period, or the event of a
 * server since it used up the capacity. While it hangs the
 * task has no level: all others and commands go first. */
static inline void rt_latch_overrun(struct rt_table *t, int i, struct rt_state *s,
                                    rt_cpu_fn cpu)
{
    if (s->overrun == RT_HUNG)
        return;
    int64_t used = cpu(&t->slots[i], 0) - s->overrun_mark;
    uint8_t overrun = used >= s->hang ? RT_HUNG : used >= s->period ? RT_LAST : RT_OVER;
    if (overrun <= s->overrun)
        return;
    s->overrun = overrun;
    rt_emit(t, RT_BEGUN, i, overrun, 0, 0);
}

/* Read what happened to slot i; emits inputs. */
static inline void rt_latch(struct rt_table *t, int i, struct rt_state *s, int64_t now,
                            rt_cpu_fn cpu)
{
    struct rt_slot *slot = &t->slots[i];
    rt_latch_lease(t, i, s);
    /* SYNC POINT: rt_alloc resets a slot before it starts a new life. */
    uint32_t life = atomic_load_explicit(&slot->config.life, memory_order_acquire);
    if (life != s->life) {
        /* Freed while armed: its task has died before it could go OFF. If no turn was
         * taken meanwhile, its arming was not seen either. */
        uint8_t said = !(life & 1) && rt_fell_in(slot, life - 1);
        uint8_t fell = !(life & 1) && (s->armed || s->fell || said);
        rt_forget_taken(t, i);
        memset(s, 0, sizeof *s);
        s->life = life;
        s->fell = fell;
        rt_emit(t, RT_LIFE, i, life, said, 0);
    }
    if (!(life & 1))
        return;
    int news = rt_latch_config(t, i, &slot->config, s);
    if (news)
        rt_emit(t, RT_CONFIG, i,
                (uint32_t)s->crit | (uint32_t)s->priority << 8 |
                    (uint32_t)s->kind << 24 | (uint32_t)(news == 2) << 31,
                s->period, s->deadline);
    if (news)
        rt_emit(t, RT_LIMITS, i,
                (uint32_t)s->drop | (uint32_t)s->handler << 8 | (uint32_t)s->tells << 16,
                s->minc, s->maxc);
    if (s->after_kind == RT_ALONE && s->ticket)
        rt_latch_after(t, i, s, RT_HANDOVER, s->after);
    if (!s->dead && atomic_load(&slot->config.dead) == life) {
        rt_emit(t, RT_DEAD, i, 0, 0, 0);
        s->fell |= s->armed;
        s->dead = 1;
        rt_disarm(s);
    }
    /* SYNC POINT: pairs with the stores in slot.h. The word is loaded first: what the
     * task did after its cycle is never seen without the cycle's end. */
    uint32_t word = atomic_load_explicit(&slot->post.word, memory_order_acquire);
    if (s->granted &&
        atomic_load_explicit(&slot->post.done, memory_order_acquire) == s->seq) {
        rt_emit(t, RT_DONE, i, 0, 0, 0);
        rt_over(s);
    } else if (s->granted && !s->begun && atomic_load(&slot->post.begun) == s->seq) {
        rt_emit(t, RT_BEGUN, i, 0, 0, 0);
        s->begun = 1;
    }
    if (s->begun || s->owed || s->kind == RT_SYNCHRONOUS)
        rt_latch_watch(t, i, s, now);
    if (s->armed && rt_is_server(s))
        rt_latch_event(t, i, s, now);
    else if (s->armed && s->kind == RT_SYNCHRONOUS)
        rt_latch_device(t, i, s, now);
    if (s->overrun)
        rt_latch_overrun(t, i, s, cpu);
    if (s->armed && s->wait_ns && s->wait_ns <= now)
        rt_latch_wait(t, i, s, now, cpu);
    if (word != s->word && s->gen)
        rt_latch_mode(t, i, s, word, now);
}

/* Grant the newest release that is due and count the others as missed. */
static inline void rt_release(struct rt_table *t, int i, struct rt_state *s, int64_t now,
                              rt_cpu_fn cpu)
{
    int64_t release = s->next_ns, last = now / s->period * s->period;
    uint64_t missed = 0;
    if (last > release) {
        missed = (uint64_t)(last / s->period - release / s->period);
        release = last;
    }
    int64_t length = s->deadline ? s->deadline : s->period;
    int in_time = s->ready && s->rel_ns + length > now; /* it was released off the grid */
    int unmet = s->ready && !s->late && !in_time;
    if (s->begun && !in_time)   /* and the deadlines at which no turn came: of a lease, or a stall */
        s->failures[RT_DEADLINE] += missed;
    missed += s->ready;
    s->dl_ns = in_time && s->begun ? s->rel_ns + length : release + length;
    if (s->begun) {
        if (s->rel_ns + s->period <= now && !s->overrun)
            rt_overruns(s, cpu(&t->slots[i], 0));
    } else {
        s->rel_ns = release;
        if (s->granted) {       /* granted, but not begun: it runs as the new one */
            atomic_store_explicit(&t->slots[i].grant.rel_ns, s->rel_ns,
                                  memory_order_relaxed);
            atomic_store_explicit(&t->slots[i].grant.dl_ns, s->dl_ns,
                                  memory_order_relaxed);
        }
    }
    s->ready = 1;
    s->missed += missed;
    s->next_ns = rt_following(s, release);
    rt_emit(t, RT_RELEASE, i, 0, release, s->dl_ns);
    if (missed)
        rt_emit(t, RT_MISS, i, (uint32_t)missed, 0, 0);
    rt_renew(t, i, s);
    if (unmet)
        rt_fail(t, i, s, RT_DEADLINE, now, s->begun);
}

/* Do what is due for an armed slot, or what its news requires. */
static inline void rt_watch(struct rt_table *t, int i, struct rt_state *s, int64_t now,
                            rt_cpu_fn cpu)
{
    int locked = rt_limited(s) ? rt_read_cpu(t, i, s, cpu) : 0;
    if (rt_is_server(s)) {
        rt_serve(t, i, s, now, locked);
    } else if (s->kind == RT_SYNCHRONOUS) {
        rt_listen(t, i, s, now, locked, cpu);
    } else if (s->kind == RT_PERIODIC) {
        if (s->fresh && !s->begun)
            s->mark = s->clock;
        if (s->next_ns <= now)
            rt_release(t, i, s, now, cpu);
        if (s->ready && !s->late && s->dl_ns <= now) {
            s->late = 1;
            rt_fail(t, i, s, RT_DEADLINE, now, s->begun);
        }
        s->check_ns = s->ready && rt_limited(s) ? rt_look(t, i, s, now, locked) : 0;
    }
    s->fresh = 0;
}

/* Write the task's release to its slot; rt_act wakes the task. */
static inline void rt_publish(struct rt_slot *slot)
{
    struct rt_grant *g = &slot->grant;
    atomic_store_explicit(&g->rel_ns, slot->state.rel_ns, memory_order_relaxed);
    atomic_store_explicit(&g->dl_ns, slot->state.dl_ns, memory_order_relaxed);
    atomic_store_explicit(&g->parked, slot->state.parked, memory_order_relaxed);
    rt_show(g, &slot->state);
    /* SYNC POINT: rt_wait loads `seq` with acquire before it reads the times. */
    atomic_store_explicit(&g->seq, slot->state.seq, memory_order_release);
    atomic_fetch_add(&g->bell, 1);
}

static inline void rt_let_run(struct rt_table *t, int i)
{
    struct rt_state s = t->slots[i].state;
    if (!s.granted) {
        s.granted = 1;
        s.seq = s.seq + 1 ? s.seq + 1 : 1;
        rt_commit(t, i, &s);
        rt_publish(&t->slots[i]);
        rt_emit(t, RT_WAKE, i, s.seq, 0, 0);
    } else if (s.parked) {
        s.parked = 0;
        rt_commit(t, i, &s);
        atomic_store(&t->slots[i].grant.parked, 0);
        rt_emit(t, RT_RESUME, i, 0, 0, 0);
    }
}

static inline void rt_hold(struct rt_table *t, int i)
{
    struct rt_state s = t->slots[i].state;
    if (s.granted && !s.parked) {
        s.parked = 1;
        rt_commit(t, i, &s);
        atomic_store(&t->slots[i].grant.parked, 1);
        rt_emit(t, RT_PARKED, i, 0, 0, 0);
    }
}

/* Rank the ready tasks: priorities first, then wake-ups, both in order of urgency. */
static inline void rt_rank(struct rt_table *t, struct muf_item *ready, int n, int park)
{
    muf_sort(ready, n);
    muf_assign_groups(ready, n);
    for (int k = 0; k < n; k++) {
        struct rt_state *s = &t->slots[ready[k].slot].state;
        if (s->level != ready[k].level) {
            s->level = ready[k].level;      /* one word: needs no journal */
            atomic_store_explicit(&t->slots[ready[k].slot].grant.level, s->level,
                                  memory_order_relaxed);
            rt_emit(t, RT_LEVEL, ready[k].slot, (uint32_t)s->level, 0, 0);
        }
    }
    uint32_t waiting = 0;
    int top = 1;
    for (int k = 0; k < n; k++) {
        int i = ready[k].slot;
        if (park && t->slots[i].state.kind == RT_PERIODIC && !top) {
            rt_hold(t, i);
            waiting++;
        } else {
            if (t->slots[i].state.kind == RT_PERIODIC)
                top = 0;
            rt_let_run(t, i);
        }
    }
    atomic_store(&t->waiting, waiting);
}

/* A ready task in the form in which it is ranked. */
static inline struct muf_item rt_item(const struct rt_state *s, int i)
{
    int group = s->overrun == RT_HUNG         ? MUF_HUNG
                : s->kind == RT_BACKGROUND ? MUF_BACKGROUND
                                           : MUF_CYCLES;
    return (struct muf_item){
        .deadline = s->dl_ns, .since = s->rel_ns, .group = group,
        .crit = s->overrun == RT_HUNG ? 0 : s->rank, .priority = s->priority,
        .last = s->overrun >= RT_LAST, .level = s->level, .slot = i};
}

/* Take one turn; returns the time of the next event, 0 for none.
 *
 * `lead` marks the first turn of a new leader, which does not know the tasks' priorities, and
 * a turn after another program has changed one.
 * The records of the turn are trace[trace_end .. trace_next) until rt_turn_end.
 */
static inline int64_t rt_turn(struct rt_table *t, int64_t now, int park, int lead,
                              rt_cpu_fn cpu)
{
    struct muf_item ready[RT_SLOTS];
    /* SYNC POINT: rt_alloc raises `high` after resetting the slot. */
    int n = 0, high = (int)atomic_load_explicit(&t->high, memory_order_acquire);
    int64_t due = 0, sure = 0;
    uint64_t head = atomic_load_explicit(&t->trace_end, memory_order_relaxed);
    t->trace_next = head;
    rt_recall(t);
    rt_emit(t, RT_TURN, 0, (uint32_t)park, now, 0);
    if (lead)
        rt_emit(t, RT_LEAD, 0, 0, atomic_load(&t->leader_pid), 0);
    for (int i = 0; i < high; i++) {
        if (!lead && !rt_news(t, i))
            continue;
        struct rt_state s = t->slots[i].state;
        if (lead)
            s.level = RT_UNSET;
        rt_latch(t, i, &s, now, cpu);
        rt_commit(t, i, &s);
    }
    for (int i = 0; i < high; i++) {
        struct rt_state *s = &t->slots[i].state;
        int64_t next = s->armed ? rt_due(s) : 0;
        if (s->fresh || (next && next <= now)) {
            struct rt_state news = *s;
            rt_watch(t, i, &news, now, cpu);
            rt_commit(t, i, &news);
            next = s->armed ? rt_due(s) : 0;
        }
        due = rt_sooner(due, next);
        sure = rt_sooner(sure, s->armed ? rt_sure(s) : 0);
        if (rt_stands(s)) {
            struct rt_state called = *s;
            rt_engage(t, i, &called, now);
            rt_commit(t, i, &called);
        }
        if (s->ready && ((s->word & 3) == RT_ON || s->engaged))
            ready[n++] = rt_item(s, i);
    }
    rt_rank(t, ready, n, park);
    t->trace[head & (RT_TRACE - 1)].b = due;
    atomic_store_explicit(&t->sure_ns, sure, memory_order_relaxed);
    return due;
}

/* Make the turn's records part of the trace that others read. */
static inline void rt_turn_end(struct rt_table *t)
{
    /* SYNC POINT: CoreTable.trace loads `trace_end` with acquire. */
    atomic_store_explicit(&t->trace_end, t->trace_next, memory_order_release);
}

/* Complete what a dead leader had begun; the first turn with `lead` follows. */
static inline void rt_recover(struct rt_table *t)
{
    uint32_t i = t->journal_slot;
    /* SYNC POINT: rt_commit stores the journal first. */
    if (atomic_load_explicit(&t->journal_valid, memory_order_acquire) && i < RT_SLOTS)
        t->slots[i].state = t->journal;
    atomic_store(&t->journal_valid, 0);
    for (i = 0; i < atomic_load(&t->high); i++) {
        struct rt_slot *slot = &t->slots[i];
        /* A task that has taken its release has written it, and may not have read it yet. */
        if ((slot->state.life & 1) && !rt_runs_taken(t, (int)i))
            rt_publish(slot);
    }
}

#endif
