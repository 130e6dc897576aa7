# cython: language_level=3, boundscheck=False, wraparound=False
# distutils: extra_compile_args = -O3 -std=c11
# distutils: depends = register.h arena.h sound.h lock.h directory.h owner.h keeper.h cut.h look.h guard.h flag.h fresh.h safe.h local.h survive.h watch.h slice.h
"""Thin wrapper of the C headers: buffers in, numbers out; Python raises the errors."""

from cpython.bytearray cimport PyByteArray_AS_STRING
from libc.stdint cimport int64_t, uint8_t, uint32_t, uint64_t
from libc.stdlib cimport free
from libc.string cimport memcpy, memset, strncpy
from posix.mman cimport (MADV_DONTFORK, MAP_FAILED, MAP_POPULATE, MAP_SHARED, PROT_READ, PROT_WRITE,
                         madvise, mmap, munmap)

from posix.unistd cimport close

from pbonet.svar._headers cimport *

VERSION = PB_VERSION
CAUSES = PB_CAUSES
CAUSES_EACH = PB_CAUSES_EACH
STATIC_BYTES = sizeof(pb_static)


def now_ns() -> int:
    return pb_now()


def survive_cuts() -> bool:
    """Let this process survive when a table's file is truncated."""
    return pb_survive() == 0


def short_slices() -> bool:
    """Let this thread, and those that it starts, run sooner after waking."""
    return pb_short_slices() == 0


cdef void c_guard_map(const void *base, size_t bytes) noexcept:
    pb_region_add(base, bytes)


cdef void c_unguard_map(const void *base) noexcept:
    pb_region_remove(base)


def process_start(unsigned long long pid) -> int:
    return pb_process_start(pid)


cdef class Blueprint:
    """The layout of a table to be made: its size is known before it has memory."""

    cdef pb_static fixed
    cdef bytes text
    cdef bytearray var_memory
    cdef pb_var *vars

    def __init__(self, const uint64_t[::1] sizes, const int64_t[::1] maxages, bytes text,
                 bytes layout, unsigned spare):
        cdef Py_ssize_t i, n = sizes.shape[0]
        if maxages.shape[0] != n or len(layout) != 16:
            raise ValueError("sizes, maxages and layout do not fit together")
        memset(&self.fixed, 0, sizeof(self.fixed))
        self.text = text
        self.var_memory = bytearray(max(1, n) * sizeof(pb_var))
        self.vars = <pb_var *>PyByteArray_AS_STRING(self.var_memory)
        for i in range(n):
            self.vars[i].bytes = sizes[i]
            self.vars[i].maxage_ns = maxages[i]
        self.fixed.n_vars = n
        self.fixed.text_bytes = len(text)
        memcpy(self.fixed.layout, <const char *>layout, 16)
        pb_lay_out(&self.fixed, self.vars, spare)

    @property
    def size(self) -> int:
        return self.fixed.size


cdef inline pb_table *table(Arena arena) noexcept nogil:
    return <pb_table *>arena.core


