"""Taking every cycle out of the tasks' rings while a subsystem runs (same machine).

A task writes one record a cycle into a ring in shared memory and never waits; whoever
wants them all must take them out in time. What a full ring dropped is counted.
"""

from __future__ import annotations

import threading
from typing import TYPE_CHECKING, Any, Final, NamedTuple, Protocol, TypeAlias

from pbonet.errors import PbonetError
from pbonet.master.recording import Recording
from pbonet.xm import messages as m
from pbonet.xm import rundir

if TYPE_CHECKING:
    from collections.abc import Callable

    from pbonet.master.subsystem import Subsystem

PERIOD: Final = 0.05
"""Seconds between two looks; a ring of 1 MiB holds seconds of a 1 kHz task."""


Hook: TypeAlias = "Callable[[str, list[Any]], None]"
"""Takes a task's name and its records."""


class RingReader(Protocol):
    """A ring, as its reader sees it; `pbonet.node._ring.Ring` is one."""

    lost: int

    def drain(self, limit: int = 0) -> list[Any]:
        """Take the records that stand in the ring."""
        ...

    def close(self) -> None:
        """Let go of it."""


class _Followed(NamedTuple):
    """A ring that is being emptied."""

    ring: str
    reader: RingReader
    outputs: tuple[str, ...]


class Drain:
    """Takes the records of a subsystem's tasks into a recording.

    Args:
        subsystem: It is open.
        open_ring: Opens a ring by the name that a task's status gives.
        about: What should be known about the run.
        hook: Called with a task's name and its records, in the drain's thread.
        keep: Keep them in the recording too.
    """

    def __init__(
        self,
        subsystem: Subsystem,
        open_ring: Callable[[str], RingReader],
        about: dict[str, Any],
        *,
        hook: Hook | None = None,
        keep: bool = True,
    ) -> None:
        self.recording = Recording(about)
        self._hook = hook
        self._keep = keep
        self.lost: dict[str, int] = {}
        """Records that each task's ring had to drop."""
        self._subsystem = subsystem
        self._open_ring = open_ring
        self._rings: dict[str, _Followed] = {}
        self._here = self._on_this_machine()
        self._end = threading.Event()
        self._thread = threading.Thread(target=self._work, name="drain", daemon=True)

    @property
    def elsewhere(self) -> list[str]:
        """RTPUs on other machines, whose cycles cannot be taken here."""
        return [name for name in self._subsystem.fleet.names if name not in self._here]

    def start(self) -> None:
        """Begin."""
        self._thread.start()

    def follow(self, statuses: list[m.TaskStatus]) -> None:
        """Open the rings of tasks that are new; called whenever status is read."""
        for status in statuses:
            known = self._rings.get(status.task)
            if not status.ring or status.rtpu not in self._here:
                continue
            member = self._subsystem.picture.get(status.task)
            if member is None or (known is not None and known.ring == status.ring):
                continue
            try:
                reader = self._open_ring(status.ring)
            except PbonetError as error:
                self._subsystem.warned(f"{status.task} is not recorded: {error}")
                continue
            self._rings[status.task] = _Followed(
                status.ring, reader, member.task.outputs
            )

    def stop(self) -> Recording:
        """Take what is left, let go of the rings, and return the recording."""
        self._end.set()
        if self._thread.is_alive():
            self._thread.join()
        self._take_all()
        for task, followed in self._rings.items():
            self.lost[task] = followed.reader.lost
            followed.reader.close()
        self._rings = {}
        self.recording.about["lost"] = {t: n for t, n in self.lost.items() if n}
        return self.recording

    def _on_this_machine(self) -> set[str]:
        results, _ = self._subsystem.fleet.each(lambda _: m.Hello(), m.AgentInfo)
        machine = rundir.machine()
        return {name for name, info in results.items() if info.machine == machine}

    def _work(self) -> None:
        while not self._end.wait(PERIOD):
            self._take_all()

    def _take_all(self) -> None:
        variables = self._subsystem.files.table.variables
        for task, followed in list(self._rings.items()):
            records = followed.reader.drain()
            if records and self._keep:
                record = self.recording.task(task, variables, followed.outputs)
                record.take(records)
            if records and self._hook is not None:
                self._hook(task, records)
