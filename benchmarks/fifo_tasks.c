/* The rival of equal_tasks.py: the same busy work in C, under plain SCHED_FIFO.
 *
 * usage: fifo_tasks CORE LEVEL TASKS PERIOD_NS USED_NS SECONDS
 * Forks TASKS processes on one core, the first at LEVEL, each further one a level below.
 * Each sleeps to its release, a multiple of PERIOD_NS, and computes until it has used
 * USED_NS of CPU time. A cycle that is not done at the next release misses that one, as
 * the dispatcher counts. Prints for each process its number, the releases, and how many
 * misses follow; then for each miss when it was seen, in nanoseconds of CLOCK_MONOTONIC,
 * and how many releases that were.
 */
#define _GNU_SOURCE
#include <sched.h>
#include <signal.h>
#include <stdint.h>
#include <stdio.h>
#include <stdlib.h>
#include <sys/mman.h>
#include <sys/prctl.h>
#include <sys/wait.h>
#include <time.h>
#include <unistd.h>

enum { MOST = 1 << 16 };
struct miss {
    int64_t at, count;
};
struct found {
    int64_t releases;
    int misses;
    struct miss miss[MOST];
};

static int64_t read_clock(clockid_t clock)
{
    struct timespec at;
    clock_gettime(clock, &at);
    return (int64_t)at.tv_sec * 1000000000 + at.tv_nsec;
}

static int enter(int core, int level)
{
    struct sched_param param = {.sched_priority = level};
    cpu_set_t set;
    CPU_ZERO(&set);
    CPU_SET((size_t)core, &set);
    prctl(PR_SET_TIMERSLACK, 1);
    if (mlockall(MCL_CURRENT | MCL_FUTURE))
        return perror("mlockall"), 1;
    if (sched_setaffinity(0, sizeof set, &set))
        return perror("affinity"), 1;
    if (sched_setscheduler(0, SCHED_FIFO, &param))
        return perror("SCHED_FIFO"), 1;
    return 0;
}

/* Note the releases that came before the cycle of `release` had begun or ended. */
static int64_t note(struct found *f, int64_t release, int64_t period)
{
    int64_t at = read_clock(CLOCK_MONOTONIC), count = (at - release) / period;
    if (count > 0 && f->misses < MOST)
        f->miss[f->misses++] = (struct miss){at, count};
    f->releases += count;
    return release + count * period;
}

static void work(struct found *f, int64_t release, int64_t period, int64_t used, int64_t end)
{
    while (release < end) {
        struct timespec at = {release / 1000000000, release % 1000000000};
        clock_nanosleep(CLOCK_MONOTONIC, TIMER_ABSTIME, &at, NULL);
        release = note(f, release, period);
        int64_t until = read_clock(CLOCK_THREAD_CPUTIME_ID) + used;
        while (read_clock(CLOCK_THREAD_CPUTIME_ID) < until)
            ;
        release = note(f, release, period) + period;
        f->releases++;
    }
}

int main(int argc, char **argv)
{
    if (argc != 7)
        return 2;
    int tasks = atoi(argv[3]), failed = 0;
    int64_t period = atoll(argv[4]), used = atoll(argv[5]);
    size_t size = (size_t)tasks * sizeof(struct found);
    struct found *found = mmap(NULL, size, PROT_READ | PROT_WRITE,
                               MAP_SHARED | MAP_ANONYMOUS | MAP_POPULATE, -1, 0);
    if (found == MAP_FAILED)
        return perror("mmap"), 1;
    int64_t first = (read_clock(CLOCK_MONOTONIC) / period + 100) * period;
    int64_t end = first + (int64_t)(atof(argv[6]) * 1e9);
    for (int k = 0; k < tasks; k++) {
        pid_t pid = fork();
        failed |= pid < 0;
        if (pid)
            continue;
        prctl(PR_SET_PDEATHSIG, SIGKILL);
        if (enter(atoi(argv[1]), atoi(argv[2]) - k))
            _exit(1);
        work(found + k, first, period, used, end);
        _exit(0);
    }
    for (int status; wait(&status) > 0;)
        failed |= status != 0;      /* one that was killed counts no more */
    for (int k = 0; k < tasks; k++) {
        struct found *f = found + k;
        printf("%d %lld %d\n", k, (long long)f->releases, f->misses);
        for (int i = 0; i < f->misses; i++)
            printf("%lld %lld\n", (long long)f->miss[i].at, (long long)f->miss[i].count);
    }
    return failed;
}
