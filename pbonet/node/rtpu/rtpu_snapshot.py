"""An RTPU process's knowledge of its tasks that is not in shared memory.

It notifies its agent whenever that changes, before the answer or event by which any
other process could learn of it. So the agent knows the state of everything without
asking, and a request for status wakes no process of the RTPU (see
`shared_memory_status`).
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any, Protocol

import msgspec
from msgspec import Struct

from pbonet.errors import UnknownTaskError, did_you_mean
from pbonet.xm.net import Restart, TaskStatus

from .claims import Claims, Entry

if TYPE_CHECKING:
    from collections.abc import Iterable

    from pbonet.config import Rmod
    from pbonet.node.wire import EventLog

    from . import ranking
    from .fallbacks import Fallbacks
    from .task_handle import Task

LETTERS = {"periodic": "P", "synchronous": "Y", "sporadic": "S", "deferrable": "D"}


class Home(Protocol):
    """The part of the RTPU process that is needed here."""

    tasks: dict[tuple[str, str], Task]
    tombs: dict[tuple[str, str], TaskStatus]
    ranks: dict[tuple[str, str], ranking.Ranked]
    claims: Claims
    stopping: set[str]
    events: EventLog
    fallbacks: Fallbacks


class TaskSnapshot(Struct, kw_only=True):
    """One task; the names are those of `TaskStatus`."""

    subsystem: str
    task: str
    slot: int
    rmod: str
    tid: int
    S: str
    crit_assumed: bool
    state: str
    ref_f: float
    warn: int
    warning: str
    error: str
    module: str
    version: str
    ring: str
    own: dict[str, int]
    """Names and bits of the module's own signals."""
    fallback_of: str
    original_rtpu: str
    takeover: float
    stands_by: bool
    waits: str = ""
    """How long its cycles wait for other things than the core; empty: they do not."""
    restart: Restart = "off"
    robot_interface: bool = False


class SnapshotChanges(Struct, tag="known", kw_only=True):
    """Changes since the last snapshot; None where there is none."""

    tasks: list[TaskSnapshot] | None = None
    """In the order in which they were spawned."""
    tombs: list[tuple[str, TaskStatus]] | None = None
    """Subsystem and last status of tasks that died."""
    claims: list[Entry] | None = None
    stopping: list[str] | None = None
    """Subsystems that are being stopped."""
    counts: list[tuple[str, str, str, int]] | None = None
    """How often each event came: subsystem, task, code, count."""


class SnapshotPublisher:
    """Reports what has changed since the last time.

    Args:
        rtpu: The RTPU whose state it is.
    """

    def __init__(self, rtpu: Home) -> None:
        self._rtpu = rtpu
        self._encoder = msgspec.msgpack.Encoder()
        self._told: dict[str, bytes] = {}

    def forget(self) -> None:
        """Start again, for an agent that knows nothing."""
        self._told.clear()

    def news(self) -> bytes:
        """Return a packed `SnapshotChanges`; empty if nothing has changed."""
        rtpu = self._rtpu
        parts: dict[str, Any] = {
            "tasks": [of(rtpu, task) for task in rtpu.tasks.values()],
            "tombs": [(key[0], tomb) for key, tomb in rtpu.tombs.items()],
            "claims": rtpu.claims.entries(),
            "stopping": sorted(rtpu.stopping),
            "counts": rtpu.events.counts(),
        }
        packed = {name: self._encoder.encode(part) for name, part in parts.items()}
        new = {k: v for k, v in packed.items() if self._told.get(k) != v}
        self._told = packed
        if not new:
            return b""
        return self._encoder.encode({
            "type": "known",
            **{name: msgspec.Raw(part) for name, part in new.items()},
        })


def of(rtpu: Home, task: Task) -> TaskSnapshot:
    """Return what an RTPU process knows of one of its tasks."""
    facts, ready = task.facts, task.ready
    pair = rtpu.fallbacks.of(task)
    rank = rtpu.ranks.get((facts.subsystem, facts.name))
    return TaskSnapshot(
        subsystem=facts.subsystem,
        task=facts.name,
        slot=facts.slot,
        rmod=facts.rmod.name,
        tid=task.child.pid,
        S=letter(facts.rmod),
        crit_assumed=rank is None or rank.assumed,
        state=task.state.value,
        ref_f=task.freq,
        warn=task.warnings,
        warning=task.warning,
        error=task.error,
        module=ready.module if ready else facts.rmod.module,
        version=ready.version if ready else "",
        ring=facts.ring,
        own=task.signals,
        fallback_of=pair.original if pair else "",
        original_rtpu=pair.rtpu if pair else "",
        takeover=pair.takeover if pair else 0.0,
        stands_by=bool(task.stands_by) or rtpu.fallbacks.stands_away(task),
        waits=task.waits,
        restart=facts.restart,
        robot_interface=bool(ready and ready.info.get("robot_interface")),
    )


def letter(rmod: Rmod) -> str:
    """Return the thesis's letter for how a task is timed."""
    return LETTERS.get(rmod.tasktype.value, "B")


def no_task(
    rtpu: str, subsystem: str, name: str, known: Iterable[str], tomb: TaskStatus | None
) -> UnknownTaskError:
    """Return the error for a task that is not there.

    Args:
        rtpu: Where it was searched for.
        subsystem: The subsystem that should have it.
        name: The task's name.
        known: The subsystem's tasks.
        tomb: Its last status, if it has died.
    """
    return UnknownTaskError(
        f"subsystem {subsystem} has no task {name} here",
        where=rtpu,
        got=f"it has died: {tomb.error}" if tomb else "",
        remedy="spawn it again" if tomb else did_you_mean(name, list(known)),
    )
