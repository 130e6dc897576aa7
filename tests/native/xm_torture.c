/* Semaphores and queues at full speed, in threads or in processes that are killed.
 *
 *   xm_torture threads|processes SECONDS KILLS
 *
 * Workers take a binary semaphore and add to a counter that nothing else guards, pass
 * tokens through a counting one, and send and receive messages, short and long. Prints what
 * was found as JSON: messages that were not whole, sections entered by two, progress. */
#define _GNU_SOURCE 1
#include "mail.h"
#include "sem.h"

#include <signal.h>
#include <sys/mman.h>
#include <sys/prctl.h>
#include <sys/wait.h>

#include "xm_rig.h"

enum { PATIENCE = 8, WORKERS = 4, MESSAGES = 16, BLOCKS = 96, BLOCK = 64, TOKENS = 3 };

struct shared {
    struct xm_sem binary, tokens;
    _Atomic uint32_t stop, inside, intruders, torn, out_of_order, errors, over;
    _Atomic uint64_t done[WORKERS];
    uint64_t guarded;           /* by the binary semaphore */
    struct xm_queue *queue;
};

static struct shared *shared;

static int p(struct xm_sem *s, uint32_t me, int32_t priority) {
    int slot, code = xm_sem_begin(s, me, priority, true, &slot);
    while (code == XM_AGAIN) {
        int slept;
        while ((slept = xm_sleep(s->o.slots + slot, XM_FOREVER)))
            if (slept == XM_AGAIN) xm_sem_patrol(s, me);
        code = xm_sem_called(s, me, slot);
    }
    return code;
}

static void section(uint32_t me, int32_t priority) {
    int code = p(&shared->binary, me, priority);
    if (code < XM_DIED) {
        atomic_fetch_add(&shared->errors, 1);
        return;
    }
    if (code == XM_DIED) atomic_store(&shared->inside, 0); /* who died may have been in */
    if (atomic_fetch_add(&shared->inside, 1)) atomic_fetch_add(&shared->intruders, 1);
    shared->guarded++;
    atomic_fetch_sub(&shared->inside, 1);
    if (xm_sem_give(&shared->binary)) atomic_fetch_add(&shared->over, 1);
}

static void pass_tokens(uint32_t me, int32_t priority) {
    int slot, code = xm_sem_begin(&shared->tokens, me, priority, false, &slot);
    if (!code && xm_sem_give(&shared->tokens)) atomic_fetch_add(&shared->over, 1);
    if (code && code != XM_EMPTY) atomic_fetch_add(&shared->errors, 1);
}

static uint32_t size_of(uint64_t n) {
    return n % 7 == 0 ? 2000 + n % 500 : 8 + n % 200;
}

static void post(uint32_t me, uint64_t n) {
    uint8_t data[2500];
    memset(data, (int)(n & 255), sizeof data);
    int code = xm_send(shared->queue, me, -1, data, size_of(n), (int32_t)(n % 5),
                       n % 3 ? XM_REFUSE : XM_DROP_OLDEST);
    if (code && code != XM_NO_ROOM) atomic_fetch_add(&shared->errors, 1);
}

static bool is_whole(const uint8_t *data, uint32_t size) {
    for (uint32_t i = 1; i < size; i++)
        if (data[i] != data[0]) return false;
    return true;
}

static void get(uint32_t me) {
    uint8_t data[2500];
    struct xm_letter letter;
    int code = xm_receive(shared->queue, me, -1, data, XM_SHORT, sizeof data, &letter);
    if (!code && letter.head != XM_END) {
        code = xm_copy_out(shared->queue, letter.head, data);
        if (xm_received(shared->queue, letter.head)) atomic_fetch_add(&shared->errors, 1);
    }
    if (code && code != XM_EMPTY) atomic_fetch_add(&shared->errors, 1);
    if (!code && !is_whole(data, letter.size)) atomic_fetch_add(&shared->torn, 1);
}

