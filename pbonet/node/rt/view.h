/* Reading a slot from outside, without disturbing its task: plain copies. */
#ifndef PBONET_VIEW_H
#define PBONET_VIEW_H

#include "slot.h"
#include "dispatch.h"

struct rt_section_view {
    char name[RT_SECTION_NAME];
    uint64_t count, total_ns, min_ns, max_ns;
};

struct rt_view {
    int life, dead, pid, kind, crit, priority, mode, level;
    int rank, drop, handler, tells, hangs, hung, flooded, in_sync, comes, called, fell, n_sections;
    int restarted;                      /* the extremes may lack cycles since `on` */
    int64_t period_ns, deadline_ns, release_ns, minc_ns, maxc_ns;
    uint64_t dispatcher_missed, errors, overruns, held_off, failures[RT_FAILURES];
    uint64_t aborted, skipped, handlers, uncalled_failures;
    uint64_t delivery_last_ns, delivery_max_ns;
    uint32_t safe;              /* commits of safe values at a timing failure ... */
    int64_t safe_last_ns, safe_max_ns;  /* ... and how long after it they came */
    int safe_stands;            /* the cycle of the last one has not ended */
    struct rt_section_view sections[RT_SECTIONS];
    uint64_t on_ns, cycles, late, failed, stable, torn, stale, faults, ring_lost;
    uint64_t on_cycles, on_missed, on_failed, on_cpu_ns, on_faults;
    uint64_t cpu_total_ns, cpu_last_ns, cpu_min_ns, cpu_max_ns;
    uint64_t cpu_first_ns, cpu_mark_ns;
    uint64_t wall_total_ns, held_ns, copy_in_ns, copy_out_ns, jitter_max_ns;
    uint64_t jitter[RT_BINS], cpu[RT_BINS];
};

static inline void rt_read_stats(const struct rt_stats *s, struct rt_view *v)
{
    v->on_ns = rt_get(&s->on_ns);
    v->cycles = rt_get(&s->cycles);
    v->late = rt_get(&s->late);
    v->failed = rt_get(&s->failed);
    v->stable = rt_get(&s->stable);
    v->torn = rt_get(&s->torn);
    v->stale = rt_get(&s->stale);
    v->faults = rt_get(&s->faults);
    v->ring_lost = rt_get(&s->ring_lost);
    v->aborted = rt_get(&s->aborted);
    v->skipped = rt_get(&s->skipped);
    v->handlers = rt_get(&s->handlers);
    v->delivery_last_ns = rt_get(&s->delivery_last_ns);
    v->delivery_max_ns = rt_get(&s->delivery_max_ns);
    v->on_cycles = rt_get(&s->on_cycles);
    v->on_missed = rt_get(&s->on_missed);
    v->on_failed = rt_get(&s->on_failed);
    v->on_cpu_ns = rt_get(&s->on_cpu_ns);
    v->on_faults = rt_get(&s->on_faults);
    v->cpu_total_ns = rt_get(&s->cpu_total_ns);
    v->cpu_last_ns = rt_get(&s->cpu_last_ns);
    v->cpu_min_ns = rt_get(&s->cpu_min_ns);
    v->cpu_max_ns = rt_get(&s->cpu_max_ns);
    v->restarted = atomic_load(&s->restart) != RT_SINCE_ON;
    v->cpu_first_ns = rt_get(&s->cpu_first_ns);
    v->cpu_mark_ns = rt_get(&s->cpu_mark_ns);
    v->wall_total_ns = rt_get(&s->wall_total_ns);
    v->held_ns = rt_get(&s->held_ns);
    v->copy_in_ns = rt_get(&s->copy_in_ns);
    v->copy_out_ns = rt_get(&s->copy_out_ns);
    v->jitter_max_ns = rt_get(&s->jitter_max_ns);
    for (int k = 0; k < RT_BINS; k++) {
        v->jitter[k] = rt_get(&s->jitter[k]);
        v->cpu[k] = rt_get(&s->cpu[k]);
    }
}

