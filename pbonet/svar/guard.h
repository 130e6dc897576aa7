/* Checks before a group is committed: whether floats are finite, and values within the
 * limits of variables with LIMIT clip or LIMIT error. Works on the private local copy.
 */
#ifndef PBONET_GUARD_H
#define PBONET_GUARD_H

#include <stdbool.h>
#include <stddef.h>
#include <stdint.h>
#include <string.h>

enum pb_type { PB_I1, PB_I2, PB_I4, PB_I8, PB_U1, PB_U2, PB_U4, PB_U8, PB_F4, PB_F8 };
enum pb_rule { PB_FINITE, PB_CLIP, PB_LIMIT };

/* A part of a group under one rule; min and max have n elements of the type. */
struct pb_check {
    uint32_t type, rule, var;
    uint64_t at, n;
    const void *min, *max;
};

/* Compiled twice if the loader can choose by processor; it cannot under a sanitizer. */
#if defined(__x86_64__) && defined(__GLIBC__) && defined(__OPTIMIZE__) && \
    !defined(__SANITIZE_THREAD__) && !defined(__SANITIZE_ADDRESS__) && !defined(__clang__)
#define PB_VECTOR __attribute__((target_clones("avx2", "default")))
#else
#define PB_VECTOR __attribute__((unused))
#endif

/* A float is not finite when all bits of its exponent are set: adding one to the lowest of
 * them then carries into the sign bit. No branches, so that the compiler vectorizes it. */
PB_VECTOR static bool pb_finite_f8(const uint8_t *data, uint64_t n) {
    uint64_t carry = 0, bits;
    for (uint64_t i = 0; i < n; i++) {
        memcpy(&bits, data + 8 * i, sizeof bits);
        carry |= (bits & 0x7ff0000000000000u) + 0x0010000000000000u;
    }
    return !(carry >> 63);
}

PB_VECTOR static bool pb_finite_f4(const uint8_t *data, uint64_t n) {
    uint32_t carry = 0, bits;
    for (uint64_t i = 0; i < n; i++) {
        memcpy(&bits, data + 4 * i, sizeof bits);
        carry |= (bits & 0x7f800000u) + 0x00800000u;
    }
    return !(carry >> 31);
}

/* Copy n floats, and return whether all are finite. Each is loaded once for both; four
 * vectors a turn, so that none waits for the one before it. */
#define PB_DEFINE_COPY_FINITE(name, word, exponent, lowest)                             \
    typedef word pb_##name##s __attribute__((vector_size(32), aligned(sizeof(word)), may_alias)); \
    PB_VECTOR static bool pb_copy_finite_##name(uint8_t *to, const uint8_t *from, uint64_t n) { \
        const pb_##name##s *in = (const pb_##name##s *)(const void *)from;              \
        pb_##name##s *out = (pb_##name##s *)(void *)to, carries[4] = {{0}};             \
        enum { EACH = sizeof *in / sizeof(word) };                                      \
        word carry = 0, bits;                                                           \
        uint64_t i = 0;                                                                 \
        for (; (i + 4) * EACH <= n; i += 4)                                             \
            for (int k = 0; k < 4; k++) {                                               \
                const pb_##name##s x = in[i + k];                                       \
                out[i + k] = x;                                                         \
                carries[k] |= (x & exponent) + lowest;                                  \
            }                                                                           \
        carries[0] |= carries[1] | carries[2] | carries[3];                             \
        for (int k = 0; k < EACH; k++) carry |= carries[0][k];                          \
        for (i *= EACH; i < n; i++) {                                                   \
            memcpy(&bits, from + sizeof bits * i, sizeof bits);                         \
            memcpy(to + sizeof bits * i, &bits, sizeof bits);                           \
            carry |= (bits & exponent) + lowest;                                        \
        }                                                                               \
        return !(carry >> (8 * sizeof carry - 1));                                      \
    }
PB_DEFINE_COPY_FINITE(f8, uint64_t, UINT64_C(0x7ff0000000000000), UINT64_C(0x0010000000000000))
PB_DEFINE_COPY_FINITE(f4, uint32_t, UINT32_C(0x7f800000), UINT32_C(0x00800000))

static inline bool pb_copy_finite(uint8_t *to, const uint8_t *from, uint32_t type, uint64_t n) {
    return type == PB_F8 ? pb_copy_finite_f8(to, from, n) : pb_copy_finite_f4(to, from, n);
}

