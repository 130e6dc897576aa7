/* A task is held by its dispatcher at every step of a deed; another one wants the lock.
 *
 *   xm_held
 *
 * The held one stands still until the other has looked, so what is found does not depend
 * on luck. Prints as JSON how often a task was held, and the faults: how often that was
 * amid the lock, and how often one that it had freed the way for had not been called. */
#define _GNU_SOURCE 1
#include <signal.h>
#include <stdlib.h>

static long steps_left; /* 0: not counting */

static void step(void) {
    if (steps_left && --steps_left == 0) raise(SIGRTMIN + 2);
}

#define PBONET_STEP(n) step()
#include "mail.h"
#include "sem.h"

#include <sys/mman.h>
#include <sys/prctl.h>
#include <sys/wait.h>

#include "xm_rig.h"

#include "sys.h"

static _Atomic uint32_t *standing;

/* The held task says so at the last place before it sleeps. */
static int said_wait(_Atomic uint32_t *word, uint32_t value, int64_t until) {
    if (standing) {
        atomic_store(standing, 1);
        rt_futex_wake(standing);
    }
    return rt_futex_wait(word, value, until);
}

#define rt_futex_wait said_wait
#include "guard.h"
#undef rt_futex_wait

enum { LARGEST = 2000, MESSAGES = 5, BLOCKS = 120, BLOCK = 64 };

static struct xm_sem *grip;
static struct xm_queue *queue;
static struct rt_table *table;
static unsigned held, amid, uncalled;

static void post(uint32_t me, uint32_t size) {
    uint8_t data[LARGEST] = {0};
    if (xm_send(queue, me, -1, data, size, 1, XM_DROP_OLDEST)) die("send");
}

static void send_short(uint32_t me) { post(me, 100); }
static void send_long(uint32_t me) { post(me, LARGEST); }

static void receive(uint32_t me) {
    uint8_t data[LARGEST];
    struct xm_letter letter;
    if (xm_receive(queue, me, -1, data, LARGEST, LARGEST, &letter)) die("receive");
}

static void give(uint32_t me) {
    (void)me;
    if (xm_sem_give(grip)) die("give");
}

static void try_take(uint32_t me) {
    int slot;
    if (xm_sem_begin(grip, me, 5, false, &slot) != XM_EMPTY) die("take");
}

/* Run a deed as a task amid its cycle that is told at step `at` to stand still. */
static pid_t task(void (*deed)(uint32_t), bool on_grip, long at) {
    struct rt_task self = {.table = table, .slot = &table->slots[0]};
    pid_t pid = fork();
    if (pid) return pid;
    prctl(PR_SET_PDEATHSIG, SIGKILL);
    if (rt_guard_slot(&self, xm_steady_here())) die("guard");
    uint32_t me = member(on_grip ? xm_sem_enter(grip) : xm_queue_enter(queue));
    steps_left = at;
    deed(me);
    steps_left = 0;
    atomic_store(standing, 2);
    rt_futex_wake(standing);
    _exit(0);
}

static void look(struct xm_object *o, const struct xm_slot *waiter) {
    held++;
    if (pthread_mutex_trylock(&o->lock))
        amid++;
    else
        pthread_mutex_unlock(&o->lock);
    if (waiter && xm_sem_value(grip) && xm_state(waiter) != XM_CALLED) uncalled++;
}

/* Returns whether the deed has so many steps. */
static bool try_step(void (*deed)(uint32_t), bool on_grip, long at,
                     const struct xm_slot *waiter) {
    struct rt_slot *slot = &table->slots[0];
    siginfo_t end = {0};
    int status;
    atomic_store(&slot->post.begun, 1);
    atomic_store(&slot->grant.parked, 1);
    atomic_store(standing, 0);
    pid_t pid = task(deed, on_grip, at);
    if (pid < 0) die("fork");
    while (!atomic_load(standing)) {
        rt_futex_wait(standing, 0, rt_now() + 100000000);
        if (waitid(P_PID, (id_t)pid, &end, WEXITED | WNOHANG | WNOWAIT)) die("waitid");
        if (end.si_pid && !atomic_load(standing)) die("a task ended");
    }
    bool was_held = atomic_load(standing) == 1;
    if (was_held) look(on_grip ? &grip->o : &queue->o, waiter);
    atomic_store(&slot->grant.parked, 0);
    rt_futex_wake(&slot->grant.parked);
    if (waitpid(pid, &status, 0) < 0 || status) die("the deed");
    return was_held;
}

static void on_queue(void (*deed)(uint32_t)) {
    struct xm_queue plan = {.policy = XM_FIFO};
    for (long at = 1, more = 1; more; at++) {
        memset(queue, 0, xm_lay_out(&plan, MESSAGES, BLOCKS, BLOCK));
        if (xm_queue_make(queue, &plan)) die("queue");
        uint32_t me = member(xm_queue_enter(queue));
        post(me, 100);
        more = try_step(deed, false, at, NULL);
        if (!xm_check(queue)) die("lists");
    }
}

static void on_grip(void (*deed)(uint32_t)) {
    for (long at = 1, more = 1; more; at++) {
        int slot;
        memset(grip, 0, sizeof *grip);
        if (xm_sem_make(grip, 0, 1, false)) die("semaphore");
        uint32_t me = member(xm_sem_enter(grip));
        if (xm_sem_begin(grip, me, 1, true, &slot) != XM_AGAIN) die("wait");
        more = try_step(deed, true, at, grip->o.slots + slot);
    }
}

int main(void) {
    struct xm_queue plan = {.policy = XM_FIFO};
    grip = memory(sizeof *grip);
    queue = memory(xm_lay_out(&plan, MESSAGES, BLOCKS, BLOCK));
    table = memory(sizeof *table);
    standing = memory(sizeof *standing);
    on_queue(send_short);
    on_queue(send_long);
    on_queue(receive);
    on_grip(give);
    on_grip(try_take);
    printf("{\"held\": %u, \"amid\": %u, \"uncalled\": %u}\n", held, amid, uncalled);
    return 0;
}
