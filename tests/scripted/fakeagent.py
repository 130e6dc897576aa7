"""Agents without tasks: they speak the messages over zenoh and have fault switches.

For tests of the master alone; what tasks do is the node's matter. A `SharedState` is
one machine: its agents share the values of each subsystem's table.
"""

from __future__ import annotations

import queue
import threading
import time
from dataclasses import dataclass, field

import zenoh

from pbonet.config import parse_rmod, parse_svar
from pbonet.config.library import Library
from pbonet.errors import (
    ClaimError,
    NodeError,
    ParameterError,
    PbonetError,
    StateError,
    UnknownTaskError,
    UnknownVariableError,
)
from pbonet.pbo import ModuleInfo
from pbonet.versions import LAYERS
from pbonet.xm.net import (
    codec,
    dialling,
    key_expressions,
    messages as m,
    roles,
    run_folder,
    session,
)

MOVES = {
    ("OFF", "on"): "ON",
    ("ON", "off"): "OFF",
    ("OFF", "kill"): "NOT-CREATED",
    ("ON", "kill"): "NOT-CREATED",
    ("ERROR", "kill"): "NOT-CREATED",
    ("ERROR", "clear"): "OFF",
    ("OFF", "reinit"): "OFF",
    ("ON", "reinit"): "ON",
}
GUARDED = (
    m.Spawn
    | m.Control
    | m.Successors
    | m.Reconfig
    | m.Set
    | m.Rank
    | m.Write
    | m.CloseTable
    | m.Release
    | m.Flag
    | m.Record
)


@dataclass
class FakeTask:
    name: str
    text: str
    rmod_name: str
    freq: float
    crit: int
    priority: int
    state: str = "OFF"
    error: str = ""
    since: float = 0.0
    params: dict[str, str] = field(default_factory=dict)


@dataclass
class SharedState:
    """What the agents of one machine share."""

    domain: str
    values: dict[str, dict[str, list[float]]] = field(default_factory=dict)
    library: Library = field(default_factory=Library)
    log: list[tuple[str, str]] = field(default_factory=list)
    """Pairs of RTPU and what it did, in order."""


class Link:
    """A zenoh session that some agents share, closed with the last of them.

    Several routers in one process sometimes make zenoh panic when one of them closes,
    which agents, each in a process of its own, do not; so they share one router, unless
    a test is about the loss of a router.
    """

    def __init__(self, world: SharedState, *names: str) -> None:
        places = [run_folder.Places(world.domain, name) for name in names]
        endpoints = [one.endpoint for one in places[1:]]
        near = dialling.neighbours(places[0])
        self.session = session.agent(places[0], listen=endpoints, dial=near)
        self.users = len(names)

    def leave(self) -> None:
        self.users -= 1
        if self.users == 0 and not self.session.is_closed():
            self.session.close()


