/* Works for 95 % of its period of 20 ms, as a module with much to compute. */
#include <time.h>

#include "counting.h"

static int64_t spent_ns(void)
{
    struct timespec t;
    clock_gettime(CLOCK_THREAD_CPUTIME_ID, &t);
    return (int64_t)t.tv_sec * 1000000000 + t.tv_nsec;
}

static int cycle(void *state, pbo_task *task)
{
    struct counts *self = state;
    int64_t ends = spent_ns() + 19000000;
    (void)task;
    self->y[0] += 1.0;
    while (spent_ns() < ends)
        ;
    return PBO_OK;
}

MISBEHAVES("Works nearly all of its time.");
