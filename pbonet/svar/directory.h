/* The directory and the registers that it names: the basis of every change of ownership.
 *
 * The next directory is prepared beside the current one and published by one store
 * (pb_write_end on the generation): killed at any point, a claimer leaves either the old
 * ownership of all its variables or the new one. The slots of a register are reused only
 * when the directory of the current generation no longer names it, so a reader that still
 * copies from them finds another generation.
 */
#ifndef PBONET_DIRECTORY_H
#define PBONET_DIRECTORY_H

#include "lock.h"

/* The last commit of a register. */
struct pb_last {
    uint64_t uid, number;
};

/* The variables that a task writes together, as its process sees them. */
struct pb_group {
    struct pb_reg *reg;
    uint8_t *slots;
    uint64_t stride, bytes, uid;
    uint64_t head; /* of its last commit: it is the only writer */
    uint32_t n;
    const uint32_t *vars; /* their indices, ascending */
    const uint64_t *at;   /* their places in the group */
    const char *predecessors;  /* names of PB_NAME bytes: tasks that hand over to this one */
    uint32_t n_predecessors;
    const struct pb_last *ends; /* NULL, or for each variable its owner's last commit when
                                   the predecessors had ended; a later commit means that
                                   the owner was turned on again */
};

/* The directory's head; the caller holds the lock. */
static inline uint64_t pb_generation(const struct pb_table *t) {
    return pb_write_last(&t->live->generation);
}

/* Whether a reader was too slow lately. Only a hint, so it needs no ordering. */
static inline bool pb_crowded(const struct pb_reg *reg, uint64_t next) {
    return pb_number(next) < atomic_load_explicit(&reg->crowd, memory_order_relaxed);
}

static inline void pb_commit_raw(struct pb_reg *reg, uint8_t *slots, uint64_t stride,
                                 const void *data, size_t bytes, struct pb_stamp stamp) {
    uint64_t next = pb_write_begin(&reg->head);
    uint8_t *slot = pb_slot(slots, stride, next);
    pb_copy_out(slot + PB_LINE, data, bytes);
    pb_copy_out(slot, &stamp, sizeof stamp);
    pb_write_end(&reg->head, next, pb_crowded(reg, next));
}

/* False, without writing, when the register's head is not what its writer stored. */
static inline bool pb_commit_group(struct pb_group *g, const void *data,
                                   struct pb_stamp stamp) {
    if (pb_write_last(&g->reg->head) != g->head) return false;
    pb_commit_raw(g->reg, g->slots, g->stride, data, g->bytes, stamp);
    g->head = pb_write_last(&g->reg->head);
    return true;
}

/* The generation, for a caller that only checks for changes. */
static inline uint64_t pb_generation_seen(const struct pb_table *t) {
    return pb_number(pb_read_begin(&t->live->generation));
}

/* Copy the descriptions of all registers; returns 0 or a negative code. */
static inline int pb_registers(const struct pb_table *t, struct pb_reg *copies) {
    const int code = pb_lock(t, true);
    if (code) return code;
    pb_copy(copies, t->regs, t->fixed->n_regs * sizeof *copies); /* heads may still change */
    pb_unlock(t);
    for (uint32_t r = 0; r < t->fixed->n_regs; r++) copies[r].task[PB_NAME - 1] = 0;
    return 0;
}

/* Begin the next directory: a copy of the current one. */
static inline struct pb_entry *pb_next(const struct pb_table *t, uint64_t *head) {
    const struct pb_entry *now = pb_directory(t, pb_generation(t));
    struct pb_stamp stamp = {0, 0};
    struct pb_entry *next;
    *head = pb_write_begin(&t->live->generation);
    next = pb_directory(t, *head);
    stamp.cycle = pb_number(*head);
    pb_copy_out((uint8_t *)next - PB_LINE, &stamp, sizeof stamp);
    pb_copy_out(next, now, t->fixed->n_vars * sizeof *now);
    return next;
}

/* Publish the next directory. */
static inline void pb_publish(const struct pb_table *t, uint64_t head) {
    pb_write_end(&t->live->generation, head, true);
}