class FakeAgent:
    def __init__(self, world: SharedState, name: str, link: Link) -> None:
        self.world = world
        self.name = name
        self.places = run_folder.Places(world.domain, name)
        self.lock = run_folder.NameLock(self.places.lock, "fake")
        self.claims: dict[str, tuple[int, str]] = {}
        self.exclusive = ""
        self.tasks: dict[str, FakeTask] = {}
        self.tables: dict[str, str] = {}
        self.flags: list[str] = []
        self.silent = False
        self.machine = "fake"
        self.fail: dict[tuple[str, str], PbonetError] = {}
        self.lost: list[m.Lost] = []
        self.told: list[m.Event] = []
        """Its events."""
        self.ahead = 0.0
        """Seconds by which its clock is ahead."""
        self.deaf: set[str] = set()
        """Agents to which it has no path."""
        self.slow: dict[str, float] = {}
        self.held: dict[str, threading.Event] = {}
        self.late: list[dict[str, list[float]]] = []
        """What has not come here yet: older values, for one look each."""
        self.executed: dict[str, bytes] = {}
        self.executing: dict[str, threading.Lock] = {}
        self.requests: list[m.Request] = []
        self.standing: list[m.Standing] = []
        self.codec = codec.Codec()
        self.link = link
        self.session = link.session
        self.closed = False
        self.kept: list[zenoh.Query] = []
        self.queries = queue.SimpleQueue()
        self.queryables = [
            self.session.declare_queryable(
                self.key(leaf), zenoh.handlers.Callback(self.queries.put)
            )
            for leaf in roles.LEAVES
        ]
        self.token = self.session.liveliness().declare_token(self.key("alive"))
        self.workers = [
            threading.Thread(target=self.work, daemon=True) for _ in range(4)
        ]
        for worker in self.workers:
            worker.start()

    def key(self, leaf: str) -> str:
        return key_expressions.rtpu(self.world.domain, self.name, leaf)

    def neighbours(self) -> list[str]:
        """Return the agents that this one sees, itself among them."""
        return session.rtpus(self.session, self.world.domain)

    def close(self) -> None:
        if self.closed:
            return
        self.closed = True
        if not self.session.is_closed():
            self.token.undeclare()
            for queryable in self.queryables:
                queryable.undeclare()
        for query in self.kept:
            query.drop()
        self.link.leave()
        for _ in self.workers:
            self.queries.put(None)
        for worker in self.workers:
            worker.join(5)
        self.lock.release()

    def work(self) -> None:
        try:
            while (query := self.queries.get()) is not None:
                if self.silent:
                    self.kept.append(query)
                    continue
                with query:
                    query.reply(query.key_expr, self.answer(query.payload.to_bytes()))
        except zenoh.ZError:
            return

    def answer(self, data: bytes) -> bytes:
        """Return the answer; a request that is sent again meanwhile is done once."""
        request = self.codec.request(data)
        with self.executing.setdefault(request.id, threading.Lock()):
            if request.id not in self.executed:
                self.requests.append(request)
                try:
                    result = self.do(request)
                    answer = m.Answer(id=request.id, ok=True, result=result)
                except PbonetError as error:
                    answer = codec.failure(error, request.id)
                self.executed[request.id] = self.codec.pack(answer)
            return self.executed[request.id]

    def do(self, request: m.Request) -> object:
        op = type(request).__struct_config__.tag
        time.sleep(self.slow.get(op, 0.0))
        if op in self.held:
            self.held[op].wait(60.0)
        if isinstance(request, GUARDED):
            self.check_epoch(request)
        if self.exists_error(op, request):
            raise self.fail[op, getattr(request, "task", "")]
        return getattr(self, f"do_{op}")(request)

    def exists_error(self, op: str, request: m.Request) -> bool:
        return (op, getattr(request, "task", "")) in self.fail

    def check_epoch(self, request: m.Request) -> None:
        epoch, holder = self.claims.get(request.subsystem, (0, ""))
        if request.epoch != epoch:
            raise ClaimError(
                "another master has taken over", where=self.name, got=holder
            )

    def did(self, text: str) -> None:
        self.world.log.append((self.name, text))

    def do_hello(self, _: m.Hello) -> m.AgentInfo:
        return m.AgentInfo(
            name=self.name,
            domain=self.world.domain,
            host="fakehost",
            machine=self.machine,
            core=0,
            cores=2,
            pid=0,
            rtpu_pid=0,
            backend="park",
            version="0",
            python="3",
            claims={name: epoch for name, (epoch, _) in self.claims.items()},
            lost=self.lost,
        )

    def do_claim(self, request: m.Claim) -> m.Claimed:
        others = set(self.claims) - {request.subsystem}
        if others and (request.usage == "exclusive" or self.exclusive):
            raise ClaimError(
                "the RTPU belongs to another subsystem",
                where=self.name,
                got=", ".join(sorted(others)),
            )
        epoch, holder = self.claims.get(request.subsystem, (0, ""))
        alive = holder != request.client and self.world_has(request.subsystem, holder)
        if alive and not request.take_over:
            raise ClaimError(
                "another master steers the subsystem",
                where=self.name,
                got=holder,
                remedy="end it, or take over",
            )
        if request.probe:
            return self.claimed(epoch, holder if alive else "")
        if request.svar:
            if error := self.fail.get(("open table", "")):
                raise error
            self.open_table(request)
        self.claims[request.subsystem] = (epoch + 1, request.client)
        self.exclusive = request.subsystem if request.usage == "exclusive" else ""
        return self.claimed(epoch + 1, holder if alive else "")

    def world_has(self, subsystem: str, master: str) -> bool:
        key = key_expressions.master(self.world.domain, subsystem, master)
        return bool(master) and session.alive(self.session, key)

    def claimed(self, epoch: int, holder: str) -> m.Claimed:
        status = self.do_status(m.Status())
        load = self.world.library.load
        return m.Claimed(
            epoch=epoch,
            tasks=list(self.tasks),
            critical=[
                task.name
                for task in self.tasks.values()
                if task.state == "ON" and parse_rmod(task.text, task.name).critical
            ],
            taken_from=holder,
            rmods={task.name: task.text for task in self.tasks.values()},
            modules={one.task: load(one.module).info for one in status.tasks},
            status=status,
            agent=self.do_hello(m.Hello()),
        )

    def do_release(self, request: m.Release) -> None:
        if self.tasks:
            raise NodeError("tasks stand on the RTPU", where=self.name)
        self.claims.pop(request.subsystem, None)
        self.exclusive = ""
        self.did("release")

    def open_table(self, request: m.Claim) -> None:
        file = parse_svar(request.svar, request.svar_name)
        if self.tables.get(request.subsystem) == request.svar:
            return
        self.tables[request.subsystem] = request.svar
        if request.keep:
            self.world.values[request.subsystem] = {
                v.name: [*map(float, v.init or ()), *[0.0] * v.nelem][: v.nelem]
                for v in file.variables
            }
        self.did(f"open table keep={request.keep}")

    def do_close_table(self, request: m.CloseTable) -> None:
        self.tables.pop(request.subsystem, None)
        self.did("close_table")

    def do_spawn(self, request: m.Spawn) -> m.TaskStatus:
        rmod = parse_rmod(request.rmod, request.rmod_name)
        task = FakeTask(
            request.task,
            request.rmod,
            rmod.name,
            request.freq or rmod.freq or 0.0,
            request.crit or 5,
            request.priority,
            params={name: " ".join(line.words) for name, line in rmod.local.items()},
        )
        self.tasks[request.task] = task
        self.did(f"spawn {request.task}")
        return self.status_of(task)

    def task(self, name: str) -> FakeTask:
        if name not in self.tasks:
            raise UnknownTaskError("there is no such task", where=f"{self.name}/{name}")
        return self.tasks[name]

    def move(self, name: str, signal: str) -> FakeTask:
        task = self.task(name)
        state = MOVES.get((task.state, signal))
        if state is None:
            raise StateError(
                f"the signal {signal} is not valid in the state {task.state}",
                where=f"{self.name}/{name}",
            )
        if (signal, name) in self.fail:
            raise self.fail[signal, name]
        task.state = state
        if signal == "on":
            task.since = time.monotonic()
        if state == "NOT-CREATED":
            del self.tasks[name]
        self.did(f"{signal} {name}")
        return task

    def do_control(self, request: m.Control) -> m.TaskStatus:
        return self.status_of(self.move(request.task, request.signal))

    def do_successors(self, request: m.Successors) -> dict[str, list[m.Call]]:
        where = {"core": 0, "slot": 0, "life": 1, "ticket": 1}
        calls: dict[str, list[m.Call]] = {}
        for name, olds in request.after.items():
            self.task(name)
            for caller, old in enumerate(olds):
                call = m.Call(successor=name, outputs=[], caller=caller, **where)
                calls.setdefault(old, []).append(call)
        return calls

    def do_reconfig(self, request: m.Reconfig) -> m.Reconfigured:
        states: dict[str, str] = {}
        for done, (name, signal) in enumerate(request.items):
            try:
                states[name] = self.move(name, signal).state
            except PbonetError as error:
                return m.Reconfigured(done=done, states=states, error=error.to_wire())
        return m.Reconfigured(done=len(request.items), states=states)

    def do_freq(self, request: m.Freq) -> float:
        task = self.task(request.task)
        if request.hz is not None:
            task.freq = request.hz
        return task.freq

    def do_get(self, request: m.Get) -> list[m.ParamValue]:
        task = self.task(request.task)
        if request.name is not None and request.name not in task.params:
            raise ParameterError("there is no such parameter", where=request.name)
        return [
            m.ParamValue(name=n, value=v, type="str", unit="", doc="a parameter")
            for n, v in task.params.items()
            if request.name in {None, n}
        ]

    def do_set(self, request: m.Set) -> list[m.ParamValue]:
        self.do_get(m.Get(task=request.task, name=request.name))
        self.task(request.task).params[request.name] = request.value
        return self.do_get(m.Get(task=request.task, name=request.name))

    def do_rank(self, request: m.Rank) -> None:
        for name, (crit, priority) in request.tasks.items():
            self.task(name).crit = 5 if crit is None else crit
            self.task(name).priority = priority

    def do_status(self, request: m.Status) -> m.RtpuStatus:
        tasks = [self.task(request.task)] if request.task else self.tasks.values()
        if request.reset:
            self.did(f"reset {request.task}")
        return m.RtpuStatus(
            versions=LAYERS,
            rtpu=self.name,
            backend="park",
            scheduler="MUF",
            tasks=[self.status_of(task) for task in tasks],
            illegal=list(self.flags),
            age=7.0,
        )

    def status_of(self, task: FakeTask) -> m.TaskStatus:
        ptime = time.monotonic() - task.since if task.state == "ON" else 0.0
        cycles = int(ptime * task.freq)
        return m.TaskStatus(
            rmod=task.rmod_name,
            task=task.name,
            rtpu=self.name,
            tid=1,
            S="P",
            crit=task.crit,
            priority=task.priority,
            state=task.state,
            cycle=cycles,
            miss=0,
            ref_f=task.freq,
            mez_f=task.freq,
            mez_t=1 / task.freq if task.freq else 0.0,
            ptime=ptime,
            tot_c=cycles * 1e-4,
            tick=1e-9,
            min_c=1e-4,
            max_c=1e-4,
            last_c=1e-4,
            warn=0,
            error=task.error,
            module=parse_rmod(task.text, f"{task.rmod_name}.rmod").module,
        )

    def do_display(self, request: m.Display) -> list[m.VarValue]:
        late = self.late.pop(0) if self.late else {}
        table = self.world.values.get(request.subsystem, {}) | late
        for name in request.names or ():
            if name not in table:
                raise UnknownVariableError("there is no such variable", where=name)
        return [
            m.VarValue(name=name, index=index, values=values, units="none")
            for index, (name, values) in enumerate(table.items())
            if request.names is None or name in request.names
        ]

    def do_write(self, request: m.Write) -> m.VarValue:
        self.world.values[request.subsystem][request.name] = list(request.values)
        return self.do_display(
            m.Display(subsystem=request.subsystem, names=[request.name])
        )[0]

    def do_modules(self, request: m.Modules) -> list[ModuleInfo]:
        library = self.world.library
        names = library.modules() if request.name is None else [request.name]
        return [library.load(name).info for name in names]

    def do_stop(self, request: m.Stop) -> m.Stopped:
        names = [n for n in request.order if n in self.tasks]
        names += [n for n in reversed(self.tasks) if n not in names]
        off = [n for n in names if self.tasks[n].state == "ON"]
        for name in off:
            self.move(name, "off")
        for name in names:
            self.move(name, "kill")
        self.standing = []
        return m.Stopped(off=off, killed=[])

    def do_flag(self, request: m.Flag) -> list[str]:
        if request.up and request.cause not in self.flags:
            self.flags.append(request.cause)
        elif not request.up and request.cause in self.flags:
            self.flags.remove(request.cause)
        return list(self.flags)

    def do_job(self, request: m.Job) -> list[m.Standing]:
        if request.changes:
            self.standing = [] if request.told is None else [request.told]
        return self.standing

    def do_record(self, _: m.Record) -> m.Recorded:
        return m.Recorded(path="", machine="fake")

    def do_events(self, request: m.Events) -> list[m.Event]:
        return [one for one in self.told if one.n >= request.since]

    def do_machine(self, _: m.Machine) -> m.MachineInfo:
        return m.MachineInfo(
            wall=time.time() + self.ahead,
            runs="/runs",
            disk_free=5 << 30,
            disk_size=9 << 30,
        )

    def do_links(self, _: m.Links) -> m.LinkReport:
        """Report a path to every other agent of the domain that is in sight."""
        names = [name for name in self.neighbours() if name != self.name]
        ways = [m.Way(rtpu=n, trip=0.001, hops=1) for n in names if n not in self.deaf]
        return m.LinkReport(rtpu=self.name, ways=ways)
