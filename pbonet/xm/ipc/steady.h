/* Sections in which a task must not be held.
 *
 * Without real-time rights a dispatcher holds a task by a signal, wherever that meets it.
 * Within a shared object's lock it would keep from it whoever is more urgent and wants the
 * lock, too. So each section is counted, by its own thread in memory of its own; a signal
 * that comes within one is noted, and raised again at the section's end. Sections are
 * bounded, and may contain others.
 */
#ifndef PBONET_XM_STEADY_H
#define PBONET_XM_STEADY_H

#include <signal.h>
#include <stdatomic.h>

struct xm_steady {
    volatile sig_atomic_t depth, owed;      /* owed: a signal that came within; 0: none */
};

/* Eight bytes, so they may stand where they are found without a call: glibc keeps room for
 * such in libraries that are loaded late. */
#if defined(__GLIBC__) && defined(__GNUC__)
__attribute__((tls_model("initial-exec")))
#endif
static _Thread_local struct xm_steady xm_steady;

static inline struct xm_steady *xm_steady_here(void)
{
    return &xm_steady;
}

/* For a handler of signals in the same thread: whether it came amid a section, at whose
 * end it will be called again. */
static inline int xm_steady_owes(struct xm_steady *steady, int signal)
{
    if (!steady->depth)
        return 0;
    steady->owed = signal;
    return 1;
}

static inline void xm_steady_begin(void)
{
    xm_steady.depth = xm_steady.depth + 1;
    atomic_signal_fence(memory_order_seq_cst);
}

static inline void xm_steady_end(void)
{
    struct xm_steady *steady = &xm_steady;
    atomic_signal_fence(memory_order_seq_cst);
    steady->depth = steady->depth - 1;
    atomic_signal_fence(memory_order_seq_cst);
    if (!steady->depth && steady->owed) {
        int signal = steady->owed;
        steady->owed = 0;
        raise(signal);
    }
}

#endif
