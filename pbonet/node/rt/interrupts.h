/* UNIX signals that have come and that the interpreter has not seen.
 *
 * The interpreter's own handler only notes a signal; its bytecode calls the handler in
 * Python. A task whose cycles are in C executes none between its cycles, and a signal
 * that comes amid a cycle does not end the wait after it. So the handler noted here calls
 * that of the interpreter, and says to the loop that there is something to see.
 */
#ifndef PBONET_INTERRUPTS_H
#define PBONET_INTERRUPTS_H

#ifndef _GNU_SOURCE
#define _GNU_SOURCE
#endif

#include <errno.h>
#include <signal.h>
#include <stdatomic.h>

enum { RT_HIGHEST = 65 };

static void (*rt_interpreter_handlers[RT_HIGHEST])(int);
static _Atomic int rt_interrupted;

static inline void rt_on_interrupt(int signal)
{
    int saved = errno;
    rt_interpreter_handlers[signal](signal);
    atomic_store(&rt_interrupted, 1);
    errno = saved;
}

/* Let the loop see a signal for which the interpreter has its handler; return an error. */
static inline int rt_see_interrupt(int signal)
{
    struct sigaction action;
    if (signal <= 0 || signal >= RT_HIGHEST || sigaction(signal, NULL, &action))
        return EINVAL;
    if (action.sa_flags & SA_SIGINFO || action.sa_handler == SIG_DFL ||
        action.sa_handler == SIG_IGN)
        return EINVAL;
    if (action.sa_handler == rt_on_interrupt)
        return 0;
    rt_interpreter_handlers[signal] = action.sa_handler;
    action.sa_handler = rt_on_interrupt;
    return sigaction(signal, &action, NULL) ? errno : 0;
}

/* Return whether a signal has come since the last call. */
static inline int rt_take_interrupt(void)
{
    return atomic_load_explicit(&rt_interrupted, memory_order_relaxed) &&
           atomic_exchange(&rt_interrupted, 0);
}

#endif
