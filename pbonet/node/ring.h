/* A ring of records in shared memory: one producer, one consumer, neither ever waits.
 *
 * `head` and `tail` count bytes since the beginning and only rise. A full ring drops the
 * new record and counts it. A consumer or producer killed anywhere leaves a ring that
 * the next one goes on with: a record exists once `head` has passed it.
 */
#ifndef PBONET_RING_H
#define PBONET_RING_H

#include <stdatomic.h>
#include <stdint.h>
#include <string.h>

#define RING_MAGIC UINT64_C(0x676e69726f6e6270)
enum { RING_VERSION = 1 };
#define RING_STABLE (UINT32_C(1) << 31)

struct ring {
    uint64_t magic;
    uint32_t version, unused;
    uint64_t capacity;                      /* of data, a power of two */
    _Alignas(64) _Atomic uint64_t head;     /* producer */
    _Atomic uint64_t lost;
    _Alignas(64) _Atomic uint64_t tail;     /* consumer */
    _Alignas(64) unsigned char data[];
};

/* What stands before the consumed pairs and the data of one record. */
struct ring_record {
    uint32_t size, n_consumed, bytes, flags;
    uint64_t cycle;
    int64_t release_ns, start_ns, end_ns;
    uint64_t cpu_ns;
};

static inline void ring_init(struct ring *r, uint64_t capacity)
{
    r->version = RING_VERSION;
    r->capacity = capacity;
    /* SYNC POINT: who maps the ring looks at `magic` first. */
    atomic_thread_fence(memory_order_release);
    r->magic = RING_MAGIC;
}

static inline void ring_copy_in(struct ring *r, uint64_t at, const void *from, uint64_t n)
{
    uint64_t place = at & (r->capacity - 1), first = r->capacity - place;
    if (!n || !from)
        return;
    if (first > n)
        first = n;
    memcpy(r->data + place, from, first);
    if (n > first)
        memcpy(r->data, (const char *)from + first, n - first);
}

static inline void ring_copy_out(const struct ring *r, uint64_t at, void *to, uint64_t n)
{
    uint64_t place = at & (r->capacity - 1), first = r->capacity - place;
    if (first > n)
        first = n;
    memcpy(to, r->data + place, first);
    if (n > first)
        memcpy((char *)to + first, r->data, n - first);
}

/* Append a record; 0 when the ring is full. Sets `size`. */
static inline int ring_put(struct ring *r, struct ring_record *record,
                           const uint64_t *consumed, const void *data)
{
    uint64_t pairs = (uint64_t)record->n_consumed * 16;
    uint64_t size = (sizeof *record + pairs + record->bytes + 7) & ~UINT64_C(7);
    uint64_t head = atomic_load_explicit(&r->head, memory_order_relaxed);
    /* SYNC POINT: ring_done stores `tail` once what stood before it is copied. */
    uint64_t tail = atomic_load_explicit(&r->tail, memory_order_acquire);
    if (size > r->capacity - (head - tail)) {
        atomic_store_explicit(&r->lost,
                              atomic_load_explicit(&r->lost, memory_order_relaxed) + 1,
                              memory_order_relaxed);
        return 0;
    }
    record->size = (uint32_t)size;
    ring_copy_in(r, head, record, sizeof *record);
    ring_copy_in(r, head + sizeof *record, consumed, pairs);
    ring_copy_in(r, head + sizeof *record + pairs, data, record->bytes);
    /* SYNC POINT: ring_ready loads `head` before it looks at records. */
    atomic_store_explicit(&r->head, head + size, memory_order_release);
    return 1;
}

/* Bytes of whole records that wait; more than the capacity means a damaged ring. */
static inline uint64_t ring_ready(const struct ring *r)
{
    return atomic_load_explicit(&r->head, memory_order_acquire) -
           atomic_load_explicit(&r->tail, memory_order_relaxed);
}

static inline uint64_t ring_lost(const struct ring *r)
{
    return atomic_load_explicit(&r->lost, memory_order_relaxed);
}

/* Copy `n` waiting bytes out; ring_done gives their place back. */
static inline void ring_look(const struct ring *r, void *to, uint64_t n)
{
    ring_copy_out(r, atomic_load_explicit(&r->tail, memory_order_relaxed), to, n);
}

static inline void ring_done(struct ring *r, uint64_t n)
{
    uint64_t tail = atomic_load_explicit(&r->tail, memory_order_relaxed);
    /* SYNC POINT: ring_put loads `tail` before it overwrites what stood there. */
    atomic_store_explicit(&r->tail, tail + n, memory_order_release);
}

#endif
