/* The illegal-configuration flag (thesis, section 3.10): a set of entries (cause, raiser,
 * machine); the flag is up while there is any entry. Raising and clearing never wait, not
 * even for the claimers' lock: a dispatcher does both during its turn.
 *
 * An entry's word holds its phase (idle, being filled, up) and its process. A process
 * takes an idle entry by compare-and-swap, fills it, and publishes it by one store. Killed
 * at any point it leaves the entry up or absent; an entry that it was filling is reused by
 * the next process that needs one. An entry is cleared by the process that raised it, or by
 * any process once that one is dead. `changes` is incremented by every change, so that
 * a check is one load as long as nothing has changed. */
#ifndef PBONET_FLAG_H
#define PBONET_FLAG_H

#include "cut.h"
#include "owner.h"

enum { PB_IDLE, PB_FILLING, PB_UP, PB_PHASE = 3 };

/* The result of the last check of the flag. */
struct pb_seen {
    uint64_t changes; /* 0: never checked */
    bool up;
};

/* A process as an entry's word names it: start time, process id, PID namespace. */
static inline uint64_t pb_identity(uint64_t pid, uint64_t start, uint64_t space) {
    return start << 32 | (pid & 0x3fffff) << 10 | (space & 0xff) << 2;
}

static inline uint64_t pb_own_identity(void) {
    const uint64_t pid = (uint64_t)getpid();
    return pb_identity(pid, pb_process_start(pid), pb_process_space());
}

/* Whether the process of an entry's word is alive; true if that cannot be determined. */
static inline bool pb_raiser_lives(uint64_t word) {
    const uint64_t pid = word >> 10 & 0x3fffff, then = word >> 32;
    uint64_t now;
    if ((word >> 2 & 0xff) != (pb_process_space() & 0xff)) return true;
    now = pb_process_start(pid);
    return now && (now == PB_UNKNOWN || then == UINT32_MAX || (uint32_t)now == then);
}

static inline uint64_t pb_cause_word(const struct pb_table *t, uint32_t i) {
    /* SYNC POINT F1, partner F2: a reader that sees an entry up sees its texts. */
    return atomic_load_explicit(t->live->words + i, memory_order_acquire);
}

static inline void pb_changed(const struct pb_table *t) {
    /* SYNC POINT F3, partner F4: a reader of the number sees the change before it. */
    atomic_fetch_add_explicit(&t->live->changes, 1, memory_order_release);
}

/* The number of changes, for callers that read the entries after it. */
static inline uint64_t pb_changes(const struct pb_table *t) {
    return atomic_load_explicit(&t->live->changes, memory_order_acquire); /* SYNC POINT F4 */
}

/* Whether the flag is up; one load while nothing has changed since the last check. */
static inline bool pb_illegal(const struct pb_table *t, struct pb_seen *seen) {
    /* SYNC POINT F4, partner F3: a change after this load increments the number again. */
    const uint64_t changes = atomic_load_explicit(&t->live->changes, memory_order_acquire);
    if (changes == seen->changes) return seen->up;
    seen->changes = changes;
    seen->up = false;
    for (uint32_t i = 0; i < PB_CAUSES && !seen->up; i++)
        seen->up = (pb_cause_word(t, i) & PB_PHASE) == PB_UP;
    return seen->up;
}

/* Copy an entry that was seen up; false when it has been removed meanwhile. */
static inline bool pb_cause_at(const struct pb_table *t, uint32_t i, uint64_t word,
                               uint64_t changes, struct pb_cause *copy) {
    pb_copy(copy, t->live->causes + i, sizeof *copy);
    copy->cause[PB_TEXT - 1] = copy->raiser[PB_NAME - 1] = copy->machine[PB_NAME - 1] = 0;
    /* SYNC POINT F5, partner F6: bytes of a later entry imply a changed number. */
    pb_read_fence();
    return atomic_load_explicit(t->live->words + i, memory_order_relaxed) == word &&
           atomic_load_explicit(&t->live->changes, memory_order_relaxed) == changes;
}

/* Copy all entries as one consistent set; returns how many, or PB_STUCK when they changed
 * in every attempt. `copies` has room for PB_CAUSES. */
static inline int pb_causes(const struct pb_table *t, struct pb_cause *copies) {
    for (int tries = 0; tries < PB_TRIES_WHOLE; tries++) {
        const uint64_t changes =
            atomic_load_explicit(&t->live->changes, memory_order_acquire); /* SYNC POINT F4 */
        int n = 0;
        uint32_t i = 0;
        for (; i < PB_CAUSES; i++) {
            const uint64_t word = pb_cause_word(t, i);
            if ((word & PB_PHASE) == PB_UP && !pb_cause_at(t, i, word, changes, copies + n++))
                break;
        }
        if (i == PB_CAUSES) return n;
    }
    return PB_STUCK;
}

static inline bool pb_text_is(const char *text, const char *wanted, size_t size) {
    return !*wanted || !strncmp(text, wanted, size);
}

