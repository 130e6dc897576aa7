/* A look at the flag between any two steps of raising and clearing a cause.
 *
 * Prints what each of them sees; the last of each line is the look behind the change. */
#define _GNU_SOURCE 1
static void step(void);
#define PBONET_STEP(n) step()
#define PBONET_STEP_WORDS 1
#include "svar_rig.h"

static struct pb_table table;
static struct pb_seen seen;

static void step(void) {
    if (table.base) printf("%d", pb_illegal(&table, &seen));
}

int main(void) {
    const struct pb_cause cause = pb_cause_of("a cause", "me", "here");
    table = rig_table(1);
    if (pb_raise(&table, &cause)) die("raise");
    printf("%d\n", pb_illegal(&table, &seen));
    if (pb_clear(&table, &cause) != 1) die("clear");
    printf("%d\n", pb_illegal(&table, &seen));
    return 0;
}
