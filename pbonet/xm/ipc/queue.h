/* A message queue's memory (Stewart 1994, section 5.4.3.1): headers and blocks in lists.
 *
 * A message is a header and as many blocks as it needs, linked. The headers' states and
 * their chains of blocks are authoritative; the lists (free headers, free blocks, the order
 * of the messages) can be rebuilt from them, and are after a process died under the lock.
 * A header leaves the state "free" only when its chain is complete.
 */
#ifndef PBONET_XM_QUEUE_H
#define PBONET_XM_QUEUE_H

#include "line.h"

enum { XM_FIFO, XM_LIFO, XM_HPF };
enum { XM_RECEIVER, XM_SENDER };
enum { XM_UNUSED, XM_WRITING, XM_QUEUED, XM_READING };  /* of a header */
#define XM_END UINT32_MAX

struct xm_head {
    _Atomic uint32_t state, member;
    uint32_t size, first;       /* bytes, and the first block */
    int32_t priority;
    uint32_t next, before;      /* in the order of service */
    uint64_t seq;
};

struct xm_queue {
    struct xm_object o;
    uint32_t policy, heads, blocks, block;      /* block: bytes in one */
    uint64_t heads_at, links_at, marks_at, data_at;
    /* protected by the lock: */
    uint32_t first, last, free_head, free_block, n_heads, n_blocks, queued;
    uint64_t seq, dropped;
};

static inline struct xm_head *xm_heads(const struct xm_queue *q)
{
    return (struct xm_head *)((uintptr_t)q + q->heads_at);
}

static inline uint32_t *xm_links(const struct xm_queue *q)
{
    return (uint32_t *)((uintptr_t)q + q->links_at);
}

static inline uint8_t *xm_block(const struct xm_queue *q, uint32_t i)
{
    return (uint8_t *)q + q->data_at + (uint64_t)i * q->block;
}

/* Number of blocks for `size` bytes; an empty message needs none. */
static inline uint32_t xm_need(const struct xm_queue *q, uint64_t size)
{
    return (uint32_t)((size + q->block - 1) / q->block);
}

/* Compute the places of all parts; returns the total size. */
static inline uint64_t xm_lay_out(struct xm_queue *q, uint32_t heads, uint32_t blocks,
                                  uint32_t block)
{
    q->heads = heads;
    q->blocks = blocks;
    q->block = block;
    q->heads_at = pb_round(sizeof *q, PB_LINE);
    q->links_at = q->heads_at + (uint64_t)heads * sizeof(struct xm_head);
    q->marks_at = q->links_at + (uint64_t)blocks * sizeof(uint32_t);
    q->data_at = pb_round(q->marks_at + blocks, PB_LINE);
    return q->data_at + (uint64_t)blocks * block;
}

/* Whether `a` is served before `b`. */
static inline bool xm_precedes(const struct xm_queue *q, const struct xm_head *a,
                               const struct xm_head *b)
{
    if (q->policy == XM_LIFO)
        return a->seq > b->seq;
    if (q->policy == XM_HPF && a->priority != b->priority)
        return a->priority > b->priority;
    return a->seq < b->seq;
}

/* Insert a header in the policy's order: at the front, or searched from the end. */
static inline void xm_insert(struct xm_queue *q, uint32_t i)
{
    struct xm_head *heads = xm_heads(q), *h = heads + i;
    uint32_t after = q->last;
    if (q->first != XM_END && xm_precedes(q, h, heads + q->first))
        after = XM_END;
    while (after != XM_END && xm_precedes(q, h, heads + after))
        after = heads[after].before;
    h->before = after;
    h->next = after == XM_END ? q->first : heads[after].next;
    PBONET_STEP(60);
    *(after == XM_END ? &q->first : &heads[after].next) = i;
    PBONET_STEP(61);
    *(h->next == XM_END ? &q->last : &heads[h->next].before) = i;
    q->queued++;
}