cdef class Arena:
    """A table's file, mapped whole and populated; unmapped when it has no more users."""

    def __cinit__(self, int fd, size_t size, bytes machine):
        self.memory = bytearray(sizeof(pb_table))
        self.core = PyByteArray_AS_STRING(self.memory)
        self.machine = machine
        self.machine_text = machine
        cdef void *base = mmap(NULL, size, PROT_READ | PROT_WRITE, MAP_SHARED | MAP_POPULATE, fd, 0)
        if base == MAP_FAILED:
            raise MemoryError("the table cannot be mapped")
        madvise(base, size, MADV_DONTFORK)  # a module may fork
        self.base = base
        self.bytes = size
        pb_region_add(base, size)
        self.fd = fd  # ours from here on: its lock marks the file as used

    def __dealloc__(self):
        if self.base != NULL:
            pb_region_remove(self.base)
            munmap(self.base, self.bytes)
            close(self.fd)
        free(self.own)

    def format(self, Blueprint plan not None, const uint8_t[::1] values) -> int:
        """Fill fresh zeroed memory; returns an errno."""
        if plan.fixed.size != self.bytes or <size_t>values.shape[0] < plan.fixed.keep_stamps:
            raise ValueError("the plan is of another size")
        cdef const void *first = &values[0] if values.shape[0] else NULL
        return pb_format(self.base, &plan.fixed, plan.vars, <const char *>plan.text, first)

    def verify(self) -> int:
        """Verify the file; no other method may be called unless this returns 0."""
        free(self.own)
        cdef int verdict = pb_verify(self.base, self.bytes, &self.own)
        if verdict == PB_NO_MEMORY:
            raise MemoryError("no room for the table's records")
        if verdict == PB_SOUND:
            table(self)[0] = pb_table_at(self.base, self.own)
        return verdict

    def sound(self) -> bool:
        """Return whether nothing has overwritten the mutable part, as far as it shows."""
        return pb_sound(table(self))

    @property
    def fileno(self) -> int:
        return self.fd

    @property
    def size(self) -> int:
        return self.bytes

    @property
    def version(self) -> int:
        return (<pb_static *>self.base).version

    @property
    def layout(self) -> bytes:
        return (<const char *>table(self).fixed.layout)[:16]

    @property
    def text(self) -> bytes:
        cdef const pb_static *fixed = table(self).fixed
        return (<const char *>self.own)[fixed.text:fixed.text + fixed.text_bytes]

    @property
    def generation(self) -> int:
        return pb_generation_seen(table(self))

    @property
    def changes(self) -> int:
        """A number that every change of the flag increments."""
        return pb_changes(table(self))

    def look(self, unsigned v, uint8_t[::1] to):
        """Copy a variable; returns its provenance, None if there was no whole copy."""
        cdef pb_view view
        if v >= table(self).fixed.n_vars or <size_t>to.shape[0] < table(self).vars[v].bytes:
            raise ValueError("no room for the variable")
        if pb_look(table(self), v, &to[0], &view) != 0:
            return None
        return (view.reg, view.live != 0, view.stamp.time_ns, view.stamp.cycle, view.uid,
                view.seq, view.task.decode(errors="replace"))

    def written(self, unsigned v) -> bool:
        """Return whether the owner of a variable is alive and has not ended."""
        if v >= table(self).fixed.n_vars:
            raise ValueError("no such variable")
        return pb_written(table(self), v)

    def set(self, unsigned v, const uint8_t[::1] value, long long now, bint wait=True) -> int:
        if v >= table(self).fixed.n_vars or <size_t>value.shape[0] < table(self).vars[v].bytes:
            raise ValueError("the value is too short")
        return pb_set(table(self), v, &value[0], now, wait)

    def registers(self):
        """Return (index, uid, owner, pid, task, bytes, commits, held) of those in use.

        A negative code when the lock could not be taken.
        """
        cdef bytearray memory = bytearray(table(self).fixed.n_regs * sizeof(pb_reg))
        cdef pb_reg *regs = <pb_reg *>PyByteArray_AS_STRING(memory)
        cdef uint32_t r
        cdef int code = pb_registers(table(self), regs)
        if code != 0:
            return code
        return [(r, regs[r].uid, regs[r].owner, regs[r].pid,
                 regs[r].task.decode(errors="replace"), regs[r].bytes, pb_number(regs[r].head),
                 regs[r].state != PB_LEFT)
                for r in range(1, table(self).fixed.n_regs) if regs[r].state != PB_FREE]

    def reap(self, unsigned r, unsigned long long uid) -> int:
        """Free what a dead process holds; returns 0 or a negative code."""
        if r == 0 or r >= table(self).fixed.n_regs:
            raise ValueError("no such register")
        return pb_reap(table(self), r, uid)

    cdef int c_raise_illegal(self, const char *cause, const char *raiser) noexcept nogil:
        cdef pb_cause c = pb_cause_of(cause, raiser, self.machine_text)
        return pb_raise(table(self), &c)

    cdef int c_clear_illegal(self, const char *raiser) noexcept nogil:
        cdef pb_cause c = pb_cause_of(b"", raiser, self.machine_text)
        return pb_clear(table(self), &c)

    cdef bint c_illegal(self) noexcept nogil:
        cdef pb_seen seen
        seen.changes, seen.up = 0, False
        return pb_illegal(table(self), &seen)

    def raise_illegal(self, bytes cause, bytes raiser, bytes machine) -> int:
        cdef pb_cause c = pb_cause_of(cause, raiser, machine)
        return pb_raise(table(self), &c)

    def clear_illegal(self, bytes cause, bytes raiser, bytes machine) -> int:
        cdef pb_cause c = pb_cause_of(cause, raiser, machine)
        return pb_clear(table(self), &c)

    def causes(self):
        """Return (cause, raiser, machine, time_ns) of every entry.

        None when they changed in every attempt.
        """
        cdef pb_seen seen
        seen.changes, seen.up = self.looked_at, self.seen_up
        cdef bint up = pb_illegal(table(self), &seen)
        self.looked_at, self.seen_up = seen.changes, seen.up
        if not up:
            return []
        cdef bytearray memory = bytearray(PB_CAUSES * sizeof(pb_cause))
        cdef pb_cause *c = <pb_cause *>PyByteArray_AS_STRING(memory)
        cdef int i, n = pb_causes(table(self), c)
        if n < 0:
            return None
        return [(c[i].cause.decode(errors="replace"), c[i].raiser.decode(errors="replace"),
                 c[i].machine.decode(errors="replace"), c[i].time_ns) for i in range(n)]

    @property
    def unlisted(self) -> int:
        return table(self).live.unlisted


