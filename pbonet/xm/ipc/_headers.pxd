"""The C headers of this folder, as far as _ipc.pyx uses them."""

from libc.stdint cimport int32_t, int64_t, uint8_t, uint32_t, uint64_t

cdef extern from "mail.h" nogil:
    enum: XM_VERSION, XM_MEMBERS, XM_SLOTS, XM_SHORT, XM_RECEIVER, XM_SENDER
    enum: XM_DIED, XM_EMPTY, XM_STUCK, XM_CROWDED, XM_NO_ROOM, XM_TOO_LONG
    enum: XM_DAMAGED, XM_TIMED_OUT, XM_SIGNAL, XM_AGAIN, XM_BAD_VERSION, XM_FIFO
    enum: XM_REFUSE, XM_DROP, XM_DROP_OLDEST, XM_WAIT
    const int64_t XM_FOREVER, XM_PATROL_NS
    const uint32_t XM_END
    struct xm_slot:
        pass
    struct xm_object:
        uint32_t version
        xm_slot slots[128]
    struct xm_head:
        pass
    struct xm_queue:
        xm_object o
        uint32_t policy, heads, blocks, block, n_heads, n_blocks, queued
        uint64_t seq, dropped
    struct xm_letter:
        uint32_t head, size
        int32_t priority
    bint xm_destroyed(const xm_object *o)
    uint32_t xm_waiting(const xm_object *o)
    void xm_destroy(xm_object *o)
    int xm_sleep(xm_slot *slot, int64_t until)
    uint64_t xm_lay_out(xm_queue *q, uint32_t heads, uint32_t blocks, uint32_t block)
    uint64_t xm_need(const xm_queue *q, uint64_t size)
    int xm_queue_make(xm_queue *q, const xm_queue *plan)
    int xm_queue_verify(const xm_queue *q, uint64_t bytes)
    int xm_queue_lock(xm_queue *q)
    void xm_queue_unlock(xm_queue *q)
    int xm_queue_enter(xm_queue *q)
    int xm_queue_exit(xm_queue *q, uint32_t me)
    int xm_send(xm_queue *q, uint32_t me, int slot, const uint8_t *data, uint32_t size,
                int32_t priority, int full)
    int xm_receive(xm_queue *q, uint32_t me, int slot, uint8_t *to, uint32_t room,
                   uint32_t most, xm_letter *letter)
    int xm_copy_out(const xm_queue *q, uint32_t i, uint8_t *to)
    int xm_received(xm_queue *q, uint32_t i)
    int xm_queue_wait(xm_queue *q, uint32_t me, uint32_t role, int32_t priority,
                      uint32_t size)
    void xm_queue_again(xm_queue *q, int slot)
    void xm_queue_patrol(xm_queue *q, uint32_t me)
    void xm_queue_leave(xm_queue *q, int slot)

cdef extern from "steady.h" nogil:
    struct xm_steady:
        pass
    xm_steady *xm_steady_here()

cdef extern from "sem.h" nogil:
    struct xm_sem:
        xm_object o
        uint32_t maximum, binary
    int xm_sem_make(xm_sem *s, uint32_t initial, uint32_t maximum, bint binary)
    int xm_sem_verify(const xm_sem *s, uint64_t bytes)
    uint32_t xm_sem_value(const xm_sem *s)
    uint64_t xm_sem_holder_pid(const xm_sem *s)
    int xm_sem_enter(xm_sem *s)
    int xm_sem_exit(xm_sem *s, uint32_t me)
    int xm_sem_take(xm_sem *s, uint32_t me, bint called)
    int xm_sem_give(xm_sem *s)
    int xm_sem_begin(xm_sem *s, uint32_t me, int32_t priority, bint wait, int *slot)
    int xm_sem_called(xm_sem *s, uint32_t me, int slot)
    void xm_sem_patrol(xm_sem *s, uint32_t me)
    void xm_sem_leave(xm_sem *s, int slot)
