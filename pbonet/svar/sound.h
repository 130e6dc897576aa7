/* Whether the mutable part of a table is what claimers and writers made it.
 *
 * Any process of the user can overwrite a table's file: a stray write through a mapping of
 * it, or a program that opens it. Nothing that this process finds there then may make it
 * access memory outside the file, or take bytes for a value that was never committed. What can
 * be recognized: the head of the directory and those of the registers are never zero, move
 * on by single commits, and have few valid forms; the directory's slot holds the number of
 * its commit; each entry holds a sum over itself and the place of its register; the words
 * around the lock are constant. The values themselves have no checksum: a stray write to
 * the arena changes values until their writer commits again.
 */
#ifndef PBONET_SOUND_H
#define PBONET_SOUND_H

#include "arena.h"

/* Results of changes of ownership; PB_GONE: the table was overwritten. */
enum { PB_RIVAL = -1, PB_FULL = -2, PB_STUCK = -3, PB_ALIVE = -4, PB_GONE = -5 };

/* Whether a register or directory that was committed can have this head. */
static inline bool pb_is_head(uint64_t head) {
    return (head >> 4 & 15) - 1 < 2 && pb_kept(head) < 3;
}

/* Whether a head cannot follow `last`: it is none, older, or by 2^40 commits newer, which
 * takes 12 days at 1 MHz. */
static inline bool pb_jumped(uint64_t last, uint64_t head) {
    return (head - last) >> 48 || !pb_is_head(head);
}

static inline struct pb_place pb_place_of(const struct pb_reg *reg) {
    return (struct pb_place){atomic_load_explicit(&reg->slots, memory_order_relaxed),
                             atomic_load_explicit(&reg->stride, memory_order_relaxed),
                             atomic_load_explicit(&reg->uid, memory_order_relaxed)};
}

/* The check word of an entry: each factor is odd, so that a change of one field always
 * changes the sum, and an entry of zeros is not valid. */
static inline uint64_t pb_sum(uint32_t v, const struct pb_entry *e, const struct pb_place *at) {
    return UINT64_C(0x9e3779b97f4a7c15) + v * UINT64_C(0xbf58476d1ce4e5b9) +
           ((uint64_t)e->reg << 32 | e->live) * UINT64_C(0x94d049bb133111eb) +
           e->at * UINT64_C(0xff51afd7ed558ccd) + at->slots * UINT64_C(0xc4ceb9fe1a85ec53) +
           at->stride * UINT64_C(0xd6e8feb86659fd93) + at->uid * UINT64_C(0xa0761d6478bd642f);
}

/* Whether the slots are inside the file. */
static inline bool pb_inside(const struct pb_table *t, const struct pb_place *at) {
    const uint64_t size = t->fixed->size;
    return at->slots >= t->fixed->arena && at->slots <= size &&
           at->slots % PB_LINE == 0 && at->stride % PB_LINE == 0 &&
           at->stride <= (size - at->slots) / PB_SLOTS;
}

/* Whether the entry of variable `v` is valid, and the variable inside its register's slots
 * at `at`. */
static inline bool pb_fits(const struct pb_table *t, uint32_t v, const struct pb_entry *e,
                           const struct pb_place *at) {
    return e->sum == pb_sum(v, e, at) && pb_inside(t, at) && e->at <= at->stride &&
           t->vars[v].bytes + PB_LINE <= at->stride - e->at;
}

/* The register of an entry; register 0 for one that does not exist. */
static inline struct pb_reg *pb_reg_of(const struct pb_table *t, const struct pb_entry *e) {
    return t->regs + (e->reg < t->fixed->n_regs ? e->reg : 0);
}

/* The entry of variable `v` in register `r`. */
static inline struct pb_entry pb_entry_in(const struct pb_table *t, uint32_t v, uint32_t r,
                                          uint32_t live, uint64_t at) {
    const struct pb_place place = pb_place_of(t->regs + r);
    struct pb_entry e = {r, live, at, 0};
    e.sum = pb_sum(v, &e, &place);
    return e;
}

/* Whether the directory's slot under this head is the one that was published with it. */
static inline bool pb_numbered(const struct pb_table *t, uint64_t head) {
    struct pb_stamp stamp;
    pb_copy(&stamp, pb_slot(t->base + t->fixed->dir, t->fixed->dir_stride, head), sizeof stamp);
    return pb_is_head(head) && stamp.cycle == pb_number(head);
}

/* Whether the words around the lock are intact: claimers must not touch it otherwise. */
static inline bool pb_guarded(const struct pb_live *live) {
    return *(const volatile uint64_t *)&live->before == PB_GUARD &&
           *(const volatile uint64_t *)&live->after == PB_GUARD;
}

/* Whether every entry under this head is valid, and so is the head of its register. */
static inline bool pb_directory_sound(const struct pb_table *t, uint64_t head) {
    if (!pb_numbered(t, head)) return false;
    for (uint32_t v = 0; v < t->fixed->n_vars; v++) {
        const struct pb_reg *reg;
        struct pb_place at;
        struct pb_entry e;
        pb_copy(&e, pb_directory(t, head) + v, sizeof e);
        reg = pb_reg_of(t, &e);
        at = pb_place_of(reg);
        if (e.reg >= t->fixed->n_regs || !pb_fits(t, v, &e, &at) ||
            !pb_is_head(pb_read_begin(&reg->head)))
            return false;
    }
    return true;
}

/* Whether the table is intact, as far as can be recognized. Waits for nothing; if the
 * directory changes in every attempt, claimers are at work, and it is. */
static inline bool pb_sound(const struct pb_table *t) {
    const struct pb_place keeper = pb_place_of(t->regs);
    if (!pb_guarded(t->live) || keeper.slots != t->fixed->arena || keeper.uid ||
        keeper.stride != pb_stride(t->fixed->keep_bytes))
        return false;
    for (int tries = 0; tries < 64; tries++) {
        const uint64_t head = pb_read_begin(&t->live->generation);
        const bool sound = pb_directory_sound(t, head);
        /* SYNC POINT C5, partners R1 and O1: what was read is of this generation. */
        pb_read_fence();
        if (pb_read_end(&t->live->generation) == head) return sound;
    }
    return true;
}

#endif