static inline void xm_remove(struct xm_queue *q, uint32_t i)
{
    struct xm_head *heads = xm_heads(q), *h = heads + i;
    *(h->before == XM_END ? &q->first : &heads[h->before].next) = h->next;
    PBONET_STEP(62);
    *(h->next == XM_END ? &q->last : &heads[h->next].before) = h->before;
    q->queued--;
}

/* The last block of a chain of `n`, or XM_END if a link is invalid. */
static inline uint32_t xm_chain_end(const struct xm_queue *q, uint32_t first, uint32_t n)
{
    const uint32_t *links = xm_links(q);
    for (; first < q->blocks && n > 1; n--)
        first = links[first];
    return first < q->blocks ? first : XM_END;
}

/* Take a header and blocks for a message of `size` bytes; the caller has checked that they
 * are free. Returns the header's index, or XM_END in a damaged queue. */
static inline uint32_t xm_alloc(struct xm_queue *q, uint32_t me, uint32_t size,
                                int32_t priority)
{
    uint32_t i = q->free_head, n = xm_need(q, size), last = XM_END;
    struct xm_head *h = xm_heads(q) + i;
    if (i >= q->heads || (n && (last = xm_chain_end(q, q->free_block, n)) == XM_END))
        return XM_END;
    h->size = size;
    h->priority = priority;
    h->first = q->free_block;
    atomic_store(&h->member, me);
    PBONET_STEP(63);
    q->free_head = h->next;
    q->n_heads--;
    PBONET_STEP(64);
    if (n)
        q->free_block = xm_links(q)[last];
    q->n_blocks -= n;
    PBONET_STEP(65);
    atomic_store(&h->state, XM_WRITING);
    PBONET_STEP(66);
    return i;
}

static inline int xm_free(struct xm_queue *q, uint32_t i)
{
    struct xm_head *h = xm_heads(q) + i;
    uint32_t n = xm_need(q, h->size), last = n ? xm_chain_end(q, h->first, n) : 0;
    if (last == XM_END)
        return XM_DAMAGED;
    PBONET_STEP(67);
    atomic_store(&h->state, XM_UNUSED);
    PBONET_STEP(68);
    if (n) {
        xm_links(q)[last] = q->free_block;
        PBONET_STEP(69);
        q->free_block = h->first;
    }
    q->n_blocks += n;
    PBONET_STEP(70);
    h->next = q->free_head;
    q->free_head = i;
    q->n_heads++;
    return 0;
}

/* Mark the blocks of a header as used; false if its chain is invalid. */
static inline bool xm_mark(const struct xm_queue *q, const struct xm_head *h, uint8_t *marks)
{
    uint32_t at = h->first, n = xm_need(q, h->size);
    if (n > q->blocks)
        return false;
    for (; n; n--, at = xm_links(q)[at]) {
        if (at >= q->blocks || marks[at])
            return false;
        marks[at] = 1;
    }
    return true;
}

/* Rebuild all lists from the headers' states, without those whose member has ended. */
static inline int xm_rebuild(struct xm_queue *q)
{
    struct xm_head *heads = xm_heads(q);
    uint8_t *marks = (uint8_t *)q + q->marks_at;
    q->first = q->last = q->free_head = q->free_block = XM_END;
    q->n_heads = q->n_blocks = q->queued = 0;
    memset(marks, 0, q->blocks);
    PBONET_STEP(71);
    for (uint32_t i = q->heads; i-- > 0;) {
        uint32_t state = atomic_load(&heads[i].state);
        if (state != XM_UNUSED && state != XM_QUEUED && xm_dead(&q->o, atomic_load(&heads[i].member)))
            atomic_store(&heads[i].state, state = XM_UNUSED);
        if (state == XM_UNUSED) {
            heads[i].next = q->free_head;
            q->free_head = i;
            q->n_heads++;
        } else if (!xm_mark(q, heads + i, marks)) {
            return XM_DAMAGED;
        } else if (state == XM_QUEUED) {
            xm_insert(q, i);
        }
        PBONET_STEP(72);
    }
    for (uint32_t i = q->blocks; i-- > 0;) {
        if (marks[i])
            continue;
        xm_links(q)[i] = q->free_block;
        q->free_block = i;
        q->n_blocks++;
    }
    PBONET_STEP(73);
    q->o.hurt = 0;
    return 0;
}

