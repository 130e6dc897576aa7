/* Two writers and two readers at full speed, and a hunter that kills writers.
 *
 *   svar_torture processes WORDS SECONDS KILLS   real processes, writers killed at random
 *   svar_torture threads WORDS SECONDS           the same as threads, for sanitizers
 *
 * Built with -DJITTER everybody lets others run at every fourth step or so, so that what
 * can happen between two steps does. Prints one line of JSON; what must be zero is judged
 * by the test that runs this. */
#define _GNU_SOURCE 1
#include <sched.h>
#ifdef JITTER
static void dawdle(void) {
    static _Thread_local unsigned state = 1;
    state = state * 1664525u + 1013904223u;
    if (!(state >> 30)) sched_yield();
}
#define PBONET_STEP(n) dawdle()
#endif
#include "svar_rig.h"

#include <pthread.h>
#include <signal.h>
#include <sys/wait.h>

enum { READERS = 2, CHANGE = 1000 }; /* commits between two changes of ownership */

struct tally {
    _Alignas(PB_LINE) _Atomic uint64_t turns, torn, false_cuts, whole_only, lost, retries, claims;
};

static struct pb_table table;
static struct tally *tallies; /* writers first, then readers; shared */
static _Atomic bool *stop;

static void add(_Atomic uint64_t *to, uint64_t n) {
    atomic_fetch_add_explicit(to, n, memory_order_relaxed);
}

static void pin(int core) {
    cpu_set_t set;
    CPU_ZERO(&set);
    CPU_SET(core % (int)sysconf(_SC_NPROCESSORS_ONLN), &set);
    sched_setaffinity(0, sizeof set, &set); /* best effort: the test holds anywhere */
}

static void judge(struct pb_local *l, struct tally *mine, int flags, uint64_t before) {
    add(&mine->turns, 1);
    add(&mine->retries, l->counts.retries - before);
    if (flags & PB_COPY_LOST) {
        add(&mine->lost, 1);
        return;
    }
    for (int w = 0; w < WRITERS; w++)
        if (!rig_is_whole(l, w)) add(&mine->torn, 1);
    if (flags & PB_COPY_TORN)
        add(&mine->whole_only, 1);
    else if (!rig_is_cut(l))
        add(&mine->false_cuts, 1);
}

static void *reader(void *arg) {
    struct tally *mine = tallies + WRITERS + (intptr_t)arg;
    struct pb_local *l = rig_local(&table, -1);
    while (!atomic_load_explicit(stop, memory_order_relaxed)) {
        uint64_t before = l->counts.retries;
        judge(l, mine, pb_copy_in(l, l->plans + PB_PLAN_ON), before);
    }
    return NULL;
}

static void *writer(void *arg) {
    const int w = (int)(intptr_t)arg;
    struct tally *mine = tallies + w;
    struct pb_local *l = rig_local(&table, w);
    uint64_t counter;
    rig_enter(l, w);
    while (pb_copy_in(l, l->plans + PB_PLAN_ON)) {} /* go on where the predecessor stopped */
    counter = *rig_word(l, w, 0);
    while (!atomic_load_explicit(stop, memory_order_relaxed)) {
        rig_fill(l, w, ++counter);
        if (rig_claim(l)) die("claim");
        add(&mine->claims, 1);
        for (int i = 0; i < CHANGE && !atomic_load_explicit(stop, memory_order_relaxed); i++) {
            pb_copy_in(l, l->plans + PB_PLAN_IN); /* a counter is one word: never torn */
            rig_fill(l, w, ++counter);
            if (pb_commit(l, l->outputs + PB_GROUP_VARS, (struct pb_stamp){pb_now(), counter})) die("commit");
            add(&mine->turns, 1);
        }
        if (rig_release(l, false)) die("release");
    }
    return NULL;
}

static pid_t spawn(void *(*role)(void *), intptr_t which) {
    pid_t pid = fork();
    if (pid < 0) die("fork");
    if (pid) return pid;
    pin((int)which);
    role((void *)which);
    _exit(0);
}