/* Free the registers that hold no variable and have no writer. */
static inline void pb_sweep(const struct pb_table *t, uint8_t *named) {
    const struct pb_entry *now = pb_directory(t, pb_generation(t));
    memset(named, 0, t->fixed->n_regs);
    for (uint32_t v = 0; v < t->fixed->n_vars; v++)
        if (now[v].reg < t->fixed->n_regs) named[now[v].reg] = 1;
    for (uint32_t r = 1; r < t->fixed->n_regs; r++) {
        struct pb_reg *reg = t->regs + r;
        uint64_t state = atomic_load_explicit(&reg->state, memory_order_relaxed);
        if (state == PB_FREE || named[r]) continue;
        if (state == PB_LEFT || !pb_alive(reg)) {
            PBONET_STEP(8);
            atomic_store_explicit(&reg->state, PB_FREE, memory_order_relaxed);
        }
    }
}

/* The first place in the arena with `bytes` free; 0 when there is none. */
static inline uint64_t pb_room(const struct pb_table *t, uint64_t bytes) {
    uint64_t at = t->fixed->arena;
    for (uint32_t r = 0; r < t->fixed->n_regs; r++) {
        const struct pb_place used = pb_place_of(t->regs + r);
        const uint64_t to = used.slots + PB_SLOTS * used.stride;
        if (atomic_load_explicit(&t->regs[r].state, memory_order_relaxed) == PB_FREE) continue;
        if (!pb_inside(t, &used)) return 0; /* overwritten; `at` would not always grow */
        if (used.slots >= at + bytes || to <= at) continue;
        at = to; /* occupied: continue after it and check all registers again */
        r = (uint32_t)-1;
    }
    return at + bytes <= t->fixed->size ? at : 0;
}

/* Find a free register and room for its slots, for a group of this size; the caller holds
 * the lock. `named` is scratch of n_regs bytes. Returns its index or PB_FULL. */
static inline int pb_find_register(const struct pb_table *t, uint64_t bytes, uint8_t *named,
                                   uint64_t *slots) {
    const struct pb_reg *reg = t->regs + 1;
    pb_sweep(t, named);
    while (reg < t->regs + t->fixed->n_regs &&
           atomic_load_explicit(&reg->state, memory_order_relaxed) != PB_FREE) reg++;
    *slots = pb_room(t, PB_SLOTS * pb_stride(bytes));
    return reg < t->regs + t->fixed->n_regs && *slots ? (int)(reg - t->regs) : PB_FULL;
}

/* Take a register for a group of g->bytes; the caller holds the lock, `who` describes the
 * writer. Returns its index, or PB_FULL without changing `g`. */
static inline int pb_take_register(const struct pb_table *t, struct pb_group *g,
                                   const struct pb_reg *who, uint8_t *named) {
    uint64_t stride = pb_stride(g->bytes), slots;
    const int found = pb_find_register(t, g->bytes, named, &slots);
    struct pb_reg *reg = t->regs + found;
    if (found < 0) return found;
    /* SYNC POINT O1, partner R4: a reader of a field set below also sees the generation
     * that no longer names the register. */
    atomic_thread_fence(memory_order_release);
    g->uid = ++t->live->uids;
    g->head = pb_write_last(&reg->head);
    atomic_store_explicit(&reg->slots, slots, memory_order_relaxed);
    atomic_store_explicit(&reg->stride, stride, memory_order_relaxed);
    atomic_store_explicit(&reg->uid, g->uid, memory_order_relaxed);
    atomic_store_explicit(&reg->crowd, 0, memory_order_relaxed);
    PBONET_STEP(9);
    reg->bytes = g->bytes;
    reg->owner = who->owner ? who->owner : g->uid;
    reg->pid = who->pid;
    reg->start = who->start;
    reg->space = who->space;
    pb_copy_out(reg->task, who->task, sizeof reg->task);
    atomic_store_explicit(&reg->state, PB_HELD, memory_order_relaxed);
    g->reg = reg;
    g->slots = t->base + slots;
    g->stride = stride;
    return found;
}

/* The same with the lock taken here; may also return PB_STUCK or PB_GONE. */
static inline int pb_enter(const struct pb_table *t, struct pb_group *g,
                           const struct pb_reg *who, uint8_t *named) {
    int code = pb_lock(t, true);
    if (code) return code;
    code = pb_take_register(t, g, who, named);
    pb_unlock(t);
    return code;
}

#endif
