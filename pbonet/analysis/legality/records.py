"""Configurations to verify and problems found: plain records, no files, no network."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from enum import StrEnum
from functools import cached_property
from typing import TYPE_CHECKING

from msgspec import Struct

from pbonet.analysis.schedule import CoreShare, Profile
from pbonet.config import Place, Restart, Rmod, RtpuEntry, SvarFile, Variable

if TYPE_CHECKING:
    from pbonet.pbo import ModuleInfo

COPY_SPEED = 1e9
"""Bytes a second that tasks may move where no agent has measured its memory.

A tenth of what a slow machine's memory moves.
"""


class Severity(StrEnum):
    """The consequence of the problem for a change."""

    REFUSE = "refuse"
    WARN = "warn"


class Code(StrEnum):
    """The kind of problem; for programs."""

    TWO_WRITERS = "two-writers"
    """Equation 1 is broken."""
    NO_WRITER = "no-writer"
    """Equation 2 is broken."""
    PARTS = "parts"
    """The parts of a combination do not fit each other."""
    PORTS = "ports"
    """The RMOD and the module's class name different ports."""
    UNKNOWN_VARIABLE = "unknown-variable"
    TYPE = "type"
    SHAPE = "shape"
    UNIT = "unit"
    CONSTANT_SIZE = "constant-size"
    """Two tasks see two sizes of one constant."""
    NO_CONSTANT = "no-constant"
    TWO_CONSTANTS = "two-constants"
    INIT_CYCLE = "init-cycle"
    NO_STABLE = "no-stable"
    """A CRITICAL task's module has no `stable`."""
    NO_METHOD = "no-method"
    """The RMOD counts on a method that its module does not have."""
    SAFE_VALUE = "safe-value"
    """A safe value that is to be written is outside its variable's limits."""
    UNKNOWN_RTPU = "unknown-rtpu"
    UNKNOWN_TASK = "unknown-task"
    TIMES = "times"
    """An execution time or a capacity does not fit into the period."""
    UNDERSTATED = "understated"
    """A cycle took longer than the RMOD's MAXC."""
    OVERLOAD = "overload"
    SERVER = "server"
    """A server is larger than the tasks below it allow."""
    NOT_GUARANTEED = "not-guaranteed"
    """Some deadlines may be missed."""
    NO_MAXAGE = "no-maxage"
    """A join connector that goes by age reads a variable that never grows old."""
    NO_LIMIT = "no-limit"
    """An input that comes from elsewhere may have any age."""
    UNSAFE_ROBOT = "unsafe-robot"
    """A robot interface goes on while the configuration is illegal."""
    RESTART = "restart"
    """A task that never comes ON unasked is to come ON."""
    NOT_ON_RTPU = "not-on-rtpu"
    """A task opens what its RTPU does not have, such as a device."""
    FALLBACK_RTPU = "fallback-rtpu"
    """A standby's RTPU does not go with TAKEOVER."""
    STAMP_LOOP = "stamp-loop"
    """Tasks pass on each other's age, which only grows."""
    HOLD_LOOP = "hold-loop"
    """Tasks that hold while their inputs are too old wait for each other."""
    RATE = "rate"
    """A frequency is outside MINFREQ and MAXFREQ."""
    BANDWIDTH = "bandwidth"
    CONDITION = "condition"
    """A PRE or POST that has no answer."""


class Problem(Struct, frozen=True, kw_only=True):
    """Something that is or would be wrong with a configuration."""

    code: Code
    what: str
    where: str = ""
    expected: str = ""
    got: str = ""
    remedy: str
    severity: Severity = Severity.REFUSE
    tasks: tuple[str, ...] = ()
    ports: tuple[str, ...] = ()
    variables: tuple[str, ...] = ()

    @property
    def key(self) -> tuple[object, ...]:
        """Key by which two problems, before and after a change, are the same."""
        return (self.code, self.tasks, self.ports, self.variables)


