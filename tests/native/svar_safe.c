/* Has a cycle fail at each of its steps, and makes its out-vars safe meanwhile.
 *
 *   svar_safe dispatcher|signal|killed|odd|threads
 *
 * A task begins a cycle, computes, commits and ends it. At one step of that the failure is
 * found: the dispatcher commits the safe values, or leaves it to the task's handler of the
 * signal; or the handler alone does; or the dispatcher is a process that is killed at each
 * of its own steps, and nobody sends a signal. A reader copies at every step. `odd` tries
 * what comes once in years, or amid a burial. `threads` has task, dispatcher and reader run
 * at once for the thread sanitizer, without steps. Prints as JSON how often what was done, and
 * how often something was wrong. */
#define _GNU_SOURCE 1
#include <pthread.h>
#include <sched.h>
#include <signal.h>
#include <stdbool.h>
#include <stdio.h>
#include <stdlib.h>
#include <sys/wait.h>

static void step(void);
#define PBONET_STEP(n) step()
#define PBONET_STEP_WORDS 1
#include "svar_rig.h"

enum { WORDS = 2, TOGETHER = 6000, ALONE = TOGETHER + 1 };
#define SAFE_WORD UINT64_C(7000000000)

static struct pb_table table;
static struct pb_local *task, *reader;
static struct pb_safe *shared;
static uint64_t *safe_words, counter, number;
static long steps_left, kill_left; /* until the failure; until the dispatcher dies */
static void (*fail)(void);
static long dies_at;
static bool died;
static bool looks, was_safe, owed, begun;
static _Atomic uint64_t running;    /* of `threads`: the cycle under way; 0: it has ended */
static _Atomic uint64_t met;        /* the last one that the dispatcher has come to */
static bool made[TOGETHER + 1];     /* the dispatcher has committed for that cycle */
static _Atomic bool over;
static pthread_t main_thread;
static struct {
    unsigned long cycles, safe, kept, deaths, torn, stale, unsafe, refused;
} found;

/* The reader: groups are whole, and a failed cycle's values never follow the safe ones. */
static void look(void) {
    looks = false;
    was_safe |= (atomic_load(&shared->word) & 7) == PB_MADE_SAFE;
    if (!(pb_copy_in(reader, reader->plans + PB_PLAN_ON) & (PB_COPY_TORN | PB_COPY_LOST))) {
        const uint64_t word = *rig_word(reader, 0, 0);
        found.torn += !rig_is_whole(reader, 0);
        found.stale += was_safe && word != SAFE_WORD;
    }
    looks = true;
}

static void step(void) {
    if (kill_left && --kill_left == 0) raise(SIGKILL);
    if (!looks) return;
    look();
    if (!steps_left || --steps_left) return;
    const int phase = (int)(atomic_load(&shared->word) & 7);
    owed = !begun || phase == PB_OPEN || phase == PB_COMMITS;
    looks = false; /* what follows is another process, or a signal that comes once */
    fail();
    looks = true;
}

static bool dispatch(void) {
    pb_safe_want(shared, number, pb_now() - 1);
    return pb_safe_commit(&table, shared, number, safe_words,
                          task->outputs[PB_GROUP_VARS].group.bytes);
}

static void dispatcher(void) {
    if (!dispatch()) pb_make_safe(task);
}

static void by_signal(void) {
    pb_safe_want(shared, number, pb_now() - 1);
    pb_make_safe(task);
}

static void killed(void) {
    int status;
    const pid_t child = fork();
    if (child < 0) die("fork");
    if (!child) {
        kill_left = dies_at;
        dispatch();
        _exit(0);
    }
    if (waitpid(child, &status, 0) != child) die("waitpid");
    died = WIFSIGNALED(status);
    found.deaths += died;
    /* One that is killed before it has asked for safe values has found no failure. */
    owed &= atomic_load(&shared->wanted) == number;
}

static void compute(void) {
    for (int i = 0; i < 3; i++) step();
    rig_fill(task, 0, ++counter);
    step();
}

