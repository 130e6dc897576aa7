/* A triple buffer: the newest whole record, from one writer to one reader (Stewart 1994,
 * section 5.6), in memory that processes share.
 *
 * Everything that the two sides must agree on is in one word: how many records were written,
 * which of three slots holds the newest one, whether the reader has taken that one, and, if
 * not, which slot it took before. So a process that is killed at any point leaves a valid
 * word, and its successor continues from there.
 *
 * The writer fills a slot that is neither the newest nor the reader's, and publishes it by
 * one compare-and-exchange, or by two if the reader took the last record in between; after
 * that the reader cannot change the word again. The reader takes the newest by one atomic
 * or. Neither ever waits for the other; docs/tbuf.md has the argument.
 *
 * Any process of the user can overwrite the file. So each process keeps the size of a record
 * itself, and checks the word before it names a slot, and the number in the slot that it
 * reads.
 */
#ifndef PBONET_TRIPLE_H
#define PBONET_TRIPLE_H

#include <stdatomic.h>
#include <stdbool.h>
#include <stddef.h>
#include <stdint.h>
#include <string.h>

#ifndef PBONET_STEP /* a test build inserts a hook between any two steps of a change */
#define PBONET_STEP(n) ((void)0)
#endif

#define TB_MAGIC UINT64_C(0x6662745f74656e62) /* differs in another byte order */
enum { TB_VERSION = 1, TB_SLOTS = 3, TB_ALIGN = 64, TB_TEXT = 3072, TB_WHO = 64 };
enum { TB_WRITER, TB_READER, TB_CARER, TB_ROLES };
enum { TB_DAMAGED = -1, TB_BAD_VERSION = -2, TB_SWAPPED = -3, TB_TIMED_OUT = -4,
       TB_SIGNAL = -5 };
#define TB_TAKEN UINT64_C(0x10)

/* The line before a record's data. */
struct tb_stamp {
    uint64_t number;  /* counter: the first record of a source is 1 */
    uint64_t source;  /* identifies the counter */
    int64_t time_ns;  /* when it was written, by CLOCK_MONOTONIC of this machine */
    int64_t stamp_ns; /* the same by the clock of the writer's machine */
};

struct tb_role {
    _Atomic uint64_t pid; /* for error messages only: locks on the file show the users */
    char who[TB_WHO];
};

struct tb_buffer {
    uint64_t magic;
    uint32_t version, text_bytes;
    uint64_t size, bytes, source; /* of the file, of a record, of its own counter */
    char text[TB_TEXT];           /* layout of a record */
    struct tb_role roles[TB_ROLES];
    _Atomic uint32_t destroyed;
    _Alignas(TB_ALIGN) _Atomic uint64_t word; /* number << 8 | TAKEN | before << 2 | newest */
    _Atomic int64_t last_ns;                  /* time of the newest record, for monitors */
    _Alignas(TB_ALIGN) _Atomic uint32_t bell; /* the reader sleeps on it */
    _Alignas(TB_ALIGN) uint8_t slots[];
};

static inline uint64_t tb_stride(uint64_t bytes) {
    return TB_ALIGN + (bytes + TB_ALIGN - 1) / TB_ALIGN * TB_ALIGN;
}

static inline uint64_t tb_size(uint64_t bytes) {
    return sizeof(struct tb_buffer) + TB_SLOTS * tb_stride(bytes);
}

/* Fill fresh zeroed memory; `text` has at most TB_TEXT bytes. */
static inline void tb_make(struct tb_buffer *b, uint64_t bytes, uint64_t source,
                           const char *text, uint32_t text_bytes) {
    b->version = TB_VERSION;
    b->size = tb_size(bytes);
    b->bytes = bytes;
    b->source = source;
    b->text_bytes = text_bytes;
    memcpy(b->text, text, text_bytes);
    atomic_store(&b->word, TB_TAKEN | 1 << 2); /* no record yet, so none is new */
    b->magic = TB_MAGIC;
}

/* Whether a word names two different slots, and has no other bits than a writer and a reader
 * set. Zero is not valid. */
static inline bool tb_valid(uint64_t word) {
    unsigned newest = word & 3, before = word >> 2 & 3;
    return newest < TB_SLOTS && before < TB_SLOTS && newest != before && !(word & 0xe0);
}

