/* The interface of modules in C (Stewart 1994, section 3.6). C11; no Python, no library.
 *
 * A module is a shared object NAME.so. It has one struct with its ports, its parameters
 * and its own data; two tables that say which field is what; and functions for the
 * methods. `PBO_MODULE` puts them together under the one name that pbonet looks for.
 * docs/c-modules.md explains each part; `pbonet new module --c` writes a first module.
 */
#ifndef PBONET_H
#define PBONET_H

#include <stdbool.h>
#include <stddef.h>
#include <stdint.h>

/* Number of this interface. A module is loaded by a pbonet of the same number only. */
#define PBO_ABI 2

/* What methods return. */
enum {
    PBO_OK = 0,         /* done */
    PBO_OFF = 1,        /* `on`: not yet, stay OFF; `error`, `clear`: may be turned on */
    PBO_CONTINUE = 2,   /* `error`: the cause is gone, go on */
    PBO_SKIP = 3,       /* `timing_failure`: leave out the next release */
    PBO_ERROR = -1      /* failed; `error`, `clear`: an operator is needed */
};

/* Kinds of timing failure, as bits of `must_end`. */
enum { PBO_DEADLINE = 1, PBO_MAXEXEC = 2, PBO_MINEXEC = 4 };

/* Signals to the master (Stewart 1994, section 4.4.4). */
enum { PBO_SIGNAL_OFF = 1, PBO_SIGNAL_FINISH = 2, PBO_SIGNAL_SHUTDOWN = 16 };

/* -- the task ------------------------------------------------------------------------- */

/* The task as its module sees it. The runtime fills it before each method. */
typedef struct pbo_task pbo_task;
struct pbo_task {
    double dt;              /* s since the release of the last executed cycle */
    int64_t now_ns;         /* release of this cycle, ns of CLOCK_MONOTONIC */
    uint64_t cyclecount;    /* cycles since the task was turned on */
    double period;          /* s; 0: not periodic */
    double freq;            /* Hz; 0: not periodic */
    int32_t handover;       /* `off`: a successor takes over the outputs at once; `on`: this task does */
    int32_t errnum;         /* the last error's number, 0 for none */
    const char *errmsg;     /* its text; for `error` and `clear` */
    /* Timing failures of this cycle, as bits; set while `cycle` runs. For tasks with
     * `timing_failure`; in a combination of modules, of any part. */
    volatile uint32_t must_end;
    struct pbo_svar { pbo_task *vartable; } svar;   /* for pbonet_chimera.h */
    /* Use the macros below. */
    int (*fail)(pbo_task *, const char *file, int line, int code, const char *format, ...)
        __attribute__((format(printf, 5, 6)));
    void (*warn)(pbo_task *, int code, const char *format, ...)
        __attribute__((format(printf, 3, 4)));
    void (*signal)(pbo_task *, uint32_t signals);
    void *(*data)(pbo_task *, const char *port);
};

/* End a method with an error: `return pbo_fail(task, 7, "joint %d is hot", joint);`. The
 * code is a number other than 0; the text is cut after 199 bytes. Nothing waits. */
#define pbo_fail(task, code, ...) \
    ((task)->fail((task), __FILE__, __LINE__, (code), __VA_ARGS__))
/* Report a problem that does not end the method; at most 8 in one method are kept. */
#define pbo_warn(task, code, ...) ((task)->warn((task), (code), __VA_ARGS__))
/* Send signals to the master, as bits; they leave when the method has returned. */
#define pbo_signal(task, signals) ((task)->signal((task), (signals)))
/* The bit of a signal of the module's own, by its number. */
#define PBO_USER(NUMBER) (UINT32_C(1) << (7 + (NUMBER)))
/* The data of a port by its name in the .rmod file; NULL if there is none. */
#define pbo_data(task, port) ((task)->data((task), (port)))

/* -- ports ---------------------------------------------------------------------------- */

enum { PBO_INCONST, PBO_OUTCONST, PBO_INVAR, PBO_OUTVAR };
enum {
    PBO_F64 = 1, PBO_F32, PBO_I64, PBO_I32, PBO_I16, PBO_I8,
    PBO_U64, PBO_U32, PBO_U16, PBO_U8, PBO_BOOL, PBO_STR
};

typedef struct {
    const char *field, *name, *shape, *unit, *doc;
    const char *stale;
    const double *safe, *value;
    double max_age;
    uint32_t offset, line, n_safe, n_value;
    uint8_t kind, type, feedback, is_new;
} pbo_port;

#define PBO_LENGTH(array) (sizeof(array) / sizeof((array)[0]))
#define PBO_VALUES(...) ((const double[]){__VA_ARGS__})

/* A pointer of another type than these is an error of the compiler: an input points to
 * const, an output does not. */
#define PBO_INPUT_TYPE(S, F) _Generic(((S *)0)->F, \
    const double *: PBO_F64, const float *: PBO_F32, \
    const int64_t *: PBO_I64, const int32_t *: PBO_I32, \
    const int16_t *: PBO_I16, const int8_t *: PBO_I8, \
    const uint64_t *: PBO_U64, const uint32_t *: PBO_U32, \
    const uint16_t *: PBO_U16, const uint8_t *: PBO_U8, const bool *: PBO_BOOL)
