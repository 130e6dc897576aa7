# cython: language_level=3, boundscheck=False, wraparound=False
# distutils: extra_compile_args = -O2 -std=c11
# distutils: depends = ../node/ring/ring.h
"""Makes messages of the records of a ring, and back; documented in `_messages.pyi`."""

from cpython.bytes cimport PyBytes_AS_STRING, PyBytes_FromStringAndSize
from cpython.mem cimport PyMem_Free, PyMem_Malloc
from libc.stdint cimport INT32_MAX, UINT32_MAX, int32_t, int64_t, uint32_t, uint64_t, uint8_t
from libc.string cimport memcpy, memset

from pbonet.errors import NodeError

cdef extern from "pbonet/node/ring/ring.h" nogil:
    struct ring_record:
        uint32_t size, n_consumed, bytes, in_bytes, heard_bytes, spare
        uint64_t cycle
        int64_t release_ns, start_ns, end_ns, dt_ns
        uint64_t cpu_ns, uid, number, lost
        uint32_t flags, kind

cdef enum:
    CDR = 4             # bytes before the fields of a message
    HEAD = 80           # of a cycle: the fields of `HEAD` in `schema.py`
    RECORD = 24         # of a ring's record before them
    EARLIER = 20        # of an earlier cycle: one time, two distances, CPU time
    MOST = 128 << 10    # bytes of a message with several cycles
    CYCLE = 0
    CLAIM = 5
    COMMIT = 6          # kinds: pbonet.log.Step

cdef struct head:       # of a message: a ring's record from `cycle` on
    uint64_t cycle
    int64_t release_ns, start_ns, end_ns, dt_ns
    uint64_t cpu_ns, uid, number, lost
    uint32_t flags, kind

cdef struct piece:
    uint32_t at, size   # in the group, or in the inputs
    uint32_t last, earlier      # where it is in a message: of its last cycle, of one before

cdef struct sequences:  # what follows the variables of a cycle
    const char *consumed
    const char *inputs
    const char *heard
    uint32_t n_consumed, n_inputs, n_heard


cdef inline uint64_t up(uint64_t at, uint64_t unit) noexcept nogil:
    return (at + unit - 1) & ~(unit - 1)


cdef inline uint32_t number_at(const char *at) noexcept nogil:
    cdef uint32_t number
    memcpy(&number, at, 4)
    return number


cdef inline char *put_number(char *to, uint32_t number) noexcept nogil:
    memcpy(to, &number, 4)
    return to + 4


