/* Signals that a task's process handles in native code: held by the dispatcher, orphaned.
 *
 * Both must work whatever the interpreter is doing, so both are C handlers that use
 * only atomics, futexes and write(). One process is one task, so the state is static.
 */
#ifndef PBONET_GUARD_H
#define PBONET_GUARD_H

#include "slot.h"
#include "../../xm/ipc/steady.h"

#include <malloc.h>
#include <sys/eventfd.h>
#include <sys/mman.h>
#include <sys/prctl.h>
#include <sys/resource.h>
#include <sys/syscall.h>
#include <unistd.h>

static struct rt_slot *_Atomic rt_guarded;  /* the slot of this process's task */
static struct rt_table *_Atomic rt_guarded_table;
static _Atomic uint32_t rt_guarded_life;
static struct xm_steady *_Atomic rt_steady; /* sections in which it must not be held */
static _Atomic int rt_orphan_flag;
static _Atomic int rt_orphan_fd = -1;

/* The dispatcher holds this task: stop here, if a cycle is under way. In a section that
 * other tasks would have to wait for, stop after its end. */
static inline void rt_on_park(int signal)
{
    int saved = errno;
    struct rt_slot *slot = atomic_load(&rt_guarded);
    struct xm_steady *steady = atomic_load(&rt_steady);
    if (slot && atomic_load(&slot->post.begun) != atomic_load(&slot->post.done) &&
        !(steady && xm_steady_owes(steady, signal)))
        rt_hold_still(slot);
    errno = saved;
}

/* Report the orphan to the task and the dispatcher. A dispatcher that still leads, of this
 * RTPU process or of another one on the core, must not give an orphan a priority. */
static inline void rt_disown(struct rt_slot *slot)
{
    atomic_store(&slot->config.dead, atomic_load(&rt_guarded_life));
    rt_kick(atomic_load(&rt_guarded_table));
    atomic_store(&slot->grant.parked, 0);
    rt_request(slot, RT_ASK_ORPHAN);
}

/* The parent is gone: notify the task, and let SIGALRM end the process if it does not
 * react. No dispatcher ranks the tasks from here on, so all orphans share one priority:
 * otherwise one that hangs in a cycle would keep those below it from turning OFF. */
static inline void rt_on_orphan(int signal)
{
    int saved = errno;
    struct rt_slot *slot = atomic_load(&rt_guarded);
    struct sigaction plain = {.sa_handler = SIG_DFL};
    uint64_t one = 1;
    sigset_t set;
    (void)signal;
    sigaction(SIGALRM, &plain, NULL);
    sigemptyset(&set);
    sigaddset(&set, SIGALRM);
    sigprocmask(SIG_UNBLOCK, &set, NULL);
    if (!atomic_exchange(&rt_orphan_flag, 1))
        alarm(1);
    if (slot)
        rt_disown(slot);
    rt_share_level(RT_COMMAND_LEVEL);
    if (rt_orphan_fd >= 0 && write(rt_orphan_fd, &one, sizeof one) < 0)
        errno = saved;          /* the counter is full: it is readable anyway */
    errno = saved;
}

static inline int rt_handle(int signal, void (*handler)(int))
{
    struct sigaction action = {.sa_handler = handler, .sa_flags = SA_RESTART};
    sigfillset(&action.sa_mask);
    sigdelset(&action.sa_mask, SIGALRM);
    return sigaction(signal, &action, NULL) ? errno : 0;
}

/* Any thread that receives this signal redirects it to the main thread, which has blocked
 * it: a signal pending for the thread that calls execve() survives that call; one that is
 * pending for the process may be taken by a thread that execve() ends. */
static inline void rt_on_leaving(int signal)
{
    int saved = errno;
    syscall(SYS_tgkill, getpid(), getpid(), signal);
    errno = saved;
}

static inline int rt_leave_to_next(int signal)
{
    return rt_handle(signal, rt_on_leaving);
}

/* Set the slot that the signal handlers use; `steady` belongs to the main thread, which
 * receives the signals. The park handler must not block the orphan signal, or a held
 * orphan would never receive it. */
static inline int rt_guard_slot(const struct rt_task *task, struct xm_steady *steady)
{
    struct rt_slot *slot = task->slot;
    struct sigaction action = {.sa_handler = rt_on_park, .sa_flags = SA_RESTART};
    sigemptyset(&action.sa_mask);
    atomic_store(&rt_steady, steady);
    atomic_store(&rt_guarded_table, task->table);
    atomic_store(&rt_guarded_life, atomic_load(&slot->config.life));
    atomic_store(&rt_guarded, slot);
    if (atomic_load(&rt_orphan_flag))
        rt_disown(slot);
    return sigaction(RT_PARK_SIGNAL, &action, NULL) ? errno : 0;
}

