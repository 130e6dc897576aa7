/* What the parts of a turn and of a cycle cost: the project's own headers, timed in C.
 *
 * usage: rtcosts CORE BLOCKS
 * Prints a line for each part and block: a name, a tab, nanoseconds for one call. The
 * loop around a part is timed without it too and taken off.
 */
#include "failure.h"
#include "loop.h"
#include "muf.h"

#include <stdio.h>
#include <stdlib.h>
#include <sys/wait.h>

enum { ROUNDS = 20000, TASKS = 64, NAPS = 300, SIGNALS = 50 };

static uint64_t seed = 7;
static volatile int64_t sink;

static uint64_t draw(void)
{
    seed ^= seed << 13, seed ^= seed >> 7, seed ^= seed << 17;
    return seed;
}

static void say(const char *name, int64_t ns, int rounds)
{
    printf("%s\t%.3f\n", name, (double)ns / rounds);
}

/* One task has a new deadline in each turn; the others keep deadline and level. */
static int64_t rank_rounds(int n, int really)
{
    struct muf_item held[TASKS], items[TASKS];
    for (int k = 0; k < n; k++)
        held[k] = (struct muf_item){.deadline = (int64_t)(draw() % 1000000), .crit = 5,
                                    .priority = k, .slot = k};
    int64_t from = rt_now();
    for (int round = 0; round < ROUNDS; round++) {
        held[draw() % (unsigned)n].deadline += (int64_t)(draw() % 1000000);
        memcpy(items, held, sizeof *items * (size_t)n);
        if (really) {
            muf_sort(items, n);
            muf_assign(items, n, MUF_LOW, MUF_HIGH);
        }
        for (int k = 0; k < n; k++)
            held[items[k].slot].level = items[k].level;
    }
    sink = held[0].level;
    return rt_now() - from;
}

static void ranking(void)
{
    static const int counts[] = {4, 16, 64};
    char name[64];
    for (int k = 0; k < 3; k++) {
        int64_t all = rank_rounds(counts[k], 1);
        snprintf(name, sizeof name, "rank %d ready tasks", counts[k]);
        say(name, all - rank_rounds(counts[k], 0), ROUNDS);
    }
}

/* Change the level of a child that sleeps, or that is ready on the caller's core. */
static int rank_change(const char *name, int ready)
{
    pid_t child = fork();
    if (child == 0)
        for (;;)
            if (!ready)
                pause();
    int refused = rt_set_level(child, 10) || rt_set_level(0, 50);
    struct timespec moment = {.tv_nsec = 5000000};
    nanosleep(&moment, NULL);
    int64_t from = rt_now();
    for (int round = 0; round < ROUNDS && !refused; round++)
        rt_set_level(child, 10 + (round & 1));
    if (!refused)
        say(name, rt_now() - from, ROUNDS);
    struct sched_param none = {0};
    sched_setscheduler(0, SCHED_OTHER, &none);
    kill(child, SIGKILL);
    waitpid(child, NULL, 0);
    return refused;
}

/* What Slot.once and Slot.close do for the profile: five clocks, then the figures. */
static void accounting(struct rt_task *task)
{
    struct rt_cost cost = {0};
    uint64_t mark = rt_thread_cpu();
    int64_t from = rt_now();
    for (int round = 0; round < ROUNDS; round++) {
        cost.start_ns = rt_now();
        cost.called_ns = rt_now();
        cost.returned_ns = rt_now();
        cost.end_ns = rt_now();
        uint64_t cpu = rt_thread_cpu();
        cost.cpu_ns = cpu - mark;
        mark = cpu;
        task->rel_ns = cost.start_ns - 20000;
        rt_account(task, &cost);
    }
    say("account a cycle", rt_now() - from, ROUNDS);
    from = rt_now();
    for (int round = 0; round < ROUNDS; round++)
        rt_account(task, &cost);
    say("of that, the figures without the clocks", rt_now() - from, ROUNDS);
    from = rt_now();
    for (int round = 0; round < ROUNDS; round++)
        sink = (int64_t)rt_thread_cpu();
    say("of that, the clock of CPU time", rt_now() - from, ROUNDS);
}

/* Set the timer that is the core's next one, and stop it, behind a sleep as a dispatcher
 * and a task do: in a loop that never sleeps it costs a fiftieth of that. */
static void timers(void)
{
    static const struct itimerspec off;
    static const struct timespec nap = {.tv_nsec = 300000};
    int64_t setting = 0, stopping = 0;
    int fd = timerfd_create(CLOCK_MONOTONIC, TFD_CLOEXEC);
    for (int round = 0; round < NAPS; round++) {
        nanosleep(&nap, NULL);
        int64_t at = rt_now();
        struct itimerspec next = {.it_value = rt_timespec(at + 160000)};
        timerfd_settime(fd, TFD_TIMER_ABSTIME, &next, NULL);
        int64_t set = rt_now();
        setting += set - at;
        while (rt_now() < set + 5000)
            ;
        at = rt_now();
        timerfd_settime(fd, 0, &off, NULL);
        stopping += rt_now() - at;
    }
    close(fd);
    say("set the core's next timer", setting, NAPS);
    say("stop it", stopping, NAPS);
}

static void on_signal(int number)
{
    (void)number;
    sink = rt_now();
}

/* Send oneself the signal of a failure, and reach its handler: again and again, and each
 * time after a sleep, as a task that rarely fails does. */
static void signals(void)
{
    static const struct timespec nap = {.tv_nsec = 5000000};
    struct sigaction action = {.sa_handler = on_signal}, before;
    sigaction(RT_FAIL_SIGNAL, &action, &before);
    for (int naps = 0; naps < 2; naps++) {
        int64_t took = 0;
        for (int round = 0; round < SIGNALS; round++) {
            if (naps)
                nanosleep(&nap, NULL);
            int64_t at = rt_now();
            syscall(SYS_tgkill, getpid(), getpid(), RT_FAIL_SIGNAL);
            took += sink - at;
        }
        say(naps ? "a signal to its handler, after a sleep of 5 ms"
                 : "a signal to its handler, in a loop", took, SIGNALS);
    }
    sigaction(RT_FAIL_SIGNAL, &before, NULL);
}

int main(int argc, char **argv)
{
    static struct rt_table table;
    struct rt_task task = {.table = &table, .slot = &table.slots[0]};
    if (argc != 3 || rt_pin(0, atoi(argv[1])))
        return fprintf(stderr, "usage: rtcosts CORE BLOCKS\n"), 2;
    for (int block = 0; block < atoi(argv[2]); block++) {
        ranking();
        if (rank_change("change a level, task asleep", 0) ||
            rank_change("change a level, task ready", 1))
            fprintf(stderr, "SCHED_FIFO is refused: no change of levels\n");
        accounting(&task);
        timers();
        signals();
        fflush(stdout);
    }
    return 0;
}