cdef inline pb_local *local(LocalTable task) noexcept nogil:
    return <pb_local *>task.core


cdef inline int copy(LocalTable task, int which) noexcept nogil:
    task.flags = pb_copy_in(local(task), local(task).plans + which)
    task.n_consumed = local(task).n_consumed
    return task.flags


cdef inline unsigned long long outside(const pb_plan *p) noexcept nogil:
    """Return a number that increases with each commit from outside; 0: there is none."""
    cdef uint32_t i
    cdef uint64_t heads = 0
    for i in range(p.n_sources):
        if p.sources[i].outside:
            heads += p.sources[i].head
    return heads


cdef inline int send(LocalTable task, pb_stamp stamp) noexcept nogil:
    task.flags = pb_commit(local(task), local(task).outputs + PB_GROUP_VARS, stamp)
    task.out_number = pb_committed(local(task).outputs + PB_GROUP_VARS)
    return task.flags


cdef void *room(list kept, size_t n, size_t size):
    memory = bytearray((n or 1) * size)
    kept.append(memory)
    return PyByteArray_AS_STRING(memory)


cdef class LocalTable:
    """Native half of a task's local table; the other half is in pbonet.svar.local."""

    def __cinit__(self, Arena arena not None, uint8_t[::1] data not None, uint8_t[::1] staging,
                  size_t largest, *args, **kwargs):
        self.arena = arena
        self.kept = [data, staging]
        self.core = room(self.kept, 1, sizeof(pb_local))
        local(self).table = table(arena)[0]
        local(self).data = &data[0]
        local(self).staging = NULL if staging is None else &staging[0]
        self.consumed = <unsigned long long *>room(self.kept, 2 * largest, sizeof(uint64_t))
        self.make_safe = <void *>pb_make_safe
        local(self).consumed = <uint64_t *>self.consumed

    def set_plan(self, unsigned which, const uint32_t[::1] vars, const uint64_t[::1] to):
        """Set which variables a copy reads, and their places."""
        cdef pb_plan *plan = local(self).plans + which
        cdef size_t n = vars.shape[0]
        self.kept += [vars, to]
        plan.n_vars = n
        plan.vars = &vars[0] if n else NULL
        plan.to = &to[0] if n else NULL
        plan.sources = <pb_source *>room(self.kept, n, sizeof(pb_source))
        plan.pieces = <pb_piece *>room(self.kept, n, sizeof(pb_piece))
        plan.ages = <pb_age *>room(self.kept, n, sizeof(pb_age))

    def set_freshness(self, unsigned which, limits, double settle) -> None:
        """Set how a copy of a plan handles ages.

        Args:
            limits: Of each variable of the plan: limit in nanoseconds (0: none), action,
                and whether its age is passed on.
            settle: Seconds that inputs must have been fresh; negative: two renewals.
        """
        cdef pb_plan *plan = local(self).plans + which
        cdef pb_freshness *f = <pb_freshness *>room(self.kept, plan.n_vars, sizeof(pb_freshness))
        for i, (maxage_ns, action, passes) in enumerate(limits):
            f[i].maxage_ns, f[i].action, f[i].passes = maxage_ns, action, passes
        plan.fresh = f
        plan.age_of = <uint32_t *>room(self.kept, plan.n_vars, sizeof(uint32_t))
        plan.generation = 0     # the next copy plans again
        if which == PB_PLAN_IN:
            local(self).fresh.settle_ns = <int64_t>(settle * 1e9)
            local(self).fresh.renewals = <pb_renewal *>room(self.kept, plan.n_vars,
                                                            sizeof(pb_renewal))

    def set_group(self, unsigned which, const uint32_t[::1] vars, const uint64_t[::1] at,
                  size_t first, size_t size, list checks):
        """Set which variables are written together, and their checks."""
        cdef pb_outputs *o = local(self).outputs + which
        cdef pb_check *c = <pb_check *>room(self.kept, len(checks), sizeof(pb_check))
        cdef const uint8_t[::1] low, high
        self.kept += [vars, at, checks]
        o.group.n = vars.shape[0]
        o.group.vars = &vars[0] if o.group.n else NULL
        o.group.at = &at[0] if o.group.n else NULL
        o.group.bytes = size
        o.first = first
        o.checks = c
        o.n_checks = len(checks)
        for i, (kind, rule, var, place, n, low, high) in enumerate(checks):
            c[i].type, c[i].rule, c[i].var, c[i].at, c[i].n = kind, rule, var, place, n
            if low is not None and high is not None:
                c[i].min, c[i].max = <const void *>&low[0], <const void *>&high[0]
        if which == PB_GROUP_VARS:
            self.out_data = local(self).data + first
            self.out_bytes = size

    def enter(self, unsigned which, unsigned long long owner, unsigned long long pid,
              bytes task) -> int:
        """Take a register for a group; returns its index or a negative code."""
        cdef pb_reg who
        memset(&who, 0, sizeof(who))
        who.owner, who.pid, who.start = owner, pid, pb_process_start(pid)
        who.space = pb_process_space()
        strncpy(who.task, task, PB_NAME - 1)
        named = bytearray(table(self.arena).fixed.n_regs)
        return pb_enter(table(self.arena), &local(self).outputs[which].group, &who,
                        <uint8_t *>PyByteArray_AS_STRING(named))

    def ask(self, unsigned which) -> tuple:
        """Return (code, variable): whether a claim would be refused."""
        cdef uint32_t rival = 0
        cdef pb_outputs *o = local(self).outputs + which
        cdef int code = pb_ask(table(self.arena), &o.group, local(self).data + o.first,
                               which == PB_GROUP_CONSTS, &rival)
        return code, rival

    def take(self, unsigned which, long long now, unsigned long long cycle,
             long long own=0) -> tuple:
        """Check, commit and claim a group; returns (code, variable), flags in `flags`."""
        cdef uint32_t rival = 0
        cdef pb_stamp stamp
        stamp.time_ns, stamp.cycle = now, cycle
        if which == PB_GROUP_VARS:
            stamp = pb_stamp_of(&local(self).fresh, own, now, cycle)
        cdef pb_outputs *o = local(self).outputs + which
        cdef int code
        self.flags = pb_judge(local(self), o)
        if self.flags or not o.group.n:
            return 0, 0
        code = pb_claim(table(self.arena), &o.group, local(self).data + o.first,
                        stamp, which == PB_GROUP_CONSTS, &rival)
        o.live = o.live or code == 0
        if which == PB_GROUP_VARS:
            self.out_uid, self.out_number = o.group.uid, pb_committed(o)
        return code, rival

    def succeed(self, unsigned which, list names) -> None:
        """Let claims of a group take its variables from these tasks while they live."""
        cdef pb_group *g = &local(self).outputs[which].group
        cdef bytes joined
        joined = b"".join([name[:PB_NAME - 1].ljust(PB_NAME, b"\0") for name in names])
        if self.predecessors is None:
            self.predecessors = [b"", b""]
        self.predecessors[which] = joined       # keeps the memory in place
        g.predecessors = <const char *>joined
        g.n_predecessors = len(names)
        g.ends = NULL

    def note_ends(self, unsigned which) -> int:
        """Accept hand-overs only from tasks that commit nothing from here on."""
        cdef pb_group *g = &local(self).outputs[which].group
        cdef list kept = []
        cdef pb_last *ends = <pb_last *>room(kept, g.n, sizeof(pb_last))
        if self.ends is None:
            self.ends = [None, None]
        cdef int code = pb_note_ends(table(self.arena), g, ends)
        if code == 0:
            self.ends[which] = kept     # keeps the memory in place
        return code

    def set_safe(self, const uint8_t[::1] values) -> None:
        """Set what a failed cycle's out-vars become, laid out as their group."""
        cdef pb_outputs *o = local(self).outputs + PB_GROUP_VARS
        if <size_t>values.shape[0] != o.group.bytes or not o.group.n:
            raise ValueError("the values are of another size")
        self.kept.append(values)
        local(self).safe_data = &values[0]

    cdef void c_share(self, void *safe) noexcept nogil:
        if local(self).safe_data != NULL:
            local(self).safe = <pb_safe *>safe

    cdef void c_begin_cycle(self, unsigned long long number) noexcept nogil:
        pb_cycle_begins(local(self), number)

    cdef bint c_end_cycle(self) noexcept nogil:
        cdef bint safe = pb_cycle_ends(local(self))
        if safe:
            self.out_number = pb_committed(local(self).outputs + PB_GROUP_VARS)
        return safe

    def cede(self) -> None:
        """Stop writing, and leave the variables to the successor's claim."""
        pb_cede(local(self), &local(self).outputs[PB_GROUP_VARS])

    def give(self, unsigned which, bint leave) -> int:
        """Release a group's variables; returns 0 or a negative code."""
        cdef pb_outputs *o = local(self).outputs + which
        o.live = False
        if o.group.reg == NULL:
            return 0
        return pb_let_go(table(self.arena), o.group.reg - table(self.arena).regs, o.group.uid,
                         leave, False)

    def owns(self, unsigned which) -> bool:
        return local(self).outputs[which].live

    def register_uid(self, unsigned which) -> int:
        return local(self).outputs[which].group.uid

    cdef int c_copy_in(self) noexcept nogil:
        return copy(self, PB_PLAN_IN)

    cdef bint c_aged(self) noexcept nogil:
        if local(self).fresh.renewals == NULL:
            return (self.flags & PB_COPY_STALE) != 0
        return local(self).fresh.settling

    cdef bint c_to_report(self) noexcept nogil:
        return local(self).fresh.report if local(self).fresh.renewals else self.c_aged()

    cdef int c_action(self) noexcept nogil:
        return local(self).fresh.action if local(self).fresh.settling else 0

    cdef void c_make_new(self) noexcept nogil:
        local(self).fresh.oldest_ns = 0

    cdef int c_commit(self, long long own_ns, long long now_ns, unsigned long long cycle) noexcept nogil:
        cdef pb_stamp stamp = pb_stamp_of(&local(self).fresh, own_ns, now_ns, cycle)
        self.cycles = cycle
        if not pb_cycle_commits(local(self)):
            self.flags = PB_COMMIT_LATE
            return self.flags
        if self.held:
            self.flags = pb_judge(local(self), local(self).outputs + PB_GROUP_VARS)
            self.held_ns, self.held_cycle = 0 if self.flags else stamp.time_ns, stamp.cycle
            return self.flags
        return send(self, stamp)

    cdef size_t c_due(self, bint whole) noexcept nogil:
        cdef const pb_plan *p = local(self).plans + PB_PLAN_IN
        cdef size_t bytes = 0
        cdef uint32_t i
        if not whole and p.generation == self.stored and outside(p) == self.stored_set:
            return 0
        for i in range(p.n_vars):
            bytes += local(self).table.vars[p.vars[i]].bytes
        return bytes

    cdef int c_inputs(self) noexcept nogil:
        return local(self).plans[PB_PLAN_IN].n_vars

    cdef const void *c_input(self, int i, size_t *n) noexcept nogil:
        cdef const pb_plan *p = local(self).plans + PB_PLAN_IN
        n[0] = local(self).table.vars[p.vars[i]].bytes
        return local(self).data + p.to[i]

    cdef void c_stored(self) noexcept nogil:
        cdef const pb_plan *p = local(self).plans + PB_PLAN_IN
        self.stored, self.stored_set = p.generation, outside(p)

    cdef bint c_illegal(self) noexcept nogil:
        return pb_illegal(&local(self).table, &local(self).flag)

    def is_stale(self, unsigned var) -> bool:
        """Return whether an in-var is older than its MAXAGE, by its last copy."""
        return pb_is_stale(local(self), var)

    def copy_in(self) -> int:
        """Copy the in-vars as one consistent cut; returns flags."""
        return copy(self, PB_PLAN_IN)

    def copy_in_on(self) -> int:
        """Copy in-vars and out-vars, as `on` needs them; returns flags."""
        return copy(self, PB_PLAN_ON)

    def copy_in_consts(self) -> int:
        """Copy the in-consts; returns flags."""
        return copy(self, PB_PLAN_CONSTS)

    def commit(self, long long now_ns=0, unsigned long long cycle=0, long long own_ns=0) -> int:
        """Commit the out-vars as one group; returns flags, and nothing is sent if any is set."""
        if self.held or self.held_ns:
            self.publish()
        return self.c_commit(own_ns, now_ns or pb_now(), cycle or self.cycles + 1)

    def publish(self) -> None:
        """Send a commit that was checked while `held` was set; nothing if there is none."""
        cdef pb_stamp stamp
        stamp.time_ns, stamp.cycle = self.held_ns, self.held_cycle
        self.held_ns, self.held = 0, False
        if stamp.time_ns:
            send(self, stamp)

    def age_ns(self, unsigned var) -> int:
        """Return the age of an in-var by its last copy; -1: never written."""
        return pb_age_of(local(self), var)

    def stamp_from(self, unsigned var) -> int:
        """Return the stamp of what is computed from this in-var alone; 0: now."""
        return pb_stamp_from(local(self), var)

    def make_new(self) -> None:
        """Let the next commit not inherit the age of an input."""
        self.c_make_new()

    @property
    def action(self) -> int:
        """The strongest action of inputs that are stale or settling; 0: none."""
        return self.c_action()

    @property
    def virtual_ns(self) -> int:
        return local(self).virtual_ns

    @virtual_ns.setter
    def virtual_ns(self, int64_t now_ns):
        local(self).virtual_ns = now_ns

    def read_one(self, unsigned v, unsigned long long at) -> int:
        return pb_read_one(local(self), v, at)

    def write_one(self, unsigned which, unsigned i, long long now, unsigned long long cycle) -> int:
        return pb_commit_one(local(self), local(self).outputs + which, i, now, cycle)

    @property
    def illegal(self) -> bool:
        return self.c_illegal()

    @property
    def pairs(self) -> list:
        """(register uid, sequence) of every register in the last copy."""
        return [(self.consumed[2 * i], self.consumed[2 * i + 1]) for i in range(self.n_consumed)]

    @property
    def fault(self) -> tuple:
        return local(self).fault_var, local(self).fault_element

    @property
    def counts(self) -> dict:
        return local(self).counts


cdef class Watch:
    """Sleep of a thread that mirrors tables, until a bell rings or a table changes."""

    cdef pb_watch core
    cdef list arenas            # kept alive, because their words are watched

    def __cinit__(self):
        memset(&self.core, 0, sizeof(self.core))
        self.arenas = []

    def forget(self) -> None:
        self.core.n = 0
        self.arenas = []

    def add(self, Arena arena not None, unsigned long long generation,
            unsigned long long changes, heads) -> None:
        cdef pb_table *t = table(arena)
        cdef uint32_t r
        self.arenas.append(arena)
        pb_watch_add(&self.core, &t.live.generation, generation, True)
        pb_watch_add(&self.core, &t.live.changes, changes, False)
        for r, number in heads:
            if r < t.fixed.n_regs:
                pb_watch_add(&self.core, &t.regs[r].head, number, True)

    def ring(self) -> None:
        pb_watch_ring(&self.core)

    def sleep(self, int64_t until_ns, int64_t pause_ns) -> bool:
        cdef int how
        with nogil:
            if pause_ns:
                how = pb_watch_sleep(&self.core, until_ns, pause_ns)
            else:
                how = pb_watch_awake(&self.core, until_ns)
        return how == PB_MOVED