cdef class Layout:
    cdef piece *pieces
    cdef piece *blanks
    cdef uint32_t n_pieces, n_blanks
    cdef uint64_t last, earlier     # bytes of a cycle up to its sequences

    def __init__(self, list pieces, list blanks, last, earlier):
        self.pieces = <piece *>PyMem_Malloc((len(pieces) + 1) * sizeof(piece))
        self.blanks = <piece *>PyMem_Malloc((len(blanks) + 1) * sizeof(piece))
        if not self.pieces or not self.blanks:
            raise MemoryError
        self.last, self.earlier = last, earlier
        for at, size, in_last, in_earlier in pieces:
            self.pieces[self.n_pieces] = piece(at, size, in_last, in_earlier)
            self.n_pieces += 1
        for at, size in blanks:
            self.blanks[self.n_blanks] = piece(at, size, 0, 0)
            self.n_blanks += 1

    def __dealloc__(self):
        PyMem_Free(self.pieces)
        PyMem_Free(self.blanks)

    # -- from records to messages ------------------------------------------------------

    cdef uint64_t size_of(self, const ring_record *r, uint64_t fields, uint64_t consumed) noexcept nogil:
        """Return the size of a cycle that begins at a multiple of 8."""
        return up(fields + 4 + consumed + 4 + r.in_bytes, 4) + 4 + r.heard_bytes

    cdef char *put_rest(self, char *to, const ring_record *r, const char *base,
                        uint64_t consumed) noexcept nogil:
        """Write the sequences of a cycle; return their end."""
        cdef const char *data = pairs_of(r)
        cdef uint64_t n = 16 * <uint64_t>r.n_consumed
        cdef uint32_t i
        to = put_number(to, <uint32_t>consumed)
        memcpy(to, data, consumed)
        to = put_number(to + consumed, r.in_bytes)
        memcpy(to, data + n, r.in_bytes)
        for i in range(self.n_blanks):
            if self.blanks[i].at + self.blanks[i].size <= r.in_bytes:
                memset(to + self.blanks[i].at, 0, self.blanks[i].size)
        to = <char *>base + up(to + r.in_bytes - base, 4)
        to = put_number(to, r.heard_bytes)
        memcpy(to, data + n + r.in_bytes, r.heard_bytes)
        return to + r.heard_bytes

    cdef void put_variables(self, char *to, const ring_record *r, bint last) noexcept nogil:
        cdef const char *data = <const char *>r + RECORD + HEAD
        cdef const piece *p = self.pieces
        cdef uint32_t i
        for i in range(self.n_pieces):
            if p.at + p.size <= r.bytes:
                memcpy(to + (p.last if last else p.earlier), data + p.at, p.size)
            p += 1

    cdef bytes message(self, const char *first, uint32_t count):
        """Return the message of some cycles, whose records follow one another."""
        cdef const ring_record *r = <const ring_record *>first
        cdef const char *one = first
        cdef uint64_t size = 0, head
        cdef uint32_t i
        cdef bytes made
        cdef char *base
        cdef char *to
        for i in range(count - 1):
            one += (<const ring_record *>one).size
        r = <const ring_record *>one
        one = first
        for i in range(count - 1):
            size = up(size, 8) + self.size_of(<const ring_record *>one, self.earlier,
                                              consumed_before(one, r, count - 1 - i))
            one += (<const ring_record *>one).size
        # The count of the earlier cycles, and the first of them, have places of their own.
        head = up(self.size_of(r, self.last, 16 * <uint64_t>r.n_consumed), 4)
        size = head + 4 if count == 1 else up(head + 4, 8) + size
        made = PyBytes_FromStringAndSize(NULL, CDR + size)
        base = PyBytes_AS_STRING(made)
        memset(base, 0, CDR + size)
        base[1] = 1     # little endian
        base += CDR
        memcpy(base, <const char *>r + RECORD, HEAD)
        self.put_variables(base, r, True)
        self.put_rest(base + self.last, r, base, 16 * <uint64_t>r.n_consumed)
        to = put_number(base + head, count - 1)
        one = first
        for i in range(count - 1):
            to = self.put_earlier(base + up(to - base, 8), <const ring_record *>one, base,
                                  consumed_before(one, r, count - 1 - i))
            one += (<const ring_record *>one).size
        return made

    cdef char *put_earlier(self, char *to, const ring_record *r, const char *base,
                           uint64_t consumed) noexcept nogil:
        cdef int32_t start = <int32_t>(r.start_ns - r.release_ns)
        cdef int32_t end = <int32_t>(r.end_ns - r.start_ns)
        cdef uint32_t cpu = <uint32_t>r.cpu_ns
        memcpy(to, &r.release_ns, 8)
        memcpy(to + 8, &start, 4)
        memcpy(to + 12, &end, 4)
        memcpy(to + 16, &cpu, 4)
        self.put_variables(to, r, False)
        return self.put_rest(to + self.earlier, r, base, consumed)

    def fold(self, const unsigned char[::1] text not None, int64_t span_ns):
        cdef uint64_t at = 0, begin = 0, n = text.shape[0]
        cdef const char *data = <const char *>&text[0] if n else NULL
        cdef const ring_record *r
        cdef const ring_record *before = NULL
        cdef uint32_t count = 0
        cdef list found = []
        while at < n:
            r = <const ring_record *>(data + at)
            if not sound(r, n - at):
                raise NodeError("the ring is damaged")
            if count and not (follows(before, r) and
                              r.end_ns - (<const ring_record *>(data + begin)).end_ns <= span_ns and
                              at + r.size - begin <= MOST):
                found.append((before.kind, count, before.release_ns, before.end_ns,
                              self.message(data + begin, count)))
                count = 0
            if is_commit(r.kind):
                begin = begin if count else at
                count += 1
                before = r
            else:
                found.append((r.kind, 1, r.release_ns, r.end_ns,
                              PyBytes_FromStringAndSize(data + at, r.size)))
            at += r.size
        if count:
            found.append((before.kind, count, before.release_ns, before.end_ns,
                          self.message(data + begin, count)))
        return found

    # -- from messages to single cycles ------------------------------------------------

    def unfold(self, bytes data not None, const int64_t[::1] sizes not None):
        cdef Py_ssize_t i, n = sizes.shape[0]
        cdef const char *text = PyBytes_AS_STRING(data)
        cdef int64_t total = 0, rows = 0
        cdef bytes out, out_sizes, counts
        for i in range(n):
            if not self.walk(text, sizes[i], NULL, NULL, &total, &rows):
                return None
            text += sizes[i]
        out = PyBytes_FromStringAndSize(NULL, total)
        out_sizes = PyBytes_FromStringAndSize(NULL, rows * sizeof(int64_t))
        counts = PyBytes_FromStringAndSize(NULL, n * sizeof(int64_t))
        cdef char *to = PyBytes_AS_STRING(out)
        cdef int64_t *size = <int64_t *>PyBytes_AS_STRING(out_sizes)
        cdef int64_t *each = <int64_t *>PyBytes_AS_STRING(counts)
        text = PyBytes_AS_STRING(data)
        for i in range(n):
            total = rows = 0
            self.walk(text, sizes[i], to, size, &total, &rows)
            each[i] = rows
            to += total
            size += rows
            text += sizes[i]
        return out, out_sizes, counts

    cdef bint walk(self, const char *text, int64_t size, char *to, int64_t *row_sizes,
                   int64_t *total, int64_t *rows) noexcept nogil:
        """Go through the cycles of a message, and write each by itself if there is room.

        Returns 0 when the message ends before they do.
        """
        cdef const char *base = text + CDR
        cdef uint64_t n = size - CDR, at = self.last, begin
        cdef sequences last, rest
        cdef head *told = <head *>base
        cdef uint32_t i, count = 0
        cdef int64_t made
        cdef bint implied
        if size < CDR or not take(base, &at, n, &last, True):
            return 0
        at = up(at, 4)
        if at + 4 <= n:     # older logs end before
            count = number_at(base + at)
            at += 4
        for i in range(count):
            begin = up(at, 8)
            at = begin + self.earlier
            if not take(base, &at, n, &rest, False):
                return 0
            if not rest.n_consumed:
                rest.consumed, rest.n_consumed = last.consumed, last.n_consumed
                implied = last.n_consumed > 0
            else:
                implied = False
            made = self.row_size(&rest)
            if to:
                self.put_row(to, text, &rest)
                if implied:
                    count_back(to + CDR + self.last + 4, rest.n_consumed, count - i)
                self.put_earlier_head(<char *>to + CDR, told, base + begin, count - i)
                to += made
                row_sizes[rows[0]] = made
            total[0] += made
            rows[0] += 1
        made = self.row_size(&last)
        if to:
            self.put_row(to, text, &last)
            memcpy(to, text, CDR + self.last)
            row_sizes[rows[0]] = made
        total[0] += made
        rows[0] += 1
        return 1

    cdef int64_t row_size(self, const sequences *rest) noexcept nogil:
        return CDR + up(self.last + 4 + rest.n_consumed + 4 + rest.n_inputs, 4) + 4 + rest.n_heard

    cdef void put_row(self, char *to, const char *text, const sequences *rest) noexcept nogil:
        """Write a cycle with zeros in place of its head and variables."""
        cdef char *base = to + CDR
        memcpy(to, text, CDR)
        memset(base, 0, self.last)
        to = put_number(base + self.last, rest.n_consumed)
        memcpy(to, rest.consumed, rest.n_consumed)
        to = put_number(to + rest.n_consumed, rest.n_inputs)
        memcpy(to, rest.inputs, rest.n_inputs)
        memset(to + rest.n_inputs, 0, up(to + rest.n_inputs - base, 4) - (to + rest.n_inputs - base))
        to = put_number(base + up(to + rest.n_inputs - base, 4), rest.n_heard)
        memcpy(to, rest.heard, rest.n_heard)

    cdef void put_earlier_head(self, char *to, const head *told, const char *one,
                               uint32_t back) noexcept nogil:
        """Write the head and the variables of a cycle so many before the last one."""
        cdef head h
        cdef int32_t start, end
        cdef const piece *p = self.pieces
        cdef uint32_t i
        memcpy(&h, told, HEAD)
        memcpy(&h.release_ns, one, 8)
        memcpy(&start, one + 8, 4)
        memcpy(&end, one + 12, 4)
        h.cycle -= back
        h.number -= back
        h.start_ns = h.release_ns + start
        h.end_ns = h.start_ns + end
        h.cpu_ns = number_at(one + 16)
        memcpy(to, &h, HEAD)
        for i in range(self.n_pieces):
            memcpy(to + p.last, one + p.earlier, p.size)
            p += 1


