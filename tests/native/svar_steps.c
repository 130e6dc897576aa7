/* Does one change to a table and kills itself at a given step of it.
 *
 *   svar_steps FILE enter|claim|again|commit|one|release|set|raise|clear WRITER STEP COUNTER
 *
 * FILE is a table with the variables of svar_rig.h. A step lies between any two words that
 * are copied to shared memory, and around every publishing store and the lock. Ends with 0
 * when the change has fewer steps. A negative STEP stops there instead of dying. */
#define _GNU_SOURCE 1
#include <signal.h>
#include <stdlib.h>

static long steps_left; /* 0: not counting */
static int deed = SIGKILL;

static void step(void) {
    if (steps_left && --steps_left == 0) raise(deed);
}

#define PBONET_STEP(n) step()
#define PBONET_STEP_WORDS 1
#include "svar_rig.h"

static struct pb_table attach(const char *path) {
    struct stat st;
    int fd = open(path, O_RDWR);
    void *base;
    if (fd < 0 || fstat(fd, &st)) die(path);
    base = mmap(NULL, (size_t)st.st_size, PROT_READ | PROT_WRITE, MAP_SHARED, fd, 0);
    if (base == MAP_FAILED) die("table");
    return rig_attach(base, (uint64_t)st.st_size);
}

static void claim_as(struct pb_local *l, int writer, uint64_t counter) {
    rig_enter(l, writer);
    if (pb_copy_in(l, l->plans + PB_PLAN_IN)) die("copy in");
    rig_fill(l, writer, counter);
    if (rig_claim(l)) die("claim");
}

int main(int argc, char **argv) {
    struct pb_table t;
    struct pb_local *l;
    struct pb_cause cause;
    const char *what;
    if (argc != 6) return 2;
    const int writer = atoi(argv[3]);
    const long step = labs(atol(argv[4]));
    const uint64_t counter = strtoull(argv[5], NULL, 10);
    what = argv[2];
    if (*argv[4] == '-') deed = SIGSTOP;
    t = attach(argv[1]);
    l = rig_local(&t, writer);
    struct pb_outputs *o = l->outputs + PB_GROUP_VARS;
    if (!strcmp(what, "enter")) {
        steps_left = step;
        rig_enter(l, writer);
    } else if (!strcmp(what, "claim")) {
        rig_enter(l, writer);
        if (pb_copy_in(l, l->plans + PB_PLAN_IN)) die("copy in");
        rig_fill(l, writer, counter);
        steps_left = step;
        if (rig_claim(l)) die("claim");
    } else if (!strcmp(what, "commit") || !strcmp(what, "one")) {
        claim_as(l, writer, counter - 1);
        rig_fill(l, writer, counter);
        steps_left = step;
        if (*what == 'c' ? pb_commit(l, o, (struct pb_stamp){pb_now(), counter})
                         : pb_commit_one(l, o, VARS - 1, pb_now(), counter)) die("commit");
    } else if (!strcmp(what, "release")) {
        claim_as(l, writer, counter);
        steps_left = step;
        if (rig_release(l, true)) die("release");
    } else if (!strcmp(what, "set")) {
        uint64_t *value = zeroed(t.vars[0].bytes);
        for (uint64_t i = 0; i < t.vars[0].bytes / 8; i++) value[i] = counter;
        steps_left = step;
        if (pb_set(&t, 0, value, pb_now(), true)) die("set");
    } else if (!strcmp(what, "raise")) {
        cause = pb_cause_of("killed while it raised", argv[5], "here");
        steps_left = step;
        if (pb_raise(&t, &cause)) die("raise");
    } else if (!strcmp(what, "clear")) {
        cause = pb_cause_of("killed while it cleared", argv[5], "here");
        if (pb_raise(&t, &cause)) die("raise");
        steps_left = step;
        if (pb_clear(&t, &cause) != 1) die("clear");
    } else if (!strcmp(what, "again")) { /* on, off, one variable set, on */
        uint64_t *value = zeroed(t.vars[0].bytes);
        for (uint64_t i = 0; i < t.vars[0].bytes / 8; i++) value[i] = counter - 1;
        claim_as(l, writer, counter - 1);
        if (rig_release(l, false) || pb_set(&t, 0, value, pb_now(), true)) die("set");
        rig_fill(l, writer, counter);
        steps_left = step;
        if (rig_claim(l)) die("claim");
    } else {
        return 2;
    }
    return 0;
}
