/* What the native tests of the table share: a table in memory, local tables by malloc.
 *
 * Two writers, 0 and 1. Writer w owns the variables w * VARS .. w * VARS + VARS - 1; all
 * words of all but the last hold its counter, the last holds the other writer's counter as
 * it saw it before it committed. So a reader can tell a torn group (words differ) and a cut
 * that never was (a group has seen a later commit of the other than the cut contains). */
#ifndef SVAR_RIG_H
#define SVAR_RIG_H

#include "local.h"

#include <stdlib.h>
#include <sys/mman.h>

#ifndef RIG_GAP /* bytes between variables in a local table: then each is a piece of its own */
#define RIG_GAP 0
#endif

enum { WRITERS = 2, VARS = 7, ALL = WRITERS * VARS };

static inline void die(const char *what) {
    perror(what);
    abort();
}

static inline void *zeroed(size_t bytes) {
    void *p = aligned_alloc(PB_LINE, pb_round(bytes + 1, PB_LINE));
    if (!p) die("aligned_alloc");
    return memset(p, 0, pb_round(bytes + 1, PB_LINE));
}

static inline struct pb_table rig_attach(void *base, uint64_t bytes) {
    void *own;
    if (pb_verify(base, bytes, &own) != PB_SOUND) die("pb_verify");
    return pb_table_at(base, own);
}

static inline struct pb_table rig_table(uint64_t words) {
    struct pb_static s = {.n_vars = ALL};
    struct pb_var vars[ALL];
    uint8_t *values;
    void *base;
    memset(vars, 0, sizeof vars);
    for (int i = 0; i < ALL; i++) vars[i].bytes = i % VARS == VARS - 1 ? 8 : 8 * words;
    pb_lay_out(&s, vars, 8);
    base = mmap(NULL, s.size, PROT_READ | PROT_WRITE, MAP_SHARED | MAP_ANONYMOUS, -1, 0);
    if (base == MAP_FAILED) die("mmap");
    values = zeroed(s.keep_stamps);
    if (pb_format(base, &s, vars, "", values)) die("pb_format");
    free(values);
    return rig_attach(base, s.size);
}

static inline void rig_plan(struct pb_plan *p, const uint32_t *vars, const uint64_t *to, uint32_t n) {
    p->n_vars = n;
    p->vars = vars;
    p->to = to;
    p->sources = zeroed(n * sizeof *p->sources);
    p->pieces = zeroed(n * sizeof *p->pieces);
    p->ages = zeroed(n * sizeof *p->ages);
}

/* A local table of all variables; `writer` is -1 for a reader. The plan IN brings what it
 * does not write, the plan ON everything. */
static inline struct pb_local *rig_local(const struct pb_table *t, int writer) {
    struct pb_local *l = zeroed(sizeof *l);
    uint32_t *vars = zeroed(ALL * sizeof *vars), n = 0, *others = zeroed(ALL * sizeof *vars);
    uint64_t *to = zeroed(ALL * sizeof *to), *others_to = zeroed(ALL * sizeof *to);
    struct pb_group *g = &l->outputs[PB_GROUP_VARS].group;
    uint64_t at = 0;
    for (uint32_t v = 0; v < ALL; v++) {
        vars[v] = v;
        to[v] = at;
        at += t->vars[v].bytes + RIG_GAP;
        if ((int)v / VARS == writer) continue;
        others[n] = v;
        others_to[n++] = to[v];
    }
    l->table = *t;
    l->data = zeroed(at);
    l->consumed = zeroed(2 * ALL * sizeof(uint64_t));
    rig_plan(l->plans + PB_PLAN_IN, others, others_to, n);
    rig_plan(l->plans + PB_PLAN_ON, vars, to, ALL);
    if (writer >= 0) {
        uint64_t *places = zeroed(VARS * sizeof *places);
        for (int i = 0; i < VARS; i++) places[i] = to[writer * VARS + i] - to[writer * VARS];
        g->n = VARS;
        g->vars = vars + writer * VARS;
        g->at = places;
        g->bytes = places[VARS - 1] + 8;
        l->outputs[PB_GROUP_VARS].first = to[writer * VARS];
    }
    return l;
}

static inline uint64_t *rig_word(struct pb_local *l, int writer, int var) {
    return (uint64_t *)(void *)(l->data + l->plans[PB_PLAN_ON].to[writer * VARS + var]);
}

static inline uint64_t rig_words(const struct pb_local *l, int writer, int var) {
    return l->table.vars[writer * VARS + var].bytes / 8;
}

/* Fill the writer's group with `counter`, and with what it saw of the other. */
static inline void rig_fill(struct pb_local *l, int writer, uint64_t counter) {
    for (int v = 0; v < VARS - 1; v++)
        for (uint64_t i = 0; i < rig_words(l, writer, v); i++) rig_word(l, writer, v)[i] = counter;
    *rig_word(l, writer, VARS - 1) = *rig_word(l, 1 - writer, 0);
}

/* Whether every word of the writer's group is the same. */
static inline bool rig_is_whole(struct pb_local *l, int writer) {
    const uint64_t first = *rig_word(l, writer, 0);
    for (int v = 0; v < VARS - 1; v++)
        for (uint64_t i = 0; i < rig_words(l, writer, v); i++)
            if (rig_word(l, writer, v)[i] != first) return false;
    return true;
}

/* Whether an instant can have existed at which both groups were current. */
static inline bool rig_is_cut(struct pb_local *l) {
    return *rig_word(l, 0, VARS - 1) <= *rig_word(l, 1, 0) &&
           *rig_word(l, 1, VARS - 1) <= *rig_word(l, 0, 0);
}

static inline void rig_enter(struct pb_local *l, int writer) {
    struct pb_reg who = {.pid = (uint64_t)getpid(), .space = pb_process_space()};
    uint8_t *named = zeroed(l->table.fixed->n_regs);
    who.start = pb_process_start(who.pid);
    snprintf(who.task, sizeof who.task, "writer%d", writer);
    if (pb_enter(&l->table, &l->outputs[PB_GROUP_VARS].group, &who, named) < 0) die("pb_enter");
    free(named);
}

static inline int rig_claim(struct pb_local *l) {
    struct pb_outputs *o = l->outputs + PB_GROUP_VARS;
    uint32_t rival;
    int code = pb_claim(&l->table, &o->group, l->data + o->first,
                        (struct pb_stamp){pb_now(), 0}, false, &rival);
    o->live = !code;
    return code;
}

static inline int rig_release(struct pb_local *l, bool leave) {
    struct pb_outputs *o = l->outputs + PB_GROUP_VARS;
    o->live = false;
    return pb_let_go(&l->table, (uint32_t)(o->group.reg - l->table.regs), o->group.uid, leave,
                     false);
}

#endif
