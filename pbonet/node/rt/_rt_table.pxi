# Part of _rt.pyx: the core's table and its dispatcher; documented in `_rt.pyi`.

cdef _refuse(int error, str path):
    """Raise the error for a result of rt_attach."""
    if error == RT_NO_TABLE:
        raise NodeError("the core has no table", where=path,
                        remedy="start an agent for this core first")
    if error == RT_FOREIGN:
        raise RealTimeError("the core table belongs to another user", where=path,
                            expected="a file of this user with mode 0600",
                            remedy="find out who made it and remove it")
    if error == RT_BAD_VERSION:
        raise NodeError("the core table is of another version of pbonet", where=path,
                        expected=f"version {RT_VERSION}",
                        remedy="stop the agents of the other version on this core")
    if error == RT_DAMAGED:
        raise NodeError("the core table is damaged", where=path,
                        remedy="restart the agents of this core")
    if error == RT_MEMBERS_FULL:
        raise NodeError("too many RTPUs share this core", where=path,
                        expected=f"at most {RT_MEMBERS}",
                        remedy="start the agent with another --core, or stop one of this core")
    if error == ENOSPC:
        raise RealTimeError("shared memory is full", where=path,
                            expected=f"{sizeof(rt_table)} bytes",
                            remedy="free space there, or set PBONET_SHM_DIR")
    raise RealTimeError(f"the core table cannot be opened: {os.strerror(error)}",
                        where=path)


