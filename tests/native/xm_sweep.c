/* A process dies, or is held, at every step of a deed; another one judges what it left.
 *
 *   xm_sweep
 *
 * Both are built from the same headers, and nothing else runs: what is found does not
 * depend on luck. Prints as JSON how many deaths there were, and the faults: messages that
 * were not whole, messages and places that were lost, lists that do not fit together,
 * semaphores that nobody gets any more, and those that two have got. */
#define _GNU_SOURCE 1
#include <signal.h>
#include <stdlib.h>

static long steps_left; /* 0: not counting */
static int deed_signal = SIGKILL;

static void step(void) {
    if (steps_left && --steps_left == 0) raise(deed_signal);
}

#define PBONET_STEP(n) step()
#include "mail.h"
#include "sem.h"

#include <sys/mman.h>
#include <sys/prctl.h>
#include <sys/wait.h>

#include "xm_rig.h"

enum { PATIENCE = 40, MESSAGES = 5, BLOCKS = 120, BLOCK = 64, LARGEST = 2000 };

static struct xm_sem *grip;
static struct xm_queue *queue;
static unsigned deaths, torn, lost, broken, stuck, intruders;

static void post(uint32_t me, uint32_t size, int full) {
    uint8_t data[LARGEST];
    memset(data, (int)(size & 255), sizeof data);
    if (xm_send(queue, me, -1, data, size, (int32_t)(size % 3), full)) die("send");
}

/* Receive one as a user does: a long one is fetched in a second step. */
static int get(uint32_t me, uint8_t *data, struct xm_letter *letter) {
    int code = xm_receive(queue, me, -1, data, XM_SHORT, LARGEST, letter);
    if (code || letter->head == XM_END) return code;
    code = xm_copy_out(queue, letter->head, data);
    return xm_received(queue, letter->head) ? XM_DAMAGED : code;
}

static void send_short(uint32_t me) { post(me, 100, XM_REFUSE); }
static void send_long(uint32_t me) { post(me, LARGEST, XM_REFUSE); }
static void send_dropping(uint32_t me) { post(me, 3 * XM_SHORT / 2, XM_DROP_OLDEST); }

static void receive(uint32_t me) {
    uint8_t data[LARGEST];
    struct xm_letter letter;
    if (get(me, data, &letter)) die("receive");
}

static void take(uint32_t me) {
    int slot, code = xm_sem_begin(grip, me, 5, false, &slot);
    _exit(code == XM_EMPTY);
}

/* Run a deed in a process that stops or dies at its step `at`; returns its status. */
static int doomed(void (*deed)(uint32_t), bool on_grip, long at, pid_t *pid) {
    int status;
    *pid = fork();
    if (*pid < 0) die("fork");
    if (!*pid) {
        prctl(PR_SET_PDEATHSIG, SIGKILL);
        uint32_t me = member(on_grip ? xm_sem_enter(grip) : xm_queue_enter(queue));
        steps_left = at;
        deed(me);
        _exit(0);
    }
    if (waitpid(*pid, &status, WUNTRACED) < 0) die("waitpid");
    return status;
}

static void fresh_queue(int policy, const uint32_t *sizes, int n) {
    struct xm_queue plan = {.policy = (uint32_t)policy};
    memset(queue, 0, xm_lay_out(&plan, MESSAGES, BLOCKS, BLOCK));
    if (xm_queue_make(queue, &plan)) die("queue");
    uint32_t me = member(xm_queue_enter(queue));
    for (int i = 0; i < n; i++) post(me, sizes[i], XM_REFUSE);
    if (xm_queue_exit(queue, me)) die("exit");
}

/* All that is left is whole, at least `least` of it, and then everything is free again. */
static void judge_queue(int least) {
    uint8_t data[LARGEST];
    struct xm_letter letter;
    int n = 0, code = XM_DAMAGED, me = xm_queue_enter(queue);
    for (; me >= 0 && n <= MESSAGES; n++) {
        if ((code = get((uint32_t)me, data, &letter))) break;
        for (uint32_t i = 0; i < letter.size; i++)
            if (data[i] != (letter.size & 255)) {
                torn++;
                break;
            }
    }
    if (code != XM_EMPTY)
        broken++;
    else if (n < least || queue->n_heads != MESSAGES || queue->n_blocks != BLOCKS)
        lost++;
}

static void sweep_queue(void (*deed)(uint32_t), int n, int least) {
    static const uint32_t sizes[MESSAGES] = {10, 1100, 0, 200, 30};
    pid_t pid;
    for (int policy = XM_FIFO; policy <= XM_HPF; policy++) {
        bool died = true;
        for (long at = 1; died; at++) {
            fresh_queue(policy, sizes, n);
            died = WIFSIGNALED(doomed(deed, false, at, &pid));
            deaths += died;
            judge_queue(least);
        }
    }
}

static void fresh_grip(void) {
    memset(grip, 0, sizeof *grip);
    if (xm_sem_make(grip, 1, 1, true)) die("semaphore");
}

/* Who dies with it, or on the way to it, leaves it to the next. */
static void sweep_grip(void) {
    bool died = true;
    pid_t pid;
    for (long at = 1; died; at++) {
        fresh_grip();
        died = WIFSIGNALED(doomed(take, true, at, &pid));
        deaths += died;
        uint32_t me = member(xm_sem_enter(grip));
        int code = xm_sem_take(grip, me, false);
        if ((code && code != XM_DIED) || xm_sem_give(grip)) stuck++;
    }
}

/* While one is held at each step of a P, another one takes; not both may get it. */
static void share_grip(void) {
    int status;
    pid_t pid;
    deed_signal = SIGSTOP;
    for (long at = 1;; at++) {
        fresh_grip();
        uint32_t me = member(xm_sem_enter(grip));
        status = doomed(take, true, at, &pid);
        if (!WIFSTOPPED(status)) break;
        int mine = xm_sem_take(grip, me, false);
        if (kill(pid, SIGCONT) || waitpid(pid, &status, 0) < 0) die("waitpid");
        if (!WIFEXITED(status)) die("who was held");
        intruders += !mine && !WEXITSTATUS(status);
        stuck += mine && WEXITSTATUS(status);
    }
}

int main(void) {
    struct xm_queue plan = {.policy = XM_FIFO};
    alarm(PATIENCE); /* who waits for the dead ends the test, not hangs it */
    grip = memory(sizeof *grip);
    queue = memory(xm_lay_out(&plan, MESSAGES, BLOCKS, BLOCK));
    sweep_queue(send_short, 3, 3);
    sweep_queue(send_long, 3, 3);
    sweep_queue(send_dropping, MESSAGES, MESSAGES - 1);
    sweep_queue(receive, 3, 2);
    sweep_grip();
    share_grip();
    printf("{\"deaths\": %u, \"torn\": %u, \"lost\": %u, \"broken\": %u, \"stuck\": %u, "
           "\"intruders\": %u}\n", deaths, torn, lost, broken, stuck, intruders);
    return 0;
}
