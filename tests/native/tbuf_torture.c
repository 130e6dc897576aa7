/* A triple buffer at full speed, or killed at every step.
 *
 *   tbuf_torture threads SECONDS          one writer, one reader, no pause
 *   tbuf_torture processes SECONDS KILLS  the same in processes that are killed
 *   tbuf_torture steps                    a writer, then a reader, that dies at each step
 *
 * Every word of a record is its number. Prints what was found as JSON: records that were
 * not whole, older than one that stood when the reading began, or read twice. */
#define _GNU_SOURCE 1
#ifdef STEPS
static void step(int n);
#define PBONET_STEP(n) step(n)
#endif
#include "doze.h"

#include <pthread.h>
#include <signal.h>
#include <stdio.h>
#include <stdlib.h>
#include <sys/mman.h>
#include <sys/prctl.h>
#include <sys/wait.h>

enum { WORDS = 64, BYTES = WORDS * 8 };

struct shared {
    _Atomic uint32_t stop;
    _Atomic uint64_t written, reads, torn, old, twice, last;
};

static struct shared *shared;
static struct tb_buffer *buffer;
static int die_at;

#ifdef STEPS
static void step(int n) {
    static int steps;
    (void)n;
    if (die_at && ++steps == die_at) raise(SIGKILL);
}
#endif

static void *memory(uint64_t bytes) {
    void *at = mmap(NULL, bytes, PROT_READ | PROT_WRITE, MAP_SHARED | MAP_ANONYMOUS, -1, 0);
    if (at == MAP_FAILED) abort();
    return at;
}

static void put(void) {
    uint64_t data[WORDS];
    struct tb_stamp stamp = {.number = tb_number(atomic_load(&buffer->word)) + 1};
    for (int i = 0; i < WORDS; i++) data[i] = stamp.number;
    if (tb_write(buffer, BYTES, &stamp, data) > 0) tb_wake(&buffer->bell);
    atomic_store(&shared->written, stamp.number);
}

static void get(bool again) {
    uint64_t data[WORDS], before = atomic_load(&shared->written);
    struct tb_stamp stamp;
    const int found = tb_read(buffer, BYTES, &stamp, data, again);
    if (found < 0) atomic_fetch_add(&shared->torn, 1);
    if (found <= 0) {
        if (atomic_load(&shared->last) < before) atomic_fetch_add(&shared->old, 1);
        return;
    }
    for (int i = 0; i < WORDS; i++)
        if (data[i] != stamp.number) {
            atomic_fetch_add(&shared->torn, 1);
            break;
        }
    if (stamp.number < before) atomic_fetch_add(&shared->old, 1);
    if (stamp.number <= atomic_load(&shared->last) && !again)
        atomic_fetch_add(&shared->twice, 1);
    atomic_store(&shared->last, stamp.number);
    atomic_fetch_add(&shared->reads, 1);
}

static void *write_on(void *nothing) {
    while (!atomic_load(&shared->stop)) put();
    return nothing;
}

static void *read_on(void *nothing) {
    get(true);
    while (!atomic_load(&shared->stop)) {
        get(false);
        if (atomic_load(&shared->reads) % 64 == 0) tb_doze(buffer, tb_now() + 1000000);
    }
    return nothing;
}

static pid_t child(void *(*work)(void *)) {
    pid_t pid = fork();
    if (pid) return pid;
    prctl(PR_SET_PDEATHSIG, SIGKILL);
    work(NULL);
    _exit(0);
}

static void run_threads(double seconds) {
    pthread_t writer, reader;
    pthread_create(&writer, NULL, write_on, NULL);
    pthread_create(&reader, NULL, read_on, NULL);
    usleep((useconds_t)(seconds * 1e6));
    atomic_store(&shared->stop, 1);
    pthread_join(writer, NULL);
    pthread_join(reader, NULL);
}

static void run_processes(double seconds, int kills) {
    void *(*work[2])(void *) = {write_on, read_on};
    pid_t pids[2] = {child(write_on), child(read_on)};
    for (int i = 0; i < kills; i++) {
        usleep((useconds_t)(seconds * 1e6 / kills));
        int which = rand() % 2;
        kill(pids[which], SIGKILL);
        waitpid(pids[which], NULL, 0);
        pids[which] = child(work[which]);
    }
    atomic_store(&shared->stop, 1);
    for (int i = 0; i < 2; i++) waitpid(pids[i], NULL, 0);
}

/* One that dies at step `n` of its writes or reads; whether it had so many steps. */
static bool killed(bool writes, int n) {
    pid_t pid = fork();
    int status;
    if (!pid) {
        die_at = n;
        for (int i = 0; i < 3; i++) writes ? put() : get(!i);
        _exit(0);
    }
    waitpid(pid, &status, 0);
    return WIFSIGNALED(status);
}

static int run_steps(void) {
    int kills = 0;
    for (int writes = 0; writes < 2; writes++)
        for (int before = 0; before < 3; before++) /* news, none, or none but once more */
            for (int n = 1; ; n++, kills++) {
                for (int i = 0; i < before; i++) put();
                if (before == 1) get(true);
                if (!killed(writes, n)) break;
                atomic_store(&shared->written, tb_number(atomic_load(&buffer->word)));
                get(true);
                for (int i = 0; i < 4; i++) {
                    put();
                    if (i % 2) get(false);
                }
            }
    return kills;
}

int main(int argc, char **argv) {
    int kills = 0;
    shared = memory(sizeof *shared);
    buffer = memory(tb_size(BYTES));
    tb_make(buffer, BYTES, 1, "", 0);
    if (argc > 2 && !strcmp(argv[1], "threads")) run_threads(atof(argv[2]));
    else if (argc > 3) run_processes(atof(argv[2]), atoi(argv[3]));
    else kills = run_steps();
    printf("{\"written\": %llu, \"reads\": %llu, \"torn\": %llu, \"old\": %llu, "
           "\"twice\": %llu, \"kills\": %d}\n", (unsigned long long)shared->written,
           (unsigned long long)shared->reads, (unsigned long long)shared->torn,
           (unsigned long long)shared->old, (unsigned long long)shared->twice, kills);
    return 0;
}
