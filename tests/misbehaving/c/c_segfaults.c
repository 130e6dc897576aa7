/* Writes to address zero in its tenth cycle. */
#include "counting.h"

static int cycle(void *state, pbo_task *task)
{
    (void)task;
    if (is_tenth(state))
        *(volatile int *)0 = 1;
    return PBO_OK;
}

MISBEHAVES("Brings its own process down.");
