/* Sleeping until a record arrives, and waking the sleeper. */
#ifndef PBONET_DOZE_H
#define PBONET_DOZE_H

#ifndef _GNU_SOURCE
#define _GNU_SOURCE 1
#endif
#include <errno.h>
#include <linux/futex.h>
#include <sys/syscall.h>
#include <time.h>
#include <unistd.h>

#include "triple.h"

static inline int64_t tb_now(void) {
    struct timespec now;
    clock_gettime(CLOCK_MONOTONIC, &now);
    return now.tv_sec * INT64_C(1000000000) + now.tv_nsec;
}

/* Wake the reader: one system call that never waits. */
static inline void tb_wake(_Atomic uint32_t *bell) {
    syscall(SYS_futex, bell, FUTEX_WAKE, 1, NULL, NULL, 0);
}

/* Wait for a record, until `until_ns` at the latest: 0, TB_TIMED_OUT or TB_SIGNAL. If the
 * writer dies before it rings, nothing wakes the reader, so a long wait must be split. */
static inline int tb_doze(struct tb_buffer *b, int64_t until_ns) {
    struct timespec until = {until_ns / 1000000000, until_ns % 1000000000};
    for (;;) {
        atomic_store(&b->bell, 1); /* SYNC POINT T4, partner in tb_write. */
        if (tb_news(b) || atomic_load(&b->destroyed)) return 0;
        if (!syscall(SYS_futex, &b->bell, FUTEX_WAIT_BITSET, 1, &until, NULL,
                     FUTEX_BITSET_MATCH_ANY)) continue;
        if (errno == ETIMEDOUT) return tb_news(b) ? 0 : TB_TIMED_OUT;
        if (errno == EINTR) return TB_SIGNAL;
    }
}

/* Predicts the next record, for a reader that may spend a little processor time to get it
 * sooner: waking a process takes longer than everything else on a record's way. A late
 * record moves the next expected time by only a quarter of its delay, because a single
 * delay does not mean that the next record will be as late. */
struct tb_pace {
    int64_t last_ns, period_ns, due_ns;
    bool steady;
};

enum { TB_EARLY = 50000, TB_LATE = 30000, TB_NAP = 60000, TB_SHORTEST = 800000 };

/* Account for a record; `lost` were missed before it. */
static inline void tb_paced(struct tb_pace *pace, int64_t time_ns, uint64_t lost) {
    const int64_t since = (time_ns - pace->last_ns) / (int64_t)(lost + 1);
    int64_t off = 0;
    pace->steady = pace->period_ns && since > pace->period_ns / 2 &&
                   since < pace->period_ns * 2;
    if (pace->steady) {
        off = time_ns - pace->due_ns - (int64_t)lost * pace->period_ns;
        if (off > pace->period_ns / 2 || off < -pace->period_ns / 2) off = 0;
        pace->period_ns += (since - pace->period_ns) / 8;
    } else {
        pace->period_ns = since;
    }
    pace->due_ns = time_ns + pace->period_ns - off * 3 / 4;
    pace->last_ns = time_ns;
}

static inline void tb_nap(int64_t ns) {
    struct timespec time = {0, ns};
    clock_nanosleep(CLOCK_MONOTONIC, 0, &time, NULL);
}

/* As tb_doze, but awake shortly before the next record is due and shortly after; then it
 * polls, for three periods or 5 ms, and after that it sleeps. So a writer with a regular
 * period needs no wake-ups. */
static inline int tb_doze_paced(struct tb_buffer *b, struct tb_pace *pace, int64_t until_ns) {
    const int64_t more = 3 * pace->period_ns, most = 5000000;
    const int64_t gone = pace->due_ns + (more < most ? more : most);
    if (!pace->steady || pace->period_ns < TB_SHORTEST || pace->due_ns - TB_EARLY >= until_ns)
        return tb_doze(b, until_ns);
    int code = tb_doze(b, pace->due_ns - TB_EARLY);
    if (code != TB_TIMED_OUT) return code; /* the record came earlier */
    atomic_store(&b->bell, 0);             /* the writer need not ring now */
    for (int64_t now = 0; now < gone && now < until_ns; now = tb_now()) {
        if (tb_news(b) || atomic_load(&b->destroyed)) return 0;
        if (now > pace->due_ns + TB_LATE) tb_nap(TB_NAP);
    }
    pace->steady = false;
    return tb_doze(b, until_ns);
}

/* Bells to be rung after the current cycle of this process, by its only thread. */
enum { TB_BELLS = 32 };
struct tb_bells {
    int defer, count;
    _Atomic uint32_t *bells[TB_BELLS];
};

static inline void tb_ring(struct tb_bells *later, _Atomic uint32_t *bell) {
    if (later->defer && later->count < TB_BELLS)
        later->bells[later->count++] = bell;
    else
        tb_wake(bell);
}

static inline void tb_ring_all(struct tb_bells *later) {
    later->defer = 0;
    for (int i = 0; i < later->count; i++) tb_wake(later->bells[i]);
    later->count = 0;
}

#endif
