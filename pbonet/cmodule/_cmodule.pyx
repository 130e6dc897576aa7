# cython: language_level=3, boundscheck=False, wraparound=False, freethreading_compatible=False
# distutils: extra_compile_args = -O2 -std=c11
# distutils: depends = pbonet.h instance.h running.h
"""Loads shared objects of modules in C and calls their methods; see `_cmodule.pyi`."""

cimport cython
from libc.stdint cimport int32_t, int64_t, uint32_t, uintptr_t
from libc.stdlib cimport free
from libc.string cimport memcpy, memset

from pbonet.errors import ModuleLoadError, ParameterError
from pbonet.pbo import Answer, Recovery

ABI = PBO_ABI

cdef extern from "dlfcn.h" nogil:
    enum:
        RTLD_NOW, RTLD_LOCAL
    void *dlopen(const char *file, int mode)
    void *dlsym(void *handle, const char *name)
    char *dlerror()

cdef extern from "stdlib.h" nogil:
    int posix_memalign(void **memory, size_t align, size_t size)

cdef extern from "pbonet/cmodule/instance.h" nogil:
    void pbo_begin(pbo_instance *one, const pbo_module *module, void *state,
                   pbo_running *running)

_CODES = {"float64": PBO_F64, "float32": PBO_F32, "int64": PBO_I64, "int32": PBO_I32,
          "int16": PBO_I16, "int8": PBO_I8, "uint64": PBO_U64, "uint32": PBO_U32,
          "uint16": PBO_U16, "uint8": PBO_U8, "bool": PBO_BOOL, "text": PBO_STR}
_TYPES = {code: name for name, code in _CODES.items()}
_FORMS = {PBO_ONE: "one", PBO_ARRAY: "array", PBO_LIST: "list"}
_METHODS = ("init", "on", "cycle", "stable", "off", "kill", "error", "clear", "reinit",
            "sync", "set", "timing_failure")
_KINDS = {"deadline": PBO_DEADLINE, "maxexec": PBO_MAXEXEC, "minexec": PBO_MINEXEC}
_ANSWERS = {
    "on": {PBO_OK: None, PBO_OFF: Answer.OFF},
    "error": {PBO_OFF: Answer.OFF, PBO_CONTINUE: Answer.CONTINUE, PBO_ERROR: Answer.ERROR},
    "clear": {PBO_OFF: Answer.OFF, PBO_ERROR: Answer.ERROR},
    "timing_failure": {PBO_OK: Recovery.CONTINUE, PBO_SKIP: Recovery.SKIP,
                       PBO_ERROR: Recovery.ABORT},
}
"""Answers of methods that give more than PBO_OK or PBO_ERROR."""
_WORDS = {PBO_OK: "PBO_OK", PBO_OFF: "PBO_OFF", PBO_CONTINUE: "PBO_CONTINUE",
          PBO_SKIP: "PBO_SKIP", PBO_ERROR: "PBO_ERROR"}

cdef pbo_running running


cdef pbo_running *c_running() noexcept nogil:
    return &running


cdef str _text(const char *text):
    return "" if text is NULL else text.decode("utf-8", "replace")


cdef object _number(const double *value):
    return None if value is NULL else value[0]


cdef tuple _numbers(const double *values, uint32_t n):
    return tuple([values[i] for i in range(n)]) if values is not NULL else ()


