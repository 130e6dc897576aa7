/* A task's local state variable table (thesis, section 5.5): private memory, copied in
 * before a cycle and copied out after it. */
#ifndef PBONET_LOCAL_H
#define PBONET_LOCAL_H

#include "flag.h"
#include "fresh.h"
#include "guard.h"
#include "keeper.h"
#include "look.h"
#include "safe.h"

enum pb_flags {
    PB_COPY_TORN = 1,  /* retry limit reached: groups whole, cut not proven */
    PB_COPY_STALE = 2, /* an input is older than its MAXAGE */
    PB_COPY_KEPT = 4,  /* with TORN: the inputs of the last copy were kept */
    PB_COPY_LOST = 8,  /* with TORN: no whole copy was possible, do not use the inputs */
    PB_COMMIT_NONFINITE = 16,
    PB_COMMIT_LIMIT = 32,
    PB_COMMIT_NOT_OWNER = 64,
    PB_TABLE_OVERWRITTEN = 128, /* of a copy or a commit */
    PB_COPY_SETTLING = 256, /* inputs are fresh again, but not for long enough */
    PB_COMMIT_LATE = 512,   /* the cycle has failed, and safe values were committed */
};

enum { PB_PLAN_CONSTS, PB_PLAN_IN, PB_PLAN_ON, PB_PLANS };
enum { PB_GROUP_VARS, PB_GROUP_CONSTS, PB_GROUPS };

struct pb_outputs {
    struct pb_group group;
    const struct pb_check *checks;
    uint32_t n_checks;
    bool live;     /* claimed by this process */
    uint64_t first; /* place of the group in the local table */
};

struct pb_counts {
    uint64_t copies, retries, torn, lost, stale, commits, refused, clipped;
};

struct pb_local {
    struct pb_table table;
    uint8_t *data, *staging; /* staging: NULL, or as large as data: keeps the last in-vars */
    struct pb_plan plans[PB_PLANS];
    struct pb_outputs outputs[PB_GROUPS];
    struct pb_counts counts;
    int64_t virtual_ns; /* the current time if it is virtual; else 0 */
    uint64_t *consumed; /* pairs of register uid and sequence, room for the largest plan */
    uint32_t n_consumed;
    uint32_t fault_var; /* of the last refused commit, or the stale input */
    uint64_t fault_element;
    struct pb_seen flag;
    struct pb_freshness_state fresh;
    uint64_t generation; /* the last one that a commit found valid; 0: none */
    struct pb_safe *safe; /* NULL: the task declares no safe values for failures */
    const uint8_t *safe_data; /* those of the out-vars, laid out as their group */
    uint64_t open; /* number of the cycle that may be taken; 0: none */
};

static inline int64_t pb_time(const struct pb_local *l) {
    return l->virtual_ns ? l->virtual_ns : pb_now();
}

/* The age of an in-var at its last copy; NULL when none was read. */
static inline const struct pb_age *pb_in_age(const struct pb_local *l, uint32_t v) {
    const struct pb_plan *p = l->plans + PB_PLAN_IN;
    for (uint32_t i = 0; i < p->n_vars && p->age_of && p->n_ages; i++)
        if (p->vars[i] == v) return p->ages + p->age_of[i];
    for (uint32_t i = 0; i < p->n_ages && !p->age_of; i++)
        if (p->ages[i].var == v) return p->ages + i;
    return NULL;
}

/* Whether an in-var is too old now, by the stamp of its last copy. */
static inline bool pb_is_stale(const struct pb_local *l, uint32_t v) {
    const struct pb_age *age = pb_in_age(l, v);
    return age && pb_too_old(age, pb_time(l));
}

/* The time since an in-var was written, by the stamp of its last copy; -1: never written. */
static inline int64_t pb_age_of(const struct pb_local *l, uint32_t v) {
    const struct pb_age *age = pb_in_age(l, v);
    return age && age->stamp.time_ns ? pb_time(l) - age->stamp.time_ns : -1;
}

/* The stamp of what is computed from this in-var alone; 0: its age does not count. */
static inline int64_t pb_stamp_from(const struct pb_local *l, uint32_t v) {
    const struct pb_age *age = pb_in_age(l, v);
    if (!age || !pb_counts(age)) return 0;
    return age->stamp.time_ns ? age->stamp.time_ns : PB_LONG_AGO;
}

