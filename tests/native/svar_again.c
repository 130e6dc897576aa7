/* A task is turned on again after an operator has set one of its variables meanwhile.
 *
 * Between any two steps of the second claim a reader takes a cut; each that is called
 * consistent is printed as the counter of the variable that was set and of the next one. */
#define _GNU_SOURCE 1
static void step(void);
#define PBONET_STEP(n) step()
#define PBONET_STEP_WORDS 1
#include "svar_rig.h"

static struct pb_local *reader; /* NULL: nobody looks */

static void step(void) {
    struct pb_local *l = reader;
    if (!l) return;
    reader = NULL; /* a look has steps of its own */
    if (pb_copy_in(l, l->plans + PB_PLAN_ON)) die("copy in");
    printf("%llu %llu\n", (unsigned long long)*rig_word(l, 0, 0),
           (unsigned long long)*rig_word(l, 0, 1));
    reader = l;
}

int main(void) {
    struct pb_table t = rig_table(1);
    struct pb_local *task = rig_local(&t, 0), *looker = rig_local(&t, -1);
    const uint64_t set = 5;
    rig_enter(task, 0);
    rig_fill(task, 0, 10);
    if (rig_claim(task) || rig_release(task, false)) die("on and off");
    if (pb_set(&t, 0, &set, pb_now(), true)) die("set");
    rig_fill(task, 0, 20);
    reader = looker;
    if (rig_claim(task)) die("on again");
    return 0;
}
