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
