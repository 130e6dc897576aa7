/* A ring of records in shared memory: one producer, one consumer, neither ever waits.
 *
 * `head` and `tail` count bytes since the beginning and only increase. A full ring drops
 * the new record and counts it. A consumer or producer killed at any point leaves a ring
 * that the next one can continue: a record exists once `head` has passed it.
 */
#ifndef PBONET_RING_H
#define PBONET_RING_H

#include <stdatomic.h>
#include <stdint.h>
#include <string.h>

#define RING_MAGIC UINT64_C(0x676e69726f6e6270)
enum { RING_VERSION = 3 };
enum { RING_WANT_NEW = 1, RING_WANT_ALL = 2 };  /* inputs: of the next record, of all */
enum { RING_SYNC = 9 };                         /* a kind: pbonet.log.Step.SYNC */
/* What ran in place of `cycle`: `stable`; nothing; the safe values were written. */
#define RING_STABLE (UINT32_C(1) << 31)
#define RING_HELD (UINT32_C(1) << 30)
#define RING_SAFE (UINT32_C(1) << 29)

/* The text `about` follows the data: it describes the ring to the process that drains it. */
struct ring_file {
    uint64_t magic;
    uint32_t version, about;                /* about: bytes of that text */
    uint64_t capacity;                      /* of data, a power of two */
    _Alignas(64) _Atomic uint64_t head;     /* producer */
    _Atomic uint64_t lost;
    _Alignas(64) _Atomic uint64_t tail;     /* consumer */
    _Atomic uint32_t want;                  /* RING_WANT_*: inputs requested by it */
    _Alignas(64) unsigned char data[];
};

/* A ring as a process uses it. The capacity is its own: the file may be overwritten by any
 * process of the user, and no place in it may then be outside the mapping. */
struct ring {
    struct ring_file *file;
    uint64_t capacity;
};

/* The head of a record; the data, the consumed pairs, the inputs and the input from outside
 * follow it. From `cycle` on it is written to a log unchanged (pbonet.log.schema). */
struct ring_record {
    uint32_t size, n_consumed, bytes, in_bytes, heard_bytes, spare;
    uint64_t cycle;
    int64_t release_ns, start_ns, end_ns, dt_ns;
    uint64_t cpu_ns;
    uint64_t uid, number;                   /* register and number of the commit */
    uint64_t lost;                          /* records lost before this one */
    uint32_t flags, kind;
};

static inline void ring_init(struct ring *r, uint64_t capacity, uint32_t about)
{
    r->capacity = capacity;
    r->file->version = RING_VERSION;
    r->file->about = about;
    r->file->capacity = capacity;
    /* SYNC POINT: a process that maps the ring reads `magic` first. */
    atomic_thread_fence(memory_order_release);
    r->file->magic = RING_MAGIC;
}

/* Use a file that another process made; 0 when its `bytes` are not a ring's. */
static inline int ring_use(struct ring *r, uint64_t bytes)
{
    const struct ring_file *file = r->file;
    if (bytes <= sizeof *file || file->magic != RING_MAGIC || file->version != RING_VERSION)
        return 0;
    r->capacity = file->capacity;
    return r->capacity && !(r->capacity & (r->capacity - 1)) &&
           r->capacity <= bytes - sizeof *file &&
           file->about == bytes - sizeof *file - r->capacity;
}

static inline void ring_copy_in(struct ring *r, uint64_t at, const void *from, uint64_t n)
{
    uint64_t place = at & (r->capacity - 1), first = r->capacity - place;
    if (!n || !from)
        return;
    if (first > n)
        first = n;
    memcpy(r->file->data + place, from, first);
    if (n > first)
        memcpy(r->file->data, (const char *)from + first, n - first);
}

static inline void ring_copy_out(const struct ring *r, uint64_t at, void *to, uint64_t n)
{
    uint64_t place = at & (r->capacity - 1), first = r->capacity - place;
    if (first > n)
        first = n;
    memcpy(to, r->file->data + place, first);
    if (n > first)
        memcpy((char *)to + first, r->file->data, n - first);
}

