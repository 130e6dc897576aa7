/* Sending to a queue and receiving from it (Stewart 1994, section 5.4.3).
 *
 * A short message is copied under the lock. For a long one the lock is released while it
 * is copied; its header names the process that copies it, and what a process had in progress
 * when it ended is returned to the free lists by the next patrol.
 */
#ifndef PBONET_XM_MAIL_H
#define PBONET_XM_MAIL_H

#include "queue.h"

enum { XM_SHORT = 1024 };                       /* bytes that are copied under the lock */
enum { XM_REFUSE, XM_DROP, XM_DROP_OLDEST, XM_WAIT };   /* if there is no room */

struct xm_letter {
    uint32_t head, size;        /* head: XM_END when it is copied and freed */
    int32_t priority;
};

static inline bool xm_fits(const struct xm_queue *q, uint32_t size)
{
    return q->n_heads && q->n_blocks >= xm_need(q, size);
}

/* Call the waiters that can go on: as many receivers as there are messages, and the first
 * of the senders if there is room for its message. Under the lock. */
static inline void xm_queue_serve(struct xm_queue *q)
{
    if (!xm_sweep(&q->o))
        return;
    struct xm_tally t = xm_tally(&q->o, XM_RECEIVER);
    for (; t.best && q->queued > t.called; t = xm_tally(&q->o, XM_RECEIVER))
        xm_call(t.best);
    t = xm_tally(&q->o, XM_SENDER);
    if (t.best && !t.called && xm_fits(q, t.best->need))
        xm_call(t.best);
}

static inline void xm_queue_unlock(struct xm_queue *q)
{
    xm_queue_serve(q);
    xm_unlock(&q->o);
}

/* Whether a newcomer, or a called waiter, may go on; others in the line come first. */
static inline bool xm_may(struct xm_queue *q, uint32_t role, int slot, uint32_t size)
{
    struct xm_tally t = {0, 0, NULL};
    if (slot < 0 && atomic_load(&q->o.high))
        t = xm_tally(&q->o, role);
    if (role == XM_SENDER)
        return xm_fits(q, size) && !t.waiting && !t.called;
    return q->queued > t.waiting + t.called;
}

/* Free the waiter's slot in the line; under the lock. */
static inline void xm_step_out(struct xm_queue *q, int slot)
{
    PBONET_STEP(80);
    if (slot >= 0)
        atomic_store(&q->o.slots[slot].state, XM_FREE);
}

static inline int xm_put_in(const struct xm_queue *q, uint32_t i, const uint8_t *from)
{
    const struct xm_head *h = xm_heads(q) + i;
    uint32_t left = h->size, at = h->first;
    for (; left; at = xm_links(q)[at]) {
        uint32_t n = left < q->block ? left : q->block;
        if (at >= q->blocks)
            return XM_DAMAGED;
        memcpy(xm_block(q, at), from, n);
        PBONET_STEP(81);
        from += n;
        left -= n;
    }
    return 0;
}

static inline int xm_copy_out(const struct xm_queue *q, uint32_t i, uint8_t *to)
{
    const struct xm_head *h = xm_heads(q) + i;
    uint32_t left = h->size, at = h->first;
    for (; left; at = xm_links(q)[at]) {
        uint32_t n = left < q->block ? left : q->block;
        if (at >= q->blocks)
            return XM_DAMAGED;
        memcpy(to, xm_block(q, at), n);
        PBONET_STEP(82);
        to += n;
        left -= n;
    }
    return 0;
}

/* Drop one message: the oldest, with HPF the oldest of the lowest priority. */
static inline int xm_drop(struct xm_queue *q)
{
    const struct xm_head *heads = xm_heads(q);
    uint32_t least = q->first;
    for (uint32_t i = q->first; i != XM_END; i = heads[i].next) {
        bool lower = q->policy == XM_HPF && heads[i].priority < heads[least].priority;
        bool equal = q->policy != XM_HPF || heads[i].priority == heads[least].priority;
        if (lower || (equal && heads[i].seq < heads[least].seq))
            least = i;
    }
    q->dropped++;
    xm_remove(q, least);
    return xm_free(q, least);
}

