/* One instance of a module in C: its state, its task, and what a method has reported.
 *
 * A method runs without the interpreter, so warnings, signals and errors are noted here
 * and passed on when it has returned: no lock, no allocation.
 */
#ifndef PBONET_INSTANCE_H
#define PBONET_INSTANCE_H

#include <stdarg.h>
#include <stdio.h>
#include <string.h>

#include "pbonet.h"
#include "running.h"

enum { PBO_MESSAGE = 200, PBO_NOTICES = 8 };

struct pbo_notice {
    int32_t code;
    uint32_t signals;   /* 0: a warning */
    char text[PBO_MESSAGE];
};

typedef struct {
    pbo_task task;      /* first, so that a task is its instance */
    const pbo_module *module;
    void *state;
    struct pbo_running *running;
    int32_t answer;     /* of the last method */
    int32_t failed;     /* `fail` was called */
    int32_t code;
    int32_t line;
    int32_t n_notices;
    uint32_t dropped;   /* notices without room */
    const char *file;
    char text[PBO_MESSAGE];
    struct pbo_notice notices[PBO_NOTICES];
} pbo_instance;

static inline int pbo_do_fail(pbo_task *task, const char *file, int line, int code,
                              const char *format, ...)
{
    pbo_instance *one = (pbo_instance *)task;
    va_list args;
    if (one->failed)
        return PBO_ERROR;   /* the first error is the cause */
    va_start(args, format);
    vsnprintf(one->text, sizeof one->text, format, args);
    va_end(args);
    one->failed = 1;
    one->code = code;
    one->file = file;
    one->line = line;
    return PBO_ERROR;
}

static inline struct pbo_notice *pbo_next_notice(pbo_instance *one)
{
    if (one->n_notices == PBO_NOTICES) {
        one->dropped++;
        return NULL;
    }
    return &one->notices[one->n_notices++];
}

static inline void pbo_do_warn(pbo_task *task, int code, const char *format, ...)
{
    struct pbo_notice *notice = pbo_next_notice((pbo_instance *)task);
    va_list args;
    if (!notice)
        return;
    notice->code = code;
    notice->signals = 0;
    va_start(args, format);
    vsnprintf(notice->text, sizeof notice->text, format, args);
    va_end(args);
}

static inline void pbo_do_signal(pbo_task *task, uint32_t signals)
{
    struct pbo_notice *notice = signals ? pbo_next_notice((pbo_instance *)task) : NULL;
    if (notice) {
        notice->signals = signals;
        notice->text[0] = 0;
    }
}

static inline void *pbo_do_data(pbo_task *task, const char *name)
{
    const pbo_instance *one = (const pbo_instance *)task;
    for (uint32_t i = 0; i < one->module->n_ports; i++) {
        const pbo_port *port = &one->module->ports[i];
        if (!strcmp(port->name, name))
            return *(void **)((char *)one->state + port->offset);
    }
    return NULL;
}

static inline void pbo_begin(pbo_instance *one, const pbo_module *module, void *state,
                             struct pbo_running *running)
{
    memset(one, 0, sizeof *one);
    one->module = module;
    one->state = state;
    one->running = running;
    one->task.fail = pbo_do_fail;
    one->task.warn = pbo_do_warn;
    one->task.signal = pbo_do_signal;
    one->task.data = pbo_do_data;
    one->task.svar.vartable = &one->task;
}

/* Show the method all failures of this cycle: those of before, and those that follow. */
static inline void pbo_show_failures(pbo_instance *one)
{
    struct pbo_running *running = one->running;
    running->must_end = &one->task.must_end;
    do {        /* again if the handler came between: it must not be overwritten */
        one->task.must_end = running->failed;
    } while (one->task.must_end != running->failed);
}

/* Call `cycle` or `stable`; returns whether something must be passed on. */
static inline int pbo_run(pbo_method *method, pbo_instance *one)
{
    pbo_show_failures(one);
    one->answer = method(one->state, &one->task);
    one->running->must_end = NULL;
    return (one->answer != PBO_OK) | one->failed | one->n_notices;
}

#endif
