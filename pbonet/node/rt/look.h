/* A look at a cycle costs a turn only where the cycle still runs.
 *
 * Deadlines and reserves are looked at when they could be missed or used up; mostly the
 * cycle has ended by then, and being woken for that is the dearest thing that the
 * dispatcher does. So under `fifo` it sleeps until the next release, and a timer in a
 * file descriptor stands for the look. Whoever ends the last cycle that the look is for
 * stops that timer, one call into the kernel, and the dispatcher never wakes up for it.
 * When the timer does run out, a second thread of the leader's rings the mailbox.
 *
 * `look` in the table holds a number and a count of cycles that are looked at. The
 * dispatcher writes it anew, with the next number, in every turn that wants a look; a
 * task takes one off only while the number is that of its own grant. Tasks of a core run
 * below the dispatcher on the same core, so a turn is atomic to them, and a turn that
 * comes between a task's steps changes the number. A task that was killed amid these
 * steps, or that could not get at the descriptor, leaves the timer as it is: then it runs
 * out, and the look finds nothing to do.
 */
#ifndef PBONET_LOOK_H
#define PBONET_LOOK_H

#include "table.h"

#include <sys/timerfd.h>

struct rt_look {
    uint32_t life;              /* of the leader's timer that `fd` is; 0: not asked yet */
    int fd;
};

/* The leader's timer as a descriptor of this process; -1: not to be had, and not tried
 * again before there is another leader. */
static inline int rt_look_fd(struct rt_look *look, struct rt_table *t)
{
    uint32_t life = atomic_load(&t->look_life);
    if (look->life == life)
        return look->fd;
    if (look->life && look->fd >= 0)
        close(look->fd);
    look->life = life;
    look->fd = -1;
    int pid = (int)syscall(SYS_pidfd_open, atomic_load(&t->leader_pid), 0);
    if (pid >= 0) {
        look->fd = (int)syscall(SYS_pidfd_getfd, pid, atomic_load(&t->look_fd), 0);
        close(pid);
    }
    return look->fd;
}

/* The caller's cycle has ended; if it was the last one looked at, nothing is left to look
 * at. Behind the store that says that it has ended. */
static inline void rt_spare(struct rt_table *t, struct rt_slot *slot, struct rt_look *look)
{
    static const struct itimerspec off;
    uint64_t word = atomic_load(&t->look);
    uint32_t mine = atomic_exchange(&slot->grant.look, 0);
    do {
        if (!mine || word >> 32 != mine || !(word & UINT32_MAX))
            return;
    } while (!atomic_compare_exchange_weak(&t->look, &word, word - 1));
    if ((word & UINT32_MAX) > 1)
        return;
    int fd = rt_look_fd(look, t);
    if (fd < 0 || timerfd_settime(fd, 0, &off, NULL))
        return;
    atomic_store(&t->look_ns, 0);
    if (atomic_load(&t->look) >> 32 != mine)
        rt_kick(t);             /* a turn came between: what it set may be gone */
    else
        atomic_fetch_add_explicit(&t->spared, 1, memory_order_relaxed);
}

#endif