cdef inline const char *pairs_of(const ring_record *r) noexcept nogil:
    """Return where the pairs of register and number are that a cycle copied in."""
    return <const char *>r + RECORD + HEAD + r.bytes


cdef uint64_t consumed_before(const char *one, const ring_record *last, uint32_t back) noexcept nogil:
    """Return how many bytes of pairs an earlier cycle needs in the message of the last one.

    None when it read the same registers, so many commits before.
    """
    cdef const ring_record *r = <const ring_record *>one
    cdef const char *a = pairs_of(r)
    cdef const char *b = pairs_of(last)
    cdef uint64_t x[2]
    cdef uint64_t y[2]
    cdef uint32_t k
    if r.n_consumed != last.n_consumed:
        return 16 * <uint64_t>r.n_consumed
    for k in range(r.n_consumed):
        memcpy(x, a + 16 * <uint64_t>k, 16)
        memcpy(y, b + 16 * <uint64_t>k, 16)
        if x[0] != y[0] or x[1] != y[1] - back:
            return 16 * <uint64_t>r.n_consumed
    return 0


cdef void count_back(char *pairs, uint32_t size, uint32_t back) noexcept nogil:
    """Make the numbers of some pairs smaller."""
    cdef uint64_t number
    cdef uint32_t at
    for at in range(8, size, 16):
        memcpy(&number, pairs + at, 8)
        number -= back
        memcpy(pairs + at, &number, 8)


