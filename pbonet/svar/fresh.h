/* The age of a task's inputs: which are too old, what the task does then, when it goes on
 * again, and the time stamp of what it writes (docs/failsafe.md). */
#ifndef PBONET_FRESH_H
#define PBONET_FRESH_H

#include "cut.h"

/* What a task does while an input is too old; the largest of several counts. */
enum pb_action { PB_GO_ON, PB_HOLD, PB_STABLE, PB_SAFE, PB_FAIL };

enum { PB_RENEWALS = 2 }; /* of each input with a limit, before the task goes on */
#define PB_LONG_AGO 1     /* the stamp of data of unknown age */

/* How often an input with a limit was renewed since all inputs are fresh. */
struct pb_renewal {
    int64_t time_ns;
    uint32_t times;
};

struct pb_freshness_state {
    int64_t settle_ns; /* how long inputs must have been fresh; negative: PB_RENEWALS */
    int64_t fresh_ns;  /* since when all are fresh, while settling; 0: one is too old */
    int64_t oldest_ns; /* stamp of the oldest input that is passed on; 0: none */
    struct pb_renewal *renewals; /* one for each variable of the plan; NULL: never settles */
    enum pb_action action;
    bool settling; /* an input is or was too old, and the task has not gone on yet */
    bool begun;    /* all inputs were fresh since the task was turned on */
    bool report;   /* others are to know: after turning on, not before the limit has passed */
    int64_t first_ns; /* the first copy with an input too old since then */
};

static inline bool pb_too_old(const struct pb_age *age, int64_t now) {
    return age->fresh.maxage_ns &&
           (!age->stamp.time_ns || now - age->stamp.time_ns > age->fresh.maxage_ns);
}

/* Whether the age of an input counts for what is computed from it. Inputs count that have a
 * limit, or whose own stamp was passed on: a set-point that never changes is not old. */
static inline bool pb_counts(const struct pb_age *a) {
    return a->fresh.maxage_ns || a->stamp.cycle & PB_PASSED_ON;
}

/* The stamp of the oldest input whose age is passed on; 0 when there is none. */
static inline int64_t pb_oldest(const struct pb_plan *p) {
    int64_t oldest = INT64_MAX;
    for (uint32_t i = 0; i < p->n_ages; i++) {
        const struct pb_age *a = p->ages + i;
        if (!a->fresh.passes || a->stamp.time_ns >= oldest) continue;
        if (pb_counts(a)) oldest = a->stamp.time_ns;
    }
    if (oldest == INT64_MAX) return 0;
    return oldest ? oldest : PB_LONG_AGO;
}

/* The first input that is too old; n_ages when none is. The strongest action counts. */
static inline uint32_t pb_first_stale(const struct pb_plan *p, int64_t now,
                                      enum pb_action *action) {
    uint32_t first = p->n_ages;
    *action = PB_GO_ON;
    for (uint32_t i = 0; i < p->n_ages; i++) {
        if (!pb_too_old(p->ages + i, now)) continue;
        if (first == p->n_ages) first = i;
        if (p->ages[i].fresh.action > *action) *action = p->ages[i].fresh.action;
    }
    return first;
}

/* Begin to count renewals: all inputs are fresh for the first time. */
static inline void pb_begin_fresh(struct pb_freshness_state *s, const struct pb_plan *p,
                                  int64_t now) {
    s->fresh_ns = now;
    for (uint32_t i = 0; i < p->n_ages; i++)
        s->renewals[i] = (struct pb_renewal){p->ages[i].stamp.time_ns, 0};
}

/* Whether inputs have been fresh for long enough; counts what has come. */
static inline bool pb_settled(struct pb_freshness_state *s, const struct pb_plan *p,
                              int64_t now) {
    bool all = true;
    if (s->settle_ns >= 0) return now - s->fresh_ns >= s->settle_ns;
    for (uint32_t i = 0; i < p->n_ages; i++) {
        struct pb_renewal *r = s->renewals + i;
        if (!p->ages[i].fresh.maxage_ns) continue;
        r->times += r->time_ns != p->ages[i].stamp.time_ns;
        r->time_ns = p->ages[i].stamp.time_ns;
        all &= r->times >= PB_RENEWALS;
    }
    return all;
}

static inline void pb_turned_on(struct pb_freshness_state *s) {
    s->settling = s->begun = s->report = false;
    s->action = PB_GO_ON;
    s->first_ns = 0;
}

/* An input is too old. */
static inline void pb_follow_stale(struct pb_freshness_state *s, int64_t limit_ns,
                                   int64_t now, enum pb_action action) {
    if (!s->first_ns) s->first_ns = now;
    s->report |= s->begun || now - s->first_ns > limit_ns;
    s->settling = true;
    s->fresh_ns = 0;
    s->action = action;
}

/* All inputs are fresh; returns whether the task still does its action. The first time
 * after it was turned on, it goes on at once. */
static inline bool pb_follow_fresh(struct pb_freshness_state *s, const struct pb_plan *p,
                                   int64_t now) {
    if (s->settling && s->begun) {
        if (!s->fresh_ns) pb_begin_fresh(s, p, now);
        if (!pb_settled(s, p, now)) return true;
    }
    s->begun = true;
    s->settling = s->report = false;
    s->action = PB_GO_ON;
    return false;
}

/* The stamp of a commit: the module's own time if it gives one, else that of the oldest
 * input, else now. */
static inline struct pb_stamp pb_stamp_of(const struct pb_freshness_state *s, int64_t own_ns,
                                          int64_t now_ns, uint64_t cycle) {
    if (own_ns) return (struct pb_stamp){own_ns, cycle | PB_PASSED_ON};
    if (s->oldest_ns) return (struct pb_stamp){s->oldest_ns, cycle | PB_PASSED_ON};
    return (struct pb_stamp){now_ns, cycle};
}

#endif