/* Copy what concerns failures and reserves; each number is consistent by itself. */
static inline void rt_read_watch(const struct rt_slot *slot, struct rt_view *v)
{
    const struct rt_config *c = &slot->config;
    const struct rt_grant *g = &slot->grant;
    v->rank = atomic_load(&g->crit);
    v->drop = atomic_load(&c->drop);
    v->handler = atomic_load(&c->handler);
    v->tells = atomic_load(&c->tells);
    v->minc_ns = atomic_load(&c->minc_ns);
    v->maxc_ns = atomic_load(&c->maxc_ns);
    v->overruns = rt_get(&g->overruns);
    v->held_off = rt_get(&g->held_off);
    v->uncalled_failures = rt_get(&slot->stats.stale_failures) + rt_get(&g->merged);
    v->hangs = atomic_load(&slot->post.locked) == RT_HANDLER_HANGS;
    v->in_sync = v->kind != RT_PERIODIC && !(atomic_load(&slot->post.events) & 1);
    v->flooded = atomic_load(&slot->grant.flooded) != 0;
    v->hung = atomic_load(&slot->grant.hung) != 0;
    for (int k = 0; k < RT_FAILURES; k++)
        v->failures[k] = rt_get(&g->failures[k]);
    v->safe = atomic_load(&slot->safe.count);
    v->safe_last_ns = atomic_load(&slot->safe.last_ns);
    v->safe_max_ns = atomic_load(&slot->safe.max_ns);
    v->safe_stands = (atomic_load(&slot->safe.word) & 7) == PB_MADE_SAFE;
    v->n_sections = (int)atomic_load(&slot->n_sections);
    for (int k = 0; k < v->n_sections; k++) {
        const struct rt_section *s = &slot->sections[k];
        memcpy(v->sections[k].name, s->name, RT_SECTION_NAME);
        v->sections[k].count = rt_get(&s->count);
        v->sections[k].total_ns = rt_get(&s->total_ns);
        v->sections[k].min_ns = rt_get(&s->min_ns);
        v->sections[k].max_ns = rt_get(&s->max_ns);
    }
}

/* Copy a slot. The stats are one consistent set unless the task was stopped in the middle
 * of its accounting (preempted, or killed); then each number is consistent by itself. */
static inline void rt_snapshot(const struct rt_slot *slot, struct rt_view *v)
{
    const struct rt_config *c = &slot->config;
    for (int tries = 0; tries < 100; tries++) {
        /* SYNC POINT: pairs with rt_stats_begin and rt_stats_end. */
        uint32_t seq = atomic_load_explicit(&slot->stats.seq, memory_order_acquire);
        rt_read_stats(&slot->stats, v);
        atomic_thread_fence(memory_order_acquire);
        if (!(seq & 1) &&
            atomic_load_explicit(&slot->stats.seq, memory_order_relaxed) == seq)
            break;
    }
    v->life = (int)atomic_load(&c->life);
    v->dead = atomic_load(&c->dead) == (uint32_t)v->life;
    v->pid = atomic_load(&c->pid);
    v->kind = atomic_load(&c->kind);
    v->crit = atomic_load(&c->crit);
    v->priority = atomic_load(&c->priority);
    v->period_ns = atomic_load(&c->period_ns);
    v->deadline_ns = atomic_load(&c->deadline_ns);
    v->mode = (int)(atomic_load(&slot->post.word) & 3);
    v->comes = rt_comes(slot);
    v->called = rt_one_has_called(c);
    v->fell = (int)atomic_load(&slot->grant.fell);
    v->level = atomic_load(&slot->grant.level);
    v->dispatcher_missed = rt_get(&slot->grant.missed);
    v->release_ns = atomic_load(&slot->grant.rel_ns);
    v->errors = atomic_load(&slot->errors);
    rt_read_watch(slot, v);
}

