/* What the kernel takes to wake a sleeper: FUTEX_WAKE alone, at 1 kHz, from C.
 *
 *     futex COUNT WAKER_CORE SLEEPER_CORE
 *
 * Prints the median nanoseconds of the system call while nobody sleeps, and while a process
 * on the sleeper's core does.
 */
#define _GNU_SOURCE
#include <linux/futex.h>
#include <sched.h>
#include <stdatomic.h>
#include <stdint.h>
#include <stdio.h>
#include <stdlib.h>
#include <sys/mman.h>
#include <sys/prctl.h>
#include <sys/syscall.h>
#include <sys/wait.h>
#include <signal.h>
#include <time.h>
#include <unistd.h>

static int64_t now(void) {
    struct timespec t;
    clock_gettime(CLOCK_MONOTONIC, &t);
    return t.tv_sec * INT64_C(1000000000) + t.tv_nsec;
}

static void pin(int core) {
    cpu_set_t set;
    CPU_ZERO(&set);
    CPU_SET(core, &set);
    sched_setaffinity(0, sizeof set, &set);
}

static int order(const void *a, const void *b) {
    int64_t x = *(const int64_t *)a, y = *(const int64_t *)b;
    return (x > y) - (x < y);
}

static int64_t median(_Atomic uint32_t *bell, int64_t *spent, int count) {
    struct timespec pause = {0, 1000000};
    for (int i = 0; i < count; i++) {
        nanosleep(&pause, NULL);
        int64_t begin = now();
        syscall(SYS_futex, bell, FUTEX_WAKE, 1, NULL, NULL, 0);
        spent[i] = now() - begin;
    }
    qsort(spent, (size_t)count, sizeof *spent, order);
    return spent[count / 2];
}

int main(int argc, char **argv) {
    if (argc != 4) return 2;
    int count = atoi(argv[1]);
    int64_t *spent = calloc((size_t)count, sizeof *spent);
    _Atomic uint32_t *bell = mmap(NULL, 4096, PROT_READ | PROT_WRITE,
                                  MAP_SHARED | MAP_ANONYMOUS, -1, 0);
    if (count < 1 || !spent || bell == MAP_FAILED) return 2;
    pin(atoi(argv[2]));
    int64_t alone = median(bell, spent, count);
    pid_t child = fork();
    if (child == 0) {
        prctl(PR_SET_PDEATHSIG, SIGKILL);
        pin(atoi(argv[3]));
        for (;;) {
            syscall(SYS_futex, bell, FUTEX_WAIT, 0, NULL, NULL, 0);
            atomic_fetch_add(bell + 1, 1);
        }
    }
    while (atomic_load(bell + 1) == 0) { /* until it sleeps and is woken */
        struct timespec pause = {0, 1000000};
        syscall(SYS_futex, bell, FUTEX_WAKE, 1, NULL, NULL, 0);
        nanosleep(&pause, NULL);
    }
    int64_t asleep = median(bell, spent, count);
    kill(child, SIGKILL);
    waitpid(child, NULL, 0);
    printf("%lld %lld\n", (long long)alone, (long long)asleep);
    return 0;
}
