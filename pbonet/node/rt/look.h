/* Cancellable checks ("looks"): a check costs a turn only if the cycle still runs.
 *
 * Deadlines and reserves are checked when they could be missed or used up. Mostly the
 * cycle has ended by then, and a wake-up is the most expensive thing that the dispatcher
 * does. So under `fifo` it sleeps until the next release, and a timerfd represents the
 * check. The task that ends the last cycle covered by the check stops that timer with one
 * system call, and the dispatcher is not woken. If the timer does expire, a second thread
 * of the leader rings the mailbox.
 *
 * `look` in the table holds a number and a count of checked cycles. The dispatcher writes
 * it with the next number in every turn that needs a check; a task decrements the count
 * only while the number is that of its own grant. The tasks of a core run below the
 * dispatcher on the same core, so a turn is atomic to them, and a turn that comes between
 * two steps of a task changes the number. A task that is killed between these steps, or
 * that cannot get the descriptor, leaves the timer running: it expires, and the check
 * finds nothing to do.
 */
#ifndef PBONET_LOOK_H
#define PBONET_LOOK_H

#include "table.h"

#include <sys/timerfd.h>

struct rt_look {
    uint32_t life;              /* the leader's timer that `fd` refers to; 0: none yet */
    int fd;
    int release_fd;             /* a timer of the process's own; see rt_hold_release. 0: none */
};

/* The leader's timer as a descriptor of this process; -1: not available, and not tried
 * again until there is another leader. The slot says whether the task has it. */
static inline int rt_look_fd(struct rt_look *look, struct rt_table *t, struct rt_slot *slot)
{
    /* SYNC POINT: the leader stores its descriptor before look_life. */
    uint32_t life = atomic_load_explicit(&t->look_life, memory_order_acquire);
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
    atomic_store(&slot->post.meets, look->fd < 0 ? 0 : life);
    return look->fd;
}

/* Count the caller's cycle off; if it was the last one to check, stop the timer. To be
 * called after the store that marks the cycle as ended. */
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
    int fd = rt_look_fd(look, t, slot);
    if (fd < 0 || timerfd_settime(fd, 0, &off, NULL))
        return;
    atomic_store(&t->look_ns, 0);
    if (atomic_load(&t->look) >> 32 != mine)
        rt_kick(t);             /* a turn came between: its timer may be stopped */
    else
        atomic_fetch_add_explicit(&t->spared, 1, memory_order_relaxed);
}

#endif