/* Check a mapped file; 0, or why it cannot be used. */
static inline int tb_verify(const struct tb_buffer *b, uint64_t bytes) {
    if (bytes < sizeof *b) return TB_DAMAGED;
    if (b->magic == __builtin_bswap64(TB_MAGIC)) return TB_SWAPPED;
    if (b->magic != TB_MAGIC) return TB_DAMAGED;
    if (b->version != TB_VERSION) return TB_BAD_VERSION;
    bool sound = b->bytes <= bytes && b->size == bytes && tb_size(b->bytes) == bytes &&
                 b->text_bytes <= TB_TEXT && tb_valid(atomic_load(&b->word));
    return sound ? 0 : TB_DAMAGED;
}

static inline uint64_t tb_number(uint64_t word) { return word >> 8; }
static inline unsigned tb_newest(uint64_t word) { return word & 3; }

/* The slot that the reader may be copying from. */
static inline unsigned tb_held(uint64_t word) {
    return word & TB_TAKEN ? tb_newest(word) : word >> 2 & 3;
}

static inline struct tb_stamp *tb_slot(struct tb_buffer *b, uint64_t bytes, unsigned slot) {
    return (struct tb_stamp *)(b->slots + slot * tb_stride(bytes));
}

/* A slot that is neither the newest nor the reader's; it stays so until we publish. */
static inline unsigned tb_spare(uint64_t word) {
    unsigned newest = tb_newest(word), held = tb_held(word);
    return newest == held ? (newest + 1) % TB_SLOTS : TB_SLOTS - newest - held;
}

/* Write a record of `bytes`: 1 when a sleeping reader must be woken (tb_wake), 0 when not, or
 * TB_DAMAGED. */
static inline int tb_write(struct tb_buffer *b, uint64_t bytes, const struct tb_stamp *stamp,
                           const void *data) {
    /* SYNC POINT T1, partner T2: acquire, so that the reader's copy from this slot, which it
     * has left, comes before our writes to it. */
    uint64_t next, word = atomic_load_explicit(&b->word, memory_order_acquire);
    unsigned slot;
    struct tb_stamp *to;
    if (!tb_valid(word)) return TB_DAMAGED;
    slot = tb_spare(word);
    to = tb_slot(b, bytes, slot);
    PBONET_STEP(1);
    *to = *stamp;
    PBONET_STEP(2);
    memcpy((uint8_t *)to + TB_ALIGN, data, bytes);
    PBONET_STEP(3);
    do {
        next = stamp->number << 8 | (uint64_t)tb_held(word) << 2 | slot;
    /* SYNC POINT T2, partners T1 and T3: a reader of this word sees the whole record; seq_cst
     * is for T4. */
    } while (!atomic_compare_exchange_strong(&b->word, &word, next));
    PBONET_STEP(4);
    /* SYNC POINT T5, no partner: monitors need only an approximate time. */
    atomic_store_explicit(&b->last_ns, stamp->time_ns, memory_order_relaxed);
    /* SYNC POINT T4, partner in tb_doze: either we see the bell, or the reader our word. */
    return atomic_load(&b->bell) && atomic_exchange(&b->bell, 0);
}

/* Whether there is a record that the reader has not taken. */
static inline bool tb_news(const struct tb_buffer *b) {
    /* SYNC POINT T4, partner in tb_write. */
    return !(atomic_load(&b->word) & TB_TAKEN);
}

/* Copy the newest record of `bytes`: 1, or 0 if it was taken before and not `again`, or if
 * none was ever written, or TB_DAMAGED. The writer does not change the copied slot until the
 * next call. */
static inline int tb_read(struct tb_buffer *b, uint64_t bytes, struct tb_stamp *stamp,
                          void *data, bool again) {
    const struct tb_stamp *from;
    struct tb_stamp found;
    /* SYNC POINT T3, partner T2. */
    uint64_t word = atomic_load_explicit(&b->word, memory_order_acquire);
    if (!tb_valid(word)) return TB_DAMAGED; /* before it is changed */
    if (word & TB_TAKEN) {
        if (!again || !tb_number(word)) return 0;
    } else {
        PBONET_STEP(5);
        /* SYNC POINT T3 again, and T2 towards the writer: our copy from the slot that we held
         * before is complete. */
        word = atomic_fetch_or(&b->word, TB_TAKEN);
        PBONET_STEP(6);
    }
    if (!tb_valid(word)) return TB_DAMAGED;
    from = tb_slot(b, bytes, tb_newest(word));
    found = *from;
    if ((found.number ^ tb_number(word)) << 8) return TB_DAMAGED;
    *stamp = found;
    PBONET_STEP(7);
    memcpy(data, (const uint8_t *)from + TB_ALIGN, bytes);
    PBONET_STEP(8);
    return 1;
}

#endif