/* Whether entry `i` is up under `word` and matches `which`; an empty text matches any. */
static inline bool pb_cause_is(const struct pb_table *t, uint32_t i, uint64_t word,
                               const struct pb_cause *which) {
    struct pb_cause c;
    if ((word & PB_PHASE) != PB_UP) return false;
    pb_copy(&c, t->live->causes + i, sizeof c);
    return pb_text_is(c.raiser, which->raiser, PB_NAME) &&
           pb_text_is(c.machine, which->machine, PB_NAME) &&
           pb_text_is(c.cause, which->cause, PB_TEXT);
}

/* Fill entry `i`, which is idle under `word` or was left half-filled by a dead process. */
static inline bool pb_fill_cause(const struct pb_table *t, uint32_t i, uint64_t word,
                                 uint64_t me, const struct pb_cause *cause) {
    _Atomic uint64_t *at = t->live->words + i;
    uint64_t filling = me | PB_FILLING;
    if (!atomic_compare_exchange_strong(at, &word, filling)) return false;
    PBONET_STEP(30);
    pb_changed(t);
    /* SYNC POINT F6, partner F5: a reader of a byte written below sees the new number. */
    atomic_thread_fence(memory_order_release);
    pb_copy_out(t->live->causes + i, cause, sizeof *cause);
    PBONET_STEP(31);
    /* SYNC POINT F2, partner F1. */
    if (!atomic_compare_exchange_strong(at, &filling, me | PB_UP)) return false;
    PBONET_STEP(32);
    pb_changed(t);
    return true;
}

/* Add an entry; adding it again changes nothing. PB_FULL, counted, when there is no room or
 * this process has raised PB_CAUSES_EACH already: no process can use up all entries. */
static inline int pb_raise(const struct pb_table *t, const struct pb_cause *cause) {
    const uint64_t me = pb_own_identity();
    uint32_t mine = 0;
    for (uint32_t i = 0; i < PB_CAUSES; i++) {
        const uint64_t word = pb_cause_word(t, i);
        if ((word & ~(uint64_t)PB_PHASE) != me) continue;
        if (pb_cause_is(t, i, word, cause)) return 0;
        mine += (word & PB_PHASE) != PB_IDLE;
    }
    for (uint32_t i = 0; i < PB_CAUSES && mine < PB_CAUSES_EACH; i++) {
        const uint64_t word = pb_cause_word(t, i);
        const bool left = (word & PB_PHASE) == PB_FILLING && !pb_raiser_lives(word);
        if (((word & PB_PHASE) == PB_IDLE || left) && pb_fill_cause(t, i, word, me, cause))
            return 0;
    }
    atomic_fetch_add_explicit(&t->live->unlisted, 1, memory_order_relaxed);
    return PB_FULL;
}

/* Remove an entry. */
static inline bool pb_drop_cause(const struct pb_table *t, uint32_t i, uint64_t word) {
    bool gone;
    PBONET_STEP(34);
    gone = atomic_compare_exchange_strong(t->live->words + i, &word, PB_IDLE);
    PBONET_STEP(33);
    return gone;
}

/* Remove what `raiser` raised on `machine`, all of it or only one cause; an empty text
 * matches any. Returns how many entries were removed; PB_ALIVE when there are some, and all
 * of them belong to other live processes. */
static inline int pb_clear(const struct pb_table *t, const struct pb_cause *which) {
    const uint64_t me = pb_own_identity();
    int count = 0;
    bool others = false;
    for (uint32_t i = 0; i < PB_CAUSES; i++) {
        const uint64_t word = pb_cause_word(t, i);
        if (!pb_cause_is(t, i, word, which)) continue;
        if ((word & ~(uint64_t)PB_PHASE) != me && pb_raiser_lives(word))
            others = true;
        else
            count += pb_drop_cause(t, i, word);
    }
    pb_changed(t); /* also for a process that died between its change and this call */
    PBONET_STEP(35);
    return !count && others ? PB_ALIVE : count;
}

/* Free what a dead process holds: the variables of register `r`, and its entries of the
 * flag. Returns 0 or a negative code. */
static inline int pb_reap(const struct pb_table *t, uint32_t r, uint64_t uid) {
    struct pb_reg who;
    uint64_t dead;
    int code;
    pb_copy(&who, t->regs + r, sizeof who);
    code = pb_let_go(t, r, uid, true, true);
    if (code || atomic_load_explicit(&who.uid, memory_order_relaxed) != uid) return code;
    dead = pb_identity(who.pid, who.start, who.space);
    for (uint32_t i = 0; i < PB_CAUSES; i++) {
        const uint64_t word = pb_cause_word(t, i);
        if ((word & ~(uint64_t)PB_PHASE) == dead && !pb_raiser_lives(word))
            pb_drop_cause(t, i, word);
    }
    pb_changed(t);
    return 0;
}

static inline struct pb_cause pb_cause_of(const char *cause, const char *raiser,
                                          const char *machine) {
    struct pb_cause c = {.time_ns = pb_now()};
    snprintf(c.cause, sizeof c.cause, "%s", cause);
    snprintf(c.raiser, sizeof c.raiser, "%s", raiser);
    snprintf(c.machine, sizeof c.machine, "%s", machine);
    return c;
}

#endif
