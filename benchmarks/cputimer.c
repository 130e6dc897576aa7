/* The rival of reserve.py: the kernel's own timers, in a C program.
 *
 * usage: cputimer CORE LEVEL LIMIT_NS ROUNDS WHAT
 * WHAT is "busy": a timer on CLOCK_THREAD_CPUTIME_ID is set to LIMIT_NS while the program
 * computes; printed is the CPU time beyond the limit in the handler's first line. Or it
 * is "asleep": a timer on CLOCK_MONOTONIC, the program sleeps, and the time beyond the
 * limit is printed. Nanoseconds, one number a line. LEVEL 0 is SCHED_OTHER.
 */
#define _GNU_SOURCE
#include <sched.h>
#include <signal.h>
#include <stdint.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>
#include <sys/mman.h>
#include <sys/prctl.h>
#include <sys/syscall.h>
#include <time.h>
#include <unistd.h>

#ifndef sigev_notify_thread_id
#define sigev_notify_thread_id _sigev_un._tid
#endif

static clockid_t clock_used;
static volatile int64_t handled;

static int64_t now(void)
{
    struct timespec at;
    clock_gettime(clock_used, &at);
    return (int64_t)at.tv_sec * 1000000000 + at.tv_nsec;
}

static void on_limit(int signal)
{
    (void)signal;
    handled = now();
}

static void rest(void)
{
    struct timespec moment = {.tv_nsec = 5000000};
    nanosleep(&moment, NULL);
}

int main(int argc, char **argv)
{
    if (argc != 6)
        return 2;
    int64_t limit = atoll(argv[3]);
    int rounds = atoi(argv[4]), busy = !strcmp(argv[5], "busy");
    struct sched_param param = {.sched_priority = atoi(argv[2])};
    struct sigaction action = {.sa_handler = on_limit};
    struct sigevent event = {.sigev_notify = SIGEV_THREAD_ID, .sigev_signo = SIGUSR1};
    timer_t timer;
    cpu_set_t set;
    CPU_ZERO(&set);
    CPU_SET((size_t)atoi(argv[1]), &set);
    clock_used = busy ? CLOCK_THREAD_CPUTIME_ID : CLOCK_MONOTONIC;
    event.sigev_notify_thread_id = (pid_t)syscall(SYS_gettid);
    if (sched_setaffinity(0, sizeof set, &set) || sigaction(SIGUSR1, &action, NULL))
        return perror("affinity"), 1;
    if (param.sched_priority && sched_setscheduler(0, SCHED_FIFO, &param))
        return perror("SCHED_FIFO"), 1;
    if (timer_create(clock_used, &event, &timer))
        return perror("timer_create"), 1;
    prctl(PR_SET_TIMERSLACK, 1);
    mlockall(MCL_CURRENT | MCL_FUTURE);
    for (int k = 0; k < rounds; k++) {
        struct itimerspec at = {.it_value = {limit / 1000000000, limit % 1000000000}};
        struct timespec long_time = {.tv_sec = 1};
        rest();
        handled = 0;
        int64_t begun = now();
        timer_settime(timer, 0, &at, NULL);
        while (!handled)
            if (!busy)
                nanosleep(&long_time, NULL);
        printf("%lld\n", (long long)(handled - begun - limit));
    }
    return 0;
}
