/* Copying numbers of any type of ROS 2 out of a message, where they stand at any address. */
#ifndef PBONET_NUMBERS_H
#define PBONET_NUMBERS_H

#include <math.h>
#include <stdbool.h>
#include <stddef.h>
#include <stdint.h>
#include <string.h>

/* `n` numbers at `at`, in an order (NULL: as they stand). */
typedef void ros_copy(double *to, const char *at, const uint32_t *order, size_t n);

#define ROS_COPY(name, type)                                                           \
    static void name(double *to, const char *at, const uint32_t *order, size_t n) {    \
        for (size_t i = 0; i < n; i++) {                                               \
            type one;                                                                  \
            memcpy(&one, at + (order ? order[i] : i) * sizeof one, sizeof one);        \
            to[i] = (double)one;                                                       \
        }                                                                              \
    }
ROS_COPY(ros_copy_i1, int8_t)
ROS_COPY(ros_copy_i2, int16_t)
ROS_COPY(ros_copy_i4, int32_t)
ROS_COPY(ros_copy_i8, int64_t)
ROS_COPY(ros_copy_u1, uint8_t)
ROS_COPY(ros_copy_u2, uint16_t)
ROS_COPY(ros_copy_u4, uint32_t)
ROS_COPY(ros_copy_u8, uint64_t)
ROS_COPY(ros_copy_f4, float)
ROS_COPY(ros_copy_f8, double)
#undef ROS_COPY

/* Any byte but 0 is true, as it is when the message is decoded. */
static void ros_copy_b(double *to, const char *at, const uint32_t *order, size_t n) {
    for (size_t i = 0; i < n; i++) to[i] = at[order ? order[i] : i] != 0;
}

/* How to copy numbers of a kind (of numpy: b, i, u, f) and size in bytes; NULL: unknown. */
static inline ros_copy *ros_copy_of(char kind, size_t bytes) {
    static const struct { char kind; size_t bytes; ros_copy *copy; } known[] = {
        {'b', 1, ros_copy_b}, {'i', 1, ros_copy_i1}, {'i', 2, ros_copy_i2},
        {'i', 4, ros_copy_i4}, {'i', 8, ros_copy_i8}, {'u', 1, ros_copy_u1},
        {'u', 2, ros_copy_u2}, {'u', 4, ros_copy_u4}, {'u', 8, ros_copy_u8},
        {'f', 4, ros_copy_f4}, {'f', 8, ros_copy_f8},
    };
    for (size_t i = 0; i < sizeof known / sizeof *known; i++)
        if (known[i].kind == kind && known[i].bytes == bytes) return known[i].copy;
    return NULL;
}

/* Numbers of a message: where they stand, and where they come from or go to. */
struct ros_part {
    size_t at, n; /* the place in the message; bytes of `from`, or numbers of `to` */
    const void *from;
    double *to;
    const uint32_t *order;
    ros_copy *copy;
};

/* Whether bytes are the same as others under a mask. */
static inline bool ros_same(const char *a, const char *b, const char *mask, size_t n) {
    char differs = 0;
    for (size_t i = 0; i < n; i++) differs |= (char)((a[i] ^ b[i]) & mask[i]);
    return !differs;
}

/* Copy the numbers of a part out of a message; returns whether all are finite. */
static inline bool ros_take(const struct ros_part *part, const char *message) {
    bool finite = true;
    part->copy(part->to, message + part->at, part->order, part->n);
    for (size_t i = 0; i < part->n; i++) finite &= isfinite(part->to[i]) != 0;
    return finite;
}

/* A time of ROS: seconds (int32), and nanoseconds (uint32) after them. */
static inline void ros_put_time(char *at, int64_t ns) {
    const int32_t seconds = (int32_t)(ns / 1000000000);
    const uint32_t rest = (uint32_t)(ns % 1000000000);
    memcpy(at, &seconds, 4);
    memcpy(at + 4, &rest, 4);
}

static inline int64_t ros_time(const char *at) {
    int32_t seconds;
    uint32_t rest;
    memcpy(&seconds, at, 4);
    memcpy(&rest, at + 4, 4);
    return seconds * INT64_C(1000000000) + rest;
}

#endif