/* Forget the slot before its memory is unmapped. */
static inline void rt_unguard_slot(struct rt_slot *slot)
{
    atomic_compare_exchange_strong(&rt_guarded, &slot, NULL);
}

/* Ask the kernel for `signal` when the parent ends; a descriptor, or -errno. */
static inline int rt_guard_orphan(int signal, pid_t parent)
{
    if (rt_orphan_fd < 0) {
        int fd = eventfd(0, EFD_CLOEXEC | EFD_NONBLOCK);
        if (fd < 0)
            return -errno;
        atomic_store(&rt_orphan_fd, fd);
    }
    int error = rt_handle(signal, rt_on_orphan);
    if (error)
        return -error;
    if (prctl(PR_SET_PDEATHSIG, (unsigned long)signal, 0UL, 0UL, 0UL))
        return -errno;
    if (parent && getppid() != parent)
        raise(signal);          /* it ended before the request */
    return rt_orphan_fd;
}

static inline int rt_is_orphan(void)
{
    return atomic_load(&rt_orphan_flag);
}

static inline void rt_timer_slack(unsigned long ns)
{
    prctl(PR_SET_TIMERSLACK, ns);
}

/* Make pages present for writing; not every kernel and mapping supports it. Those that
 * are shared with the parent process are copied. */
static inline int rt_populate(size_t at, size_t size)
{
    return madvise((void *)at, size, 23 /* MADV_POPULATE_WRITE, Linux 5.14 */);
}

/* The same for those pages only that are not there: others may be shared with the parent
 * process, and stay so. Returns how many bytes are made present. */
static inline size_t rt_populate_absent(size_t at, size_t size)
{
    enum { MOST = 1024 };
    const size_t page = (size_t)sysconf(_SC_PAGESIZE), end = at + size;
    unsigned char present[MOST];
    size_t done = 0;
    for (size_t here = at; here < end;) {
        size_t pages = (end - here) / page < MOST ? (end - here) / page : MOST;
        if (!pages || mincore((void *)here, pages * page, present))
            return done;
        for (size_t first = 0, last; first < pages; first = last) {
            for (last = first + 1; last < pages && !((present[first] ^ present[last]) & 1);)
                last++;
            if (!(present[first] & 1) && !rt_populate(here + first * page, (last - first) * page))
                done += (last - first) * page;
        }
        here += pages * page;
    }
    return done;
}

/* Have at least `size` bytes of the heap free in one piece. Nothing is given back to the
 * kernel: M_TRIM_THRESHOLD is set before exec (process_setup.py). */
static inline int rt_spare_heap(size_t size)
{
    void *volatile piece = malloc(size);
    free(piece);
    return piece ? 0 : ENOMEM;
}

/* Touch `size` bytes of stack below the caller, so that no cycle faults there. */
static __attribute__((noinline, unused)) int rt_prefault_stack(size_t size)
{
    volatile unsigned char page[4096];
    page[0] = (unsigned char)size;
    page[4095] = page[0];
    if (size > sizeof page)
        return rt_prefault_stack(size - sizeof page) + page[4095];
    return page[0];
}

/* Lock memory; EPERM when the limit would make later allocations fail. */
static inline int rt_lock_memory(void)
{
    struct rlimit limit;
    if (!getrlimit(RLIMIT_MEMLOCK, &limit) && limit.rlim_cur != RLIM_INFINITY) {
        /* Without CAP_IPC_LOCK a limit counts, and MCL_FUTURE would turn every later
         * mmap beyond it into a MemoryError. Only a probe shows whether we have it. */
        size_t probe = (size_t)limit.rlim_cur + 4096;
        void *at = mmap(NULL, probe, PROT_NONE, MAP_PRIVATE | MAP_ANONYMOUS, -1, 0);
        if (at == MAP_FAILED)
            return errno;
        int error = mlock2(at, probe, MLOCK_ONFAULT) ? errno : 0;
        munmap(at, probe);
        if (error)
            return EPERM;
    }
    return mlockall(MCL_CURRENT | MCL_FUTURE | MCL_ONFAULT) ? errno : 0;
}

#endif