/* One cycle with the failure at step `at`; returns whether it had so many steps. */
static bool cycle(long at) {
    struct pb_outputs *o = task->outputs + PB_GROUP_VARS;
    const uint64_t before = o->group.head;
    bool safe;
    int flags = 0;
    number++;
    owed = was_safe = begun = false;
    steps_left = at;
    looks = true;
    step(); /* it is granted, but the task has not come to it yet */
    begun = true;
    pb_cycle_begins(task, number);
    found.unsafe += owed && !died && (atomic_load(&shared->word) & 7) == PB_OPEN;
    step();
    compute();
    if (pb_cycle_commits(task)) {
        step();
        flags = pb_commit(task, o, (struct pb_stamp){pb_now(), counter});
    }
    step();
    safe = pb_cycle_ends(task);
    looks = false;
    found.cycles++;
    found.safe += safe;
    found.kept += !safe;
    found.refused += flags != 0 || pb_number(o->group.head) <= pb_number(before) ||
                     pb_write_last(&o->group.reg->head) != o->group.head;
    found.unsafe += owed != safe && (owed || !atomic_load(&shared->wanted));
    was_safe = false;
    look();
    looks = false;
    found.unsafe += (*rig_word(reader, 0, 0) == SAFE_WORD) != safe;
    return !steps_left;
}

/* A cycle that nothing happens to must find the register as it left it. */
static void plain(void) {
    found.unsafe += cycle(0) && atomic_load(&shared->wanted) == number;
}

/* Begin a cycle that is to be made safe from outside, if at all. */
static void open_cycle(uint64_t which) {
    number = which;
    pb_cycle_begins(task, number);
}

/* Cycles whose number is 0, or was that of a failure long ago: numbers have 32 bits. */
static void numbers(void) {
    open_cycle(0);
    found.unsafe += dispatch() && pb_cycle_commits(task); /* two would write */
    found.unsafe += pb_cycle_ends(task);
    open_cycle(5);
    found.unsafe += !dispatch() || !pb_cycle_ends(task);
    open_cycle(6);
    found.unsafe += pb_cycle_ends(task);
    open_cycle(5);
    found.unsafe += pb_cycle_ends(task);
}

/* A cycle of a dead task whose register was given up: its slots may be another's. */
static void given_up(void) {
    struct pb_reg *reg = task->outputs[PB_GROUP_VARS].group.reg;
    const uint64_t head = pb_write_last(&reg->head);
    for (int state = PB_FREE; state <= PB_LEFT; state++) {
        if (state == PB_HELD) continue;
        open_cycle(10 + (uint64_t)state);
        atomic_store(&reg->state, state);
        found.unsafe += dispatch() || pb_write_last(&reg->head) != head;
        atomic_store(&reg->state, PB_HELD);
        atomic_store(&shared->wanted, 0);
        pb_cycle_ends(task);
    }
}

/* A dispatcher that stands still amid its commit: the task writes no more beside it. */
static void stands_still(void) {
    int ready[2];
    char byte;
    pid_t child = 0;
    open_cycle(20);
    if (pipe(ready) || (child = fork()) < 0) die("fork");
    if (!child) {
        pthread_mutex_lock(&table.live->lock);
        pb_safe_take(shared, number, PB_TAKEN);
        if (write(ready[1], "", 1) != 1) _exit(1);
        for (;;) pause();
    }
    if (read(ready[0], &byte, 1) != 1) die("read");
    found.unsafe += pb_cycle_ends(task);
    found.unsafe += pb_commit(task, task->outputs + PB_GROUP_VARS,
                              (struct pb_stamp){pb_now(), 1}) != PB_COMMIT_NOT_OWNER;
    kill(child, SIGKILL);
    waitpid(child, NULL, 0);
}

static void on_failure(int signal) {
    (void)signal;
    pb_make_safe(task);
}

/* A dispatcher that finds a failure in every third cycle, at any time of it. */
static void *dispatches(void *arg) {
    uint64_t last = 0;
    (void)arg;
    for (unsigned round = 0; !atomic_load(&over); round++) {
        const uint64_t now = atomic_load(&running);
        if (now == last || now % 3) {
            sched_yield();
            continue;
        }
        last = now;
        atomic_store(&met, now);
        for (volatile unsigned wait = round * 7919 % 400; wait; wait--) continue;
        pb_safe_want(shared, now, pb_now() - 1);
        made[now] = pb_safe_commit(&table, shared, now, safe_words,
                                   task->outputs[PB_GROUP_VARS].group.bytes);
        if (!made[now]) pthread_kill(main_thread, SIGUSR1);
    }
    return NULL;
}