cdef inline bint is_commit(uint32_t kind) noexcept nogil:
    return kind == CYCLE or kind == CLAIM or kind == COMMIT


cdef inline bint sound(const ring_record *r, uint64_t n) noexcept nogil:
    """Return whether a whole record is there."""
    return n >= RECORD + HEAD and r.size <= n and r.size >= (
        RECORD + HEAD + 16 * <uint64_t>r.n_consumed + r.bytes + r.in_bytes + r.heard_bytes)


cdef inline bint near(int64_t distance) noexcept nogil:
    return -INT32_MAX <= distance <= INT32_MAX


cdef bint follows(const ring_record *one, const ring_record *r) noexcept nogil:
    """Return whether a cycle follows from the one after it but for what `put_earlier` writes."""
    return (one.kind == CYCLE and r.kind == CYCLE and r.cycle == one.cycle + 1 and
            r.number == one.number + 1 and r.uid == one.uid and r.dt_ns == one.dt_ns and
            r.lost == one.lost and r.flags == one.flags and one.cpu_ns <= UINT32_MAX and
            (one.n_consumed == 0) == (r.n_consumed == 0) and
            near(one.start_ns - one.release_ns) and near(one.end_ns - one.start_ns))


cdef bint take(const char *base, uint64_t *at, uint64_t n, sequences *found,
               bint last) noexcept nogil:
    """Find the sequences at a place, and move it past them; 0 when they are not all there."""
    if not bytes_at(base, at, n, &found.consumed, &found.n_consumed):
        return 0
    if not bytes_at(base, at, n, &found.inputs, &found.n_inputs):
        return 0
    at[0] = up(at[0], 4)
    if last and at[0] >= n:     # the oldest logs have no input from outside
        found.heard, found.n_heard = base, 0
        return 1
    return bytes_at(base, at, n, &found.heard, &found.n_heard)


cdef bint bytes_at(const char *base, uint64_t *at, uint64_t n, const char **data,
                   uint32_t *size) noexcept nogil:
    if at[0] + 4 > n:
        return 0
    size[0] = number_at(base + at[0])
    data[0] = base + at[0] + 4
    at[0] += 4 + <uint64_t>size[0]
    return at[0] <= n
