"""The C headers of this folder, as far as _svar.pyx uses them."""

from libc.stdint cimport int64_t, uint8_t, uint32_t, uint64_t

cdef extern from "safe.h" nogil:
    struct pb_safe:
        pass

cdef extern from "local.h" nogil:
    enum: PB_NAME, PB_TEXT, PB_CAUSES, PB_CAUSES_EACH, PB_VERSION, PB_PLAN_CONSTS, PB_PLAN_IN, PB_PLAN_ON
    enum: PB_FREE, PB_LEFT, PB_GROUP_VARS, PB_GROUP_CONSTS, PB_SOUND, PB_NO_MEMORY, PB_OVERWRITTEN
    enum: PB_KEEPER, PB_COPY_STALE, PB_COMMIT_LATE
    struct pb_stamp:
        int64_t time_ns
        uint64_t cycle
    struct pb_static:
        uint32_t n_vars, n_regs, version
        uint64_t size, text, text_bytes, live, keep_stamps
        uint8_t layout[16]
    struct pb_var:
        uint64_t bytes
        int64_t maxage_ns
    struct pb_cause:
        int64_t time_ns
        char cause[128]
        char raiser[64]
        char machine[64]
    struct pb_reg:
        uint64_t state, uid, bytes, owner, pid, start, space, head
        char task[64]
    struct pb_live:
        uint64_t generation, changes, unlisted
    struct pb_table:
        uint8_t *base
        pb_live *live
        const pb_static *fixed
        const pb_var *vars
        pb_reg *regs
    struct pb_last:
        uint64_t uid, number
    struct pb_group:
        pb_reg *reg
        uint64_t bytes, uid
        uint32_t n
        const uint32_t *vars
        const uint64_t *at
        const char *predecessors
        uint32_t n_predecessors
        const pb_last *ends
    struct pb_check:
        uint32_t type, rule, var
        uint64_t at, n
        const void *min
        const void *max
    struct pb_source:
        pb_reg *reg
        uint64_t uid, head
        bint outside
    struct pb_piece:
        uint64_t bytes
    uint64_t PB_PASSED_ON
    struct pb_freshness:
        int64_t maxage_ns
        uint32_t action, passes
    struct pb_age:
        uint32_t var
    struct pb_renewal:
        uint32_t times
    struct pb_freshness_state:
        int64_t settle_ns, oldest_ns
        pb_renewal *renewals
        int action
        bint settling, report
    struct pb_plan:
        uint32_t n_vars, n_sources
        const pb_freshness *fresh
        uint32_t *age_of
        uint64_t generation
        const uint32_t *vars
        const uint64_t *to
        pb_source *sources
        pb_piece *pieces
        pb_age *ages
    struct pb_outputs:
        pb_group group
        const pb_check *checks
        uint32_t n_checks
        bint live
        uint64_t first
    struct pb_counts:
        uint64_t copies, retries, torn, lost, stale, commits, refused, clipped
    struct pb_seen:
        uint64_t changes
        bint up
    struct pb_local:
        pb_table table
        uint8_t *data
        uint8_t *staging
        pb_plan plans[3]
        pb_outputs outputs[2]
        pb_counts counts
        int64_t virtual_ns
        uint64_t *consumed
        uint32_t n_consumed, fault_var
        uint64_t fault_element
        pb_seen flag
        pb_freshness_state fresh
        pb_safe *safe
        const uint8_t *safe_data
        uint64_t open
    struct pb_view:
        pb_stamp stamp
        uint64_t uid, seq
        uint32_t reg, live
        char task[64]
    uint64_t pb_number(uint64_t head)
    void pb_lay_out(pb_static *s, pb_var *vars, uint64_t spare)
    int pb_format(void *base, pb_static *s, pb_var *vars, const void *text, const void *values)
    pb_table pb_table_at(void *base, const void *fixed)
    int pb_verify(const void *base, uint64_t bytes, void **own)
    bint pb_sound(pb_table *t)
    int pb_look(pb_table *t, uint32_t v, void *to, pb_view *view)
    bint pb_written(pb_table *t, uint32_t v)
    int pb_set(pb_table *t, uint32_t v, const void *value, int64_t now_ns, bint wait)
    int pb_enter(pb_table *t, pb_group *g, pb_reg *who, uint8_t *named)
    int pb_note_ends(pb_table *t, pb_group *g, pb_last *ends)
    int pb_ask(pb_table *t, pb_group *g, const uint8_t *data, bint constants, uint32_t *rival)
    int pb_claim(pb_table *t, pb_group *g, const uint8_t *data, pb_stamp stamp, bint constants,
                 uint32_t *rival)
    int pb_let_go(pb_table *t, uint32_t r, uint64_t uid, bint leave, bint dead)
    int pb_registers(pb_table *t, pb_reg *copies)
    pb_cause pb_cause_of(const char *cause, const char *raiser, const char *machine)
    int pb_raise(pb_table *t, const pb_cause *cause)
    int pb_clear(pb_table *t, const pb_cause *which)
    int pb_causes(pb_table *t, pb_cause *copies)
    bint pb_illegal(pb_table *t, pb_seen *seen)
    int pb_reap(pb_table *t, uint32_t r, uint64_t uid)
    uint64_t pb_generation_seen(pb_table *t)
    uint64_t pb_changes(pb_table *t)
    uint64_t pb_process_start(uint64_t pid)
    uint64_t pb_process_space()
    int64_t pb_now()
    int pb_copy_in(pb_local *l, pb_plan *p)
    void pb_cycle_begins(pb_local *l, uint64_t number)
    bint pb_cycle_commits(pb_local *l)
    bint pb_cycle_ends(pb_local *l)
    void pb_make_safe(pb_local *l)
    bint pb_is_stale(const pb_local *l, uint32_t v)
    int pb_judge(pb_local *l, pb_outputs *o)
    uint64_t pb_committed(const pb_outputs *o)
    void pb_cede(const pb_local *l, pb_outputs *o)
    int64_t pb_age_of(const pb_local *l, uint32_t v)
    int64_t pb_stamp_from(const pb_local *l, uint32_t v)
    pb_stamp pb_stamp_of(const pb_freshness_state *s, int64_t own_ns, int64_t now_ns,
                         uint64_t cycle)
    int pb_commit(pb_local *l, pb_outputs *o, pb_stamp stamp)
    int pb_commit_one(pb_local *l, pb_outputs *o, uint32_t i, int64_t now_ns, uint64_t cycle)
    int pb_read_one(pb_local *l, uint32_t v, uint64_t at)

cdef extern from "survive.h" nogil:
    void pb_region_add(const void *base, size_t bytes)
    void pb_region_remove(const void *base)
    int pb_survive()

cdef extern from "slice.h" nogil:
    int pb_short_slices()

cdef extern from "watch.h" nogil:
    enum: PB_MOVED
    struct pb_watch:
        uint32_t n
    void pb_watch_add(pb_watch *w, const void *at, uint64_t known, bint head)
    void pb_watch_ring(pb_watch *w)
    int pb_watch_sleep(pb_watch *w, int64_t until_ns, int64_t pause_ns)
    int pb_watch_awake(pb_watch *w, int64_t until_ns)
