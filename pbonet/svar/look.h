/* One variable with its provenance, for prompts, displays and tools. */
#ifndef PBONET_LOOK_H
#define PBONET_LOOK_H

#include "cut.h"
#include "lock.h"

struct pb_view {
    struct pb_stamp stamp;
    uint64_t uid, seq;
    uint32_t reg, live;
    char task[PB_NAME]; /* the writer; empty for the keeper */
};

/* Copy variable `v` to `to` (its rounded size) with its provenance. */
static inline enum pb_result pb_look(const struct pb_table *t, uint32_t v, void *to,
                                     struct pb_view *view) {
    const uint64_t at = 0;
    struct pb_source source;
    struct pb_piece piece;
    struct pb_age age;
    struct pb_plan plan = {.n_vars = 1, .vars = &v, .to = &at, .sources = &source,
                           .pieces = &piece, .ages = &age, .all_ages = true};
    uint64_t tries = 0;
    struct pb_entry e;
    for (int i = 0; i < PB_TRIES_WHOLE; i++) {
        const enum pb_result result = pb_cut(t, &plan, to, &tries);
        if (result == PB_LOST || result == PB_OVERWRITTEN) return result;
        pb_copy(&e, pb_directory(t, plan.generation) + v, sizeof e);
        pb_copy(view->task, source.reg->task, sizeof view->task);
        /* SYNC POINT C5, partners R1 and O1: the entry and the name are of this generation. */
        pb_read_fence();
        if (pb_read_end(&t->live->generation) != plan.generation) continue;
        view->stamp = age.stamp;
        view->uid = source.uid;
        view->seq = pb_number(source.head);
        view->reg = (uint32_t)(source.reg - t->regs);
        view->live = e.live;
        view->task[PB_NAME - 1] = 0;
        return PB_CONSISTENT;
    }
    return PB_LOST;
}

/* Whether a task writes variable `v`: its owner is alive and has not ended. */
static inline bool pb_written(const struct pb_table *t, uint32_t v) {
    for (int i = 0; i < PB_TRIES_WHOLE; i++) {
        const uint64_t head = pb_read_begin(&t->live->generation);
        struct pb_entry e;
        struct pb_reg owner;
        pb_copy(&e, pb_directory(t, head) + v, sizeof e);
        pb_copy(&owner, pb_reg_of(t, &e), sizeof owner);
        /* SYNC POINT C5: as in pb_look. */
        pb_read_fence();
        if (pb_read_end(&t->live->generation) != head) continue;
        return e.live && atomic_load(&owner.state) == PB_HELD && pb_alive(&owner);
    }
    return false;
}

#endif
