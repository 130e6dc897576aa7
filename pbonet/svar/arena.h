/* The file of a table: its layout.
 *
 *   static part   struct pb_static, struct pb_var[n_vars], text (the variables' records);
 *                 covered by a checksum, never changed after the table is made
 *   mutable part  struct pb_live, struct pb_reg[n_regs], the directory's four slots,
 *                 and the arena, from which registers take their slots
 *
 * The directory is itself a register (register.h): one entry per variable names the
 * register that holds its newest value, and says whether a task owns it now. The number of
 * its newest commit is the table's generation.
 *
 * Any process of the user can overwrite the file. So each process copies the static part
 * when it attaches, and uses only that copy; what it reads of the mutable part is checked
 * before it becomes an index or an address (sound.h).
 */
#ifndef PBONET_ARENA_H
#define PBONET_ARENA_H

#ifndef _GNU_SOURCE
#define _GNU_SOURCE 1 /* robust locks, under -std=c11 */
#endif
#include <pthread.h>

#include "register.h"

#define PB_MAGIC "pbSVAR\r\n"

enum { PB_VERSION = 5, PB_CAUSES = 128, PB_CAUSES_EACH = 64, PB_NAME = 64, PB_TEXT = 128, PB_KEEPER = 0 };

struct pb_static {
    char magic[8];
    uint32_t version, abi; /* abi: size of what the C library puts into pb_live */
    uint32_t n_vars, n_regs;
    uint64_t size, checksum;
    uint8_t layout[16];
    uint64_t vars, text, text_bytes, live, regs, dir, dir_stride, arena;
    uint64_t keep_bytes, keep_stamps; /* the keeper's group, and the place of its stamps */
};

/* One variable; the keeper's group holds all of them, in order of their index. */
struct pb_var {
    uint64_t bytes; /* rounded up to words of 8 bytes */
    uint64_t keep;  /* place in the keeper's group */
    int64_t maxage_ns;
};

/* One reason why the configuration is illegal now (thesis, section 3.10). */
struct pb_cause {
    int64_t time_ns;
    char cause[PB_TEXT], raiser[PB_NAME], machine[PB_NAME];
};

struct pb_live {
    _Alignas(PB_LINE) _Atomic uint64_t generation; /* head of the directory */
    _Atomic uint64_t changes;  /* incremented by every change of the flag, and by every end */
    _Atomic uint64_t unlisted; /* number of entries that did not fit */
    /* Taken by claimers only. A C library may end a process that locks arbitrary bytes, so
     * a claimer checks first that the words around the lock are PB_GUARD. */
    _Alignas(PB_LINE) uint64_t before;
    pthread_mutex_t lock;
    uint64_t after, uids;
    _Atomic uint64_t words[PB_CAUSES]; /* of the flag's entries: phase and process */
    struct pb_cause causes[PB_CAUSES];
};

/* PB_ENDED: its task has ended and owns its variables until a successor takes them;
 * PB_LEFT: no writer; its values may still be read. */
enum { PB_FREE, PB_HELD, PB_ENDED, PB_LEFT };

/* A register's description. `head` has a cache line of its own: every commit writes it. */
struct pb_reg {
    _Alignas(PB_LINE) _Atomic uint64_t head;
    _Alignas(PB_LINE) _Atomic uint64_t state;
    _Atomic uint64_t slots, stride, uid;
    _Atomic uint64_t crowd; /* readers are slow: use all four slots up to this commit */
    uint64_t bytes, owner, pid, start, space; /* space: the PID namespace */
    char task[PB_NAME];
};

/* One variable's entry in the directory. */
struct pb_entry {
    uint32_t reg;
    uint32_t live; /* a task owns it now */
    uint64_t at;   /* place in the register's group */
    uint64_t sum;  /* of the above, the variable, and the register's place: pb_sum */
};

/* Where a register's slots are. It does not change while a directory names the register. */
struct pb_place {
    uint64_t slots, stride, uid;
};

#define PB_GUARD UINT64_C(0x70625356415221a5)

/* Differs between C libraries, and between machines whose locks differ in size. */
#define PB_ABI (uint32_t)(sizeof(struct pb_live) + sizeof(pthread_mutex_t))

/* A table as a process uses it: the static part is its own copy. */
struct pb_table {
    uint8_t *base;
    const struct pb_static *fixed;
    const struct pb_var *vars;
    struct pb_live *live;
    struct pb_reg *regs;
};

/* Compute the layout of a table with these variables, including `keep` of each. `spare` is
 * how many more copies of the whole table fit into the arena besides the keeper's. */
static inline void pb_lay_out(struct pb_static *s, struct pb_var *vars, uint64_t spare) {
    uint64_t at = 0, least;
    for (uint32_t i = 0; i < s->n_vars; i++) {
        vars[i].keep = at;
        at += vars[i].bytes;
    }
    s->keep_stamps = at;
    s->keep_bytes = at + s->n_vars * sizeof(struct pb_stamp);
    s->n_regs = 64 + 2 * s->n_vars;
    s->vars = pb_round(sizeof *s, PB_LINE);
    s->text = s->vars + s->n_vars * sizeof *vars;
    s->live = pb_round(s->text + s->text_bytes, PB_LINE);
    s->regs = s->live + pb_round(sizeof(struct pb_live), PB_LINE);
    s->dir = s->regs + s->n_regs * sizeof(struct pb_reg);
    s->dir_stride = pb_stride(s->n_vars * sizeof(struct pb_entry));
    s->arena = s->dir + PB_SLOTS * s->dir_stride;
    least = s->n_regs * pb_stride(PB_LINE); /* many small groups must fit as well */
    s->size = pb_round(s->arena + PB_SLOTS * (pb_stride(s->keep_bytes) + least +
                                              spare * pb_stride(s->keep_stamps)), 4096);
}

/* A table mapped at `base`, with a verified static part at `fixed`. */
static inline struct pb_table pb_table_at(void *base, const void *fixed) {
    const struct pb_static *s = fixed;
    uint8_t *b = base;
    return (struct pb_table){b, s, (const struct pb_var *)((const uint8_t *)fixed + s->vars),
                             (struct pb_live *)(b + s->live), (struct pb_reg *)(b + s->regs)};
}

/* The directory of a given head. A caller without the lock must check the head again. */
static inline struct pb_entry *pb_directory(const struct pb_table *t, uint64_t head) {
    return (struct pb_entry *)(pb_slot(t->base + t->fixed->dir, t->fixed->dir_stride, head) +
                               PB_LINE);
}

/* FNV-1a over the static part, with the checksum field counted as zero. */
static inline uint64_t pb_checksum(const uint8_t *base, uint64_t bytes) {
    uint64_t sum = 0xcbf29ce484222325u;
    const uint64_t at = offsetof(struct pb_static, checksum);
    for (uint64_t i = 0; i < bytes; i++) {
        sum ^= i - at < sizeof(uint64_t) ? 0 : base[i];
        sum *= 0x100000001b3u;
    }
    return sum;
}

#endif
