/* The few kernel calls of the real-time side: futexes, clocks, priorities. */
#ifndef PBONET_SYS_H
#define PBONET_SYS_H

#ifndef _GNU_SOURCE
#define _GNU_SOURCE
#endif
#include <errno.h>
#include <fcntl.h>
#include <limits.h>
#include <linux/futex.h>
#include <sched.h>
#include <signal.h>
#include <stdatomic.h>
#include <stdint.h>
#include <stdio.h>
#include <stdlib.h>
#include <sys/syscall.h>
#include <time.h>
#include <unistd.h>

#define RT_PARK_SIGNAL (SIGRTMIN + 2)
#define RT_FAIL_SIGNAL (SIGRTMIN + 3)

static inline int64_t rt_clock(clockid_t clock)
{
    struct timespec at;
    clock_gettime(clock, &at);
    return (int64_t)at.tv_sec * 1000000000 + at.tv_nsec;
}

static inline int64_t rt_now(void)
{
    return rt_clock(CLOCK_MONOTONIC);
}

static inline uint64_t rt_thread_cpu(void)
{
    return (uint64_t)rt_clock(CLOCK_THREAD_CPUTIME_ID);
}

/* The CPU time of another process; 0 when it is gone. Exact if the process does not run at
 * this moment, as on the dispatcher's own core; otherwise up to a tick old. */
static inline int64_t rt_process_cpu(pid_t pid)
{
    struct timespec at = {0, 0};
    clockid_t clock = (clockid_t)(~(unsigned)pid << 3 | 2 /* CPUCLOCK_SCHED */);
    if (clock_gettime(clock, &at))
        return 0;
    return (int64_t)at.tv_sec * 1000000000 + at.tv_nsec;
}

/* Reads a thread's CPU time repeatedly, through a file that stays open. Initialize it with
 * zero before the first read. */
struct rt_meter {
    int file;                   /* 0: none */
    pid_t pid, tid;             /* the thread */
};

static inline void rt_meter_close(struct rt_meter *meter)
{
    if (meter->file)
        close(meter->file);
    meter->file = 0;
}

static inline void rt_meter_open(struct rt_meter *meter, pid_t pid, pid_t tid)
{
    char path[64];
    int file;
    snprintf(path, sizeof path, "/proc/%d/task/%d/schedstat", (int)pid, (int)tid);
    file = open(path, O_RDONLY | O_CLOEXEC);
    *meter = (struct rt_meter){file > 0 ? file : 0, pid, tid};
}

/* The CPU time of a thread of another process, exact; 0 when it is gone. */
static inline int64_t rt_meter_read(struct rt_meter *meter, pid_t pid, pid_t tid)
{
    char text[64];
    ssize_t bytes = -1;
    if (meter->file && meter->pid == pid && meter->tid == tid)
        bytes = pread(meter->file, text, sizeof text - 1, 0);
    if (bytes <= 0) {           /* another thread, or the old one is gone */
        rt_meter_close(meter);
        rt_meter_open(meter, pid, tid);
        bytes = meter->file ? pread(meter->file, text, sizeof text - 1, 0) : 0;
    }
    text[bytes > 0 ? bytes : 0] = 0;
    return strtoll(text, NULL, 10);
}

/* The same for a single read. */
static inline int64_t rt_cpu_of(pid_t pid, pid_t tid)
{
    struct rt_meter once = {0};
    const int64_t time = rt_meter_read(&once, pid, tid);
    rt_meter_close(&once);
    return time;
}

static inline struct timespec rt_timespec(int64_t ns)
{
    return (struct timespec){.tv_sec = ns / 1000000000, .tv_nsec = ns % 1000000000};
}

/* Sleep while *word == value, until CLOCK_MONOTONIC `until` (0: no time-out). */
static inline int rt_futex_wait(_Atomic uint32_t *word, uint32_t value, int64_t until)
{
    struct timespec at = rt_timespec(until);
    if (syscall(SYS_futex, (uint32_t *)word, FUTEX_WAIT_BITSET, value,
                until ? &at : NULL, NULL, FUTEX_BITSET_MATCH_ANY) == 0)
        return 0;
    return errno;
}

static inline void rt_futex_wake(_Atomic uint32_t *word)
{
    syscall(SYS_futex, (uint32_t *)word, FUTEX_WAKE, INT_MAX, NULL, NULL, 0);
}

/* Upper half of the process ids in the node's own calls that change a priority or a core:
 * the kernel ignores it, and the filter of a task's process lets no others pass. */
#define RT_OWN_CALL UINT32_C(0x70626f)

static inline int rt_schedule(pid_t pid, int policy, int level)
{
    struct sched_param param = {.sched_priority = level};
    uint64_t who = (uint64_t)RT_OWN_CALL << 32 | (uint32_t)pid;
    return syscall(SYS_sched_setscheduler, who, policy | SCHED_RESET_ON_FORK, &param)
               ? errno : 0;
}

/* Give a process's main thread (0: the caller) a SCHED_FIFO priority; its children and
 * later threads start without one. */
static inline int rt_set_level(pid_t pid, int level)
{
    return rt_schedule(pid, SCHED_FIFO, level);
}

/* Remove the real-time priority of a process that ends or hangs: of one that ends the
 * kernel frees the memory, for some milliseconds, at the priority that it had. */
static inline int rt_take_level(pid_t pid)
{
    return rt_schedule(pid, SCHED_OTHER, 0);
}

/* Let the caller's main thread share `level` with others by time slices, if it has a
 * real-time priority at all; async-signal-safe. */
static inline void rt_share_level(int level)
{
    if ((sched_getscheduler(0) & ~SCHED_RESET_ON_FORK) == SCHED_FIFO)
        rt_schedule(0, SCHED_RR, level);
}

/* Pin a thread (0: the caller) to a core. */
static inline int rt_pin(pid_t tid, int core)
{
    cpu_set_t set;
    if (core < 0 || core >= CPU_SETSIZE)
        return EINVAL;
    CPU_ZERO(&set);
    CPU_SET((size_t)core, &set);
    uint64_t who = (uint64_t)RT_OWN_CALL << 32 | (uint32_t)tid;
    return syscall(SYS_sched_setaffinity, who, sizeof set, &set) ? errno : 0;
}

#endif
