"""What the native loop calls without Python: a method of a module in C."""

cimport cython
from libc.stdint cimport int32_t, int64_t, uint32_t, uint64_t, uint8_t


cdef extern from "pbonet/cmodule/pbonet.h" nogil:
    enum:
        PBO_ABI, PBO_OK, PBO_OFF, PBO_CONTINUE, PBO_SKIP, PBO_ERROR
        PBO_DEADLINE, PBO_MAXEXEC, PBO_MINEXEC, PBO_ONE, PBO_ARRAY, PBO_LIST
        PBO_F64, PBO_F32, PBO_I64, PBO_I32, PBO_I16, PBO_I8, PBO_U64, PBO_U32, PBO_U16
        PBO_U8, PBO_BOOL, PBO_STR
    ctypedef struct pbo_task:
        double dt
        int64_t now_ns
        uint64_t cyclecount
        double period, freq
        int32_t handover, errnum
        const char *errmsg
        uint32_t must_end
    ctypedef int pbo_method(void *state, pbo_task *task)
    ctypedef struct pbo_port:
        const char *field
        const char *name
        const char *shape
        const char *unit
        const char *doc
        const char *stale
        const double *safe
        const double *value
        double max_age
        uint32_t offset, line, n_safe, n_value
        uint8_t kind, type, feedback, is_new
    ctypedef struct pbo_param:
        const char *field
        const char *unit
        const char *doc
        const double *initial
        const double *ge
        const double *gt
        const double *le
        const double *lt
        const double *rate
        const double *total
        const char *text
        const char **choices
        uint32_t offset, line, n_initial, room, count_offset, n_choices
        uint8_t type, form
    ctypedef struct pbo_user_signal:
        const char *name
        const char *doc
        uint32_t number, line
    ctypedef struct pbo_module:
        uint32_t abi, size, port_size, param_size, signal_size, task_size
        uint32_t state_size, state_align, n_ports, n_params, n_signals
        const char *file
        const char *doc
        const char *module_class
        const pbo_port *ports
        const pbo_param *params
        const pbo_user_signal *signals
        pbo_method *init
        pbo_method *on
        pbo_method *cycle
        pbo_method *stable
        pbo_method *off
        pbo_method *kill
        pbo_method *error
        pbo_method *clear
        pbo_method *reinit
        pbo_method *sync
        int (*set)(void *state, pbo_task *task, int param)
        int (*timing_failure)(void *state, pbo_task *task, int kind)


cdef extern from "pbonet/cmodule/running.h" nogil:
    struct pbo_running:
        pass


cdef extern from "pbonet/cmodule/instance.h" nogil:
    struct pbo_notice:
        int32_t code
        uint32_t signals
        const char *text
    ctypedef struct pbo_instance:
        pbo_task task
        void *state
        int32_t answer, failed, code, line, n_notices
        uint32_t dropped
        const char *file
        const char *text
        pbo_notice *notices
    int pbo_run(pbo_method *method, pbo_instance *one)


@cython.final
cdef class NativeState:
    cdef pbo_instance one
    cdef const pbo_module *module
    cdef void *memory
    cdef readonly object task       # the TaskContext
    cdef object kept                # what the module's pointers point into
    cdef bytes errmsg
    cdef pbo_method *function(self, str method) except NULL
    cdef int write(self, int i, value) except -1
    cdef int write_text(self, const pbo_param *p, str value) except -1
    cdef int change(self, int i, value) except -1
    cdef int prepare(self) except -1
    cdef int pass_on(self, str method) except -1


@cython.final
cdef class NativeMethod:
    cdef pbo_method *function
    cdef readonly NativeState of
    cdef pbo_instance *one
    cdef readonly str name
    cdef int64_t before             # cycles of the slot before the task was turned on
    cdef int begin(self, int64_t cycles) except -1


# The method in C that runs in this process.
cdef pbo_running *c_running() noexcept nogil
