/* The lock between claimers, and whether a process is alive.
 *
 * Only changes of ownership and operator-set values take the lock; reading, committing and
 * the flag never do. It is robust (the kernel passes it on when its holder dies; since each
 * change is published by one store there is nothing to repair), inherits priorities where
 * the kernel supports it, and is never waited for longer than PB_PATIENCE seconds.
 */
#ifndef PBONET_LOCK_H
#define PBONET_LOCK_H

#include "sound.h"

#include <errno.h>
#include <fcntl.h>
#include <signal.h>
#include <stdio.h>
#include <stdlib.h>
#include <sys/stat.h>
#include <time.h>
#include <unistd.h>

enum { PB_PATIENCE = 2 };
#define PB_UNKNOWN UINT64_MAX /* of a process: it exists, but its start time is unreadable */

static inline int64_t pb_now(void) {
    struct timespec now;
    clock_gettime(CLOCK_MONOTONIC, &now);
    return now.tv_sec * INT64_C(1000000000) + now.tv_nsec;
}

static inline int pb_lock_make(pthread_mutex_t *lock) {
    static const int protocols[] = {PTHREAD_PRIO_INHERIT, PTHREAD_PRIO_NONE};
    pthread_mutexattr_t attr;
    int error = 0;
    for (int i = 0; i < 2; i++) {
        pthread_mutexattr_init(&attr);
        pthread_mutexattr_setpshared(&attr, PTHREAD_PROCESS_SHARED);
        pthread_mutexattr_setrobust(&attr, PTHREAD_MUTEX_ROBUST);
        pthread_mutexattr_setprotocol(&attr, protocols[i]);
        error = pthread_mutex_init(lock, &attr);
        pthread_mutexattr_destroy(&attr);
        if (error) continue;
        error = pthread_mutex_lock(lock); /* some kernels refuse only here */
        if (!error) return pthread_mutex_unlock(lock);
    }
    return error;
}

/* Wait for the lock by the monotonic clock, if C library and kernel support it. */
static inline int pb_lock_wait(pthread_mutex_t *lock) {
    struct timespec until;
#if defined(__GLIBC__) && defined(__GLIBC_PREREQ) && !defined(PB_TSAN) /* not in TSan */
#if __GLIBC_PREREQ(2, 34)
    int error;
    clock_gettime(CLOCK_MONOTONIC, &until);
    until.tv_sec += PB_PATIENCE;
    error = pthread_mutex_clocklock(lock, CLOCK_MONOTONIC, &until);
    if (error != EINVAL) return error; /* with priority inheritance from Linux 5.14 on */
#endif
#endif
    clock_gettime(CLOCK_REALTIME, &until);
    until.tv_sec += PB_PATIENCE;
    return pthread_mutex_timedlock(lock, &until);
}

static inline void pb_unlock(const struct pb_table *t) {
    PBONET_STEP(6);
    /* SYNC POINT L2, partner L1 in pb_lock. */
    pthread_mutex_unlock(&t->live->lock);
    PBONET_STEP(7);
}

/* Returns 0, PB_STUCK when the holder of the lock does not run or, without `wait`, when
 * there is one, or PB_GONE. */
static inline int pb_lock(const struct pb_table *t, bool wait) {
    pthread_mutex_t *lock = &t->live->lock;
    int error;
    if (!pb_guarded(t->live)) return PB_GONE;
    /* SYNC POINT L1, partner L2 in pb_unlock: the new holder sees what the old one wrote,
     * whether that one unlocked or died (the kernel's hand-over also orders memory). */
    error = wait ? pb_lock_wait(lock) : pthread_mutex_trylock(lock);
    if (error == EOWNERDEAD) error = pthread_mutex_consistent(lock);
    PBONET_STEP(5);
    if (error) return PB_STUCK;
    if (pb_sound(t)) return 0;
    pb_unlock(t);
    return PB_GONE;
}

/* When the process started, in ticks since boot; 0 if there is none or it is a zombie,
 * PB_UNKNOWN if it exists but cannot be read (no descriptor is left, /proc hides it).
 * Together with the process id it is unique: process ids are reused. */
static inline uint64_t pb_process_start(uint64_t pid) {
    char path[40], text[512], *at;
    ssize_t bytes;
    int file;
    snprintf(path, sizeof path, "/proc/%llu/stat", (unsigned long long)pid);
    file = open(path, O_RDONLY | O_CLOEXEC);
    bytes = file < 0 ? -1 : read(file, text, sizeof text - 1);
    if (file >= 0) close(file);
    if (bytes <= 0) return !kill((pid_t)pid, 0) || errno != ESRCH ? PB_UNKNOWN : 0;
    text[bytes] = 0;
    at = strrchr(text, ')'); /* the name before it may contain anything */
    if (!at || at[1] != ' ' || at[2] == 'Z' || at[2] == 'X') return 0;
    at += 2;
    for (int field = 3; field < 22; field++) {
        at = strchr(at, ' ');
        if (!at) return 0;
        at++;
    }
    return strtoull(at, NULL, 10);
}

/* The PID namespace in which process ids are valid. */
static inline uint64_t pb_process_space(void) {
    struct stat st;
    return stat("/proc/self/ns/pid", &st) ? 0 : (uint64_t)st.st_ino;
}

/* Whether a process is alive; true if that cannot be determined from here. */
static inline bool pb_process_lives(uint64_t pid, uint64_t start, uint64_t space) {
    uint64_t now;
    if (space != pb_process_space()) return true;
    now = pb_process_start(pid);
    return now == start || now == PB_UNKNOWN || (now && start == PB_UNKNOWN);
}

/* Whether the holder of a register is alive. */
static inline bool pb_alive(const struct pb_reg *reg) {
    return pb_process_lives(reg->pid, reg->start, reg->space);
}

#endif
