/* Sleeping until a record comes, and waking the sleeper. */
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

/* Wake the reader: one system call that waits for nobody. */
static inline void tb_wake(_Atomic uint32_t *bell) {
    syscall(SYS_futex, bell, FUTEX_WAKE, 1, NULL, NULL, 0);
}

/* Wait for a record, until `until_ns` at the latest: 0, TB_TIMED_OUT or TB_SIGNAL. A writer
 * that dies before it rings is not noticed, so a caller that waits for long looks again. */
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

/* When the next record is to be expected, for a reader that may spend a little processor time
 * to have it sooner: waking a process takes longer than all else on a record's way. */
struct tb_pace {
    int64_t last_ns, period_ns;
    int rest; /* records for which nothing is expected: the last guess was wrong */
};

enum { TB_EARLY = 50000, TB_LATE = 30000, TB_SHORTEST = 800000, TB_REST = 4 };

/* Take note of a record; `lost` were missed before it. */
static inline void tb_paced(struct tb_pace *pace, int64_t time_ns, uint64_t lost) {
    int64_t period = (time_ns - pace->last_ns) / (int64_t)(lost + 1);
    bool steady = pace->period_ns && period > pace->period_ns / 2 &&
                  period < pace->period_ns * 2;
    pace->period_ns = steady ? (7 * pace->period_ns + period) / 8 : period;
    if (pace->rest) pace->rest--;
    if (!steady) pace->rest = 1;
    pace->last_ns = time_ns;
}

/* As tb_doze. Awake a little before the next record is due, and for a little behind that, so
 * that a writer that is on time need wake nobody. */
static inline int tb_doze_paced(struct tb_buffer *b, struct tb_pace *pace, int64_t until_ns) {
    int64_t due = pace->last_ns + pace->period_ns;
    if (pace->rest || pace->period_ns < TB_SHORTEST || due - TB_EARLY >= until_ns)
        return tb_doze(b, until_ns);
    int code = tb_doze(b, due - TB_EARLY);
    if (code != TB_TIMED_OUT) return code; /* it came sooner */
    atomic_store(&b->bell, 0);             /* who writes now need not ring */
    while (tb_now() < due + TB_LATE)
        if (tb_news(b) || atomic_load(&b->destroyed)) return 0;
    pace->rest = TB_REST;
    return tb_doze(b, until_ns);
}

/* Bells to be rung behind the present cycle of this process, by its one thread. */
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