static uint64_t turns(void) {
    uint64_t least = UINT64_MAX;
    for (int i = 0; i < WRITERS + READERS; i++) {
        uint64_t n = atomic_load_explicit(&tallies[i].turns, memory_order_relaxed);
        if (n < least) least = n;
    }
    return least;
}

static void nap(long us) {
    nanosleep(&(struct timespec){us / 1000000, us % 1000000 * 1000}, NULL);
}

/* Returns how many children ended otherwise than asked. */
static int processes(double seconds, int kills) {
    pid_t writers[WRITERS], readers[READERS];
    int64_t end = pb_now() + (int64_t)(seconds * 1e9);
    int killed = 0, bad = 0, status;
    for (intptr_t i = 0; i < WRITERS; i++) writers[i] = spawn(writer, i);
    for (intptr_t i = 0; i < READERS; i++) readers[i] = spawn(reader, i);
    while (killed < kills || pb_now() < end) {
        nap(200 + random() % 8000);
        if (killed == kills) continue;
        int w = (int)(random() % WRITERS);
        kill(writers[w], SIGKILL);
        if (waitpid(writers[w], &status, 0) < 0 || !WIFSIGNALED(status) ||
            WTERMSIG(status) != SIGKILL) bad++;
        writers[w] = spawn(writer, w);
        killed++;
    }
    for (uint64_t seen = turns(); turns() == seen;) nap(1000); /* the last heirs work too */
    atomic_store(stop, true);
    for (int i = 0; i < WRITERS; i++)
        if (waitpid(writers[i], &status, 0) < 0 || status) bad++;
    for (int i = 0; i < READERS; i++)
        if (waitpid(readers[i], &status, 0) < 0 || status) bad++;
    return bad;
}

static int threads(double seconds) {
    pthread_t thread[WRITERS + READERS];
    for (intptr_t i = 0; i < WRITERS + READERS; i++)
        if (pthread_create(thread + i, NULL, i < WRITERS ? writer : reader,
                           (void *)(i < WRITERS ? i : i - WRITERS))) die("pthread_create");
    nap((long)(seconds * 1e6));
    atomic_store(stop, true);
    for (int i = 0; i < WRITERS + READERS; i++) pthread_join(thread[i], NULL);
    return 0;
}

int main(int argc, char **argv) {
    struct tally sum = {0};
    uint64_t commits = 0, claims = 0;
    int bad, kills = argc > 4 ? atoi(argv[4]) : 0;
    if (argc < 4) return 2;
    tallies = mmap(NULL, 4096, PROT_READ | PROT_WRITE, MAP_SHARED | MAP_ANONYMOUS, -1, 0);
    if (tallies == MAP_FAILED) die("mmap");
    stop = (_Atomic bool *)(void *)(tallies + WRITERS + READERS);
    table = rig_table(strtoull(argv[2], NULL, 10));
    bad = argv[1][0] == 'p' ? processes(atof(argv[3]), kills) : threads(atof(argv[3]));
    for (int i = 0; i < WRITERS; i++) {
        commits += tallies[i].turns;
        claims += tallies[i].claims;
    }
    for (int i = WRITERS; i < WRITERS + READERS; i++) {
        sum.turns += tallies[i].turns;
        sum.torn += tallies[i].torn;
        sum.false_cuts += tallies[i].false_cuts;
        sum.whole_only += tallies[i].whole_only;
        sum.lost += tallies[i].lost;
        sum.retries += tallies[i].retries;
    }
#define N(x) (unsigned long long)(x)
    printf("{\"commits\": %llu, \"claims\": %llu, \"reads\": %llu, \"torn\": %llu, "
           "\"false_cuts\": %llu, \"unproven\": %llu, \"lost\": %llu, \"retries\": %llu, "
           "\"bad_ends\": %d, \"least\": %llu}\n",
           N(commits), N(claims), N(sum.turns), N(sum.torn), N(sum.false_cuts),
           N(sum.whole_only), N(sum.lost), N(sum.retries), bad, N(turns()));
    return 0;
}