static void *reads(void *arg) {
    unsigned long *torn = arg;
    while (!atomic_load(&over))
        if (!(pb_copy_in(reader, reader->plans + PB_PLAN_ON) & (PB_COPY_TORN | PB_COPY_LOST)))
            *torn += !rig_is_whole(reader, 0);
    return NULL;
}

/* One cycle beside the others; returns whether its values are safe ones. */
static bool beside(struct pb_local *own) {
    bool safe;
    pb_cycle_begins(task, number);
    atomic_store(&running, number);
    while (number % 3 == 0 && atomic_load(&met) != number) sched_yield();
    rig_fill(task, 0, ++counter);
    for (volatile unsigned wait = counter * 104729 % 400; wait; wait--) continue;
    if (pb_cycle_commits(task))
        found.refused += pb_commit(task, task->outputs + PB_GROUP_VARS,
                                   (struct pb_stamp){pb_now(), counter}) != 0;
    safe = pb_cycle_ends(task);
    atomic_store(&running, 0);
    pb_copy_in(own, own->plans + PB_PLAN_ON);
    found.unsafe += (*rig_word(own, 0, 0) == SAFE_WORD) != safe || !rig_is_whole(own, 0);
    return safe;
}

static void *wants(void *arg) {
    (void)arg;
    pb_safe_want(shared, ALONE, pb_now() - 1);
    atomic_store_explicit(&met, ALONE, memory_order_relaxed);
    return NULL;
}

/* A failure that only `wanted` itself tells the task of: nothing else orders the two. */
static void unordered(void) {
    pthread_t thread;
    pb_safe_open(shared, ALONE, 0, 0);
    if (pthread_create(&thread, NULL, wants, NULL)) die("pthread_create");
    while (atomic_load_explicit(&met, memory_order_relaxed) != ALONE) sched_yield();
    found.unsafe += pb_safe_close(shared, ALONE) != PB_COMMITS;
    pthread_join(thread, NULL);
}

static void together(void) {
    static bool safe[TOGETHER + 1];
    struct pb_local *own = rig_local(&table, -1);
    pthread_t thread[2];
    main_thread = pthread_self();
    signal(SIGUSR1, on_failure);
    if (pthread_create(thread, NULL, dispatches, NULL) ||
        pthread_create(thread + 1, NULL, reads, &found.torn)) die("pthread_create");
    for (number = 1; number <= TOGETHER; number++) safe[number] = beside(own);
    atomic_store(&over, true);
    for (int i = 0; i < 2; i++) pthread_join(thread[i], NULL);
    for (number = 1; number <= TOGETHER; number++) {
        found.cycles++;
        found.safe += safe[number];
        found.kept += !safe[number];
        found.unsafe += made[number] && !safe[number];
    }
}

static void odd(void) {
    numbers();
    given_up();
    stands_still();
}

int main(int argc, char **argv) {
    if (argc != 2) return 2;
    table = rig_table(WORDS);
    task = rig_local(&table, 0);
    reader = rig_local(&table, -1);
    rig_enter(task, 0);
    rig_fill(task, 0, 0);
    if (rig_claim(task)) die("claim");
    shared = mmap(NULL, sizeof *shared, PROT_READ | PROT_WRITE, MAP_SHARED | MAP_ANONYMOUS,
                  -1, 0);
    if (shared == MAP_FAILED) die("mmap");
    safe_words = zeroed(task->outputs[PB_GROUP_VARS].group.bytes);
    for (uint64_t i = 0; i < task->outputs[PB_GROUP_VARS].group.bytes / 8; i++)
        safe_words[i] = SAFE_WORD;
    task->safe = shared;
    task->safe_data = (const uint8_t *)safe_words;
    fail = *argv[1] == 'd' ? dispatcher : *argv[1] == 's' ? by_signal : killed;
    if (*argv[1] == 'o') odd();
    if (*argv[1] == 't') {
        unordered();
        together();
    }
    for (long at = 1, more = !strchr("ot", *argv[1]); more; at++) {
        dies_at = 1;
        do {
            died = false;
            more = cycle(at);
            plain();
            dies_at++;
        } while (died);
    }
    printf("{\"cycles\": %lu, \"safe\": %lu, \"kept\": %lu, \"deaths\": %lu, \"torn\": %lu, "
           "\"stale\": %lu, \"unsafe\": %lu, \"refused\": %lu}\n",
           found.cycles, found.safe, found.kept, found.deaths, found.torn, found.stale,
           found.unsafe, found.refused);
    return 0;
}
