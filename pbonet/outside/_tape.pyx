# cython: language_level=3, boundscheck=False, wraparound=False
# distutils: extra_compile_args = -O2 -std=c11
# distutils: depends = tape.h
"""Thin wrapper of tape.h; documented in `_tape.pyi`."""

from cpython.bytes cimport PyBytes_FromStringAndSize
from libc.stdint cimport uint32_t, uint64_t, uint8_t
from libc.stdlib cimport calloc, free, realloc
from libc.string cimport memset

from pbonet.outside import answers

ROOM = 1 << 16
MOST = 1 << 22
ALWAYS = answers.ALWAYS
RAW, PACKED, TUPLE, RAISED = TAPE_RAW, TAPE_PACKED, TAPE_TUPLE, TAPE_RAISED
BROKEN, NAME, LOST = TAPE_BROKEN, TAPE_NAME, TAPE_LOST
cdef object _current = None     # a Tape, a Player, or None


def use(tape) -> object:
    global _current
    before, _current = _current, tape
    return before


def active() -> bool:
    return _current is not None


def plays() -> bool:
    return _current is not None and not isinstance(_current, Tape)


cdef class Tape:
    def __cinit__(self, *_):
        memset(&self.t, 0, sizeof(self.t))

    def __init__(self, room=ROOM):
        self.t.bytes = <unsigned char *>calloc(1, room)
        if self.t.bytes is NULL:
            raise MemoryError("no memory for a module's inputs from outside")
        self.t.room = room
        self.sources = []

    def calls(self) -> list:
        return [source.calls for source in self.sources]

    def reserve(self, uint64_t size) -> None:
        cdef uint64_t room = min(self.t.room + tape_size(size), <uint64_t>MOST)
        cdef void *more = realloc(self.t.bytes, room)
        if more is NULL:
            raise MemoryError("no memory for a module's inputs from outside")
        self.t.bytes = <unsigned char *>more
        if room > self.t.room:
            memset(self.t.bytes + self.t.room, 0, room - self.t.room)
            self.t.room = room

    def take(self) -> bytes:
        cdef uint64_t n = tape_ready(&self.t)
        cdef bytes found = PyBytes_FromStringAndSize(<char *>self.t.bytes, n)
        tape_empty(&self.t)
        return found

    def __dealloc__(self):
        free(self.t.bytes)


cdef class Outside:
    def __init__(self, str name, *, uint64_t room=0):
        cdef bytes text = name.encode()
        self.name = name
        if isinstance(_current, Tape):
            self.tape = _current
            self.tape.opened += 1
            self.number = self.tape.opened
            self.tape.sources.append(self)
            if room:
                self.tape.reserve(room)
            self.put(TAPE_NAME, <char *>text, len(text), NULL, 0)
        elif _current is not None:
            self.player = _current
            self.number = self.player.open(self)

    @property
    def plays(self) -> bool:
        return self.player is not None

    cdef bint recording(self):
        return self.tape is not None

    cdef void put(self, uint8_t kind, const void *first, uint32_t n,
                  const void *second, uint32_t m) noexcept:
        cdef tape_entry e
        e.bytes, e.source, e.call, e.kind = 0, self.number, self.calls, kind
        tape_put(&self.tape.t, e, first, n, second, m)

    cdef int failed(self, error) except -1:
        """Count a call that ended with an exception, and record the exception."""
        cdef bytes text = b""
        if not isinstance(error, Exception):
            self.calls += 1
            self.put(TAPE_BROKEN, NULL, 0, NULL, 0)
            return 0
        text = answers.pack_error(error)
        self.calls += 1
        self.put(TAPE_RAISED, <char *>text, len(text), NULL, 0)
        return 0

    def ask(self, call, *args, default=ALWAYS):
        """Count calls when they end: a handler may ask the same source meanwhile."""
        cdef bytes text = None
        cdef uint8_t kind = 0
        if self.player is not None:
            self.calls += 1
            return self.player.answer(self, default)
        if self.tape is None:
            return call(*args)
        try:
            answer = call(*args)
            if default is ALWAYS or answer != default or type(answer) is not type(default):
                kind, text = answers.pack(answer, self.name)
        except BaseException as error:
            self.failed(error)
            raise
        self.calls += 1
        if text is not None:
            self.put(kind, <char *>text, len(text), NULL, 0)
        return answer
