/* The cycle proper, for cmodules.py: what a thread does from the end of one wait on a futex
 * to the beginning of the next, in nanoseconds of CLOCK_MONOTONIC. The wake-up is not in it.
 *
 * To be loaded before all else (LD_PRELOAD): it stands in for `syscall`, which the native loop
 * calls for its waits. `between_waits_begin` begins the times of the calling thread, in memory
 * that it shares with its parent; in other threads, and before, a call is only passed on.
 */
#define _GNU_SOURCE
#include <dlfcn.h>
#include <linux/futex.h>
#include <stdarg.h>
#include <stdatomic.h>
#include <stdint.h>
#include <sys/mman.h>
#include <sys/syscall.h>
#include <time.h>

enum { MOST = 1 << 18 };
struct times {
    _Atomic int64_t count;
    int64_t ns[MOST];
};
static struct times *times;
static long (*pass_on)(long, ...);
static _Thread_local int measures;
static _Thread_local int64_t left;      /* when the last wait ended */

static int64_t now(void)
{
    struct timespec at;
    clock_gettime(CLOCK_MONOTONIC, &at);
    return (int64_t)at.tv_sec * 1000000000 + at.tv_nsec;
}

__attribute__((constructor)) static void prepare(void)
{
    pass_on = (long (*)(long, ...))dlsym(RTLD_NEXT, "syscall");
    times = mmap(NULL, sizeof *times, PROT_READ | PROT_WRITE, MAP_SHARED | MAP_ANONYMOUS, -1, 0);
}

void between_waits_begin(void)
{
    measures = 1;
    left = 0;
    atomic_store(&times->count, 0);
}

int64_t between_waits_count(void)
{
    return atomic_load(&times->count);
}

int64_t between_waits(int64_t i)
{
    return times->ns[i];
}

long syscall(long number, ...)
{
    long a[6], found;
    va_list all;
    va_start(all, number);
    for (int i = 0; i < 6; i++)
        a[i] = va_arg(all, long);
    va_end(all);
    int waits = measures && number == SYS_futex && (a[1] & FUTEX_CMD_MASK) == FUTEX_WAIT_BITSET;
    if (waits && left) {
        int64_t n = atomic_load_explicit(&times->count, memory_order_relaxed);
        if (n < MOST) {
            times->ns[n] = now() - left;
            atomic_store_explicit(&times->count, n + 1, memory_order_relaxed);
        }
    }
    found = pass_on(number, a[0], a[1], a[2], a[3], a[4], a[5]);
    if (waits)
        left = now();
    return found;
}
