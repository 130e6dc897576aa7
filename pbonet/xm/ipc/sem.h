/* A semaphore, counting or binary (Stewart 1994, section 5.4.2).
 *
 * Its value and whether any thread waits are in one word. While none waits, P and V are one
 * compare-and-exchange each. V never waits for the lock: if it cannot get it, it leaves a
 * mark in the word, and the holder, which checks the mark after unlocking, does the work. A
 * binary semaphore's word also names its holder, so that the death of a holder is detected;
 * the next P takes the semaphore and returns XM_DIED.
 */
#ifndef PBONET_XM_SEM_H
#define PBONET_XM_SEM_H

#include "line.h"

#define XM_VALUE UINT64_C(0xffffffff)
#define XM_BUSY (UINT64_C(1) << 32)     /* slots are in use: P goes through the line */
#define XM_KICK (UINT64_C(1) << 33)     /* a waiter must be called */
#define XM_ORPHAN (UINT64_C(1) << 34)   /* the last holder died with it */
enum { XM_HOLDER = 48 };                /* from this bit: holder's member + 1 */

struct xm_sem {
    struct xm_object o;
    _Alignas(PB_LINE) _Atomic uint64_t word;
    uint32_t maximum, binary;
};

static inline int xm_sem_make(struct xm_sem *s, uint32_t initial, uint32_t maximum,
                              bool binary)
{
    int error = xm_make(&s->o, XM_SEM, sizeof *s);
    s->maximum = maximum;
    s->binary = binary;
    atomic_store(&s->word, initial);
    return error;
}

static inline int xm_sem_verify(const struct xm_sem *s, uint64_t bytes)
{
    int verdict = bytes < sizeof *s ? XM_DAMAGED : xm_verify(&s->o, XM_SEM, bytes);
    if (verdict)
        return verdict;
    return s->maximum && (atomic_load(&s->word) & XM_VALUE) <= s->maximum ? 0 : XM_DAMAGED;
}

static inline uint32_t xm_sem_value(const struct xm_sem *s)
{
    return (uint32_t)(atomic_load(&s->word) & XM_VALUE);
}

/* The holder's member, or XM_NONE. */
static inline int xm_sem_holder(const struct xm_sem *s)
{
    return (int)(atomic_load(&s->word) >> XM_HOLDER) - 1;
}

/* The holder's process, or 0. */
static inline uint64_t xm_sem_holder_pid(const struct xm_sem *s)
{
    int m = xm_sem_holder(s);
    return m < 0 ? 0 : atomic_load(&s->o.members[m % XM_MEMBERS].pid);
}

/* Take one: 0, XM_DIED or XM_EMPTY. A called waiter passes those that still wait. */
static inline int xm_sem_take(struct xm_sem *s, uint32_t me, bool called)
{
    uint64_t next, word = atomic_load(&s->word);
    do {
        if (!(word & XM_VALUE) || (!called && (word & XM_BUSY)))
            return XM_EMPTY;
        next = (word - 1) & (XM_VALUE | XM_BUSY | XM_KICK);
        if (s->binary)
            next |= (uint64_t)(me + 1) << XM_HOLDER;
        PBONET_STEP(50);
    /* SYNC POINT S1, partner S2 in xm_sem_give: the next holder sees this one's writes. */
    } while (!atomic_compare_exchange_weak(&s->word, &word, next));
    PBONET_STEP(51);
    return word & XM_ORPHAN ? XM_DIED : 0;
}

/* Bring word and line in agreement and call the waiters that can go on; under the lock. */
static inline void xm_sem_serve(struct xm_sem *s)
{
    uint64_t next, word = atomic_load(&s->word);
    bool busy = xm_sweep(&s->o);
    do {
        next = (word & ~(XM_BUSY | XM_KICK)) | (busy ? XM_BUSY : 0);
        PBONET_STEP(52);
    /* SYNC POINT S3, partner S2: a V after this sees BUSY, and a V before it is seen
     * here. */
    } while (!atomic_compare_exchange_weak(&s->word, &word, next));
    struct xm_tally t = xm_tally(&s->o, 0);
    for (uint64_t value = next & XM_VALUE; t.best && value > t.called;) {
        xm_call(t.best);
        t = xm_tally(&s->o, 0);
    }
    s->o.hurt = 0;
}

/* Serve a mark that a V has left, unless another thread holds the lock and will. */
static inline void xm_sem_answer(struct xm_sem *s)
{
    /* SYNC POINT S4, with itself: either the try-lock below fails before the holder unlocks,
     * and the holder's check of the mark comes after that, or the try-lock succeeds. */
    atomic_thread_fence(memory_order_seq_cst);
    while (atomic_load(&s->word) & XM_KICK) {
        if (xm_try_lock(&s->o))
            return;
        xm_sem_serve(s);
        xm_unlock(&s->o);
        atomic_thread_fence(memory_order_seq_cst); /* SYNC POINT S4 again */
    }
}

static inline void xm_sem_unlock(struct xm_sem *s)
{
    xm_steady_begin();
    xm_sem_serve(s);
    xm_unlock(&s->o);
    xm_sem_answer(s);
    xm_steady_end();
}

