/* Sleeping until a bell rings, or until words of tables have changed. The thread that
 * mirrors a table has nothing to do while no task writes, and a writing task should not
 * have to wake it. So it polls, which without Python costs some microseconds. */
#ifndef PBONET_WATCH_H
#define PBONET_WATCH_H

#ifndef _GNU_SOURCE
#define _GNU_SOURCE 1
#endif
#include <linux/futex.h>
#include <sys/prctl.h>
#include <sys/syscall.h>
#include <unistd.h>

#include "local.h"

enum { PB_SLACK_NS = 50000 }; /* by which Linux ends timers late, unless told otherwise */
enum { PB_WATCHED = 128, PB_MOVED = 0, PB_RUNG, PB_OVER };

/* A word and its last handled value; of a register's head the number alone. */
struct pb_word {
    const _Atomic uint64_t *at;
    uint64_t known;
    bool head;
};

struct pb_watch {
    _Atomic uint32_t bell; /* 1: rung */
    uint32_t n;
    bool exact;        /* the thread's timers end without the usual slack */
    int64_t glance_ns; /* when to read the words next */
    struct pb_word words[PB_WATCHED];
};

/* Add a word; if there is no room it is not watched: the caller also checks at times. */
static inline void pb_watch_add(struct pb_watch *w, const _Atomic uint64_t *at,
                                uint64_t known, bool head) {
    if (w->n < PB_WATCHED) w->words[w->n++] = (struct pb_word){at, known, head};
}

/* May be called from any thread. */
static inline void pb_watch_ring(struct pb_watch *w) {
    /* SYNC POINT W1, partner W2: what was written before the ring is seen after it. */
    if (!atomic_exchange(&w->bell, 1))
        syscall(SYS_futex, &w->bell, FUTEX_WAKE_PRIVATE, 1, NULL, NULL, 0);
}

static inline bool pb_watch_moved(const struct pb_watch *w) {
    for (uint32_t i = 0; i < w->n; i++) {
        const uint64_t now = atomic_load_explicit(w->words[i].at, memory_order_acquire);
        if ((w->words[i].head ? pb_number(now) : now) != w->words[i].known) return true;
    }
    return false;
}

/* Read the words until `until_ns` without sleeping, for a change that is expected within
 * microseconds: to be woken takes longer than that. */
static inline int pb_watch_awake(struct pb_watch *w, int64_t until_ns) {
    while (pb_now() < until_ns) {
        if (pb_watch_moved(w)) return PB_MOVED;
        if (atomic_load(&w->bell)) break; /* the next sleep takes it */
    }
    return PB_OVER;
}

/* Sleep until `until_ns`, and read the words every `pause_ns`, even if bells ring more
 * often. A changed word that is not handled ends at most one sleep per pause. */
static inline int pb_watch_sleep(struct pb_watch *w, int64_t until_ns, int64_t pause_ns) {
    if (pause_ns < PB_SLACK_NS && !w->exact) {
        w->exact = true; /* one thread sleeps by one watch */
        prctl(PR_SET_TIMERSLACK, 1UL);
    }
    for (;;) {
        const int64_t now = pb_now();
        int64_t at = until_ns;
        struct timespec time;
        if (w->n && now >= w->glance_ns) {
            w->glance_ns = now + pause_ns;
            if (pb_watch_moved(w)) return PB_MOVED;
        }
        if (now + pause_ns < w->glance_ns) w->glance_ns = now + pause_ns; /* it was longer */
        if (atomic_exchange(&w->bell, 0)) return PB_RUNG; /* SYNC POINT W2 */
        if (now >= until_ns) return PB_OVER;
        if (w->n && w->glance_ns < at) at = w->glance_ns;
        time = (struct timespec){at / 1000000000, at % 1000000000};
        syscall(SYS_futex, &w->bell, FUTEX_WAIT_BITSET_PRIVATE, 0, &time, NULL,
                FUTEX_BITSET_MATCH_ANY);
    }
}

#endif