#define PBO_OUTPUT_TYPE(S, F) _Generic(((S *)0)->F, \
    double *: PBO_F64, float *: PBO_F32, int64_t *: PBO_I64, int32_t *: PBO_I32, \
    int16_t *: PBO_I16, int8_t *: PBO_I8, uint64_t *: PBO_U64, uint32_t *: PBO_U32, \
    uint16_t *: PBO_U16, uint8_t *: PBO_U8, bool *: PBO_BOOL)
#define PBO_PORT_(S, F, KIND, TYPE, NAME, SHAPE, UNIT, ...) \
    {.field = #F, .name = NAME, .shape = SHAPE, .unit = UNIT, .offset = offsetof(S, F), \
     .line = __LINE__, .kind = KIND, .type = TYPE, .doc = __VA_ARGS__}

/* One port: the struct, its field, the name in the .rmod file, the shape in fields of
 * the same struct ("1", "6", "ndof", "ndof,4"), the unit, what it carries, options. */
#define PBO_IN_CONST(S, F, NAME, SHAPE, UNIT, ...) \
    PBO_PORT_(S, F, PBO_INCONST, PBO_INPUT_TYPE(S, F), NAME, SHAPE, UNIT, __VA_ARGS__)
#define PBO_OUT_CONST(S, F, NAME, SHAPE, UNIT, ...) \
    PBO_PORT_(S, F, PBO_OUTCONST, PBO_OUTPUT_TYPE(S, F), NAME, SHAPE, UNIT, __VA_ARGS__)
#define PBO_IN_VAR(S, F, NAME, SHAPE, UNIT, ...) \
    PBO_PORT_(S, F, PBO_INVAR, PBO_INPUT_TYPE(S, F), NAME, SHAPE, UNIT, __VA_ARGS__)
#define PBO_OUT_VAR(S, F, NAME, SHAPE, UNIT, ...) \
    PBO_PORT_(S, F, PBO_OUTVAR, PBO_OUTPUT_TYPE(S, F), NAME, SHAPE, UNIT, __VA_ARGS__)

/* Options of a port, after its description; docs/failsafe.md explains them. */
#define PBO_MAX_AGE(SECONDS) .max_age = (SECONDS)
#define PBO_STALE(ACTION) .stale = (ACTION)
#define PBO_FEEDBACK .feedback = 1
#define PBO_NEW .is_new = 1
#define PBO_SAFE(...) \
    .safe = PBO_VALUES(__VA_ARGS__), .n_safe = PBO_LENGTH(PBO_VALUES(__VA_ARGS__))
#define PBO_VALUE(...) /* of an out-const: what it holds before `init` */ \
    .value = PBO_VALUES(__VA_ARGS__), .n_value = PBO_LENGTH(PBO_VALUES(__VA_ARGS__))

/* -- parameters ----------------------------------------------------------------------- */

typedef struct {
    const char *field, *unit, *doc;
    const double *initial, *ge, *gt, *le, *lt, *rate, *total;
    const char *text;               /* the default of a text */
    const char *const *choices;
    uint32_t offset, line, n_initial, room, count_offset, n_choices;
    uint8_t type, form;
} pbo_param;

enum { PBO_ONE, PBO_ARRAY, PBO_LIST };

#define PBO_PARAM_TYPE(S, F) _Generic(((S *)0)->F, \
    double: PBO_F64, int64_t: PBO_I64, bool: PBO_BOOL)
#define PBO_ELEMENT_TYPE(S, F) _Generic(&((S *)0)->F[0], \
    double *: PBO_F64, int64_t *: PBO_I64, bool *: PBO_BOOL)
#define PBO_COUNT_(S, F) \
    (offsetof(S, F) + 0 * sizeof(_Generic(((S *)0)->F, int32_t: 1)))
#define PBO_PARAM_(S, F, FORM, TYPE, ROOM, UNIT, ...) \
    .field = #F, .unit = UNIT, .offset = offsetof(S, F), .line = __LINE__, \
    .form = FORM, .type = TYPE, .room = (uint32_t)(ROOM), .doc = __VA_ARGS__

/* One parameter: the struct, its field (double, int64_t or bool), the unit, what it is,
 * options. The field holds the value before `init`, and the new one before `set`. */
#define PBO_PARAM(S, F, UNIT, ...) \
    {PBO_PARAM_(S, F, PBO_ONE, PBO_PARAM_TYPE(S, F), 1, UNIT, __VA_ARGS__)}
/* A field that is an array: exactly as many values. */
#define PBO_PARAM_ARRAY(S, F, UNIT, ...) \
    {PBO_PARAM_(S, F, PBO_ARRAY, PBO_ELEMENT_TYPE(S, F), PBO_LENGTH(((S *)0)->F), UNIT, \
                __VA_ARGS__)}
