"""The C headers of this folder, as far as _tbuf.pyx uses them."""

from libc.stdint cimport int64_t, uint8_t, uint16_t, uint32_t, uint64_t

cdef extern from "<string.h>" nogil:
    size_t strnlen(const char *text, size_t most)

cdef extern from "doze.h" nogil:
    enum: TB_VERSION, TB_TEXT, TB_WHO, TB_ROLES, TB_ALIGN
    enum: TB_WRITER, TB_READER, TB_CARER
    enum: TB_DAMAGED, TB_BAD_VERSION, TB_SWAPPED, TB_TIMED_OUT, TB_SIGNAL
    struct tb_stamp:
        uint64_t number, source
        int64_t time_ns, stamp_ns
    struct tb_role:
        uint64_t pid
        char who[64]
    struct tb_buffer:
        uint32_t version, text_bytes
        uint64_t size, bytes, source
        char *text
        tb_role roles[3]
        uint32_t destroyed
        uint64_t word
        int64_t last_ns
        uint32_t bell
    struct tb_bells:
        int defer
    struct tb_pace:
        int64_t last_ns, period_ns, due_ns
    void tb_paced(tb_pace *pace, int64_t time_ns, uint64_t lost)
    int tb_doze_paced(tb_buffer *b, tb_pace *pace, int64_t until_ns)
    uint64_t tb_size(uint64_t bytes)
    void tb_make(tb_buffer *b, uint64_t bytes, uint64_t source, const char *text,
                 uint32_t text_bytes)
    int tb_verify(const tb_buffer *b, uint64_t bytes)
    uint64_t tb_number(uint64_t word)
    bint tb_news(const tb_buffer *b)
    int tb_write(tb_buffer *b, uint64_t bytes, const tb_stamp *stamp, const void *data)
    int tb_read(tb_buffer *b, uint64_t bytes, tb_stamp *stamp, void *data, bint again)
    int64_t tb_now()
    void tb_wake(uint32_t *bell)
    int tb_doze(tb_buffer *b, int64_t until_ns)
    void tb_ring(tb_bells *later, uint32_t *bell)
    void tb_ring_all(tb_bells *later)

cdef extern from "message.h" nogil:
    enum: TB_NO_MESSAGE, TB_OTHER_MESSAGE, TB_NO_TIME, TB_MESSAGE_VERSION
    struct tb_head:
        uint16_t version, text_bytes
        uint64_t number, source
        int64_t stamp_ns, age_ns
    struct tb_form:
        const void *text
        uint64_t text_bytes, bytes
    uint64_t tb_message_bytes(const tb_form *f)
    void tb_pack(const tb_form *f, const tb_stamp *stamp, const void *data,
                 int64_t now_ns, uint8_t *to)
    int tb_unpack(const uint8_t *message, uint64_t bytes, tb_head *head)
    int tb_written(const tb_head *head, int64_t now_ns, bint known, int64_t offset_ns,
                   int64_t error_ns, int64_t *time_ns)
    bint tb_fits(const tb_form *f, const uint8_t *message, const tb_head *head)
