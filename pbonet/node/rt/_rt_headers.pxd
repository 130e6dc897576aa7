"""The C headers as Cython sees them; atomic fields are accessed by functions only."""

from libc.stdint cimport int32_t, int64_t, uint16_t, uint32_t, uint64_t

from pbonet.cmodule._cmodule cimport pbo_running


cdef extern from "layout.h" nogil:
    enum:
        RT_SLOTS, RT_MASKS, RT_MEMBERS, RT_NAME, RT_TRACE, RT_BINS, RT_VERSION, RT_SIGNALS
        RT_COMMAND_LEVEL, RT_DISPATCHER_LEVEL
        RT_OFF, RT_ON, RT_COMMAND
        RT_PERIODIC, RT_SYNCHRONOUS, RT_DEFERRABLE, RT_SPORADIC, RT_BACKGROUND
        RT_FAILURES, RT_SECTIONS, RT_SECTION_NAME, RT_HANDLER_HANGS
        RT_NONE, RT_FIFO, RT_PARK
        RT_ASK_COMMAND, RT_ASK_ORPHAN, RT_ASK_LAST
        RT_ALONE, RT_FALLBACK, RT_HANDOVER
    const int64_t RT_MIN_PERIOD_NS
    struct rt_event:
        int64_t a, b
        uint32_t arg
        uint16_t slot, kind
    struct rt_config:
        char *rtpu
        char *task
        uint64_t callers
    struct pb_safe:
        pass
    struct rt_slot:
        rt_config config
        pb_safe safe
    struct rt_table:
        rt_slot *slots
        int64_t due_ns, virtual_ns
        uint32_t mailbox
    enum:
        RT_TELLS
    int RT_SAFE_AT(int kind)

cdef extern from "../../svar/flag.h" nogil:
    struct pb_table:
        pass

cdef extern from "sys.h" nogil:
    int64_t rt_now()
    uint64_t rt_thread_cpu()
    int64_t rt_cpu_of(int pid, int tid)
    struct rt_meter:
        int file
    int64_t rt_meter_read(rt_meter *meter, int pid, int tid)
    void rt_meter_close(rt_meter *meter)
    int rt_pin(int tid, int core)

cdef extern from "table.h" nogil:
    enum:
        RT_NO_TABLE, RT_FOREIGN, RT_BAD_VERSION, RT_DAMAGED, RT_MEMBERS_FULL
    struct rt_map:
        rt_table *table
        int fd, member
    struct rt_settings:
        int32_t pid, crit, priority, kind, drop, handler, tells
        int64_t period_ns, deadline_ns, minc_ns, maxc_ns, hang_ns
    int rt_attach(rt_map *map, const char *path, int core, int member)
    void rt_detach(rt_map *map, const char *path)
    void rt_unmap(rt_map *map)
    void rt_reap_others(rt_table *t, int me)
    int rt_alloc(rt_table *t, int member, const char *rtpu, const char *task)
    void rt_free(rt_table *t, int i)
    void rt_configure(rt_table *t, int i, const rt_settings *s)
    void rt_died(rt_table *t, int i)
    void rt_follow(rt_table *t, int i, int kind, const uint64_t *after, uint64_t callers)
    void rt_kick(rt_table *t)
    void rt_relevel(rt_table *t)
    int64_t rt_time(const rt_table *t)
    int rt_is_virtual(const rt_table *t)

cdef extern from "call.h" nogil:
    uint64_t rt_callers(uint32_t ticket, int n)
    int rt_expects(const rt_config *c, uint64_t callers, uint32_t life, uint32_t ticket,
                   int caller)
    int rt_call(rt_config *c, uint32_t life, uint32_t ticket, int caller)

cdef extern from "dispatch.h" nogil:
    ctypedef int64_t (*rt_cpu_fn)(const rt_slot *)
    int64_t rt_turn(rt_table *t, int64_t now, int park, int lead, rt_cpu_fn cpu)
    void rt_turn_end(rt_table *t)

