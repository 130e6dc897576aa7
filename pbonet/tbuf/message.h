/* A record of a link in transit between machines.
 *
 * One message carries one record: the source of its counter, the counter, the time and the
 * age at sending, the layout of a record, and its bytes as stored in the writer's memory.
 * The head is little-endian on all machines; the layout names the byte order of the rest.
 */
#ifndef PBONET_MESSAGE_H
#define PBONET_MESSAGE_H

#ifndef _DEFAULT_SOURCE
#define _DEFAULT_SOURCE 1
#endif
#include <endian.h>

#include "triple.h"

enum { TB_MESSAGE_VERSION = 1 };
enum { TB_NO_MESSAGE = -6, TB_OTHER_MESSAGE = -7, TB_NO_TIME = -8 };

struct tb_head {
    char magic[4];
    uint16_t version, text_bytes;
    uint64_t number, source;
    int64_t stamp_ns, age_ns;
};
_Static_assert(sizeof(struct tb_head) == 40, "the fields have no padding");

/* The layout of a record, and its size: a process's own copy of both. */
struct tb_form {
    const void *text;
    uint64_t text_bytes, bytes;
};

static inline uint64_t tb_message_bytes(const struct tb_form *f) {
    return sizeof(struct tb_head) + f->text_bytes + f->bytes;
}

/* Pack a record into memory of tb_message_bytes. */
static inline void tb_pack(const struct tb_form *f, const struct tb_stamp *stamp,
                           const void *data, int64_t now_ns, uint8_t *to) {
    struct tb_head head = {
        {'p', 'b', 'T', 'B'}, htole16(TB_MESSAGE_VERSION), htole16((uint16_t)f->text_bytes),
        htole64(stamp->number), htole64(stamp->source),
        (int64_t)htole64((uint64_t)stamp->stamp_ns),
        (int64_t)htole64((uint64_t)(now_ns - stamp->time_ns)),
    };
    memcpy(to, &head, sizeof head);
    memcpy(to + sizeof head, f->text, f->text_bytes);
    memcpy(to + sizeof head + f->text_bytes, data, f->bytes);
}

/* Check a message and read its head: 0, or why it is invalid. */
static inline int tb_unpack(const uint8_t *from, uint64_t bytes, struct tb_head *head) {
    if (bytes < sizeof *head || memcmp(from, "pbTB", 4)) return TB_NO_MESSAGE;
    memcpy(head, from, sizeof *head);
    head->version = le16toh(head->version);
    head->text_bytes = le16toh(head->text_bytes);
    head->number = le64toh(head->number);
    head->source = le64toh(head->source);
    head->stamp_ns = (int64_t)le64toh((uint64_t)head->stamp_ns);
    head->age_ns = (int64_t)le64toh((uint64_t)head->age_ns);
    if (head->version != TB_MESSAGE_VERSION) return TB_OTHER_MESSAGE;
    return bytes < sizeof *head + head->text_bytes ? TB_NO_MESSAGE : 0;
}

#define TB_UNKNOWN_TIME 1   /* a nanosecond after boot: older than any limit; 0 is "no time" */

/* When a record that arrives now was written, by this machine's clock: 0 or TB_NO_TIME. The
 * age at sending is exact but does not include the transmission. The measured offset of the
 * clocks, if `known`, includes the transmission and an error of at most `error_ns`; it cannot
 * make a record younger than it was when it was sent. If it is not known, or would make it
 * younger by more than its error, the record counts as old. */
static inline int tb_written(const struct tb_head *head, int64_t now_ns, bool known,
                             int64_t offset_ns, int64_t error_ns, int64_t *time_ns) {
    int64_t there, newer;
    if (__builtin_sub_overflow(now_ns, head->age_ns, time_ns)) return TB_NO_TIME;
    if (known && __builtin_add_overflow(head->stamp_ns, offset_ns, &there)) return TB_NO_TIME;
    if (!known || __builtin_sub_overflow(there, *time_ns, &newer) || newer > error_ns)
        *time_ns = TB_UNKNOWN_TIME;
    else if (newer < 0)
        *time_ns = there;
    return 0;
}

/* Whether a message's record has this layout, in the same byte order. */
static inline bool tb_fits(const struct tb_form *f, const uint8_t *from,
                           const struct tb_head *head) {
    return head->text_bytes == f->text_bytes &&
           !memcmp(from + sizeof *head, f->text, f->text_bytes);
}

#endif