/* A field that is an array with room for more values than are given; the int32_t field N
 * holds how many there are, at least one. */
#define PBO_PARAM_LIST(S, F, N, UNIT, ...) \
    {PBO_PARAM_(S, F, PBO_LIST, PBO_ELEMENT_TYPE(S, F), PBO_LENGTH(((S *)0)->F), UNIT, \
                __VA_ARGS__), .count_offset = PBO_COUNT_(S, N)}
/* A text in UTF-8: an array of char with room for it and the zero at its end. Its options
 * are PBO_TEXT (the default) and PBO_CHOICES. */
#define PBO_PARAM_TEXT(S, F, ...) \
    {PBO_PARAM_(S, F, PBO_ONE, _Generic(&((S *)0)->F[0], char *: PBO_STR), \
                PBO_LENGTH(((S *)0)->F), "none", __VA_ARGS__)}

/* Options of a parameter, after its description. Without PBO_DEFAULT it must be given. */
#define PBO_DEFAULT(...) \
    .initial = PBO_VALUES(__VA_ARGS__), .n_initial = PBO_LENGTH(PBO_VALUES(__VA_ARGS__))
#define PBO_GE(VALUE) .ge = PBO_VALUES(VALUE)       /* smallest value */
#define PBO_GT(VALUE) .gt = PBO_VALUES(VALUE)       /* values are larger */
#define PBO_LE(VALUE) .le = PBO_VALUES(VALUE)       /* largest value */
#define PBO_LT(VALUE) .lt = PBO_VALUES(VALUE)       /* values are smaller */
#define PBO_RATE(VALUE) .rate = PBO_VALUES(VALUE)   /* largest step while ON */
#define PBO_TOTAL(VALUE) .total = PBO_VALUES(VALUE) /* sum of all values */
#define PBO_TEXT(TEXT) .text = (TEXT)
#define PBO_CHOICES(...) /* the only texts that are allowed */ \
    .choices = (const char *const[]){__VA_ARGS__}, \
    .n_choices = PBO_LENGTH(((const char *const[]){__VA_ARGS__}))

/* -- signals of the module's own -------------------------------------------------------- */

typedef struct {
    const char *name, *doc;
    uint32_t number, line;
} pbo_user_signal;

/* One signal (Stewart 1994, section 4.4.4): a number of 0 to 24, a name in capital letters,
 * what it means. `pbo_signal(task, PBO_USER(number))` sends it. */
#define PBO_USER_SIGNAL(NUMBER, NAME, DOC) \
    {.number = (NUMBER), .name = NAME, .line = __LINE__, .doc = DOC}

/* -- the module ----------------------------------------------------------------------- */

typedef int pbo_method(void *state, pbo_task *task);

typedef struct {
    uint32_t abi, size, port_size, param_size, signal_size, task_size;
    uint32_t state_size, state_align, n_ports, n_params, n_signals;
    const char *file, *doc, *module_class;
    const pbo_port *ports;
    const pbo_param *params;
    const pbo_user_signal *signals;
    /* Called as the methods of PortBasedObject; `state` begins as zeros. All but `cycle`
     * may be left out. */
    pbo_method *init, *on, *cycle, *stable, *off, *kill, *error, *clear, *reinit, *sync;
    /* Parameter number `param` of the table has changed; PBO_ERROR refuses it. */
    int (*set)(void *state, pbo_task *task, int param);
    /* A timing failure, PBO_DEADLINE ...: called when `cycle` has returned, or in place of
     * a cycle that could not finish. PBO_OK goes on, PBO_SKIP leaves out a release,
     * PBO_ERROR discards the outputs and runs `on` again. */
    int (*timing_failure)(void *state, pbo_task *task, int kind);
} pbo_module;

#define PBO_PORTS(TABLE) .ports = (TABLE), .n_ports = PBO_LENGTH(TABLE)
#define PBO_PARAMS(TABLE) .params = (TABLE), .n_params = PBO_LENGTH(TABLE)
#define PBO_SIGNALS(TABLE) .signals = (TABLE), .n_signals = PBO_LENGTH(TABLE)
/* Its class in the library: "controller", "robot interface" and so on. */
#define PBO_CLASS(NAME) .module_class = (NAME)

/* The module: its struct, what it does, PBO_PORTS(...), PBO_PARAMS(...), PBO_SIGNALS(...),
 * PBO_CLASS(...), methods. */
#define PBO_MODULE(S, DOC, ...) \
    _Static_assert(sizeof(S) <= UINT32_MAX, "the struct of a module is too large"); \
    extern const pbo_module pbonet_module; \
    __attribute__((visibility("default"), used)) const pbo_module pbonet_module = { \
        .abi = PBO_ABI, .size = sizeof(pbo_module), .port_size = sizeof(pbo_port), \
        .param_size = sizeof(pbo_param), .signal_size = sizeof(pbo_user_signal), \
        .task_size = sizeof(pbo_task), \
        .state_size = sizeof(S), .state_align = _Alignof(S), .file = __FILE__, \
        .doc = DOC, __VA_ARGS__}

#endif