cdef extern from "loop.h" nogil:
    struct rt_loop:
        rt_table *table
        int backend, running
    int rt_start(rt_loop *loop)
    void rt_stop(rt_loop *loop)
    int rt_leading(const rt_loop *loop)
    int rt_try_fifo()
    void rt_keep_values(rt_loop *loop, int i, const pb_table *table, const void *data,
                        uint64_t bytes)
    void rt_drop_values(rt_loop *loop, int i)

cdef extern from "slot.h" nogil:
    enum:
        RT_RELEASED, RT_WAIT_COMMAND, RT_WAIT_ORPHAN, RT_WAIT_SIGNAL, RT_WAIT_IDLE
    struct rt_task:
        rt_table *table
        rt_slot *slot
        int kind
        int64_t rel_ns, dl_ns
    struct rt_cost:
        int64_t start_ns, called_ns, returned_ns, end_ns
        uint64_t cpu_ns
        int failed, stable, torn, stale, lost, aborted
    void rt_arm(rt_task *task)
    int rt_rest(rt_task *task)
    int rt_leave(rt_task *task, int mode)
    int rt_fall(rt_task *task)
    int rt_was_last(rt_task *task)
    void rt_stand_by_for(rt_task *task)
    int rt_command_level(const rt_task *task)
    int rt_wait(rt_task *task, int served)
    int rt_begin(rt_task *task)
    uint32_t rt_number_of(const rt_task *task)
    void rt_meet_dispatcher(rt_task *task)
    void rt_end(rt_task *task)
    int64_t rt_step(const rt_task *task)
    void rt_account(rt_task *task, const rt_cost *cost)
    void rt_request(rt_slot *slot, uint32_t ask)
    void rt_ask_restart(rt_slot *slot)
    uint64_t rt_mark_cpu(rt_task *task)
    uint64_t rt_faults()
    void rt_count_faults(rt_slot *slot, uint64_t n)

cdef extern from "vigil.h" nogil:
    enum:
        RT_CAUSE, RT_RAISER
    struct rt_watched:
        const pb_table *table
        char *died
        char *fell
        char *raiser
        char *machine
    struct rt_vigil:
        int running
        rt_watched *watched
    int rt_vow(rt_slot *slot)
    void rt_release_vow(rt_slot *slot)
    int rt_start_vigil(rt_vigil *v, const rt_loop *loop)
    void rt_end_vigil(rt_vigil *v)
    void rt_watch_life(rt_vigil *v, int i)
    void rt_unwatch(rt_vigil *v, int i)
    uint64_t rt_deaths(const rt_vigil *v)
    uint64_t rt_falls(const rt_vigil *v)

cdef extern from "signals.h" nogil:
    uint32_t rt_send_signal(rt_slot *slot, uint32_t bits)
    uint64_t rt_signal_count(const rt_slot *slot, int k)
    void rt_mask_signals(rt_slot *slot, uint32_t bits)
    uint32_t rt_signal_mask(const rt_slot *slot)

cdef extern from "Python.h" nogil:
    int PyErr_SetInterruptEx(int signum) noexcept

cdef extern from "failure.h" nogil:
    enum:
        RT_IN_CYCLE, RT_IN_SYNC
    int RT_FAIL_SIGNAL
    int rt_guard_failures(rt_task *task, int64_t bound_ns, int (*interrupt)(int) noexcept,
                          pbo_running *in_c)
    void rt_unguard_failures(const rt_task *task)
    void rt_use_safe(void (*make_safe)(void *) noexcept, void *of)
    int rt_enter(int where)
    int rt_has_failed(const rt_task *task)
    void rt_exit()
    unsigned rt_take_failures(rt_task *task)
    uint32_t rt_begin_handler(rt_task *task)
    void rt_end_handler(rt_task *task, uint32_t told)
    void rt_begin_abort()
    int rt_handles()
    int rt_is_overdue()
    int rt_is_aborting()
    int rt_is_outside()
    void rt_lock()
    int rt_unlock()
    void rt_wish(rt_task *task, int crit, int64_t dl_ns)
    void rt_post_wish(rt_task *task, int crit, int64_t dl_ns)
    void rt_skipped(rt_task *task, uint64_t cpu_ns)
    int rt_section(rt_slot *slot, const char *name)
    void rt_time_section(rt_slot *slot, int k, uint64_t ns)