static inline int xm_make_room(struct xm_queue *q, uint32_t size)
{
    int code = 0;
    while (!code && !xm_fits(q, size) && q->queued)
        code = xm_drop(q);
    return code ? code : xm_fits(q, size) ? 0 : XM_NO_ROOM;
}

/* Copy a message in and queue it; called with the lock, which is released. */
static inline int xm_post(struct xm_queue *q, uint32_t i, const uint8_t *data)
{
    struct xm_head *h = xm_heads(q) + i;
    bool is_long = h->size > XM_SHORT;
    if (is_long)
        xm_unlock(&q->o);
    int code = xm_put_in(q, i, data);
    if (is_long && xm_queue_lock(q))
        return XM_STUCK;        /* stays in progress until the sender has ended */
    if (!code) {
        h->seq = ++q->seq;
        PBONET_STEP(83);
        atomic_store(&h->state, XM_QUEUED);
        PBONET_STEP(84);
        xm_insert(q, i);
    }
    xm_queue_unlock(q);
    return code;
}

/* Receive: the first message is copied to `to` if it has at most `room` bytes; otherwise it
 * stays in progress until xm_received. XM_TOO_LONG, with its size, leaves a message longer
 * than `most` bytes in the queue; XM_EMPTY keeps the slot in the line. */
static inline int xm_receive(struct xm_queue *q, uint32_t me, int slot, uint8_t *to,
                             uint32_t room, uint32_t most, struct xm_letter *letter)
{
    int code = xm_queue_lock(q);
    if (code)
        return code;
    if (!xm_may(q, XM_RECEIVER, slot, 0)) {
        xm_queue_unlock(q);
        return XM_EMPTY;
    }
    struct xm_head *h = xm_heads(q) + q->first;
    *letter = (struct xm_letter){q->first, h->size, h->priority};
    xm_step_out(q, slot);
    if (h->size > most) {
        xm_queue_unlock(q);
        return XM_TOO_LONG;
    }
    atomic_store(&h->member, me);
    PBONET_STEP(85);
    atomic_store(&h->state, XM_READING);
    PBONET_STEP(86);
    xm_remove(q, letter->head);
    if (h->size <= room) {
        code = xm_copy_out(q, letter->head, to);
        if (!code)
            code = xm_free(q, letter->head);
        letter->head = XM_END;
    }
    xm_queue_unlock(q);
    return code;
}

/* Free a long message after it has been copied. */
static inline int xm_received(struct xm_queue *q, uint32_t i)
{
    int code = xm_queue_lock(q);
    if (code)
        return code;
    code = xm_free(q, i);
    xm_queue_unlock(q);
    return code;
}

/* A member that has ended and still has a slot or a message, or XM_NONE; needs no lock. */
static inline int xm_queue_dead(const struct xm_queue *q, uint32_t me)
{
    const struct xm_head *heads = xm_heads(q);
    int m = xm_dead_in_line(&q->o, me);
    for (uint32_t i = 0; m < 0 && i < q->heads; i++) {
        uint32_t state = atomic_load(&heads[i].state), who = atomic_load(&heads[i].member);
        if ((state == XM_WRITING || state == XM_READING) && who != me && xm_dead(&q->o, who))
            m = (int)who;
    }
    return m;
}

/* Clean up after a member that has ended: its slots, and its messages in progress. */
static inline int xm_queue_settle(struct xm_queue *q, uint32_t m)
{
    const struct xm_head *heads = xm_heads(q);
    int code = 0;
    xm_forget(&q->o, m);
    for (uint32_t i = 0; i < q->heads && !code; i++) {
        uint32_t state = atomic_load(&heads[i].state);
        if ((state == XM_WRITING || state == XM_READING) && atomic_load(&heads[i].member) == m)
            code = xm_free(q, i);
    }
    PBONET_STEP(87);
    atomic_store(&q->o.members[m].pid, 0);
    return code;
}