class Task(Struct, frozen=True, kw_only=True, dict=True):
    """One task of a configuration."""

    rmod: Rmod
    info: ModuleInfo | None = None
    """Of the module's class; None when it is not known here, then it is not checked."""
    rtpu: str
    freq: float | None = None
    """Hz, in place of the RMOD's."""
    minc: float | None = None
    """Least CPU seconds a cycle as measured, where the RMOD has none."""
    maxc: float | None = None
    """Worst CPU seconds a cycle as measured, where the RMOD has none."""
    profile: Profile | None = None
    """Execution profile as measured (section 6.4); its end is MAXC if none is given."""
    task: str = ""
    """Its name, when that is not the RMOD's."""
    fallback_of: str = ""
    """The task that it stands by for, OFF until that one fails."""
    takeover: float = 0.0
    """Seconds after which it takes over from another RTPU by itself; 0: never."""
    restart: Restart = "off"
    """As the job says (``RESTART``)."""
    job_places: Mapping[str, Place] = {}
    """Where a job says something in place of the RMOD, such as its RTPU."""

    @property
    def name(self) -> str:
        """The task's name in the subsystem."""
        return self.task or self.rmod.name

    @property
    def hz(self) -> float | None:
        """How often it runs; None for a server that no frequency is known of."""
        return self.freq if self.freq is not None else self.rmod.freq

    @property
    def worst(self) -> float | None:
        """The worst CPU seconds a cycle, None while unknown; the RMOD's goes first."""
        return self.measured if self.rmod.maxc is None else self.rmod.maxc

    @property
    def measured(self) -> float | None:
        """The worst CPU seconds a cycle as measured, None where nothing was."""
        if self.maxc is None and self.profile is not None:
            return self.profile.worst_ns / 1e9
        return self.maxc

    @cached_property
    def inputs(self) -> tuple[str, ...]:
        """Variables it reads every cycle (X of section 3.3.1)."""
        return tuple(map(self.rmod.svar_name, self.rmod.invar))

    @cached_property
    def outputs(self) -> tuple[str, ...]:
        """Variables it writes every cycle (Y of section 3.3.1)."""
        return tuple(map(self.rmod.svar_name, self.rmod.outvar))

    @cached_property
    def needs(self) -> tuple[str, ...]:
        """Constants that it reads before `init`."""
        return tuple(map(self.rmod.svar_name, self.rmod.inconst))

    @cached_property
    def gives(self) -> tuple[str, ...]:
        """Constants that it writes after `init`."""
        return tuple(map(self.rmod.svar_name, self.rmod.outconst))

    def port(self, keyword: str, variable: str) -> str:
        """Return the port in the list `keyword` that is mapped to `variable`."""
        ports: tuple[str, ...] = getattr(self.rmod, keyword.lower())
        return next(port for port in ports if self.rmod.svar_name(port) == variable)

    def place(self, keyword: str) -> str:
        """Return the place of `keyword` in the job or the RMOD, or the RMOD's file."""
        said = self.job_places.get(keyword) or self.rmod.places.get(keyword)
        return str(said or self.rmod.file)


class Configuration(Struct, frozen=True, kw_only=True, dict=True):
    """A subsystem at one moment: its tasks, and which of them are ON."""

    svar: SvarFile
    tasks: tuple[Task, ...] = ()
    """All existing tasks, ON or not, in the order in which they were spawned."""
    on: frozenset[str] = frozenset()
    rtpus: tuple[RtpuEntry, ...] = ()
    """Of the ``.sbs`` file."""
    machines: Mapping[str, str] = {}
    """The machine of each RTPU, where it is known."""
    names: Mapping[str, Mapping[str, Sequence[str]]] = {}
    """Names of things that each RTPU has, by kind such as ``device``, where known."""
    keeper: str = ""
    """The RTPU that keeps the table; empty: not known."""
    alone: float = 2.0
    """Seconds without its machine after which others act (``ALONE``); 0: never."""
    strict: bool = False
    """Whether what is unsafe is refused (``STRICT``)."""
    producers: Mapping[str, tuple[str, ...]] = {}
    """RMODs of the library that write a variable, by variable; for remedies."""
    core: CoreShare = CoreShare()
    """The share of a core for tasks, for RTPUs that are not in `cores`."""
    cores: Mapping[str, CoreShare] = {}
    """The same of each RTPU whose agent has said it."""
    copy_speed: float = COPY_SPEED
    """Bytes a second that the tasks of a machine may move, if its RTPUs are not in
    `copy_speeds`."""
    copy_speeds: Mapping[str, float] = {}
    """The same as measured by the agent of each RTPU."""

    def share_of(self, rtpu: str) -> CoreShare:
        """Return what tasks may use of the core of an RTPU."""
        return self.cores.get(rtpu, self.core)

    def copies(self, rtpu: str) -> float:
        """Return the bytes a second that the memory of an RTPU's machine moves."""
        return self.copy_speeds.get(rtpu, self.copy_speed)

    def limit(self, rtpu: str) -> float:
        """Return the share of the core of an RTPU that is left for its tasks."""
        rates = (task.hz or 0.0 for task in self.running if task.rtpu == rtpu)
        return self.share_of(rtpu).left(rates)

    @cached_property
    def task_names(self) -> frozenset[str]:
        """The names of all its tasks."""
        return frozenset(task.name for task in self.tasks)

    @cached_property
    def running(self) -> tuple[Task, ...]:
        """The tasks that are ON."""
        return tuple(task for task in self.tasks if task.name in self.on)

    @cached_property
    def table(self) -> dict[str, Variable]:
        """The variables by name."""
        return {variable.name: variable for variable in self.svar.variables}

    @cached_property
    def notes(self) -> dict[str, object]:
        """Results about it that several checks need, by name."""
        return {}

    @cached_property
    def given(self) -> frozenset[str]:
        """The constants that its tasks give."""
        return frozenset(name for task in self.tasks for name in task.gives)

    @cached_property
    def writers(self) -> dict[str, list[Task]]:
        """The tasks that are ON and write a variable, by variable."""
        found: dict[str, list[Task]] = {}
        for task in self.running:
            for variable in task.outputs:
                found.setdefault(variable, []).append(task)
        return found
