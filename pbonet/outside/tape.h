/* What a module has read from outside since its last record: a buffer of fixed size,
 * one thread.
 *
 * Each entry names its source and the number of the call that it answers; a call without
 * new input leaves no entry. An entry that does not fit is marked as lost, and nothing is
 * kept after it until the tape is emptied.
 */
#ifndef PBONET_TAPE_H
#define PBONET_TAPE_H

#include <stdint.h>
#include <string.h>

enum { TAPE_RAW, TAPE_PACKED, TAPE_TUPLE, TAPE_RAISED, TAPE_BROKEN, TAPE_NAME, TAPE_LOST };

struct tape_entry {
    uint32_t bytes, source;
    uint64_t call : 56, kind : 8;
};

struct tape {
    uint64_t used, room;
    unsigned char *bytes;
    uint32_t lost;
};

static inline uint64_t tape_size(uint64_t bytes)
{
    return (sizeof(struct tape_entry) + bytes + 7) & ~UINT64_C(7);
}

/* Append one entry, whose payload comes in two pieces. */
static inline void tape_put(struct tape *t, struct tape_entry e, const void *first,
                            uint32_t n, const void *second, uint32_t m)
{
    uint64_t size;
    e.bytes = n + m;
    size = tape_size((uint64_t)n + m);
    if (t->lost || t->used + size + sizeof e > t->room) {
        t->lost = 1;
        return;
    }
    memcpy(t->bytes + t->used, &e, sizeof e);
    if (n)
        memcpy(t->bytes + t->used + sizeof e, first, n);
    if (m)
        memcpy(t->bytes + t->used + sizeof e + n, second, m);
    t->used += size;
}

/* Return the bytes to be recorded, with a final entry if something was lost. */
static inline uint64_t tape_ready(struct tape *t)
{
    struct tape_entry e = {.kind = TAPE_LOST};
    if (t->lost == 1 && t->used + sizeof e <= t->room) {
        memcpy(t->bytes + t->used, &e, sizeof e);
        t->used += sizeof e;
        t->lost = 2;
    }
    return t->used;
}

static inline void tape_empty(struct tape *t)
{
    t->used = 0;
    t->lost = 0;
}

#endif