@cython.final
cdef class SharedObject:
    cdef const pbo_module *module
    cdef readonly str path

    def __init__(self, str path):
        self.path = path
        cdef bytes name = path.encode()
        cdef void *handle = dlopen(name, RTLD_NOW | RTLD_LOCAL)
        if handle is NULL:
            raise ModuleLoadError(
                "the shared object does not load", where=path, got=_text(dlerror()),
                remedy="link it with every library that it uses (`-l...`), and build it on "
                "this machine")
        self.module = <const pbo_module *>dlsym(handle, "pbonet_module")
        if self.module is NULL:
            raise ModuleLoadError(
                "it is no module in C", where=path, expected="the symbol pbonet_module",
                got="none", remedy="end the file with PBO_MODULE(...), of pbonet.h")
        self.check("abi", self.module.abi, PBO_ABI)
        self.check("size", self.module.size, sizeof(pbo_module))
        self.check("port_size", self.module.port_size, sizeof(pbo_port))
        self.check("param_size", self.module.param_size, sizeof(pbo_param))
        self.check("signal_size", self.module.signal_size, sizeof(pbo_user_signal))
        self.check("task_size", self.module.task_size, sizeof(pbo_task))

    cdef int check(self, str field, size_t got, size_t wanted) except -1:
        if got != wanted:
            raise ModuleLoadError(
                f"the module was built for another pbonet: {field} differs",
                where=f"{self.path}: pbonet_module.{field}", expected=str(wanted),
                got=str(got), remedy="build it again with this pbonet's header: "
                "`-I$(python -c 'import pbonet; print(pbonet.get_include())')`")
        return 0

    @property
    def address(self) -> int:
        return <uintptr_t>self.module

    @property
    def about(self) -> dict:
        return {"file": _text(self.module.file), "doc": _text(self.module.doc),
                "state_size": self.module.state_size,
                "module_class": _text(self.module.module_class)}

    @property
    def ports(self) -> list:
        cdef const pbo_port *p
        found = []
        for i in range(self.module.n_ports):
            p = &self.module.ports[i]
            found.append({
                "field": _text(p.field), "name": _text(p.name), "shape": _text(p.shape),
                "unit": _text(p.unit), "doc": _text(p.doc), "kind": p.kind,
                "type": _TYPES.get(p.type, ""), "offset": p.offset, "line": p.line,
                "max_age": p.max_age or None, "stale": _text(p.stale),
                "feedback": bool(p.feedback), "new": bool(p.is_new),
                "safe": _numbers(p.safe, p.n_safe) or None,
                "value": _numbers(p.value, p.n_value) or None})
        return found

    @property
    def params(self) -> list:
        cdef const pbo_param *p
        found = []
        for i in range(self.module.n_params):
            p = &self.module.params[i]
            found.append({
                "field": _text(p.field), "unit": _text(p.unit), "doc": _text(p.doc),
                "type": _TYPES.get(p.type, ""), "form": _FORMS.get(p.form, ""),
                "room": p.room, "offset": p.offset, "line": p.line,
                "count_offset": p.count_offset,
                "initial": (_numbers(p.initial, p.n_initial) if p.text is NULL
                            else (_text(p.text),)),
                "choices": tuple([_text(p.choices[k]) for k in range(p.n_choices)]),
                "ge": _number(p.ge), "gt": _number(p.gt), "le": _number(p.le),
                "lt": _number(p.lt), "rate": _number(p.rate), "total": _number(p.total)})
        return found

    @property
    def signals(self) -> list:
        cdef const pbo_user_signal *s
        found = []
        for i in range(self.module.n_signals):
            s = &self.module.signals[i]
            found.append({"field": _text(s.name), "number": s.number,
                          "doc": _text(s.doc), "line": s.line})
        return found

    @property
    def methods(self) -> tuple:
        cdef const pbo_module *m = self.module
        there = (m.init is not NULL, m.on is not NULL, m.cycle is not NULL,
                 m.stable is not NULL, m.off is not NULL, m.kill is not NULL,
                 m.error is not NULL, m.clear is not NULL, m.reinit is not NULL,
                 m.sync is not NULL, m.set is not NULL, m.timing_failure is not NULL)
        return tuple([name for name, has in zip(_METHODS, there) if has])