cdef extern from "view.h" nogil:
    struct rt_section_view:
        char *name
        uint64_t count, total_ns, min_ns, max_ns
    struct rt_view:
        int life, dead, pid, kind, crit, priority, mode, level
        int rank, drop, handler, tells, hangs, hung, flooded, in_sync, comes, called, fell, n_sections
        int restarted
        int64_t period_ns, deadline_ns, release_ns, minc_ns, maxc_ns
        uint64_t dispatcher_missed, errors, overruns, held_off
        uint64_t *failures
        uint64_t aborted, skipped, handlers, uncalled_failures
        uint64_t delivery_last_ns, delivery_max_ns
        uint32_t safe
        int64_t safe_last_ns, safe_max_ns
        int safe_stands
        rt_section_view *sections
        uint64_t on_ns, cycles, late, failed, stable, torn, stale, faults, ring_lost
        uint64_t on_cycles, on_missed, on_failed, on_cpu_ns, on_faults
        uint64_t cpu_total_ns, cpu_last_ns, cpu_min_ns, cpu_max_ns
        uint64_t cpu_first_ns, cpu_mark_ns
        uint64_t wall_total_ns, held_ns, copy_in_ns, copy_out_ns, jitter_max_ns
        uint64_t *jitter
        uint64_t *cpu
    struct rt_core_view:
        int backend, leader_pid, leader_tid, look_tid
        int64_t since_ns, late_max_ns
        uint64_t turns, releases, level_changes, errors, takeovers, stalls, stalled_ns
        uint64_t spared
        int64_t stall_age_ns
    struct rt_part:
        int mode, begun, done, event, locked, handled, fell
        int64_t now_ns, cpu_ns
    void rt_snapshot(const rt_slot *slot, rt_view *v)
    void rt_core_snapshot(const rt_table *t, rt_core_view *v)
    int rt_member_at(const rt_table *t, int i, int *lives)
    uint64_t rt_copy_trace(const rt_table *t, uint64_t since, rt_event *to,
                           uint64_t *first, uint64_t *end)
    uint32_t rt_life(const rt_table *t, int i)
    int rt_mode_of(const rt_slot *slot)
    int rt_kind_of(const rt_slot *slot)
    int rt_after_of(const rt_slot *slot)
    uint64_t rt_cycles(const rt_slot *slot)
    uint64_t rt_missed(const rt_slot *slot)
    int64_t rt_period(const rt_slot *slot)
    int rt_pending(const rt_slot *slot)
    int rt_leader(const rt_table *t)
    int64_t rt_posted_cpu(const rt_slot *slot)
    int rt_crit_of(const rt_slot *slot)
    int rt_own_crit_of(const rt_slot *slot)
    int64_t rt_deadline_of(const rt_slot *slot)
    void rt_play(rt_table *t, rt_slot *slot, const rt_part *part)
    int rt_play_turn(rt_table *t, int64_t now_ns)
    void rt_play_grant(rt_table *t, rt_slot *slot, int64_t now_ns, int periodic)

cdef extern from "restrict.h" nogil:
    int rt_restrict(const int32_t *pids, size_t count)
    int rt_drop_rights()

cdef extern from "interrupts.h" nogil:
    int rt_see_interrupt(int signal)
    int rt_take_interrupt()

cdef extern from "guard.h" nogil:
    struct xm_steady:
        pass
    int rt_guard_slot(const rt_task *task, xm_steady *steady)
    void rt_unguard_slot(rt_slot *slot)
    int rt_guard_orphan(int signal, int parent)
    int rt_is_orphan()
    int rt_leave_to_next(int signal)
    int rt_lock_memory()
    int rt_prefault_stack(size_t size)
    int rt_spare_heap(size_t size)
    int rt_populate(size_t at, size_t size)
    size_t rt_populate_absent(size_t at, size_t size)
    void rt_timer_slack(unsigned long ns)
