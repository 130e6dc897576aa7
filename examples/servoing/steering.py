"""One way to steer the example in real and in virtual time."""

from __future__ import annotations

import os
import time
from typing import TYPE_CHECKING, Protocol

from pbonet.errors import StateError
from pbonet.master.embedded import Embedded
from pbonet.master.rings import Drain
from pbonet.master.sim import Simulation
from pbonet.master.subsystem import Subsystem
from pbonet.node._ring import Ring  # noqa: PLC2701 - a task's every cycle

if TYPE_CHECKING:
    from collections.abc import Sequence
    from pathlib import Path

    from pbonet.master.recording import Recording


class Steering(Protocol):
    """What the example's program needs of a running job."""

    def begin(self, job: Path, spare: Sequence[tuple[str, str]]) -> None:
        """Start a job, and create more tasks (RMOD and RTPU) that stay OFF."""
        ...

    def value(self, variable: str) -> float:
        """Return the first element of a variable."""
        ...

    def swap(self, old: Sequence[str], new: Sequence[str]) -> None:
        """Put tasks into the place of others."""
        ...

    def now(self) -> float:
        """Return seconds since the job was started."""
        ...

    def wait(self, seconds: float) -> None:
        """Let time pass."""
        ...

    def end(self) -> Recording:
        """Turn everything off; return every cycle."""
        ...


class Virtual:
    """In virtual time: the same result every time."""

    def begin(self, job: Path, spare: Sequence[tuple[str, str]]) -> None:
        """Start a job, and create more tasks that stay OFF."""
        self._simulation = Simulation(job)
        self._simulation.start()
        self._begin_ns = self._simulation.now_ns
        for rmod, rtpu in spare:
            self._simulation.spawn(rmod, rtpu)

    def value(self, variable: str) -> float:
        """Return the first element of a variable."""
        return float(self._simulation.table.values[variable][0])

    def swap(self, old: Sequence[str], new: Sequence[str]) -> None:
        """Put tasks into the place of others; both as the data flow."""
        items = [(task, "off") for task in reversed(old)]
        self._simulation.reconfig([*items, *((task, "on") for task in new)])

    def now(self) -> float:
        """Return seconds since the job was started."""
        return (self._simulation.now_ns - self._begin_ns) * 1e-9

    def wait(self, seconds: float) -> None:
        """Let virtual time pass."""
        self._simulation.advance(seconds)

    def end(self) -> Recording:
        """Turn everything off; return every cycle."""
        self._simulation.stop()
        return self._simulation.recording


class Real:
    """In real time, with agents of its own in a domain of its own.

    Args:
        domain: The domain, where agents run already; by default a new one.
    """

    def __init__(self, domain: str = "") -> None:
        self._domain = domain or f"servoing{os.getpid()}"

    def begin(self, job: Path, spare: Sequence[tuple[str, str]]) -> None:
        """Start a job, and create more tasks that stay OFF."""
        self._agents = Embedded(self._domain)
        self._subsystem = Subsystem(job, domain=self._domain)
        self._drain: Drain | None = None
        try:
            rtpus = [entry.name for entry in self._subsystem.sbs.rtpus]
            if missing := self._agents.missing(rtpus):
                self._agents.start(missing)
            self._subsystem.open()
            self._drain = Drain(self._subsystem, Ring.attach, {"job": job.stem})
            self._drain.start()
            self._subsystem.start()
            for rmod, rtpu in spare:
                self._subsystem.spawn(rmod, rtpu)
            self._drain.follow(self._subsystem.status_all())
        except BaseException:
            self.end()
            raise
        self._begin = time.monotonic()

    @property
    def subsystem(self) -> Subsystem:
        """The subsystem."""
        return self._subsystem

    def value(self, variable: str) -> float:
        """Return the first element of a variable."""
        (found,) = self._subsystem.display([variable])
        return float(found.values[0])

    def swap(self, old: Sequence[str], new: Sequence[str]) -> None:
        """Put tasks into the place of others."""
        self._subsystem.swap(old, new)

    def now(self) -> float:
        """Return seconds since the job was started."""
        return time.monotonic() - self._begin

    def wait(self, seconds: float) -> None:
        """Let time pass."""
        time.sleep(seconds)

    def end(self) -> Recording:
        """Turn everything off; return every cycle."""
        with self._agents:
            self._subsystem.__exit__(None, None, None)
        if self._drain is None:
            raise StateError("the job was never started", where=self._domain)
        return self._drain.stop()
