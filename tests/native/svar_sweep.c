/* What a read may meet, one case after the other, without any luck.
 *
 *   svar_sweep
 *
 * At one step of a read the writers commit, few times or many, in any order; and between
 * any two words of a commit a whole read is made. Everything happens in one thread: the
 * steps call what comes between. Prints one line of JSON. */
static void step(void);
#define PBONET_STEP(n) step()
#define PBONET_STEP_WORDS 1
#define RIG_GAP 8 /* a step between any two variables that are read */
#include "svar_rig.h"

enum { MOST_COMMITS = 7, WORDS = 4 };

static struct pb_local *writers[WRITERS], *reader;
static uint64_t counters[WRITERS];
static long steps_left; /* 0: not counting */
static void (*between)(void);
static int first, commits; /* who begins, and how many commits */
static unsigned long reads, proven, torn, false_cuts;

static void step(void) {
    if (!steps_left || --steps_left) return;
    between();
}

static void commit(int w) {
    pb_copy_in(writers[w], writers[w]->plans + PB_PLAN_IN);
    rig_fill(writers[w], w, ++counters[w]);
    if (pb_commit(writers[w], writers[w]->outputs + PB_GROUP_VARS, (struct pb_stamp){pb_now(), counters[w]}))
        die("commit");
}

/* The writers take turns, or (where `first` is beyond them) one of them commits alone. */
static void commit_some(void) {
    for (int i = 0; i < commits; i++)
        commit(first < WRITERS ? (first + i) % WRITERS : first - WRITERS);
}

static void look(void) {
    int flags = pb_copy_in(reader, reader->plans + PB_PLAN_ON);
    reads++;
    if (flags & PB_COPY_LOST) return;
    for (int w = 0; w < WRITERS; w++) torn += !rig_is_whole(reader, w);
    if (flags & PB_COPY_TORN) return;
    proven++;
    false_cuts += !rig_is_cut(reader);
}

/* Do one thing with `between` at its step 1, 2, ... until it has fewer steps. */
static void sweep(void (*what)(void), void (*meanwhile)(void)) {
    between = meanwhile;
    for (long at = 1, met = 1; met; at++) {
        steps_left = at;
        what();
        met = !steps_left;
        steps_left = 0;
    }
}

static void commit_first(void) { commit(first); }

int main(void) {
    struct pb_table table = rig_table(WORDS);
    reader = rig_local(&table, -1);
    for (int w = 0; w < WRITERS; w++) {
        writers[w] = rig_local(&table, w);
        rig_enter(writers[w], w);
        rig_fill(writers[w], w, 0);
        if (rig_claim(writers[w])) die("claim");
    }
    for (commits = 1; commits <= MOST_COMMITS; commits++)
        for (first = 0; first < 2 * WRITERS; first++) sweep(look, commit_some);
    for (first = 0; first < WRITERS; first++) sweep(commit_first, look);
    printf("{\"reads\": %lu, \"proven\": %lu, \"torn\": %lu, \"false_cuts\": %lu}\n", reads,
           proven, torn, false_cuts);
    return 0;
}
