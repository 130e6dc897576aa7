/* The rival of jitter.py: a bare C loop on clock_nanosleep.
 *
 * usage: clockloop CORE LEVEL PERIOD_NS CYCLES
 * Prints how many releases were missed, the CPU time of its cycles in nanoseconds, and then the
 * delay of every wake-up in nanoseconds, one number a line. LEVEL 0 is SCHED_OTHER. As in pbonet a
 * delay counts from the newest release; the ones slept through are missed.
 */
#define _GNU_SOURCE
#include <sched.h>
#include <stdint.h>
#include <stdio.h>
#include <stdlib.h>
#include <sys/mman.h>
#include <sys/prctl.h>
#include <time.h>

static int64_t now(clockid_t clock)
{
    struct timespec at;
    clock_gettime(clock, &at);
    return (int64_t)at.tv_sec * 1000000000 + at.tv_nsec;
}

int main(int argc, char **argv)
{
    if (argc != 5)
        return 2;
    int64_t period = atoll(argv[3]), cycles = atoll(argv[4]);
    struct sched_param param = {.sched_priority = atoi(argv[2])};
    cpu_set_t set;
    CPU_ZERO(&set);
    CPU_SET((size_t)atoi(argv[1]), &set);
    if (sched_setaffinity(0, sizeof set, &set))
        return perror("affinity"), 1;
    if (param.sched_priority && sched_setscheduler(0, SCHED_FIFO, &param))
        return perror("SCHED_FIFO"), 1;
    prctl(PR_SET_TIMERSLACK, 1);
    mlockall(MCL_CURRENT | MCL_FUTURE);
    int64_t *delay = calloc((size_t)cycles, sizeof *delay);
    int64_t release = (now(CLOCK_MONOTONIC) / period + 10) * period, missed = 0;
    int64_t before = now(CLOCK_THREAD_CPUTIME_ID);
    for (int64_t k = 0; k < cycles; k++) {
        struct timespec at = {release / 1000000000, release % 1000000000};
        clock_nanosleep(CLOCK_MONOTONIC, TIMER_ABSTIME, &at, NULL);
        int64_t woken = now(CLOCK_MONOTONIC);
        for (; woken - release >= period; release += period)
            missed++;
        delay[k] = woken - release;
        release += period;
    }
    int64_t spent = now(CLOCK_THREAD_CPUTIME_ID) - before;
    printf("%lld\n%lld\n", (long long)missed, (long long)spent);
    for (int64_t k = 0; k < cycles; k++)
        printf("%lld\n", (long long)delay[k]);
    return 0;
}
