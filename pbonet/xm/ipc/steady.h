/* Sections in which a task must not be held.
 *
 * Without real-time rights a dispatcher holds a task by a signal, at any instruction. A task
 * held inside a shared object's lock would keep the lock from more urgent tasks. So each
 * thread counts its sections in thread-local memory; a signal that arrives within one is
 * noted, and raised again at the section's end. Sections are bounded, and may be nested.
 */
#ifndef PBONET_XM_STEADY_H
#define PBONET_XM_STEADY_H

#include <signal.h>
#include <stdatomic.h>

struct xm_steady {
    volatile sig_atomic_t depth, owed;      /* owed: a signal that arrived; 0: none */
};

/* Eight bytes, so the initial-exec model needs no call: glibc reserves static TLS space for
 * small variables of libraries that are loaded late. */
#if defined(__GLIBC__) && defined(__GNUC__)
__attribute__((tls_model("initial-exec")))
#endif
static _Thread_local struct xm_steady xm_steady;

static inline struct xm_steady *xm_steady_here(void)
{
    return &xm_steady;
}

/* For a signal handler in the same thread: whether it interrupted a section, at whose end
 * it will be called again. */
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
