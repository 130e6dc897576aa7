"""Functions that other native parts of pbonet call without Python.

The structures of these classes stay in the C headers of this folder, so a module that
cimports the classes needs no include path.
"""


# Let a process that has called `survive_cuts` survive when this mapping's file is truncated.
cdef void c_guard_map(const void *base, size_t bytes) noexcept
cdef void c_unguard_map(const void *base) noexcept


cdef class Arena:
    """A table's file, mapped whole."""

    cdef object memory, machine
    cdef const char *machine_text
    cdef void *core            # struct pb_table
    cdef void *base
    cdef void *own             # this process's copy of the static part
    cdef size_t bytes
    cdef int fd
    cdef unsigned long long looked_at   # the last result of `causes`: a struct pb_seen
    cdef bint seen_up
    # Raise an entry of the illegal-configuration flag; clear all entries of a raiser. No
    # lock, no waiting. Negative: no room, or another live process has raised them.
    cdef int c_raise_illegal(self, const char *cause, const char *raiser) noexcept nogil
    cdef int c_clear_illegal(self, const char *raiser) noexcept nogil
    cdef bint c_illegal(self) noexcept nogil


cdef class LocalTable:
    """One task's local table; flags are the bits of pbonet.svar.Flags, 0 means success."""

    cdef readonly Arena arena
    cdef list kept             # the buffers that core points into
    cdef list predecessors     # of each group: names of the tasks that hand over
    cdef list ends             # of each group: the owners' last commits
    cdef void *core            # struct pb_local
    cdef readonly int flags    # of the last copy, commit or claim
    cdef readonly unsigned long long cycles  # cycle number of the last commit
    cdef void *out_data        # the out-vars' place in the local table
    cdef size_t out_bytes
    cdef unsigned long long *consumed  # pairs: register uid, sequence
    cdef int n_consumed                # number of pairs
    cdef readonly unsigned long long out_uid     # register of the out-vars; 0: none
    cdef readonly unsigned long long out_number  # number of its last commit there
    cdef unsigned long long stored, stored_set  # generation and commits from outside, see below
    cdef public bint held      # commits are checked, and sent by `publish`
    cdef long long held_ns
    cdef unsigned long long held_cycle
    cdef int c_copy_in(self) noexcept nogil
    cdef bint c_aged(self) noexcept nogil       # inputs are stale or settling
    cdef bint c_to_report(self) noexcept nogil  # others are to know that
    cdef int c_action(self) noexcept nogil      # while inputs are stale or settling, else 0
    cdef void c_make_new(self) noexcept nogil   # the next commit does not inherit an age
    # Safe values at a timing failure (safe.h): c_share says where the words are, `make_safe`
    # is a C function of `core` for the handler of a signal, and c_end_cycle returns whether
    # the cycle has failed and the out-vars are safe.
    cdef void *make_safe
    cdef void c_share(self, void *safe) noexcept nogil
    cdef void c_begin_cycle(self, unsigned long long number) noexcept nogil
    cdef bint c_end_cycle(self) noexcept nogil
    # Inputs for a log: c_due returns the bytes of the in-vars if they cannot be rebuilt from
    # what other tasks committed since the last store, else 0; c_input returns them one by
    # one; c_stored marks them as stored.
    cdef size_t c_due(self, bint whole) noexcept nogil
    cdef int c_inputs(self) noexcept nogil
    cdef const void *c_input(self, int i, size_t *n) noexcept nogil
    cdef void c_stored(self) noexcept nogil
    # own_ns: the module's own time of the outputs; 0: none
    cdef int c_commit(self, long long own_ns, long long now_ns, unsigned long long cycle) noexcept nogil
    cdef bint c_illegal(self) noexcept nogil
