/* Hangs in its tenth cycle. */
#include "counting.h"

static int cycle(void *state, pbo_task *task)
{
    (void)task;
    if (is_tenth(state))
        for (volatile int on = 1; on;)
            ;
    return PBO_OK;
}

MISBEHAVES("Never comes back from cycle.");
