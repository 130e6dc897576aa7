/* Computes a value that is none. */
#include <math.h>

#include "counting.h"

static int cycle(void *state, pbo_task *task)
{
    (void)task;
    if (is_tenth(state))
        ((struct counts *)state)->y[1] = NAN;
    return PBO_OK;
}

MISBEHAVES("y is NaN in the tenth cycle.");
