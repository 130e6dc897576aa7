/* Ownership: variables are claimed and released, always under the lock, and always as one
 * event for readers (directory.h explains why). */
#ifndef PBONET_OWNER_H
#define PBONET_OWNER_H

#include "directory.h"

/* Whether the newest value of variable `v` equals `value`; the caller holds the lock. The
 * owner may go on writing, so the copy is repeated until it is whole; false if it never is. */
static inline bool pb_peek_equal(const struct pb_table *t, uint32_t v, const struct pb_entry *e,
                                 const uint8_t *value) {
    const uint64_t bytes = t->vars[v].bytes;
    const struct pb_reg *reg = pb_reg_of(t, e);
    const struct pb_place place = pb_place_of(reg);
    if (!pb_fits(t, v, e, &place)) return false;
    for (int tries = 0; tries < 64; tries++) {
        uint64_t word, head = pb_read_begin(&reg->head);
        const uint8_t *from = pb_slot(t->base + place.slots, place.stride, head) + PB_LINE + e->at;
        bool same = true;
        for (uint64_t i = 0; i < bytes && same; i += sizeof word) {
            pb_copy(&word, from + i, sizeof word);
            same = !memcmp(&word, value + i, sizeof word);
        }
        pb_read_fence();
        if (pb_whole(head, pb_read_end(&reg->head))) return same;
    }
    return false;
}

enum { PB_TAKE, PB_SHARE, PB_REFUSE };

/* The last commit of a register; the caller holds the lock. Its writer may go on. */
static inline struct pb_last pb_last_of(const struct pb_reg *reg) {
    return (struct pb_last){atomic_load_explicit(&reg->uid, memory_order_relaxed),
                            pb_number(pb_read_begin(&reg->head))};
}

/* Record the last commits of the owners of the group's variables, now that the predecessors
 * have ended: an owner that commits later was turned on again and does not hand over.
 * `ends` has room for each variable and must stay in place. Returns 0 or a negative code. */
static inline int pb_note_ends(const struct pb_table *t, struct pb_group *g,
                               struct pb_last *ends) {
    const struct pb_entry *now;
    const int code = pb_lock(t, true);
    if (code) return code;
    now = pb_directory(t, pb_generation(t));
    for (uint32_t i = 0; i < g->n; i++) {
        const struct pb_entry *e = now + g->vars[i];
        ends[i] = e->live ? pb_last_of(pb_reg_of(t, e)) : (struct pb_last){0, UINT64_MAX};
    }
    pb_unlock(t);
    g->ends = ends;
    return 0;
}

/* Whether the holder of a register hands over the group's variable `i`: it is transferred
 * by the group's own claim, so that it has an owner at every instant. */
static inline bool pb_hands_over(const struct pb_group *g, uint32_t i,
                                 const struct pb_reg *holder) {
    struct pb_last last = pb_last_of(holder);
    if (g->ends && (g->ends[i].uid != last.uid || g->ends[i].number != last.number))
        return false;
    for (uint32_t k = 0; k < g->n_predecessors; k++)
        if (!strncmp(holder->task, g->predecessors + k * PB_NAME, PB_NAME)) return true;
    return false;
}

/* Whether the group may take this variable. A constant to which its owner gives the same
 * value stays with that owner (thesis, section 3.5: only a different value is a conflict). */
static inline int pb_may(const struct pb_table *t, const struct pb_group *g, uint32_t i,
                         const uint8_t *data, bool constants) {
    struct pb_entry e;
    const struct pb_reg *holder;
    pb_copy(&e, pb_directory(t, pb_generation(t)) + g->vars[i], sizeof e);
    holder = pb_reg_of(t, &e);
    if (!e.live || holder == g->reg || pb_hands_over(g, i, holder) || !pb_alive(holder))
        return PB_TAKE;
    if (constants && pb_peek_equal(t, g->vars[i], &e, data + g->at[i]))
        return PB_SHARE;
    return PB_REFUSE;
}

/* Find a variable that another live task owns, if any; the caller holds the lock. */
static inline bool pb_refused(const struct pb_table *t, const struct pb_group *g,
                              const uint8_t *data, bool constants, uint32_t *rival) {
    for (uint32_t i = 0; i < g->n; i++) {
        if (pb_may(t, g, i, data, constants) != PB_REFUSE) continue;
        *rival = g->vars[i];
        return true;
    }
    return false;
}

/* Whether some variables of a claim are already in the group's register and others are not:
 * a commit there would change the former at once, the latter with the generation. */