/* Judge the ages of a plan's variables; returns flags. */
static inline int pb_judge_ages(struct pb_local *l, const struct pb_plan *p) {
    enum pb_action action;
    int64_t now;
    uint32_t first;
    int flags;
    l->fresh.oldest_ns = p->fresh ? pb_oldest(p) : 0;
    if (!p->limited) return 0;
    now = pb_time(l);
    first = pb_first_stale(p, now, &action);
    flags = first < p->n_ages ? PB_COPY_STALE : 0;
    if (flags) {
        l->fault_var = p->ages[first].var;
        l->fault_element = 0;
        l->counts.stale++;
    }
    if (p == l->plans + PB_PLAN_ON) pb_turned_on(&l->fresh);
    if (p != l->plans + PB_PLAN_IN || !l->fresh.renewals) return flags;
    if (flags) pb_follow_stale(&l->fresh, p->ages[first].fresh.maxage_ns, now, action);
    else if (pb_follow_fresh(&l->fresh, p, now)) flags = PB_COPY_SETTLING;
    return flags;
}

/* Copy a plan's variables to the local table; returns flags. */
static inline int pb_copy_in(struct pb_local *l, struct pb_plan *p) {
    uint8_t *staging = p == l->plans + PB_PLAN_IN ? l->staging : NULL;
    enum pb_result result;
    int flags = 0;
    l->counts.copies++;
    result = pb_cut(&l->table, p, staging ? staging : l->data, &l->counts.retries);
    if (result != PB_CONSISTENT) {
        flags |= PB_COPY_TORN;
        if (result == PB_OVERWRITTEN) return PB_TABLE_OVERWRITTEN;
        l->counts.torn++;
        if (result == PB_LOST) l->counts.lost++;
        if (staging) return flags | PB_COPY_KEPT;
        if (result == PB_LOST) return flags | PB_COPY_LOST;
    }
    if (staging) {
        for (uint32_t i = 0; i < p->n_pieces; i++)
            memcpy(l->data + p->pieces[i].to, staging + p->pieces[i].to, p->pieces[i].bytes);
    }
    for (uint32_t i = 0; i < p->n_sources; i++) {
        l->consumed[2 * i] = p->sources[i].uid;
        l->consumed[2 * i + 1] = pb_number(p->sources[i].head);
    }
    l->n_consumed = p->n_sources;
    return p->n_ages ? flags | pb_judge_ages(l, p) : flags;
}

/* Check a group's outputs with these checks; returns flags. */
static inline int pb_judge_by(struct pb_local *l, const struct pb_outputs *o,
                              const struct pb_check *checks, uint32_t n) {
    uint32_t failed = pb_guard(checks, n, l->data + o->first, &l->fault_element,
                               &l->counts.clipped);
    if (failed == n) return 0;
    l->fault_var = checks[failed].var;
    l->counts.refused++;
    return checks[failed].rule == PB_FINITE ? PB_COMMIT_NONFINITE : PB_COMMIT_LIMIT;
}

/* Check a group before it is committed; returns flags. */
static inline int pb_judge(struct pb_local *l, const struct pb_outputs *o) {
    return o->n_checks ? pb_judge_by(l, o, o->checks, o->n_checks) : 0;
}

/* Check one variable of the group only: the others are not committed. */
static inline int pb_judge_one(struct pb_local *l, const struct pb_outputs *o, uint32_t i) {
    const struct pb_group *g = &o->group;
    struct pb_check part;
    int flags = 0;
    for (uint32_t c = 0; c < o->n_checks && !flags; c++) {
        if (!pb_narrow(o->checks + c, g->at[i], l->table.vars[g->vars[i]].bytes, &part)) continue;
        part.var = g->vars[i];
        flags = pb_judge_by(l, o, &part, 1);
    }
    return flags;
}

static inline bool pb_is_mine(const struct pb_outputs *o) {
    return o->live && atomic_load_explicit(&o->group.reg->uid, memory_order_relaxed) ==
                          o->group.uid;
}

/* Stop writing the group, and leave its variables to the successor's claim. While this
 * process lives and has not left, no other one changes the state. */
static inline void pb_cede(const struct pb_local *l, struct pb_outputs *o) {
    /* SYNC POINT: before the calls of successors, so a successor's death shows the end. */
    if (pb_is_mine(o)) {
        atomic_store(&o->group.reg->state, PB_ENDED);
        pb_changed(&l->table); /* for the agent, which tells other machines */
    }
    o->live = false;
}