/* Walk the order of service and mark blocks; the number of messages, or XM_END if broken. */
static inline uint32_t xm_check_order(const struct xm_queue *q, uint8_t *marks)
{
    const struct xm_head *heads = xm_heads(q);
    uint32_t n = 0, before = XM_END;
    for (uint32_t i = q->first; i != XM_END; before = i, i = heads[i].next) {
        if (i >= q->heads || n++ >= q->heads || heads[i].before != before ||
            atomic_load(&heads[i].state) != XM_QUEUED || !xm_mark(q, heads + i, marks))
            return XM_END;
    }
    return q->last == before ? n : XM_END;
}

static inline uint32_t xm_check_free(const struct xm_queue *q)
{
    const struct xm_head *heads = xm_heads(q);
    uint32_t n = 0;
    for (uint32_t i = q->free_head; i != XM_END; i = heads[i].next)
        if (i >= q->heads || n++ >= q->heads || atomic_load(&heads[i].state) != XM_UNUSED)
            return XM_END;
    return n;
}

/* Whether lists, states and chains are consistent; under the lock, when attaching. */
static inline bool xm_check(struct xm_queue *q)
{
    const struct xm_head *heads = xm_heads(q);
    uint8_t *marks = (uint8_t *)q + q->marks_at;
    uint32_t in_hand = 0, used = 0;
    memset(marks, 0, q->blocks);
    if (xm_check_order(q, marks) != q->queued || xm_check_free(q) != q->n_heads)
        return false;
    for (uint32_t i = 0; i < q->heads; i++) {
        uint32_t state = atomic_load(&heads[i].state);
        if (state != XM_WRITING && state != XM_READING)
            continue;
        in_hand++;
        if (!xm_mark(q, heads + i, marks))
            return false;
    }
    for (uint32_t i = q->free_block, n = 0; n < q->n_blocks; n++, i = xm_links(q)[i]) {
        if (i >= q->blocks || marks[i])
            return false;
        marks[i] = 1;
    }
    for (uint32_t i = 0; i < q->blocks; i++)
        used += marks[i];
    return used == q->blocks && q->queued + q->n_heads + in_hand == q->heads;
}

/* Make a queue in fresh zeroed memory that was laid out as `plan`. */
static inline int xm_queue_make(struct xm_queue *q, const struct xm_queue *plan)
{
    *q = *plan;
    int error = xm_make(&q->o, XM_QUEUE, q->data_at + (uint64_t)q->blocks * q->block);
    return error ? error : xm_rebuild(q);
}

static inline int xm_queue_verify(const struct xm_queue *q, uint64_t bytes)
{
    struct xm_queue plan = {.policy = 0};
    int verdict = bytes < sizeof *q ? XM_DAMAGED : xm_verify(&q->o, XM_QUEUE, bytes);
    if (verdict)
        return verdict;
    uint64_t size = xm_lay_out(&plan, q->heads, q->blocks, q->block);
    return size == bytes && q->block && q->heads && q->policy <= XM_HPF &&
           plan.heads_at == q->heads_at && plan.links_at == q->links_at &&
           plan.marks_at == q->marks_at && plan.data_at == q->data_at ? 0 : XM_DAMAGED;
}

/* Lock, with the lists in order: 0, XM_STUCK or XM_DAMAGED. */
static inline int xm_queue_lock(struct xm_queue *q)
{
    if (xm_lock(&q->o))
        return XM_STUCK;
    if (!q->o.hurt || !xm_rebuild(q))
        return 0;
    xm_unlock(&q->o);
    return XM_DAMAGED;
}

#endif