static inline uint64_t ring_size(const struct ring_record *record)
{
    return (sizeof *record + record->bytes + (uint64_t)record->n_consumed * 16 +
            record->in_bytes + record->heard_bytes + 7) & ~UINT64_C(7);
}

/* Whether there is room for a record; its size is known before it is filled. */
static inline int ring_fits(const struct ring *r, const struct ring_record *record)
{
    uint64_t head = atomic_load_explicit(&r->file->head, memory_order_relaxed);
    /* SYNC POINT: ring_done stores `tail` after the records before it have been copied. */
    uint64_t tail = atomic_load_explicit(&r->file->tail, memory_order_acquire);
    const uint64_t used = head - tail; /* more than the capacity: it was overwritten */
    return used <= r->capacity && ring_size(record) <= r->capacity - used;
}

static inline uint32_t ring_wants(const struct ring *r)
{
    return atomic_load_explicit(&r->file->want, memory_order_relaxed);
}

static inline void ring_want(struct ring *r, uint32_t bits)
{
    atomic_fetch_or_explicit(&r->file->want, bits, memory_order_relaxed);
}

static inline void ring_wanted(struct ring *r)
{
    atomic_fetch_and_explicit(&r->file->want, ~(uint32_t)RING_WANT_NEW, memory_order_relaxed);
}

/* Write inputs to their place in the next record, `at` bytes into its inputs. The caller
 * has checked that the record fits; the consumer sees nothing of it before ring_put. */
static inline void ring_stage(struct ring *r, const struct ring_record *record, uint64_t at,
                              const void *from, uint64_t n)
{
    uint64_t head = atomic_load_explicit(&r->file->head, memory_order_relaxed);
    ring_copy_in(r, head + sizeof *record + record->bytes +
                 (uint64_t)record->n_consumed * 16 + at, from, n);
}

/* Append a record; 0 when the ring is full. Sets `size` and `lost`; the inputs have been
 * staged. */
static inline int ring_put(struct ring *r, struct ring_record *record,
                           const uint64_t *consumed, const void *data,
                           const void *heard)
{
    uint64_t head = atomic_load_explicit(&r->file->head, memory_order_relaxed);
    uint64_t lost = atomic_load_explicit(&r->file->lost, memory_order_relaxed);
    if (!ring_fits(r, record)) {
        atomic_store_explicit(&r->file->lost, lost + 1, memory_order_relaxed);
        return 0;
    }
    record->size = (uint32_t)ring_size(record);
    record->lost = lost;
    ring_copy_in(r, head, record, sizeof *record);
    ring_copy_in(r, head + sizeof *record, data, record->bytes);
    ring_copy_in(r, head + sizeof *record + record->bytes, consumed,
                 (uint64_t)record->n_consumed * 16);
    ring_copy_in(r, head + sizeof *record + record->bytes +
                 (uint64_t)record->n_consumed * 16 + record->in_bytes, heard,
                 record->heard_bytes);
    /* SYNC POINT: ring_ready loads `head` before it reads records. */
    atomic_store_explicit(&r->file->head, head + record->size, memory_order_release);
    return 1;
}

/* Bytes of complete waiting records; more than the capacity means a damaged ring. */
static inline uint64_t ring_ready(const struct ring *r)
{
    return atomic_load_explicit(&r->file->head, memory_order_acquire) -
           atomic_load_explicit(&r->file->tail, memory_order_relaxed);
}

static inline uint64_t ring_lost(const struct ring *r)
{
    return atomic_load_explicit(&r->file->lost, memory_order_relaxed);
}

/* Copy `n` waiting bytes out; ring_done frees their space. */
static inline void ring_look(const struct ring *r, void *to, uint64_t n)
{
    ring_copy_out(r, atomic_load_explicit(&r->file->tail, memory_order_relaxed), to, n);
}

static inline void ring_done(struct ring *r, uint64_t n)
{
    uint64_t tail = atomic_load_explicit(&r->file->tail, memory_order_relaxed);
    /* SYNC POINT: ring_put loads `tail` before it overwrites these bytes. */
    atomic_store_explicit(&r->file->tail, tail + n, memory_order_release);
}

#endif