struct rt_core_view {
    int backend, leader_pid, leader_tid, look_tid;
    int64_t since_ns, late_max_ns;
    uint64_t turns, releases, level_changes, errors, takeovers, stalls, stalled_ns;
    uint64_t spared;
    int64_t stall_age_ns;               /* since the last stall; 0: it lasts; -1: none yet */
};

/* A leader's turn that is overdue has not been counted yet. */
static inline int64_t rt_stall_age(const struct rt_table *t)
{
    /* SYNC POINT: rt_thread clears `sure_ns` before it says that it leads; rt_once stores the
     * end before the turn, and rt_turn the next event. The clock is read between: no end is in
     * the future, and a slow reader sees no stall. */
    int leads = atomic_load(&t->leader_tid) != 0;
    int64_t end = atomic_load(&t->stall_end_ns), now = rt_now();
    int64_t sure = atomic_load(&t->sure_ns);
    if (leads && sure && now - sure > RT_STALL_NS)
        return 0;
    return !end ? -1 : now > end ? now - end : 1;
}

static inline void rt_core_snapshot(const struct rt_table *t, struct rt_core_view *v)
{
    v->backend = atomic_load(&t->backend);
    v->leader_pid = atomic_load(&t->leader_pid);
    v->leader_tid = atomic_load(&t->leader_tid);
    v->look_tid = atomic_load(&t->look_tid);
    v->spared = atomic_load(&t->spared);
    v->since_ns = atomic_load(&t->since_ns);
    v->late_max_ns = atomic_load(&t->late_max_ns);
    v->turns = atomic_load(&t->turns);
    v->releases = atomic_load(&t->releases);
    v->level_changes = atomic_load(&t->level_changes);
    v->errors = atomic_load(&t->errors);
    v->takeovers = atomic_load(&t->takeovers);
    v->stalls = atomic_load(&t->stalls);
    v->stalled_ns = atomic_load(&t->stalled_ns);
    v->stall_age_ns = rt_stall_age(t);
}

/* The process of member `i` (0: none); sets whether it is alive. */
static inline int rt_member_at(const struct rt_table *t, int i, int *lives)
{
    *lives = rt_member_lives(&t->members[i]);
    return atomic_load(&t->members[i].pid);
}

/* Copy the trace's records from number `since` on; `*first` is the number of the first
 * one copied. */
static inline uint64_t rt_copy_trace(const struct rt_table *t, uint64_t since,
                                     struct rt_event *to, uint64_t *first, uint64_t *end)
{
    /* SYNC POINT: pairs with rt_turn_end. */
    *end = atomic_load_explicit(&t->trace_end, memory_order_acquire);
    uint64_t bound = RT_TRACE - RT_TURN_MAX;
    uint64_t from = since > *end ? *end : since;
    if (*end - from > bound)
        from = *end - bound;
    for (uint64_t k = from; k < *end; k++)
        to[k - from] = t->trace[k & (RT_TRACE - 1)];
    /* Records that the dispatcher may have overwritten meanwhile are dropped; it is at
     * most a turn ahead of what it has published. */
    atomic_thread_fence(memory_order_acquire);
    uint64_t now = atomic_load_explicit(&t->trace_end, memory_order_relaxed);
    uint64_t safe = now > bound ? now - bound : 0;
    *first = from > safe ? from : safe > *end ? *end : safe;
    memmove(to, to + (*first - from), (*end - *first) * sizeof *to);
    return *end - *first;
}

static inline uint32_t rt_life(const struct rt_table *t, int i)
{
    return atomic_load(&t->slots[i].config.life);
}

static inline int rt_mode_of(const struct rt_slot *slot)
{
    return (int)(atomic_load(&slot->post.word) & 3);
}

static inline int rt_after_of(const struct rt_slot *slot)
{
    return atomic_load(&slot->config.after_kind);
}

static inline int rt_kind_of(const struct rt_slot *slot)
{
    return atomic_load(&slot->config.kind);
}