/* Copy one variable to any place in the local table; returns flags. */
static inline int pb_read_one(struct pb_local *l, uint32_t v, uint64_t at) {
    struct pb_view view;
    struct pb_age age = {.var = v, .fresh = {.maxage_ns = l->table.vars[v].maxage_ns}};
    switch (pb_look(&l->table, v, l->data + at, &view)) {
    case PB_CONSISTENT: break;
    case PB_OVERWRITTEN: return PB_TABLE_OVERWRITTEN;
    default: return PB_COPY_TORN | PB_COPY_LOST;
    }
    age.stamp = view.stamp;
    if (!pb_too_old(&age, pb_time(l))) return 0;
    l->fault_var = v;
    l->fault_element = 0;
    l->counts.stale++;
    return PB_COPY_STALE;
}

/* Whether a variable of the group is stored in the group's register: a constant to which
 * another task gives the same value is stored in that task's register. */
static inline bool pb_stands(const struct pb_local *l, const struct pb_group *g, uint32_t i) {
    for (int tries = 0; tries < PB_TRIES_WHOLE; tries++) {
        const uint64_t head = pb_read_begin(&l->table.live->generation);
        struct pb_entry e;
        pb_copy(&e, pb_directory(&l->table, head) + g->vars[i], sizeof e);
        pb_read_fence();
        if (pb_whole(head, pb_read_end(&l->table.live->generation)))
            return pb_reg_of(&l->table, &e) == g->reg;
    }
    return false;
}

/* Why the group may not be committed: another task has its variables, or the table is lost. */
static inline int pb_not_mine(const struct pb_local *l) {
    return pb_sound(&l->table) ? PB_COMMIT_NOT_OWNER : PB_TABLE_OVERWRITTEN;
}

/* The number of the last commit of a group; 0 when it has no register. */
static inline uint64_t pb_committed(const struct pb_outputs *o) {
    return o->group.reg ? pb_number(o->group.head) : 0;
}

/* Whether readers can find what a task commits: the directory's head is a valid one. */
static inline bool pb_readable(struct pb_local *l) {
    uint64_t head = pb_read_begin(&l->table.live->generation);
    for (int tries = 0; head != l->generation || !head; tries++) {
        const bool valid = pb_numbered(&l->table, head);
        const uint64_t last = head;
        pb_read_fence(); /* SYNC POINT C5: what was read is of this generation */
        head = pb_read_end(&l->table.live->generation);
        if (head != last && tries < PB_TRIES_WHOLE) continue;
        if (!valid) return false;
        l->generation = last;
        break;
    }
    return true;
}

/* Whether the only check of a group is that all of it is finite. A test build copies word
 * by word, and the thread sanitizer knows one copy: there the check is made before. */
static inline bool pb_only_finite(const struct pb_outputs *o) {
#if defined(PBONET_STEP_WORDS) || defined(PB_TSAN)
    (void)o;
    return false;
#else
    const struct pb_check *c = o->checks;
    return o->n_checks == 1 && c->rule == PB_FINITE && !c->at &&
           c->n * (c->type == PB_F8 ? 8 : 4) == o->group.bytes;
#endif
}

/* Commit such a group, checked while it is copied; false, and not published, if a value is
 * not finite. The slot then holds what a writer that was killed might have left. */
static inline bool pb_commit_finite(struct pb_group *g, const struct pb_check *c,
                                    const uint8_t *data, struct pb_stamp stamp) {
    const uint64_t next = pb_write_begin(&g->reg->head);
    uint8_t *slot = pb_slot(g->slots, g->stride, next);
    if (!pb_copy_finite(slot + PB_LINE, data, c->type, c->n)) return false;
    pb_copy_out(slot, &stamp, sizeof stamp);
    pb_write_end(&g->reg->head, next, pb_crowded(g->reg, next));
    g->head = pb_write_last(&g->reg->head);
    return true;
}

/* Commit the safe values from the task itself; the cycle is taken, or closed. */
static inline void pb_write_safe(struct pb_local *l) {
    const struct pb_group *g = &l->outputs[PB_GROUP_VARS].group;
    const uint64_t head = pb_write_last(&g->reg->head);
    pb_commit_raw(g->reg, g->slots, g->stride, l->safe_data, g->bytes,
                  pb_safe_stamp(g->slots, g->stride, head, pb_time(l)));
}

/* Make the out-vars safe if the cycle has failed and is open. Called by the handler of a
 * signal, at any point of the task's code. */
static inline void pb_make_safe(struct pb_local *l) {
    struct pb_safe *s = l->safe;
    const uint64_t number = s ? atomic_load(&s->wanted) : 0;
    if (!number || !pb_safe_take(s, number, PB_TAKEN)) return;
    pb_write_safe(l);
    pb_safe_done(s, number, pb_time(l));
}