static void *work(void *which) {
    uintptr_t w = (uintptr_t)which;
    int b = xm_sem_enter(&shared->binary), t = xm_sem_enter(&shared->tokens);
    int q = xm_queue_enter(shared->queue);
    if (b < 0 || t < 0 || q < 0) {
        atomic_fetch_add(&shared->errors, 1);
        return NULL;
    }
    for (uint64_t n = w; !atomic_load(&shared->stop); n += WORKERS) {
        section((uint32_t)b, (int32_t)w);
        pass_tokens((uint32_t)t, (int32_t)w);
        post((uint32_t)q, n);
        if (n % 2) get((uint32_t)q);
        atomic_fetch_add(&shared->done[w], 1);
    }
    if (xm_sem_exit(&shared->binary, (uint32_t)b) || xm_sem_exit(&shared->tokens, (uint32_t)t) ||
        xm_queue_exit(shared->queue, (uint32_t)q)) atomic_fetch_add(&shared->errors, 1);
    return NULL;
}

static void make(void) {
    struct xm_queue plan = {.policy = XM_HPF};
    shared = memory(sizeof *shared);
    shared->queue = memory(xm_lay_out(&plan, MESSAGES, BLOCKS, BLOCK));
    if (xm_sem_make(&shared->binary, 1, 1, true) ||
        xm_sem_make(&shared->tokens, TOKENS, TOKENS, false) ||
        xm_queue_make(shared->queue, &plan)) die("make");
}

static void nap(double seconds) {
    struct timespec at = {(time_t)seconds, (long)((seconds - (double)(time_t)seconds) * 1e9)};
    nanosleep(&at, NULL);
}

static void in_threads(double seconds) {
    pthread_t threads[WORKERS];
    for (uintptr_t w = 0; w < WORKERS; w++)
        if (pthread_create(threads + w, NULL, work, (void *)w)) die("pthread_create");
    nap(seconds);
    atomic_store(&shared->stop, 1);
    for (int w = 0; w < WORKERS; w++) pthread_join(threads[w], NULL);
}

static pid_t spawn(uintptr_t w) {
    pid_t pid = fork();
    if (pid < 0) die("fork");
    if (!pid) {
        prctl(PR_SET_PDEATHSIG, SIGKILL); /* nobody outlives the test */
        work((void *)w);
        _exit(0);
    }
    return pid;
}

static void in_processes(double seconds, int kills) {
    pid_t pids[WORKERS];
    unsigned seed = 7;
    for (uintptr_t w = 0; w < WORKERS; w++) pids[w] = spawn(w);
    for (int k = 0; k < kills; k++) {
        uintptr_t w = (uintptr_t)rand_r(&seed) % WORKERS;
        nap(seconds / kills);
        kill(pids[w], SIGKILL);
        waitpid(pids[w], NULL, 0);
        pids[w] = spawn(w);
    }
    uint64_t before[WORKERS];   /* everybody still gets on behind the last kill */
    for (int w = 0; w < WORKERS; w++) before[w] = atomic_load(&shared->done[w]);
    for (int w = 0; w < WORKERS; w++)
        while (atomic_load(&shared->done[w]) == before[w]) nap(0.001);
    atomic_store(&shared->stop, 1);
    for (int w = 0; w < WORKERS; w++) waitpid(pids[w], NULL, 0);
}

int main(int argc, char **argv) {
    if (argc != 4) return 2;
    make();
    alarm(PATIENCE + (unsigned)atoi(argv[2])); /* who is forgotten ends the test, not hangs it */
    if (*argv[1] == 't') in_threads(atof(argv[2]));
    else in_processes(atof(argv[2]), atoi(argv[3]));
    uint64_t least = UINT64_MAX;
    for (int w = 0; w < WORKERS; w++)
        if (atomic_load(&shared->done[w]) < least) least = atomic_load(&shared->done[w]);
    if (xm_sem_enter(&shared->binary) < 0 || xm_sem_enter(&shared->tokens) < 0) die("enter");
    printf("{\"intruders\": %u, \"torn\": %u, \"errors\": %u, \"over\": %u, \"sound\": %d, "
           "\"least\": %llu, \"guarded\": %llu, \"binary\": %u, \"tokens\": %u, "
           "\"dropped\": %llu}\n",
           atomic_load(&shared->intruders), atomic_load(&shared->torn),
           atomic_load(&shared->errors), atomic_load(&shared->over),
           xm_queue_enter(shared->queue) >= 0, (unsigned long long)least,
           (unsigned long long)shared->guarded, xm_sem_value(&shared->binary),
           xm_sem_value(&shared->tokens), (unsigned long long)shared->queue->dropped);
    return 0;
}