cdef class CoreTable:
    cdef rt_map map
    cdef rt_table *t
    cdef char *file
    cdef readonly int core
    cdef readonly str path
    cdef readonly bint member
    cdef int busy           # dispatchers of this process that run on it
    cdef rt_meter[2] meters  # of the leader's threads
    cdef uint32_t heard     # mailbox value that the last turn in virtual time has seen

    def __cinit__(self, int core, *, bint member=True, int64_t virtual_ns=0):
        self.core = core
        self.member = member
        name = f"virtual{os.getpid()}.{core}" if virtual_ns else f"core{core}"
        self.path = str(shm.path_of(name))
        cdef int error
        self.file = strdup(os.fsencode(self.path))
        with nogil:
            error = rt_attach(&self.map, self.file, core, member)
        if error:
            _refuse(error, self.path)
        self.t = self.map.table
        if not member:          # an agent survives a truncated file; members and tasks do not
            c_guard_map(self.t, sizeof(rt_table))
        if virtual_ns:
            os.unlink(self.path)        # no other process may find it
            self.turn(virtual_ns)

    def close(self) -> None:
        if self.busy:
            raise NodeError("the core table is in use", where=self.path,
                            remedy="stop the dispatcher first")
        self.detach()

    def __dealloc__(self):
        self.detach()
        free(self.file)

    cdef void detach(self):
        rt_meter_close(&self.meters[0])
        rt_meter_close(&self.meters[1])
        if self.t is not NULL:
            if not self.member:
                c_unguard_map(self.t)
            self.t = NULL
            rt_detach(&self.map, self.file)

    cdef rt_table *open(self) except NULL:
        if self.t is NULL:
            raise NodeError("the core table is closed", where=self.path)
        return self.t

    cdef rt_slot *slot(self, int i) except NULL:
        self.open()
        if not 0 <= i < RT_SLOTS or not rt_life(self.t, i) & 1:
            raise NodeError(f"slot {i} is not in use", where=self.path)
        return &self.t.slots[i]

    def alloc(self, str rtpu, str task) -> int:
        cdef bytes r = rtpu.encode(), n = task.encode()
        if max(len(r), len(n)) >= RT_NAME:
            raise NodeError("the name is too long", where=f"{rtpu}/{task}",
                            expected=f"at most {RT_NAME - 1} bytes")
        self.open()
        if not self.member:
            raise NodeError("only a member of the core takes slots", where=self.path,
                            remedy="open the table with member=True")
        cdef int i = rt_alloc(self.t, self.map.member, r, n)
        if i < 0:
            raise NodeError("all slots of the core are taken", where=self.path,
                            expected=f"at most {RT_SLOTS} tasks",
                            remedy="kill tasks, or use another core")
        rt_kick(self.t)
        return i

    def relevel(self) -> None:
        rt_relevel(self.open())

    def kick(self) -> None:
        rt_kick(self.open())

    def reap(self) -> None:
        rt_reap_others(self.t, self.map.member)

    def free(self, int i) -> None:
        self.slot(i)
        rt_free(self.t, i)
        rt_kick(self.t)

    def configure(self, int i, *, pid=None, period_ns=None, deadline_ns=None, crit=None,
                  priority=None, kind=None, minc_ns=None, maxc_ns=None, hang_ns=None,
                  drop=None, handler=None, tells=None, safe_at=()) -> None:
        cdef rt_slot *slot = self.slot(i)
        cdef rt_settings s = rt_settings(pid=-1, crit=-1, priority=-1, kind=-1,
                                         period_ns=-1, deadline_ns=-1, minc_ns=-1,
                                         maxc_ns=-1, hang_ns=-1, drop=-1, handler=-1,
                                         tells=-1)
        if minc_ns is not None:
            s.minc_ns = _within("minc_ns", minc_ns, 0, 1 << 61)
        if maxc_ns is not None:
            s.maxc_ns = _within("maxc_ns", maxc_ns, 0, 1 << 61)
        if hang_ns is not None:
            s.hang_ns = _within("hang_ns", hang_ns, 1, 1 << 61)
        if drop is not None:
            s.drop = _within("drop", drop, 0, 63)
        if handler is not None:
            s.handler = _within("handler", handler, 0, 63)
        if tells is not None:
            s.tells = RT_TELLS if tells else 0
            for one in safe_at:
                s.tells |= RT_SAFE_AT(KINDS.index(one))
        if pid is not None:
            s.pid = _within("pid", pid, 1, 1 << 30)
        if period_ns is not None:
            s.period_ns = _within("period_ns", period_ns, RT_MIN_PERIOD_NS, 1 << 61)
        if deadline_ns is not None:
            s.deadline_ns = _within("deadline_ns", deadline_ns, 0, 1 << 61)
        if crit is not None:
            s.crit = _within("crit", crit, 0, 63)
        if priority is not None:
            s.priority = _within("priority", priority, 0, 65535)
        if kind is not None:
            s.kind = Kind(kind)
            if rt_mode_of(slot) != RT_OFF:
                raise ValueError("the kind of a task changes only while it is OFF")
        rt_configure(self.t, i, &s)
        rt_kick(self.t)

    def request(self, int i, *, bint last=False) -> None:
        rt_request(self.slot(i), RT_ASK_LAST if last else RT_ASK_COMMAND)

    def restart_extremes(self, int i) -> None:
        rt_ask_restart(self.slot(i))

    def follow(self, int i, slots) -> None:
        cdef uint64_t after[RT_MASKS]
        memset(after, 0, sizeof(after))
        for one in slots:
            self.slot(one)
            after[<int>one // 64] |= <uint64_t>1 << (<int>one % 64)
        self.slot(i)
        rt_follow(self.t, i, RT_FALLBACK if slots else RT_ALONE, after, 0)
        rt_kick(self.t)

    def expect(self, int i, unsigned ticket, int callers) -> int:
        cdef uint64_t nobody[RT_MASKS]
        memset(nobody, 0, sizeof(nobody))
        if not 0 < callers <= 32:
            raise ValueError(f"{callers} callers; at most 32 fit")
        if not 0 < ticket < <unsigned>1 << 31:
            raise ValueError(f"{ticket} is no ticket; those are from 1 to 2**31 - 1")
        self.slot(i)
        rt_follow(self.t, i, RT_HANDOVER, nobody, rt_callers(ticket, callers))
        rt_kick(self.t)
        return rt_life(self.t, i)

    cdef rt_config *awaiting(self, int i, int caller) except? NULL:
        """Return the configuration of slot `i`; NULL if the arguments are invalid."""
        self.open()
        if 0 <= i < RT_SLOTS and 0 <= caller < 32:
            return &self.t.slots[i].config
        return NULL

    def expects(self, int i, unsigned life, unsigned ticket, int caller) -> bool:
        cdef const rt_config *c = self.awaiting(i, caller)
        return c is not NULL and bool(rt_expects(c, c.callers, life, ticket, caller))

    cdef bint count_call(self, int i, unsigned life, unsigned ticket,
                         int caller) except? -1:
        cdef rt_config *c = self.awaiting(i, caller)
        return c is not NULL and rt_call(c, life, ticket, caller)

    def call(self, int i, unsigned life, unsigned ticket, int caller) -> bool:
        cdef bint heard = self.count_call(i, life, ticket, caller)
        if heard:
            rt_kick(self.t)
        return heard

    def died(self, int i) -> None:
        self.slot(i)
        rt_died(self.t, i)
        rt_kick(self.t)

    def slots(self, rtpu=None) -> list:
        self.open()
        return [i for i in range(RT_SLOTS) if rt_life(self.t, i) & 1
                and (rtpu is None or self.t.slots[i].config.rtpu.decode() == rtpu)]

    def find(self, str rtpu, str task):
        for i in self.slots(rtpu):
            if self.t.slots[<int>i].config.task.decode() == task:
                return i
        return None

    def snapshot(self, int i):
        cdef rt_slot *slot = self.slot(i)
        cdef rt_view v
        rt_snapshot(slot, &v)
        return SlotStatus(
            index=i, rtpu=slot.config.rtpu.decode(), task=slot.config.task.decode(),
            pid=v.pid, kind=Kind(v.kind), mode=Mode(v.mode), dead=bool(v.dead),
            comes=bool(v.comes), called=bool(v.called), fell=bool(v.fell),
            period_ns=v.period_ns, deadline_ns=v.deadline_ns, crit=v.crit,
            priority=v.priority, level=v.level, errors=v.errors, now_ns=rt_time(self.t),
            on_ns=v.on_ns, release_ns=v.release_ns, cycles=v.cycles,
            missed=v.dispatcher_missed + v.failed + v.skipped, late=v.late, failed=v.failed,
            stable_cycles=v.stable, on_cycles=v.on_cycles, on_missed=v.on_missed,
            on_failed=v.on_failed, on_cpu_ns=v.on_cpu_ns, on_faults=v.on_faults, cpu_total_ns=v.cpu_total_ns,
            cpu_last_ns=v.cpu_last_ns, cpu_min_ns=v.cpu_min_ns, cpu_max_ns=v.cpu_max_ns,
            restarted=bool(v.restarted),
            cpu_first_ns=v.cpu_first_ns, cpu_now_ns=_under_way(&v),
            wall_total_ns=v.wall_total_ns, held_ns=v.held_ns,
            copy_in_ns=v.copy_in_ns, copy_out_ns=v.copy_out_ns, torn=v.torn,
            stale=v.stale, faults=v.faults, ring_lost=v.ring_lost,
            jitter_max_ns=v.jitter_max_ns,
            jitter=octaves([v.jitter[k] for k in range(RT_BINS)]),
            rank=v.rank, drop=v.drop, handler=v.handler, minc_ns=v.minc_ns,
            maxc_ns=v.maxc_ns, failures=tuple([v.failures[k] for k in range(RT_FAILURES)]),
            overruns=v.overruns, held_off=v.held_off, aborted=v.aborted,
            skipped=v.skipped, handlers=v.handlers, uncalled_failures=v.uncalled_failures,
            delivery_last_ns=v.delivery_last_ns, delivery_max_ns=v.delivery_max_ns,
            safe=v.safe, safe_last_ns=v.safe_last_ns, safe_max_ns=v.safe_max_ns,
            safe_stands=bool(v.safe_stands),
            hangs=bool(v.hangs), hung=bool(v.hung), flooded=bool(v.flooded), in_sync=bool(v.in_sync), sections=tuple([
                Section(v.sections[k].name.decode(errors="replace"), v.sections[k].count,
                        v.sections[k].total_ns, v.sections[k].min_ns,
                        v.sections[k].max_ns) for k in range(v.n_sections)]))

    def signals(self, int i) -> tuple:
        cdef rt_slot *slot = self.slot(i)
        cdef int k
        return tuple([rt_signal_count(slot, k) for k in range(RT_SIGNALS)])

    def mask_signals(self, int i, uint32_t bits) -> None:
        rt_mask_signals(self.slot(i), bits)

    def histograms(self, int i):
        cdef rt_view v
        rt_snapshot(self.slot(i), &v)
        return Histograms(jitter=[v.jitter[k] for k in range(RT_BINS)],
                          cpu=[v.cpu[k] for k in range(RT_BINS)])

    def status(self):
        cdef rt_core_view v
        rt_core_snapshot(self.open(), &v)
        return CoreStatus(
            core=self.core, backend=_BACKENDS[v.backend], leader_pid=v.leader_pid,
            leader_tid=v.leader_tid, since_ns=v.since_ns, turns=v.turns,
            releases=v.releases, level_changes=v.level_changes, errors=v.errors,
            late_max_ns=v.late_max_ns, takeovers=v.takeovers,
            stalls=v.stalls, stalled_ns=v.stalled_ns, spared=v.spared,
            stall_age_ns=v.stall_age_ns if v.stall_age_ns >= 0 else None)

    def cpu_ns(self) -> int:
        cdef rt_core_view v
        rt_core_snapshot(self.open(), &v)
        cdef int64_t time = rt_meter_read(&self.meters[0], v.leader_pid, v.leader_tid)
        if v.look_tid:
            time += rt_meter_read(&self.meters[1], v.leader_pid, v.look_tid)
        return time

    def members(self) -> list:
        cdef int lives
        cdef rt_table *t = self.open()
        found = [(rt_member_at(t, k, &lives), bool(lives)) for k in range(RT_MEMBERS)]
        return [one for one in found if one[0]]

    def trace(self, uint64_t since=0):
        self.open()
        cdef uint64_t end, first, n, k
        cdef rt_event *copy = <rt_event *>malloc(RT_TRACE * sizeof(rt_event))
        if copy is NULL:
            raise MemoryError
        try:
            n = rt_copy_trace(self.t, since, copy, &first, &end)
            records = [Decision(copy[k].kind, copy[k].slot, copy[k].arg, copy[k].a,
                                copy[k].b) for k in range(n)]
        finally:
            free(copy)
        return end, first - since if first > since else 0, records

    cdef _alone(self):
        if rt_leader(self.open()):
            raise RealTimeError("a dispatcher leads this core", where=self.path,
                                expected="virtual time on a table of its own")

    def step(self, int64_t now_ns, *, bint park=False, bint lead=False) -> int:
        self._alone()
        cdef int64_t due = rt_turn(self.t, now_ns, park, lead, rt_posted_cpu)
        rt_turn_end(self.t)
        return due

    @property
    def virtual_ns(self) -> int:
        return self.open().virtual_ns

    @virtual_ns.setter
    def virtual_ns(self, int64_t now_ns):
        self.open().virtual_ns = now_ns

    @property
    def due_ns(self) -> int:
        cdef rt_table *t = self.open()
        return t.due_ns if t.mailbox == self.heard else t.virtual_ns

    def turn(self, int64_t now_ns) -> int:
        self._alone()
        self.heard = self.t.mailbox
        return rt_play_turn(self.t, now_ns)

    def grant(self, int i, int64_t now_ns, *, bint periodic=True) -> None:
        self._alone()
        rt_play_grant(self.t, self.slot(i), now_ns, periodic)

    def post(self, int i, *, mode=None, bint begun=False, bint done=False, event=None,
             locked=None, bint handled=False, bint fell=False, wish=None,
             int64_t cpu_ns=0) -> None:
        self._alone()
        cdef rt_part part = rt_part(
            mode=-1 if mode is None else int(mode), begun=begun, done=done,
            event=event is not None, locked=-1 if locked is None else bool(locked),
            handled=handled, fell=fell, now_ns=event or 0, cpu_ns=cpu_ns)
        rt_play(self.t, self.slot(i), &part)
        cdef rt_task task
        if wish is not None:
            task.table, task.slot = self.t, self.slot(i)
            rt_post_wish(&task, wish[0], wish[1])


def _within(name, value, low, high):
    if not low <= value <= high:
        raise ValueError(f"{name} {value} is not within {low} to {high}")
    return value


cdef _under_way(rt_view *v):
    """Return the CPU time that the cycle under way has used; 0 without one."""
    if v.mode != RT_ON or not v.cpu_mark_ns:
        return 0
    return max(rt_cpu_of(v.pid, v.pid) - <int64_t>v.cpu_mark_ns, 0)


cdef class Dispatcher:
    cdef rt_loop loop
    cdef readonly CoreTable table
    cdef int pid
    cdef dict values        # by slot: table and bytes that the thread uses

    def __init__(self, CoreTable table not None, str backend="auto"):
        table.open()
        if backend not in ("auto", "fifo", "park"):
            raise ValueError(f"backend {backend!r} is not auto, fifo or park")
        if self.loop.running:
            raise NodeError("the dispatcher runs already")
        cdef int error = 0
        if backend != "park":
            error = rt_try_fifo()
        if error and backend == "fifo":
            what, _, remedy = probe().reasons[0].partition("; ")
            raise RealTimeError(what.replace(", timing is soft", ""), remedy=remedy)
        self.table = table
        self.values = {}
        self.loop.table = table.t
        self.loop.backend = RT_PARK if backend == "park" or error else RT_FIFO
        self.pid = os.getpid()

    def start(self) -> None:
        if self.loop.running:
            return
        self.table.open()
        cdef int error = rt_start(&self.loop)
        if error:
            raise RealTimeError("the dispatcher's thread cannot be started",
                                where=f"core {self.table.core}", got=os.strerror(error),
                                remedy="is the core in this process's affinity mask?")
        self.table.busy += 1

    def keep_values(self, int i, Arena arena not None, const uint8_t[::1] values) -> None:
        self.table.slot(i)
        self.drop_values(i)
        self.values[i] = arena, values
        rt_keep_values(&self.loop, i, <pb_table *>arena.core, &values[0], values.shape[0])

    def drop_values(self, int i) -> None:
        if i in self.values:
            rt_drop_values(&self.loop, i)
            del self.values[i]

    def stop(self) -> None:
        if self.loop.running and self.pid == os.getpid():
            with nogil:
                rt_stop(&self.loop)
            self.table.busy -= 1

    def __dealloc__(self):
        if self.loop.running and self.pid == os.getpid():
            with nogil:
                rt_stop(&self.loop)

    @property
    def leading(self) -> bool:
        return bool(rt_leading(&self.loop))

    @property
    def running(self) -> bool:
        return bool(self.loop.running)

    @property
    def backend(self) -> str:
        return _BACKENDS[self.loop.backend]
