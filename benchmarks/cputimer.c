/* The rival of reserve.py: the kernel's own timers, in a C program.
 *
 * usage: cputimer CORE LEVEL LIMIT_NS ROUNDS WHAT
 * WHAT is "busy": a timer on CLOCK_THREAD_CPUTIME_ID is set to LIMIT_NS while the program
 * computes; printed is the CPU time beyond the limit in the handler's first line. Or it
 * is "asleep": a timer on CLOCK_MONOTONIC, the program sleeps, and the time beyond the
 * limit is printed. "thread" and "thread-asleep" are the least that a dispatcher could do: a
 * thread at the level above reads a timer and the CPU time and sends the
 * signal; the program computes or sleeps, and rests 45 ms before each round.
 * Nanoseconds, one number a line. LEVEL 0 is SCHED_OTHER.
 */
#define _GNU_SOURCE
#include <pthread.h>
#include <sched.h>
#include <signal.h>
#include <stdint.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>
#include <sys/mman.h>
#include <sys/prctl.h>
#include <sys/syscall.h>
#include <sys/timerfd.h>
#include <time.h>
#include <unistd.h>

#ifndef sigev_notify_thread_id
#define sigev_notify_thread_id _sigev_un._tid
#endif

static clockid_t clock_used;
static volatile int64_t handled;
static int timer_file;
static pid_t main_thread;

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

static void rest(long ns)
{
    struct timespec moment = {.tv_nsec = ns};
    nanosleep(&moment, NULL);
}

static void *signaller(void *level)
{
    struct sched_param param = {.sched_priority = *(int *)level + 1};
    struct timespec used;
    uint64_t times;
    prctl(PR_SET_TIMERSLACK, 1);
    if (*(int *)level && sched_setscheduler(0, SCHED_FIFO, &param))
        perror("SCHED_FIFO"), exit(1);
    while (read(timer_file, &times, sizeof times) > 0) {
        clock_gettime(CLOCK_PROCESS_CPUTIME_ID, &used);
        syscall(SYS_tgkill, getpid(), main_thread, SIGUSR1);
    }
    return NULL;
}

/* Start the thread of "thread", which takes the core and the rest from the caller. */
static int start_signaller(int *level)
{
    pthread_t thread;
    sigset_t all, old;
    timer_file = timerfd_create(CLOCK_MONOTONIC, TFD_CLOEXEC);
    sigfillset(&all);
    pthread_sigmask(SIG_SETMASK, &all, &old);
    int error = timer_file < 0 || pthread_create(&thread, NULL, signaller, level);
    pthread_sigmask(SIG_SETMASK, &old, NULL);
    return error;
}

int main(int argc, char **argv)
{
    if (argc != 6)
        return 2;
    int64_t limit = atoll(argv[3]);
    int rounds = atoi(argv[4]), busy = !strcmp(argv[5], "busy");
    int threaded = !strncmp(argv[5], "thread", 6), computes = busy || !strcmp(argv[5], "thread");
    struct sched_param param = {.sched_priority = atoi(argv[2])};
    struct sigaction action = {.sa_handler = on_limit};
    struct sigevent event = {.sigev_notify = SIGEV_THREAD_ID, .sigev_signo = SIGUSR1};
    timer_t timer;
    cpu_set_t set;
    CPU_ZERO(&set);
    CPU_SET((size_t)atoi(argv[1]), &set);
    clock_used = busy ? CLOCK_THREAD_CPUTIME_ID : CLOCK_MONOTONIC;
    event.sigev_notify_thread_id = main_thread = (pid_t)syscall(SYS_gettid);
    if (sched_setaffinity(0, sizeof set, &set) || sigaction(SIGUSR1, &action, NULL))
        return perror("affinity"), 1;
    if (param.sched_priority && sched_setscheduler(0, SCHED_FIFO, &param))
        return perror("SCHED_FIFO"), 1;
    if (timer_create(clock_used, &event, &timer))
        return perror("timer_create"), 1;
    prctl(PR_SET_TIMERSLACK, 1);
    mlockall(MCL_CURRENT | MCL_FUTURE);
    if (threaded && start_signaller(&param.sched_priority))
        return perror("thread"), 1;
    for (int k = 0; k < rounds; k++) {
        struct itimerspec at = {.it_value = {limit / 1000000000, limit % 1000000000}};
        struct timespec long_time = {.tv_sec = 1};
        rest(threaded ? 45000000 : 5000000);
        handled = 0;
        int64_t begun = now();
        if (threaded)
            timerfd_settime(timer_file, 0, &at, NULL);
        else
            timer_settime(timer, 0, &at, NULL);
        while (!handled)
            if (!computes)
                nanosleep(&long_time, NULL);
        printf("%lld\n", (long long)(handled - begun - limit));
    }
    return 0;
}
