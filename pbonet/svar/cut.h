/* A consistent cut: the newest values of many variables from several registers, such that
 * at some instant all of them were current (thesis, section 5.5: data is always transferred
 * as a complete set).
 *
 * Load the generation and every register's head, copy, then load them all again. If all are
 * unchanged except possibly the register loaded last, and that one was copied whole, every
 * group was current at the instant of the last first load. Otherwise repeat, at most
 * PB_TRIES times; after that, whole groups are accepted, and the result says that the cut is
 * not proven. Nothing waits: no iteration depends on another process's progress. A table
 * that was overwritten is recognized when the plan is made (sound.h); after that a copy only
 * checks that the generation is the plan's and that no head jumped.
 */
#ifndef PBONET_CUT_H
#define PBONET_CUT_H

#include "sound.h"

enum { PB_TRIES = 16, PB_TRIES_WHOLE = 256, PB_CROWD = 4096 };
enum pb_result { PB_CONSISTENT, PB_WHOLE, PB_LOST, PB_OVERWRITTEN };
enum pb_planned { PB_PLANNED, PB_OUTDATED, PB_INVALID };

struct pb_source {
    struct pb_reg *reg;
    uint8_t *slots;
    uint64_t stride, uid, head; /* head: of the last copy; before it, of the plan */
    bool outside; /* no task of this machine writes it, so no log holds its commits */
};

struct pb_piece {
    uint32_t source;
    uint64_t from, to, bytes;
};

/* How a task handles the age of one variable that it reads. */
struct pb_freshness {
    int64_t maxage_ns; /* 0: no limit */
    uint32_t action;   /* while it is too old: enum pb_action */
    uint32_t passes;   /* whether its age is passed on to what the task writes */
};

struct pb_age {
    uint32_t source, var;
    uint64_t from;
    struct pb_freshness fresh;
    struct pb_stamp stamp;
};

/* Which bytes go where; rebuilt whenever the generation has changed. The caller provides
 * arrays for n_vars sources, pieces and ages. */
struct pb_plan {
    uint32_t n_vars, n_sources, n_pieces, n_ages;
    const uint32_t *vars; /* indices, ascending */
    const uint64_t *to;   /* places in the local table */
    struct pb_source *sources;
    struct pb_piece *pieces;
    struct pb_age *ages;
    uint64_t generation; /* the directory's head; 0: none yet, no directory has it */
    bool all_ages; /* read every variable's stamp, not only of those with MAXAGE */
    const struct pb_freshness *fresh; /* of each variable, then every stamp is read; NULL:
                                         only limits count, those of the table */
    uint32_t *age_of; /* with `fresh`: the entry in `ages` of each variable */
    bool limited;     /* a variable has a limit */
};

/* Whether a register is the keeper's, an agent's (TASK@HOST) or a player's (replay:TASK). */
static inline bool pb_is_outside(const struct pb_table *t, const struct pb_reg *reg) {
    return reg == t->regs + PB_KEEPER || memchr(reg->task, '@', PB_NAME) ||
           memchr(reg->task, ':', PB_NAME);
}

static inline uint32_t pb_source_of(const struct pb_table *t, struct pb_plan *p, uint32_t r) {
    struct pb_reg *reg = t->regs + r;
    uint32_t i = 0;
    while (i < p->n_sources && p->sources[i].reg != reg) i++;
    if (i == p->n_sources) {
        const struct pb_place at = pb_place_of(reg);
        p->sources[p->n_sources++] = (struct pb_source){
            reg, t->base + at.slots, at.stride, at.uid, pb_read_begin(&reg->head),
            pb_is_outside(t, reg)};
    }
    return i;
}

/* Whether an entry is valid, with the place of its register as the plan has it. */
static inline bool pb_source_fits(const struct pb_table *t, uint32_t v, const struct pb_entry *e,
                                  const struct pb_source *s) {
    const struct pb_place at = {(uint64_t)(s->slots - t->base), s->stride, s->uid};
    return pb_fits(t, v, e, &at) && pb_is_head(s->head);
}

static inline void pb_add_piece(struct pb_plan *p, struct pb_piece new) {
    struct pb_piece *last = p->pieces + p->n_pieces - 1;
    if (p->n_pieces && last->source == new.source && last->from + last->bytes == new.from &&
        last->to + last->bytes == new.to) {
        last->bytes += new.bytes; /* neighbours on both sides: one copy */
    } else {
        p->pieces[p->n_pieces++] = new;
    }
}

/* Plan to read the stamp of the plan's variable `i`. Variables that are written together
 * and handled alike share one. */
static inline void pb_plan_age(struct pb_plan *p, uint32_t i, struct pb_age new) {
    uint32_t k = 0;
    if (!new.fresh.maxage_ns && !p->all_ages && !p->fresh) return;
    p->limited |= new.fresh.maxage_ns != 0;
    while (p->fresh && k < p->n_ages &&
           (p->ages[k].source != new.source || p->ages[k].from != new.from ||
            memcmp(&p->ages[k].fresh, &new.fresh, sizeof new.fresh))) k++;
    if (!p->fresh) k = p->n_ages;
    if (p->age_of) p->age_of[i] = k;
    if (k == p->n_ages) p->ages[p->n_ages++] = new;
}

