/* The common head of every shared object of express mail: users, waiters, one lock.
 *
 * A member is an attached process: its id and its start time, so that a killed one is
 * recognized. Everything that the lock protects can be repaired by the next holder, so the
 * lock is robust: when a holder dies the kernel passes it on. It inherits priorities where
 * the kernel supports it, every section under it is bounded, and none makes a blocking call.
 * Nor does a dispatcher hold a task in one (steady.h).
 */
#ifndef PBONET_XM_OBJECT_H
#define PBONET_XM_OBJECT_H

#include "../../svar/lock.h"
#include "steady.h"

#define XM_MAGIC UINT64_C(0x0a0d6c69614d6270)
#define XM_FOREVER INT64_C(0)

enum { XM_VERSION = 1, XM_SEM = 1, XM_QUEUE = 2 };
enum { XM_MEMBERS = 128, XM_SLOTS = 128, XM_NONE = -1 };
enum { XM_FREE, XM_WAITING, XM_CALLED, XM_LEFT };       /* of a slot */

/* Results of operations besides 0. */
enum { XM_DIED = -1,        /* taken, and its last holder died with it */
       XM_EMPTY = -2, XM_STUCK = -3, XM_CROWDED = -4, XM_NO_ROOM = -5,
       XM_TOO_LONG = -6, XM_DAMAGED = -7, XM_TIMED_OUT = -8, XM_SIGNAL = -9,
       XM_AGAIN = -10, XM_BAD_VERSION = -11 };

struct xm_member {
    _Atomic uint64_t pid, start, space;     /* pid 0: free */
};

/* One waiter; `state` is the word that it sleeps on. */
struct xm_slot {
    _Alignas(PB_LINE) _Atomic uint32_t state;
    _Atomic uint32_t member;
    int32_t priority;
    uint32_t role, need;        /* of queues: receiver or sender, and its message's size */
    uint64_t ticket;            /* first come, first served among equals */
};

struct xm_object {
    uint64_t magic;
    uint32_t version, kind;
    uint64_t size;
    uint32_t mutex_size;        /* of this machine's C library */
    _Atomic uint32_t destroyed;
    _Alignas(PB_LINE) pthread_mutex_t lock;
    uint32_t hurt;              /* a holder died under the lock; under the lock */
    _Atomic uint32_t high;      /* slots from this index on are free */
    uint64_t tickets;
    struct xm_member members[XM_MEMBERS];
    struct xm_slot slots[XM_SLOTS];
};

static inline int xm_make(struct xm_object *o, uint32_t kind, uint64_t size)
{
    int error = pb_lock_make(&o->lock);
    o->version = XM_VERSION;
    o->kind = kind;
    o->size = size;
    o->mutex_size = sizeof o->lock;
    o->magic = XM_MAGIC;
    return error;
}

/* Check a mapped file; 0, XM_DAMAGED or XM_BAD_VERSION. */
static inline int xm_verify(const struct xm_object *o, uint32_t kind, uint64_t bytes)
{
    if (bytes < sizeof *o || o->magic != XM_MAGIC || o->kind != kind)
        return XM_DAMAGED;
    if (o->version != XM_VERSION || o->mutex_size != sizeof o->lock)
        return XM_BAD_VERSION;
    return o->size == bytes ? 0 : XM_DAMAGED;
}

/* Record that a holder died, if one did; 0 if the lock is held now. */
static inline int xm_held(struct xm_object *o, int error)
{
    if (error == EOWNERDEAD) {
        o->hurt = 1;
        error = pthread_mutex_consistent(&o->lock);
    }
    return error ? XM_STUCK : 0;
}

/* Returns 0, or XM_STUCK when the holder of the lock does not run for seconds. */
static inline int xm_lock(struct xm_object *o)
{
    PBONET_STEP(30);
    xm_steady_begin();
    int error = pthread_mutex_trylock(&o->lock);
    if (error == EBUSY)
        error = pb_lock_wait(&o->lock);
    if (!xm_held(o, error))
        return 0;
    xm_steady_end();
    return XM_STUCK;
}

/* As xm_lock, for a caller that does not wait for another holder. */
static inline int xm_try_lock(struct xm_object *o)
{
    xm_steady_begin();
    if (!xm_held(o, pthread_mutex_trylock(&o->lock)))
        return 0;
    xm_steady_end();
    return XM_STUCK;
}

static inline void xm_unlock(struct xm_object *o)
{
    PBONET_STEP(31);
    pthread_mutex_unlock(&o->lock);
    PBONET_STEP(32);
    xm_steady_end();
}

/* SYNC POINT X1, partner X2: a thread woken by the destruction sees the mark. */
static inline bool xm_destroyed(const struct xm_object *o)
{
    return atomic_load_explicit(&o->destroyed, memory_order_acquire);
}

/* Whether member `m` is recorded and has ended; false if that cannot be determined. */
static inline bool xm_dead(const struct xm_object *o, uint32_t m)
{
    const struct xm_member *who = o->members + m;
    uint64_t pid = m < XM_MEMBERS ? atomic_load(&who->pid) : 0;
    return pid && atomic_load(&who->space) == pb_process_space() &&
           pb_process_start(pid) != atomic_load(&who->start);
}

/* Take a place among the members, under the lock; XM_CROWDED if there is none. The caller
 * has cleaned up after dead members before. */
static inline int xm_enter(struct xm_object *o)
{
    for (int m = 0; m < XM_MEMBERS; m++) {
        struct xm_member *who = o->members + m;
        if (atomic_load(&who->pid))
            continue;
        atomic_store(&who->start, pb_process_start((uint64_t)getpid()));
        atomic_store(&who->space, pb_process_space());
        PBONET_STEP(33);
        atomic_store(&who->pid, (uint64_t)getpid());
        return m;
    }
    return XM_CROWDED;
}

#endif
