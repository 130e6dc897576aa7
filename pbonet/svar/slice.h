/* How soon Linux gives a thread a core when all are busy. */
#ifndef PBONET_SLICE_H
#define PBONET_SLICE_H

#ifndef _GNU_SOURCE
#define _GNU_SOURCE 1
#endif
#include <errno.h>
#include <sched.h>
#include <stdint.h>
#include <sys/syscall.h>
#include <unistd.h>

enum { PB_SLICE_NS = 100000 }; /* the shortest that Linux takes */

/* The first version of the kernel's struct sched_attr, which newer C libraries declare. */
struct pb_sched_attr {
    uint32_t size, policy;
    uint64_t flags;
    int32_t nice;
    uint32_t priority;
    uint64_t runtime, deadline, period;
};

/* Let this thread, and those that it starts (without SCHED_RESET_ON_FORK), run in short
 * slices: as much as before, but sooner after waking (EEVDF, Linux 6.12; older kernels do
 * nothing). 0, or an error's number. A thread of another policy stays as it is, and so
 * does one that may not have SCHED_FIFO: tasks of its user are ordinary processes then,
 * and it would run before them, amid their cycles. */
static inline int pb_short_slices(void) {
    struct pb_sched_attr now = {.size = sizeof now};
    if (syscall(SYS_sched_getattr, 0, &now, sizeof now, 0)) return errno;
    if (now.policy != SCHED_OTHER) return 0;
    struct pb_sched_attr fifo = {sizeof fifo, SCHED_FIFO, now.flags, 0, 1, 0, 0, 0};
    if (syscall(SYS_sched_setattr, 0, &fifo, 0)) return errno;
    now.runtime = PB_SLICE_NS;
    return syscall(SYS_sched_setattr, 0, &now, 0) ? errno : 0; /* and back */
}

#endif
