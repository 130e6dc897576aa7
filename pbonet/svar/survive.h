/* Lets a process that reads tables of others survive when one of their files is truncated.
 *
 * The kernel answers an access to a page that a file no longer has with SIGBUS. Here that
 * page, and all after it, are replaced by zero pages of the process, and the access is
 * repeated. What was read is then wrong, which the size of the file shows: a process that
 * uses this must check it. Tasks do not use it; they must not compute with zeros.
 */
#ifndef PBONET_SURVIVE_H
#define PBONET_SURVIVE_H

#ifndef _GNU_SOURCE
#define _GNU_SOURCE 1 /* anonymous mappings, and the address of a fault, under -std=c11 */
#endif

#include <signal.h>
#include <stdatomic.h>
#include <stdint.h>
#include <sys/mman.h>
#include <unistd.h>

enum { PB_REGIONS = 256 };

struct pb_region {
    _Atomic uintptr_t from, to;   /* from 0: free */
};

static struct pb_region pb_regions[PB_REGIONS];
static struct sigaction pb_before;

/* Register a mapping; if there is no room it is not guarded. Not thread-safe. */
static inline void pb_region_add(const void *base, size_t bytes) {
    for (int i = 0; i < PB_REGIONS; i++) {
        struct pb_region *r = pb_regions + i;
        if (atomic_load(&r->from)) continue;
        atomic_store(&r->to, (uintptr_t)base + bytes);
        atomic_store(&r->from, (uintptr_t)base);
        return;
    }
}

static inline void pb_region_remove(const void *base) {
    for (int i = 0; i < PB_REGIONS; i++) {
        uintptr_t from = (uintptr_t)base;
        atomic_compare_exchange_strong(&pb_regions[i].from, &from, 0);
    }
}

/* Any other bus error goes to the previous handler, when the access is repeated. */
static inline void pb_on_bus_error(int signal, siginfo_t *info, void *context) {
    const uintptr_t page = (uintptr_t)sysconf(_SC_PAGESIZE);
    const uintptr_t at = (uintptr_t)info->si_addr & ~(page - 1);
    (void)context;
    for (int i = 0; i < PB_REGIONS; i++) {
        uintptr_t from = atomic_load(&pb_regions[i].from), to = atomic_load(&pb_regions[i].to);
        if (from && at >= from && at < to &&
            mmap((void *)at, to - at, PROT_READ | PROT_WRITE,
                 MAP_PRIVATE | MAP_ANONYMOUS | MAP_FIXED, -1, 0) != MAP_FAILED)
            return;
    }
    sigaction(signal, &pb_before, NULL);
}

/* Install the handler; returns 0. */
static inline int pb_survive(void) {
    struct sigaction ours = {.sa_sigaction = pb_on_bus_error, .sa_flags = SA_SIGINFO};
    struct sigaction now;
    if (sigaction(SIGBUS, NULL, &now)) return -1;
    if (now.sa_flags & SA_SIGINFO && now.sa_sigaction == pb_on_bus_error) return 0;
    pb_before = now;
    return sigaction(SIGBUS, &ours, NULL);
}

#endif