/* V: 0, or XM_NO_ROOM if the value is at its maximum. Never waits; the dispatcher does not
 * hold the task between its mark and the call of the waiter. */
static inline int xm_sem_give(struct xm_sem *s)
{
    uint64_t next, word = atomic_load(&s->word);
    xm_steady_begin();
    do {
        if ((word & XM_VALUE) >= s->maximum) {
            xm_steady_end();
            return XM_NO_ROOM;
        }
        next = ((word & (XM_VALUE | XM_BUSY | XM_KICK)) + 1) | (word & XM_BUSY ? XM_KICK : 0);
        PBONET_STEP(53);
    /* SYNC POINT S2, partners S1 and S3. */
    } while (!atomic_compare_exchange_weak(&s->word, &word, next));
    PBONET_STEP(54);
    if (next & XM_KICK)
        xm_sem_answer(s);
    xm_steady_end();
    return 0;
}

/* Clean up after a member that has ended: its slots, and the semaphore if it held it. */
static inline void xm_sem_settle(struct xm_sem *s, uint32_t m)
{
    uint64_t word = atomic_load(&s->word);
    xm_forget(&s->o, m);
    while ((word >> XM_HOLDER) == m + 1) {
        uint64_t next = (word & (XM_BUSY | XM_KICK)) | 1 | XM_ORPHAN;
        PBONET_STEP(55);
        if (atomic_compare_exchange_weak(&s->word, &word, next))
            break;
    }
    PBONET_STEP(56);
    atomic_store(&s->o.members[m].pid, 0);
}

/* A member that has ended and still waits or holds, or XM_NONE; needs no lock. */
static inline int xm_sem_dead(const struct xm_sem *s, uint32_t me)
{
    int holder = xm_sem_holder(s), m = xm_dead_in_line(&s->o, me);
    if (m < 0 && holder >= 0 && (uint32_t)holder != me && xm_dead(&s->o, (uint32_t)holder))
        m = holder;
    return m;
}

/* Check for dead members: in the line, the holder, and one that died with the lock. */
static inline void xm_sem_patrol(struct xm_sem *s, uint32_t me)
{
    int m;
    do {
        m = xm_sem_dead(s, me);
        if (xm_try_lock(&s->o))
            return;
        if (m >= 0 && xm_dead(&s->o, (uint32_t)m))
            xm_sem_settle(s, (uint32_t)m);
        xm_sem_unlock(s);
    } while (m >= 0);
}

/* Begin a P: 0 or XM_DIED when taken; XM_AGAIN with a slot in the line, if `wait`; else
 * XM_EMPTY, XM_STUCK or XM_CROWDED. */
static inline int xm_sem_begin(struct xm_sem *s, uint32_t me, int32_t priority, bool wait,
                               int *slot)
{
    int code = xm_sem_take(s, me, false);
    *slot = XM_NONE;
    if (code != XM_EMPTY)
        return code;
    if (!wait && !atomic_load(&s->word))
        return code;
    if (!wait)
        xm_sem_patrol(s, me);   /* a waiter patrols later: the patrol reads /proc */
    if (xm_lock(&s->o))
        return XM_STUCK;
    struct xm_tally t = xm_tally(&s->o, 0);
    if (xm_sem_value(s) > t.waiting + t.called)
        code = xm_sem_take(s, me, true);
    if (code == XM_EMPTY && wait) {
        *slot = xm_queue_up(&s->o, me, 0, priority, 0);
        code = *slot < 0 ? *slot : XM_AGAIN;
    }
    xm_sem_unlock(s);
    return code;
}

/* Take what the slot was called for: 0 or XM_DIED, or XM_AGAIN to keep waiting. */
static inline int xm_sem_called(struct xm_sem *s, uint32_t me, int slot)
{
    if (xm_lock(&s->o))
        return XM_STUCK;
    int code = xm_sem_take(s, me, true);
    atomic_store(&s->o.slots[slot].state, code == XM_EMPTY ? XM_WAITING : XM_FREE);
    PBONET_STEP(57);
    xm_sem_unlock(s);
    return code == XM_EMPTY ? XM_AGAIN : code;
}

/* Leave the line without having taken anything. */
static inline void xm_sem_leave(struct xm_sem *s, int slot)
{
    atomic_store(&s->o.slots[slot].state, XM_LEFT);
    PBONET_STEP(58);
    if (!xm_lock(&s->o))
        xm_sem_unlock(s);
}

/* Become a member, after cleaning up those that have ended; the member, or an error. */
static inline int xm_sem_enter(struct xm_sem *s)
{
    if (xm_lock(&s->o))
        return XM_STUCK;
    for (uint32_t m = 0; m < XM_MEMBERS; m++)
        if (xm_dead(&s->o, m))
            xm_sem_settle(s, m);
    int me = xm_enter(&s->o);
    xm_sem_unlock(s);
    return me;
}

/* Leave; a binary semaphore that the member still holds counts as one whose holder died. */
static inline int xm_sem_exit(struct xm_sem *s, uint32_t me)
{
    if (xm_lock(&s->o))
        return XM_STUCK;
    xm_sem_settle(s, me);
    xm_sem_unlock(s);
    return 0;
}

#endif
