/* The keeper's register: initial values, and values set by an operator. Also the
 * initialization of a new table, and the verification of a file before it is used. */
#ifndef PBONET_KEEPER_H
#define PBONET_KEEPER_H

#include "owner.h"

/* Set a variable that no task owns: the keeper commits all its values with this one
 * changed, then the variable is moved to the keeper if it was elsewhere. Without `wait`
 * a lock that is held is not waited for. */
static inline int pb_set(const struct pb_table *t, uint32_t v, const void *value,
                         int64_t now_ns, bool wait) {
    struct pb_reg *reg = t->regs + PB_KEEPER;
    uint8_t *slots = t->base + t->fixed->arena, *slot, *before;
    uint64_t head, stride = pb_stride(t->fixed->keep_bytes);
    struct pb_stamp stamp = {now_ns, 0};
    const struct pb_entry *now;
    uint8_t *mark;
    if (wait ? pb_lock(t->live) : pb_lock_now(t->live)) return PB_STUCK;
    now = pb_directory(t, pb_generation(t)) + v;
    if (now->live && pb_alive(t->regs + now->reg)) {
        pb_unlock(t->live);
        return PB_RIVAL;
    }
    before = pb_slot(slots, stride, pb_write_last(&reg->head));
    head = pb_write_begin(&reg->head);
    slot = pb_slot(slots, stride, head);
    pb_copy_out(slot, before, stride);
    pb_copy_out(slot + PB_LINE + t->vars[v].keep, value, t->vars[v].bytes);
    mark = slot + PB_LINE + t->fixed->keep_stamps + v * sizeof stamp;
    stamp.cycle = ((const struct pb_stamp *)(const void *)mark)->cycle + 1;
    pb_copy_out(mark, &stamp, sizeof stamp);
    pb_write_end(&reg->head, head, true);
    if (now->reg != PB_KEEPER || now->live) {
        struct pb_entry *next = pb_next(t, &head);
        struct pb_entry kept = {PB_KEEPER, 0, t->vars[v].keep};
        pb_copy_out(next + v, &kept, sizeof kept);
        pb_publish(t, head);
    }
    pb_unlock(t->live);
    return 0;
}

/* Make a table in zeroed memory: `values` is the keeper's first group, without stamps. */
static inline int pb_format(void *base, const struct pb_static *s, const struct pb_var *vars,
                            const void *text, const void *values) {
    struct pb_static *fixed = base;
    uint64_t head;
    struct pb_table t;
    struct pb_reg *keeper;
    struct pb_entry *first;
    *fixed = *s;
    t = pb_table_at(base);
    memcpy(t.vars, vars, s->n_vars * sizeof *vars);
    memcpy(t.base + s->text, text, s->text_bytes);
    keeper = t.regs + PB_KEEPER;
    atomic_store(&keeper->slots, s->arena);
    atomic_store(&keeper->stride, pb_stride(s->keep_bytes));
    atomic_store(&keeper->state, PB_HELD);
    pb_commit_raw(keeper, t.base + s->arena, pb_stride(s->keep_bytes), values,
                  s->keep_stamps, (struct pb_stamp){0, 0});
    head = pb_write_begin(&t.live->generation);
    first = pb_directory(&t, head);
    for (uint32_t v = 0; v < s->n_vars; v++)
        first[v] = (struct pb_entry){PB_KEEPER, 0, vars[v].keep};
    pb_publish(&t, head);
    atomic_store(&t.live->changes, 1);
    memcpy(fixed->magic, PB_MAGIC, sizeof fixed->magic);
    fixed->version = PB_VERSION;
    fixed->abi = PB_ABI;
    fixed->checksum = pb_checksum(t.base, s->live);
    return pb_lock_make(&t.live->lock);
}

enum pb_verdict { PB_SOUND, PB_NO_TABLE, PB_OTHER_VERSION, PB_CUT_SHORT, PB_DAMAGED };

/* Verify `bytes` of a file before use; nothing beyond them is touched. */
static inline enum pb_verdict pb_verify(const void *base, uint64_t bytes) {
    const struct pb_static *s = base;
    if (bytes < sizeof *s || memcmp(s->magic, PB_MAGIC, sizeof s->magic)) return PB_NO_TABLE;
    if (s->version != PB_VERSION || s->abi != PB_ABI) return PB_OTHER_VERSION;
    if (s->size != bytes) return s->size > bytes ? PB_CUT_SHORT : PB_DAMAGED;
    if (s->live > bytes || s->live < sizeof *s) return PB_DAMAGED;
    return pb_checksum(base, s->live) == s->checksum ? PB_SOUND : PB_DAMAGED;
}

#endif
