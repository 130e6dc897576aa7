/* Ends its process in its tenth cycle. */
#include <stdlib.h>

#include "counting.h"

static int cycle(void *state, pbo_task *task)
{
    (void)task;
    if (is_tenth(state))
        exit(3);
    return PBO_OK;
}

MISBEHAVES("Believes that it is a program.");