@cython.final
cdef class NativeState:
    def __init__(self, SharedObject shared not None, task, arrays, values):
        cdef size_t align = max(64, shared.module.state_align)
        cdef const unsigned char[::1] data
        cdef uintptr_t address
        self.module = shared.module
        self.task = task
        self.kept = shared, arrays
        if posix_memalign(&self.memory, align, max(64, shared.module.state_size)):
            raise MemoryError
        memset(self.memory, 0, shared.module.state_size)
        pbo_begin(&self.one, self.module, self.memory, &running)
        for i in range(self.module.n_ports):
            address = arrays[_text(self.module.ports[i].field)].ctypes.data
            (<uintptr_t *>(<char *>self.memory + self.module.ports[i].offset))[0] = address
        for i in range(self.module.n_params):
            self.write(i, values[_text(self.module.params[i].field)])

    def __dealloc__(self):
        free(self.memory)

    cdef int write(self, int i, value) except -1:
        """Write a parameter into the state."""
        cdef const pbo_param *p = &self.module.params[i]
        cdef char *at = <char *>self.memory + p.offset
        cdef uint32_t k
        if p.type == PBO_STR:
            return self.write_text(p, value)
        values = value if p.form != PBO_ONE else (value,)
        if len(values) > p.room:
            raise ParameterError(
                f"parameter {_text(p.field)} has too many values",
                expected=f"at most {p.room}, for which the module has room",
                got=f"{len(values)} values", remedy="give fewer")
        for k in range(len(values)):
            if p.type == PBO_F64:
                (<double *>at)[k] = values[k]
            elif p.type == PBO_BOOL:
                (<unsigned char *>at)[k] = bool(values[k])
            else:
                try:
                    (<int64_t *>at)[k] = values[k]
                except OverflowError:
                    raise ParameterError(
                        f"parameter {_text(p.field)} is too large",
                        expected="an integer of 64 bits", got=str(values[k]),
                        remedy="give a smaller one") from None
        if p.form == PBO_LIST:
            (<int32_t *>(<char *>self.memory + p.count_offset))[0] = len(values)
        return 0

    cdef int write_text(self, const pbo_param *p, str value) except -1:
        """Write a text into the state, with zeros to the end of its room."""
        cdef bytes data = value.encode()
        cdef char *at = <char *>self.memory + p.offset
        if len(data) >= p.room or 0 in data:
            raise ParameterError(
                f"parameter {_text(p.field)} has no room for the text",
                expected=f"at most {p.room - 1} bytes in UTF-8, none of them 0",
                got=f"{len(data)} bytes", remedy="give a shorter one")
        memset(at, 0, p.room)
        memcpy(at, <const char *>data, len(data))
        return 0

    cdef int prepare(self) except -1:
        """Fill the task as it is now; forget what the last method reported."""
        cdef pbo_task *t = &self.one.task
        task = self.task
        t.now_ns = task.now
        t.cyclecount = task.cyclecount
        t.freq = task.freq
        t.period = task.period
        t.handover = task.handover
        t.errnum = task.errnum
        self.errmsg = task.errmsg.encode("utf-8", "replace")
        t.errmsg = self.errmsg
        self.one.failed = self.one.n_notices = 0
        return 0

    cdef int pass_on(self, str method) except -1:
        """Pass on what a method has reported, and its failure.

        All of it is taken first: what is called here may call a handler of timing
        failures, which reports for itself.
        """
        cdef int32_t i, answer = self.one.answer, code = self.one.code
        cdef uint32_t lost = self.one.dropped
        failure = (_text(self.one.text), f"{_text(self.one.file)}:{self.one.line}"
                   ) if self.one.failed else None
        notices = [(self.one.notices[i].signals, _text(self.one.notices[i].text),
                    self.one.notices[i].code) for i in range(self.one.n_notices)]
        self.one.n_notices = self.one.failed = 0
        self.one.dropped = 0
        for signals, text, number in notices:
            if signals:
                self.task.signal(signals)
            else:
                self.task.warn(text, number)
        if lost:
            self.task.warn(f"{lost} more warnings and signals of {method} had no room")
        if failure is not None:
            text, place = failure
            self.task.fail(text, code or 1, place=f"{place} in {method}")
        elif answer not in _ANSWERS.get(method, (PBO_OK,)):
            got = _WORDS.get(answer, str(answer))
            self.task.fail(f"{method} returned {got}", place=f"{method} of the module")
        return 0

    def call(self, str method, int argument=0):
        cdef pbo_method *plain = NULL
        cdef const pbo_module *m = self.module
        self.prepare()
        if method == "set":
            self.one.answer = m.set(self.memory, &self.one.task, argument)
        elif method == "timing_failure":
            self.one.answer = m.timing_failure(self.memory, &self.one.task, argument)
        else:
            plain = self.function(method)
            self.one.answer = plain(self.memory, &self.one.task)
        cdef int32_t answer = self.one.answer
        self.pass_on(method)
        return _ANSWERS.get(method, {}).get(answer)

    cdef pbo_method *function(self, str method) except NULL:
        cdef const pbo_module *m = self.module
        if method == "init":
            return m.init
        if method == "on":
            return m.on
        if method == "off":
            return m.off
        if method == "kill":
            return m.kill
        if method == "error":
            return m.error
        if method == "clear":
            return m.clear
        if method == "reinit":
            return m.reinit
        if method == "sync":
            return m.sync
        return m.cycle if method == "cycle" else m.stable

    def set(self, str field, value) -> None:
        cdef int i
        for i in range(self.module.n_params):
            if _text(self.module.params[i].field) == field:
                self.change(i, value)

    cdef int change(self, int i, value) except -1:
        """Write a parameter and tell the module, which may refuse it."""
        cdef const pbo_param *p = &self.module.params[i]
        cdef size_t size = p.room * (1 if p.type in (PBO_BOOL, PBO_STR) else 8)
        cdef char *at = <char *>self.memory + p.offset
        cdef bytes before = at[:size]
        cdef int32_t *count = NULL
        cdef int32_t counted = 0
        if p.form == PBO_LIST:
            count = <int32_t *>(<char *>self.memory + p.count_offset)
            counted = count[0]
        try:
            self.write(i, value)
            if self.module.set is not NULL:
                self.call("set", i)
        except BaseException:
            for k in range(size):
                at[k] = before[k]
            if count is not NULL:
                count[0] = counted
            raise
        return 0

    def timing_failure(self, str kind):
        return self.call("timing_failure", _KINDS[kind])


@cython.final
cdef class NativeMethod:
    def __init__(self, NativeState of not None, str name):
        self.of = of
        self.one = &of.one
        self.name = name
        self.function = of.function(name)

    def __call__(self, double dt) -> None:
        self.of.prepare()
        self.one.task.dt = dt
        if pbo_run(self.function, self.one):
            self.of.pass_on(self.name)

    cdef int begin(self, int64_t cycles) except -1:
        """Prepare for cycles of the native loop; `cycles` is the count of its slot."""
        self.of.prepare()
        self.before = cycles - <int64_t>self.one.task.cyclecount
        return 0
