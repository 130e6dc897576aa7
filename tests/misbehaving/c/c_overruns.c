/* Takes more CPU time than it has, in every `every`th cycle, until it is told to end. */
#include <pbonet.h>

enum { MOST = 300000000 };      /* steps after which it ends by itself, as in a replay */

struct overruns {
    double *y;
    int64_t answer, every;
    int64_t cycles, handled, ended;
};

static const pbo_port ports[] = {
    PBO_OUT_VAR(struct overruns, y, "Y", "2", "none", "cycles, calls of the handler"),
};

static const pbo_param params[] = {
    PBO_PARAM(struct overruns, answer, "none", "what the handler answers"),
    PBO_PARAM(struct overruns, every, "none", "which cycles are long", PBO_DEFAULT(5)),
};

static int on(void *state, pbo_task *task)
{
    struct overruns *self = state;
    (void)task;
    self->cycles = 0;
    return PBO_OK;
}

static int cycle(void *state, pbo_task *task)
{
    struct overruns *self = state;
    self->y[0] += 1.0;
    self->y[1] = (double)self->handled;
    if (++self->cycles % self->every == 0) {
        for (volatile long i = 0; i < MOST && !(task->must_end & PBO_MAXEXEC); i++)
            ;
        if (task->must_end && !self->ended++)
            pbo_warn(task, 5, "a cycle has ended early");
    }
    return PBO_OK;
}

static int timing_failure(void *state, pbo_task *task, int kind)
{
    struct overruns *self = state;
    (void)task;
    (void)kind;
    self->handled++;
    return (int)self->answer;
}

PBO_MODULE(struct overruns, "Counts its cycles and its failures.", PBO_PORTS(ports),
           PBO_PARAMS(params), .on = on, .cycle = cycle, .timing_failure = timing_failure);
