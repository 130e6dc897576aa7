"""Transports of batches to an executive: its own process, or none in virtual time."""

from __future__ import annotations

import itertools
import os
import time
from collections import deque
from typing import TYPE_CHECKING, Any, Final, Protocol

from pbonet.config import SppEntry
from pbonet.errors import PbonetError, SppError
from pbonet.outside import using as taping
from pbonet.xm.ipc import names

from . import batches, channel, executive_start, processors
from .execution import Execution

if TYPE_CHECKING:
    from .execution import Loaded
    from .kernel_library import Variable

START_TIME: Final = 60.0
"""Seconds in which an executive must start and load a library."""
_LOOK_NS: Final = 200_000_000
_GONE_NS: Final = 5_000_000_000
"""How long a wait goes on without an executive."""
_PAUSE: Final = 0.02
_numbers = itertools.count(1)


class Transport(Protocol):
    """The way of a client to its executive."""

    def open(self, place: str) -> dict[str, Any]:
        """Download a library; return its manifest.

        Raises:
            SppError: It cannot be used.
        """
        ...

    def reserve(self, variables: list[Variable], depth: int) -> None:
        """Make room for batches and results."""

    def submit(self, number: int, batch: memoryview, priority: int) -> None:
        """Hand a batch over; never waits."""

    def receive(self, until_ns: int | None) -> bytes | None:
        """Return the next result; None: there is none in time."""

    def lock(self, until_ns: int | None) -> bool:
        """Take the executive for exclusive use; return whether it was taken."""
        ...

    def release(self) -> None:
        """Give it back."""

    def close(self) -> None:
        """Leave the executive."""


class ProcessTransport:
    """To an executive that is a process.

    Args:
        name: As in ``[spp.NAME]``.
    """

    def __init__(self, name: str) -> None:
        self._name = name
        self._holds = False
        self._taken = 0
        self._executive: channel.Executive | None = None
        self._memory: channel.ClientMemory | None = None

    def open(self, place: str) -> dict[str, Any]:
        entry = processors.entry(self._name)
        owner = processors.owner()
        here = names.home()
        key = self._name if owner else f"{self._name}.{os.getpid()}"
        self._place = channel.Place(here.domain, here.rtpu, key)
        hello = channel.Hello(library=place, pid=os.getpid(), owner=owner)
        name = channel.client_name(next(_numbers))
        until = time.monotonic() + START_TIME
        with taping(None):  # only answers to the module stand in the log
            if not owner:
                config = executive_start.ExecutiveConfig(place=self._place, entry=entry)
                executive_start.ensure(config)
            self._executive = channel.Executive(self._place)
            self._await_start(self._executive, until)
            self._memory = channel.ClientMemory(self._place, name, hello)
        self._executive.enter(name)
        return self._manifest(until)

    def _await_start(self, executive: channel.Executive, until: float) -> None:
        while not executive.state().back_end:
            if error := executive.state().error:
                raise PbonetError.from_wire(error)  # type: ignore[arg-type]
            if time.monotonic() > until:
                raise SppError(
                    "the executive does not run",
                    where=f"[spp.{self._name}]",
                    remedy="see the agent's events SPP_DIED, or start it again",
                )
            time.sleep(_PAUSE)

    def _manifest(self, until: float) -> dict[str, Any]:
        memory, _ = self._parts()
        found = memory.manifest(int(until * 1e9))
        if found is None:
            self.close()
            raise SppError(
                "the executive does not answer",
                where=f"[spp.{self._name}]",
                got=f"nothing in {START_TIME:g} s",
                remedy="a batch of another task may be too long: see pbonet status",
            )
        if "error" in found:
            self.close()
            raise PbonetError.from_wire(found["error"])
        return found

    def _parts(self) -> tuple[channel.ClientMemory, channel.Executive]:
        if self._memory is None or self._executive is None:
            raise SppError(
                "the processor is not in use",
                where=self._name,
                remedy="make a new Spp after finish()",
            )
        return self._memory, self._executive

    def reserve(self, variables: list[Variable], depth: int) -> None:
        memory, executive = self._parts()
        sizes = batches.room_of_batch(variables), batches.room_of_result(variables)
        with taping(None):
            self._buffers = memory.make_buffers(depth, *sizes)
        self._bell = executive.bell

    def submit(self, number: int, batch: memoryview, priority: int) -> None:
        self._buffers.submit(number, batch, priority, holds=self._holds)
        self._bell.v()

    def receive(self, until_ns: int | None) -> bytes | None:
        # One result for each P: what comes after it is visible with its own.
        while self._done(until_ns):
            if self._taken < self._buffers.finished:
                self._taken += 1
                return self._buffers.result(self._taken)
        return None

    def _done(self, until_ns: int | None) -> bool:
        """Wait for a result while there is an executive, or one may come."""
        if until_ns == 0:
            return bool(self._buffers.done.try_p())
        gone_ns = 0
        while True:
            now = time.monotonic_ns()
            step = now + _LOOK_NS
            step = step if until_ns is None else min(step, until_ns)
            if self._buffers.done.p(step):
                return True
            if until_ns is not None and now >= until_ns:
                return False
            gone_ns = 0 if self._place.is_running() else gone_ns or now
            if gone_ns and now - gone_ns > _GONE_NS:
                raise SppError(
                    "the executive has ended, and was not started again",
                    where=f"[spp.{self._name}]",
                    remedy="see the agent's events SPP_DIED",
                )

    def lock(self, until_ns: int | None) -> bool:
        _, executive = self._parts()
        self._holds = self._holds or bool(executive.lock.p(until_ns))
        return self._holds

    def release(self) -> None:
        _, executive = self._parts()
        if self._holds:
            self._holds = False
            executive.lock.v()

    def close(self) -> None:
        if self._executive is not None and self._holds:
            self.release()
        if self._memory is not None:
            self._memory.destroy()
        if self._executive is not None:
            self._executive.close()
        self._memory = self._executive = None


class InlineTransport:
    """In virtual time: a batch is done when it is handed over, in this process.

    Args:
        name: As in ``[spp.NAME]``.
    """

    def __init__(self, name: str) -> None:
        self._name = name
        self._results: deque[bytes] = deque()

    def open(self, place: str) -> dict[str, Any]:
        try:  # numpy loads at once, and gives the same on each machine
            self._loaded = self._load(place, "numpy")
        except SppError:
            self._loaded = self._load(place, "auto")
        return self._loaded.manifest()

    def _load(self, place: str, driver: str) -> Loaded:
        execution = Execution(SppEntry(driver=driver, device="cpu"), self._name)
        return execution.load(place)

    def reserve(self, variables: list[Variable], depth: int) -> None:
        """Nothing is reserved: a result is kept until it is read."""

    def submit(self, number: int, batch: memoryview, priority: int) -> None:
        del number, priority
        self._results.append(self._loaded.run(bytes(batch), 1))

    def receive(self, until_ns: int | None) -> bytes | None:
        del until_ns
        return self._results.popleft() if self._results else None

    def lock(self, until_ns: int | None) -> bool:
        del until_ns
        return True  # no two batches are under way at a time

    def release(self) -> None:
        """Nothing to give back."""

    def close(self) -> None:
        """Nothing to leave."""