static inline uint64_t rt_cycles(const struct rt_slot *slot)
{
    return rt_get(&slot->stats.cycles);
}

static inline uint64_t rt_missed(const struct rt_slot *slot)
{
    return rt_get(&slot->grant.missed) + rt_get(&slot->stats.failed) +
           rt_get(&slot->stats.skipped);
}

static inline int64_t rt_period(const struct rt_slot *slot)
{
    return atomic_load(&slot->config.period_ns);
}

static inline int rt_pending(const struct rt_slot *slot)
{
    return (atomic_load(&slot->grant.ask) & RT_ASK_COMMAND) != 0;
}

static inline int rt_leader(const struct rt_table *t)
{
    return atomic_load(&t->leader_pid);
}

static inline int rt_crit_of(const struct rt_slot *slot)
{
    return atomic_load(&slot->grant.crit);
}

static inline int rt_own_crit_of(const struct rt_slot *slot)
{
    return atomic_load(&slot->config.crit);
}

static inline int64_t rt_deadline_of(const struct rt_slot *slot)
{
    return atomic_load(&slot->grant.dl_ns);
}

static inline int64_t rt_posted_cpu(const struct rt_slot *slot, int main)
{
    (void)main;
    return (int64_t)rt_get(&slot->post.cpu_ns);
}

/* What a task does in virtual time; mode and locked: -1 means unchanged. */
struct rt_part {
    int mode, begun, done, event, locked, handled, fell;
    int64_t now_ns, cpu_ns;
};

static inline void rt_play(struct rt_table *t, struct rt_slot *slot,
                           const struct rt_part *part)
{
    struct rt_task task = {.table = t, .slot = slot};
    struct rt_post *post = &slot->post;
    rt_add(&post->cpu_ns, (uint64_t)part->cpu_ns);
    if (part->begun || part->done)
        atomic_store(&post->begun, atomic_load(&slot->grant.seq));
    if (part->done)
        atomic_store(&post->done, atomic_load(&slot->grant.seq));
    if (part->event) {
        if (!(atomic_fetch_add(&post->events, 1) & 1))
            atomic_store(&post->event_ns, part->now_ns);
    }
    if (part->locked >= 0)
        atomic_store(&post->locked, (uint32_t)part->locked);
    if (part->handled)
        atomic_store(&post->handled, slot->state.told);
    if (part->fell)
        rt_fall(&task);
    else if (part->mode == RT_ON)
        rt_arm(&task);
    else if (part->mode == RT_STANDS)
        rt_stand_by_for(&task);
    else if (part->mode == RT_OFF)
        rt_rest(&task);
    else if (part->mode >= 0)
        rt_leave(&task, part->mode);
}

/* Take a turn in virtual time; returns the slot that may run, -1 for none. */
static inline int rt_play_turn(struct rt_table *t, int64_t now_ns)
{
    atomic_store(&t->virtual_ns, now_ns);
    t->due_ns = rt_turn(t, now_ns, 1, 0, rt_posted_cpu);
    rt_turn_end(t);
    for (uint32_t i = 0; i < atomic_load(&t->high); i++) {
        const struct rt_state *s = &t->slots[i].state;
        if (s->granted && !s->parked && atomic_load(&t->slots[i].post.done) != s->seq)
            return (int)i;
    }
    return -1;
}

/* Grant a cycle without a turn, in virtual time; if the task has no period, the `dt` of its
 * first cycle is 0. */
static inline void rt_play_grant(struct rt_table *t, struct rt_slot *slot, int64_t now_ns,
                                 int periodic)
{
    if (!periodic && !rt_get(&slot->stats.last_rel_ns))
        rt_put(&slot->stats.last_rel_ns, (uint64_t)now_ns);
    atomic_store(&t->virtual_ns, now_ns);
    atomic_store(&slot->grant.rel_ns, now_ns);
    atomic_store(&slot->grant.dl_ns, RT_NEVER);
    atomic_fetch_add(&slot->grant.seq, 1);
}

#endif