/* Check for dead members, also for one that died with the lock. */
static inline void xm_queue_patrol(struct xm_queue *q, uint32_t me)
{
    int m;
    do {
        m = xm_queue_dead(q, me);
        if (xm_try_lock(&q->o))
            return;
        if (q->o.hurt && xm_rebuild(q))
            m = XM_NONE;
        else if (m >= 0 && xm_dead(&q->o, (uint32_t)m) && xm_queue_settle(q, (uint32_t)m))
            m = XM_NONE;
        xm_queue_unlock(q);
    } while (m >= 0);
}

static inline int xm_try_send(struct xm_queue *q, uint32_t me, int slot, const uint8_t *data,
                              uint32_t size, int32_t priority, int full)
{
    int code = xm_queue_lock(q);
    if (code)
        return code;
    if (!xm_may(q, XM_SENDER, slot, size))
        code = full == XM_DROP_OLDEST ? xm_make_room(q, size) : XM_NO_ROOM;
    uint32_t i = code ? XM_END : xm_alloc(q, me, size, priority);
    if (!code && i == XM_END)
        code = XM_DAMAGED;
    if (code) {
        q->dropped += code == XM_NO_ROOM && full == XM_DROP;
        xm_queue_unlock(q);
        return code;
    }
    xm_step_out(q, slot);
    return xm_post(q, i, data);
}

/* Send: 0, XM_NO_ROOM (the slot in the line is kept), XM_TOO_LONG, XM_STUCK or XM_DAMAGED.
 * If the queue is full, dead members' messages are freed before `full` applies. */
static inline int xm_send(struct xm_queue *q, uint32_t me, int slot, const uint8_t *data,
                          uint32_t size, int32_t priority, int full)
{
    if (xm_need(q, size) > q->blocks)
        return XM_TOO_LONG;
    int code = xm_try_send(q, me, slot, data, size, priority, XM_WAIT);
    if (code != XM_NO_ROOM || slot >= 0)
        return code;
    xm_queue_patrol(q, me);
    return xm_try_send(q, me, slot, data, size, priority, full);
}

/* Join the line as receiver or sender; the slot, XM_CROWDED, XM_STUCK, XM_DAMAGED. */
static inline int xm_queue_wait(struct xm_queue *q, uint32_t me, uint32_t role,
                                int32_t priority, uint32_t size)
{
    int code = xm_queue_lock(q);
    if (code)
        return code;
    code = xm_queue_up(&q->o, me, role, priority, size);
    xm_queue_unlock(q);
    return code;
}

/* The call was in vain: keep waiting in the same place. */
static inline void xm_queue_again(struct xm_queue *q, int slot)
{
    uint32_t state = XM_CALLED;
    if (xm_queue_lock(q))
        return;
    atomic_compare_exchange_strong(&q->o.slots[slot].state, &state, XM_WAITING);
    xm_queue_unlock(q);
}

static inline void xm_queue_leave(struct xm_queue *q, int slot)
{
    atomic_store(&q->o.slots[slot].state, XM_LEFT);
    PBONET_STEP(88);
    if (!xm_queue_lock(q))
        xm_queue_unlock(q);
}

/* Become a member, after cleaning up those that have ended; the member, or an error. */
static inline int xm_queue_enter(struct xm_queue *q)
{
    int code = xm_queue_lock(q);
    if (code)
        return code;
    if (!xm_check(q)) {
        xm_unlock(&q->o);
        return XM_DAMAGED;
    }
    for (uint32_t m = 0; m < XM_MEMBERS && !code; m++)
        if (xm_dead(&q->o, m))
            code = xm_queue_settle(q, m);
    int me = code ? code : xm_enter(&q->o);
    xm_queue_unlock(q);
    return me;
}

static inline int xm_queue_exit(struct xm_queue *q, uint32_t me)
{
    int code = xm_queue_lock(q);
    if (code)
        return code;
    code = xm_queue_settle(q, me);
    xm_queue_unlock(q);
    return code;
}

#endif