static inline bool pb_divided(const struct pb_table *t, const struct pb_group *g,
                              const uint8_t *data, bool constants) {
    const struct pb_entry *now = pb_directory(t, pb_generation(t));
    uint32_t here = 0, taken = 0;
    for (uint32_t i = 0; i < g->n; i++) {
        if (pb_may(t, g, i, data, constants) != PB_TAKE) continue;
        taken++;
        here += t->regs + now[g->vars[i]].reg == g->reg;
    }
    return here && here < taken;
}

/* Find a register for a divided group; with `take` the group moves there, where it has no
 * readers yet. Returns 0 or PB_FULL. */
static inline int pb_renew(const struct pb_table *t, struct pb_group *g, bool take) {
    struct pb_reg who = {.owner = g->reg->owner, .pid = g->reg->pid,
                         .start = g->reg->start, .space = g->reg->space};
    uint8_t *named = malloc(t->fixed->n_regs);
    uint64_t slots;
    int code = PB_FULL;
    memcpy(who.task, g->reg->task, sizeof who.task);
    if (named)
        code = take ? pb_take_register(t, g, &who, named)
                    : pb_find_register(t, g->bytes, named, &slots);
    free(named);
    return code < 0 ? code : 0;
}

/* Whether a claim would be refused now; asked before a module is turned on, not binding. */
static inline int pb_ask(const struct pb_table *t, struct pb_group *g, const uint8_t *data,
                         bool constants, uint32_t *rival) {
    int code = pb_lock(t, true);
    if (code) return code;
    if (pb_refused(t, g, data, constants, rival))
        code = PB_RIVAL;
    else if (pb_divided(t, g, data, constants))
        code = pb_renew(t, g, false);
    pb_unlock(t);
    return code;
}

/* Commit the group and take all its variables, as one event. Returns 0 or a negative code,
 * PB_RIVAL with the variable that another live task owns. */
static inline int pb_claim(const struct pb_table *t, struct pb_group *g, const uint8_t *data,
                           struct pb_stamp stamp, bool constants, uint32_t *rival) {
    struct pb_group old;
    uint64_t head;
    struct pb_entry *next;
    int code = pb_lock(t, true);
    if (code) return code;
    if (pb_refused(t, g, data, constants, rival)) {
        pb_unlock(t);
        return PB_RIVAL;
    }
    g->ends = NULL; /* checked once: a later commit of an owner must not divide the claim */
    old = *g;
    if (pb_divided(t, g, data, constants) && pb_renew(t, g, true)) {
        pb_unlock(t);
        return PB_FULL;
    }
    if (!pb_commit_group(g, data, stamp)) {
        pb_unlock(t);
        return PB_GONE;
    }
    atomic_store_explicit(&g->reg->state, PB_HELD, memory_order_relaxed);
    next = pb_next(t, &head);
    for (uint32_t i = 0; i < g->n; i++) {
        const uint32_t v = g->vars[i];
        struct pb_entry mine = pb_entry_in(t, v, (uint32_t)(g->reg - t->regs), 1, g->at[i]);
        if (pb_may(t, &old, i, data, constants) == PB_TAKE)
            pb_copy_out(next + v, &mine, sizeof mine);
    }
    pb_publish(t, head);
    if (g->reg != old.reg)
        atomic_store_explicit(&old.reg->state, PB_LEFT, memory_order_relaxed);
    pb_unlock(t);
    return 0;
}

/* Release all variables in register `r`; their values remain. With `leave` the register is
 * not written again; with `dead` it must belong to a process that has ended. Does nothing
 * if the register has another uid: it was reused meanwhile. */
static inline int pb_let_go(const struct pb_table *t, uint32_t r, uint64_t uid, bool leave,
                            bool dead) {
    const struct pb_entry *now;
    struct pb_entry *next;
    uint64_t head;
    uint32_t v = 0;
    const int code = pb_lock(t, true);
    if (code) return code;
    if (atomic_load_explicit(&t->regs[r].uid, memory_order_relaxed) != uid ||
        atomic_load_explicit(&t->regs[r].state, memory_order_relaxed) == PB_FREE) {
        pb_unlock(t);
        return 0;
    }
    if (dead && pb_alive(t->regs + r)) {
        pb_unlock(t);
        return PB_ALIVE;
    }
    now = pb_directory(t, pb_generation(t));
    while (v < t->fixed->n_vars && !(now[v].reg == r && now[v].live)) v++;
    if (v < t->fixed->n_vars) {
        next = pb_next(t, &head);
        for (; v < t->fixed->n_vars; v++) {
            const struct pb_entry left = pb_entry_in(t, v, r, 0, next[v].at);
            if (next[v].reg == r) pb_copy_out(next + v, &left, sizeof left);
        }
        pb_publish(t, head);
    }
    if (leave) atomic_store_explicit(&t->regs[r].state, PB_LEFT, memory_order_relaxed);
    pb_unlock(t);
    return 0;
}

#endif