/* Begin a cycle: from here on its failure makes the out-vars safe. */
static inline void pb_cycle_begins(struct pb_local *l, uint64_t number) {
    const struct pb_outputs *o = l->outputs + PB_GROUP_VARS;
    uint64_t wanted;
    if (!l->safe || !number || !pb_is_mine(o)) return;
    l->open = number;
    pb_safe_open(l->safe, number, (uint32_t)(o->group.reg - l->table.regs), o->group.uid);
    wanted = atomic_load(&l->safe->wanted);
    if (wanted == number) pb_make_safe(l);
    else if (wanted) /* of another cycle; numbers come again after 2^32 of them */
        atomic_compare_exchange_strong(&l->safe->wanted, &wanted, 0);
}

/* Whether the cycle may commit its outputs. Then no other process writes the register until
 * the cycle ends. */
static inline bool pb_cycle_commits(struct pb_local *l) {
    return !l->open || pb_safe_take(l->safe, l->open, PB_COMMITS);
}

/* End the cycle; returns whether it has failed and the out-vars have their safe values. */
static inline bool pb_cycle_ends(struct pb_local *l) {
    struct pb_group *g = &l->outputs[PB_GROUP_VARS].group;
    const uint64_t number = l->open;
    int how;
    if (!number) return false;
    l->open = 0;
    how = pb_safe_close(l->safe, number);
    if (how == PB_TAKEN) { /* with the lock, no process is amid it */
        if (pb_lock(&l->table, true)) { /* it stands still there, or the table is overwritten */
            l->outputs[PB_GROUP_VARS].live = false; /* the register has another writer */
            return false;
        }
        how = (atomic_load(&l->safe->word) & 7) == PB_MADE_SAFE ? PB_MADE_SAFE : PB_COMMITS;
        pb_unlock(&l->table);
    }
    if (how == PB_CLOSED) return false;
    if (how == PB_COMMITS) {
        pb_write_safe(l);
        pb_safe_done(l->safe, number, pb_time(l));
    }
    atomic_store(&l->safe->word, number << 3 | PB_CLOSED);
    g->head = pb_write_last(&g->reg->head);
    return true;
}

/* Commit a group; returns flags, and publishes nothing if any is set. */
static inline int pb_commit(struct pb_local *l, struct pb_outputs *o, struct pb_stamp stamp) {
    const uint8_t *data = l->data + o->first;
    const bool only_finite = pb_only_finite(o);
    int flags;
    if (!o->group.n) return 0;
    if (!pb_is_mine(o)) return pb_not_mine(l);
    if (!only_finite && (flags = pb_judge(l, o))) return flags;
    if (!pb_readable(l)) return PB_TABLE_OVERWRITTEN;
    if (!only_finite) {
        if (!pb_commit_group(&o->group, data, stamp)) return PB_TABLE_OVERWRITTEN;
    } else if (pb_write_last(&o->group.reg->head) != o->group.head) {
        return PB_TABLE_OVERWRITTEN;
    } else if (!pb_commit_finite(&o->group, o->checks, data, stamp)) {
        return pb_judge(l, o);
    }
    l->counts.commits++;
    return 0;
}

/* Commit one variable of the group; the others keep their last committed values. */
static inline int pb_commit_one(struct pb_local *l, struct pb_outputs *o, uint32_t i,
                                int64_t now_ns, uint64_t cycle) {
    struct pb_group *g = &o->group;
    struct pb_stamp stamp = {now_ns, cycle};
    const uint8_t *last;
    uint64_t next;
    uint8_t *slot;
    int flags;
    if (!pb_is_mine(o)) return pb_not_mine(l);
    if (o == l->outputs + PB_GROUP_CONSTS && !pb_stands(l, g, i)) return pb_not_mine(l);
    if ((flags = pb_judge_one(l, o, i))) return flags;
    if (!pb_readable(l) || pb_write_last(&g->reg->head) != g->head) return PB_TABLE_OVERWRITTEN;
    last = pb_slot(g->slots, g->stride, g->head) + PB_LINE;
    next = pb_write_begin(&g->reg->head);
    slot = pb_slot(g->slots, g->stride, next) + PB_LINE;
    pb_copy_out(slot, last, g->bytes);
    pb_copy_out(slot + g->at[i], l->data + o->first + g->at[i],
                l->table.vars[g->vars[i]].bytes);
    pb_copy_out(slot - PB_LINE, &stamp, sizeof stamp);
    pb_write_end(&g->reg->head, next, pb_crowded(g->reg, next));
    g->head = pb_write_last(&g->reg->head);
    l->counts.commits++;
    return 0;
}

#endif
