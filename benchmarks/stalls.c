/* The reference of swap.py: a bare C loop that tells when it was late.
 *
 * usage: stalls CORE LEVEL PERIOD_NS OFFSET_NS LATE_NS
 * Says "ready", and sleeps from release to release, OFFSET_NS behind the multiples of
 * PERIOD_NS, until standard input ends. Then prints how many there were, and for each
 * wake-up that came LATE_NS late or more when it was due and when it came, in
 * nanoseconds of CLOCK_MONOTONIC. Its memory is there before it takes its level: to fill
 * it takes milliseconds, in which nothing below runs.
 */
#define _GNU_SOURCE
#include <poll.h>
#include <sched.h>
#include <stdint.h>
#include <stdio.h>
#include <stdlib.h>
#include <sys/mman.h>
#include <sys/prctl.h>
#include <time.h>

enum { MOST = 1 << 20 };
static int64_t due_at[MOST], came_at[MOST];

static int64_t now(void)
{
    struct timespec at;
    clock_gettime(CLOCK_MONOTONIC, &at);
    return (int64_t)at.tv_sec * 1000000000 + at.tv_nsec;
}

int main(int argc, char **argv)
{
    if (argc != 6)
        return 2;
    int64_t period = atoll(argv[3]), offset = atoll(argv[4]);
    int64_t least = atoll(argv[5]), count = 0;
    int late = 0;
    struct sched_param param = {.sched_priority = atoi(argv[2])};
    cpu_set_t set;
    CPU_ZERO(&set);
    CPU_SET((size_t)atoi(argv[1]), &set);
    prctl(PR_SET_TIMERSLACK, 1);
    if (mlockall(MCL_CURRENT | MCL_FUTURE))
        return perror("mlockall"), 1;
    if (sched_setaffinity(0, sizeof set, &set))
        return perror("affinity"), 1;
    if (param.sched_priority && sched_setscheduler(0, SCHED_FIFO, &param))
        return perror("SCHED_FIFO"), 1;
    puts("ready");
    fflush(stdout);
    struct pollfd end = {.fd = 0, .events = POLLIN};
    int64_t release = (now() / period + 10) * period + offset;
    for (;; release += period, count++) {
        struct timespec at = {release / 1000000000, release % 1000000000};
        clock_nanosleep(CLOCK_MONOTONIC, TIMER_ABSTIME, &at, NULL);
        int64_t woken = now();
        if (woken - release >= least && late < MOST) {
            due_at[late] = release;
            came_at[late++] = woken;
        }
        release += (woken - release) / period * period;
        if (poll(&end, 1, 0) > 0)
            break;
    }
    printf("%lld\n", (long long)count);
    for (int k = 0; k < late; k++)
        printf("%lld %lld\n", (long long)due_at[k], (long long)came_at[k]);
    return 0;
}