static inline bool pb_finite(const uint8_t *data, uint32_t type, uint64_t n) {
    return type == PB_F8 ? pb_finite_f8(data, n) : pb_finite_f4(data, n);
}

/* The first of n elements outside its limits, n if there is none; with `clip` they are
 * clipped and counted. NaN is not outside any limit: FINITE checks for it. */
#define PB_DEFINE_LIMIT(name, kind)                                                     \
    static inline uint64_t pb_limit_##name(uint8_t *data, const kind *min, const kind *max, \
                                           uint64_t n, bool clip, uint64_t *clipped) {  \
        kind *x = (kind *)(void *)data;                                                 \
        for (uint64_t i = 0; i < n; i++) {                                              \
            if (!(x[i] < min[i]) && !(x[i] > max[i])) continue;                         \
            if (!clip) return i;                                                        \
            x[i] = x[i] < min[i] ? min[i] : max[i];                                     \
            ++*clipped;                                                                 \
        }                                                                               \
        return n;                                                                       \
    }
PB_DEFINE_LIMIT(i1, int8_t)
PB_DEFINE_LIMIT(i2, int16_t)
PB_DEFINE_LIMIT(i4, int32_t)
PB_DEFINE_LIMIT(i8, int64_t)
PB_DEFINE_LIMIT(u1, uint8_t)
PB_DEFINE_LIMIT(u2, uint16_t)
PB_DEFINE_LIMIT(u4, uint32_t)
PB_DEFINE_LIMIT(u8, uint64_t)
PB_DEFINE_LIMIT(f4, float)
PB_DEFINE_LIMIT(f8, double)

static inline uint64_t pb_limit(const struct pb_check *c, uint8_t *data, uint64_t *clipped) {
    bool clip = c->rule == PB_CLIP;
    switch (c->type) {
    case PB_I1: return pb_limit_i1(data, c->min, c->max, c->n, clip, clipped);
    case PB_I2: return pb_limit_i2(data, c->min, c->max, c->n, clip, clipped);
    case PB_I4: return pb_limit_i4(data, c->min, c->max, c->n, clip, clipped);
    case PB_I8: return pb_limit_i8(data, c->min, c->max, c->n, clip, clipped);
    case PB_U1: return pb_limit_u1(data, c->min, c->max, c->n, clip, clipped);
    case PB_U2: return pb_limit_u2(data, c->min, c->max, c->n, clip, clipped);
    case PB_U4: return pb_limit_u4(data, c->min, c->max, c->n, clip, clipped);
    case PB_U8: return pb_limit_u8(data, c->min, c->max, c->n, clip, clipped);
    case PB_F4: return pb_limit_f4(data, c->min, c->max, c->n, clip, clipped);
    default: return pb_limit_f8(data, c->min, c->max, c->n, clip, clipped);
    }
}

/* The part of a check that applies to `bytes` of the group starting at `from`; false if no
 * part does. A variable begins at an element boundary, so elements are never divided. */
static inline bool pb_narrow(const struct pb_check *c, uint64_t from, uint64_t bytes,
                             struct pb_check *part) {
    const uint64_t size = c->type < PB_F4 ? UINT64_C(1) << (c->type & 3) : c->type == PB_F4 ? 4 : 8;
    const uint64_t end = c->at + c->n * size, stop = from + bytes;
    const uint64_t skip = from > c->at ? from - c->at : 0;
    if (c->at >= stop || end <= from) return false;
    *part = *c;
    part->at += skip;
    part->n = ((end < stop ? end : stop) - part->at) / size;
    return true; /* a LIMIT check covers one variable: none of its limits are skipped */
}

/* The first check that the group fails, with the element in `*element`; n if none fails. */
static inline uint32_t pb_guard(const struct pb_check *checks, uint32_t n, uint8_t *group,
                                uint64_t *element, uint64_t *clipped) {
    for (uint32_t i = 0; i < n; i++) {
        const struct pb_check *c = checks + i;
        uint8_t *data = group + c->at;
        uint64_t e = 0;
        if (c->rule == PB_FINITE) {
            const uint64_t size = c->type == PB_F8 ? 8 : 4;
            if (pb_finite(data, c->type, c->n)) continue;
            while (pb_finite(data + e * size, c->type, 1)) e++;
        } else if ((e = pb_limit(c, data, clipped)) == c->n) {
            continue;
        }
        *element = e;
        return i;
    }
    return n;
}

#endif
