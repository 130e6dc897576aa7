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
    const int code = pb_lock(t, wait);
    struct pb_reg *reg = t->regs + PB_KEEPER;
    uint8_t *slots = t->base + t->fixed->arena, *slot, *before;
    uint64_t head, stride = pb_stride(t->fixed->keep_bytes);
    struct pb_stamp stamp = {now_ns, 0};
    const struct pb_entry *now;
    uint8_t *mark;
    if (code) return code;
    now = pb_directory(t, pb_generation(t)) + v;
    if (now->live && pb_alive(pb_reg_of(t, now))) {
        pb_unlock(t);
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
        const struct pb_entry kept = pb_entry_in(t, v, PB_KEEPER, 0, t->vars[v].keep);
        pb_copy_out(next + v, &kept, sizeof kept);
        pb_publish(t, head);
    }
    pb_unlock(t);
    return 0;
}

/* Make a table in zeroed memory: `values` is the keeper's first group, without stamps. */
static inline int pb_format(void *base, const struct pb_static *s, const struct pb_var *vars,
                            const void *text, const void *values) {
    struct pb_static *fixed = base;
    uint64_t head;
    struct pb_stamp stamp = {0, 0};
    struct pb_table t;
    struct pb_reg *keeper;
    struct pb_entry *first;
    *fixed = *s;
    t = pb_table_at(base, base);
    memcpy(t.base + s->vars, vars, s->n_vars * sizeof *vars);
    memcpy(t.base + s->text, text, s->text_bytes);
    keeper = t.regs + PB_KEEPER;
    atomic_store(&keeper->slots, s->arena);
    atomic_store(&keeper->stride, pb_stride(s->keep_bytes));
    atomic_store(&keeper->state, PB_HELD);
    pb_commit_raw(keeper, t.base + s->arena, pb_stride(s->keep_bytes), values,
                  s->keep_stamps, (struct pb_stamp){0, 0});
    head = pb_write_begin(&t.live->generation);
    first = pb_directory(&t, head);
    stamp.cycle = pb_number(head);
    memcpy((uint8_t *)first - PB_LINE, &stamp, sizeof stamp);
    for (uint32_t v = 0; v < s->n_vars; v++)
        first[v] = pb_entry_in(&t, v, PB_KEEPER, 0, vars[v].keep);
    pb_publish(&t, head);
    atomic_store(&t.live->changes, 1);
    t.live->before = t.live->after = PB_GUARD;
    memcpy(fixed->magic, PB_MAGIC, sizeof fixed->magic);
    fixed->version = PB_VERSION;
    fixed->abi = PB_ABI;
    fixed->checksum = pb_checksum(t.base, s->live);
    return pb_lock_make(&t.live->lock);
}

enum pb_verdict { PB_SOUND, PB_NO_TABLE, PB_OTHER_VERSION, PB_CUT_SHORT, PB_DAMAGED, PB_NO_MEMORY };

static inline enum pb_verdict pb_verify_header(const struct pb_static *s, uint64_t bytes) {
    if (memcmp(s->magic, PB_MAGIC, sizeof s->magic)) return PB_NO_TABLE;
    if (s->version != PB_VERSION || s->abi != PB_ABI) return PB_OTHER_VERSION;
    if (s->size != bytes) return s->size > bytes ? PB_CUT_SHORT : PB_DAMAGED;
    return s->live > bytes || s->live < sizeof *s ? PB_DAMAGED : PB_SOUND;
}

/* Whether the places in a static part are those that pb_lay_out gives. */
static inline bool pb_laid_out(const struct pb_static *s) {
    const uint64_t at = pb_round(sizeof *s, PB_LINE);
    struct pb_static again = *s;
    struct pb_var *vars;
    bool same;
    if (s->vars != at || s->text_bytes > s->live || s->n_vars > s->live / sizeof *vars) return false;
    if (at + s->n_vars * sizeof *vars + s->text_bytes > s->live) return false;
    vars = malloc(s->n_vars * sizeof *vars + 1);
    if (!vars) return false;
    memcpy(vars, (const uint8_t *)s + at, s->n_vars * sizeof *vars);
    pb_lay_out(&again, vars, 0);
    same = again.size <= s->size;
    again.size = s->size;
    same &= !memcmp(&again, s, sizeof again) &&
            !memcmp(vars, (const uint8_t *)s + at, s->n_vars * sizeof *vars);
    free(vars);
    return same;
}

/* Verify `bytes` of a file before use; nothing beyond them is touched. If it is sound,
 * `*own` is a copy of its static part, to be freed, which nothing can overwrite. */
static inline enum pb_verdict pb_verify(const void *base, uint64_t bytes, void **own) {
    struct pb_static header;
    enum pb_verdict verdict;
    *own = NULL;
    if (bytes < sizeof header) return PB_NO_TABLE;
    memcpy(&header, base, sizeof header);
    verdict = pb_verify_header(&header, bytes);
    if (verdict != PB_SOUND) return verdict;
    if (!(*own = malloc(header.live))) return PB_NO_MEMORY;
    memcpy(*own, base, header.live);
    if (!memcmp(*own, &header, sizeof header) &&
        pb_checksum(*own, header.live) == header.checksum && pb_laid_out(*own))
        return PB_SOUND;
    free(*own);
    *own = NULL;
    return PB_DAMAGED;
}

#endif