/* Build the plan for `generation`; outdated when that is no longer the newest, invalid when
 * it is and its directory is not one that a claimer made. */
static inline enum pb_planned pb_replan(const struct pb_table *t, struct pb_plan *p,
                                        uint64_t generation) {
    const struct pb_entry *dir = pb_directory(t, generation);
    bool valid = pb_numbered(t, generation);
    p->generation = 0;
    p->n_sources = p->n_pieces = p->n_ages = 0;
    p->limited = false;
    for (uint32_t i = 0; i < p->n_vars && valid; i++) {
        const uint32_t v = p->vars[i];
        const struct pb_var *var = t->vars + v;
        struct pb_entry e;
        uint32_t source;
        pb_copy(&e, dir + v, sizeof e);
        valid = e.reg < t->fixed->n_regs;
        if (!valid) break;
        source = pb_source_of(t, p, e.reg);
        valid = pb_source_fits(t, v, &e, p->sources + source);
        pb_add_piece(p, (struct pb_piece){source, PB_LINE + e.at, p->to[i], var->bytes});
        pb_plan_age(p, i, (struct pb_age){
            source, v,
            e.reg == PB_KEEPER ? PB_LINE + t->fixed->keep_stamps + v * sizeof(struct pb_stamp)
                               : 0,
            p->fresh ? p->fresh[i] : (struct pb_freshness){.maxage_ns = var->maxage_ns},
            {0, 0}});
    }
    /* SYNC POINT C1, partners R1 (directory slot) and O1 (register fields): nothing above
     * may be used, not even to compute an address, unless it belongs to this generation. */
    pb_read_fence();
    if (pb_read_end(&t->live->generation) != generation) return PB_OUTDATED;
    if (!valid) return PB_INVALID;
    p->generation = generation;
    return PB_PLANNED;
}

static inline void pb_copy_pieces(struct pb_plan *p, uint8_t *to) {
    for (uint32_t i = 0; i < p->n_pieces; i++) {
        const struct pb_piece *piece = p->pieces + i;
        const struct pb_source *s = p->sources + piece->source;
        pb_copy(to + piece->to, pb_slot(s->slots, s->stride, s->head) + piece->from,
                piece->bytes);
        PBONET_STEP(21);
    }
    for (uint32_t i = 0; i < p->n_ages; i++) {
        const struct pb_source *s = p->sources + p->ages[i].source;
        pb_copy(&p->ages[i].stamp, pb_slot(s->slots, s->stride, s->head) + p->ages[i].from,
                sizeof p->ages[i].stamp);
    }
}

/* Whether a group was copied whole; if not, ask its writer to keep more commits. */
static inline bool pb_whole_or_ask(struct pb_source *s, uint64_t again) {
    if (pb_whole(s->head, again)) return true;
    atomic_store_explicit(&s->reg->crowd, pb_number(again) + PB_CROWD, memory_order_relaxed);
    return false;
}

/* Read the plan's variables to `to`; adds the number of failed attempts to `tries`. */
static inline enum pb_result pb_cut(const struct pb_table *t, struct pb_plan *p, uint8_t *to,
                                    uint64_t *tries) {
    for (uint32_t try = 0; try < PB_TRIES_WHOLE; try++, ++*tries) {
        bool same = true, whole = true;
        /* SYNC POINT C2, partner R2 in pb_write_end on the generation. */
        uint64_t generation = pb_read_begin(&t->live->generation);
        if (generation != p->generation || !generation) {
            const enum pb_planned planned = pb_replan(t, p, generation);
            if (planned == PB_INVALID) return PB_OVERWRITTEN;
            if (planned == PB_OUTDATED) continue;
        }
        for (uint32_t i = 0; i < p->n_sources; i++) {
            const uint64_t head = pb_read_begin(&p->sources[i].reg->head);
            if (pb_jumped(p->sources[i].head, head)) return PB_OVERWRITTEN;
            p->sources[i].head = head;
            PBONET_STEP(20);
        }
        pb_copy_pieces(p, to);
        /* SYNC POINT C3, partner R1: all second loads come after all copies, and all first
         * loads (acquire) came before them. */
        pb_read_fence();
        for (uint32_t i = 0; i < p->n_sources; i++) {
            uint64_t again = pb_read_end(&p->sources[i].reg->head);
            same &= again == p->sources[i].head || i + 1 == p->n_sources;
            whole &= pb_whole_or_ask(p->sources + i, again);
        }
        /* SYNC POINT C4, partner R1 on the generation: the registers were not reused. */
        if (pb_read_end(&t->live->generation) != generation) continue;
        if (same && whole) return PB_CONSISTENT;
        if (whole && try + 1 >= PB_TRIES) return PB_WHOLE;
    }
    return PB_LOST;
}

#endif
