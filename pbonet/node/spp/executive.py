"""The executive: takes batches in the order of priorities, one at a time (7.4.2)."""

from __future__ import annotations

import heapq
import itertools
import os
import signal
import time
from typing import TYPE_CHECKING, Final, NamedTuple

from pbonet.errors import PbonetError, XmDestroyedError, XmError
from pbonet.io.spp import batches, channel
from pbonet.xm import Full

if TYPE_CHECKING:
    from pbonet.io.spp import Execution, Loaded

_IDLE_NS: Final = 500_000_000
"""How often it looks after clients that have died."""
DEVICE_LOST: Final = 3
"""Exit status when a back end cannot be used any more by this process."""
_LOCKED_NS: Final = 2_000_000
"""How often it looks whether it is free again, while batches wait for that."""


class _Client(NamedTuple):
    memory: channel.ClientMemory
    loaded: Loaded


class _Wanted(NamedTuple):
    """A batch that waits; the first in order is next."""

    rank: int
    turn: int
    client: str
    holds: bool


class Executive:
    """An infinite loop over the batches of all clients.

    Args:
        place: Where it is.
        execution: Loads libraries.
        door: Its shared memory.
        longest: Seconds after which a batch ends this process.
    """

    def __init__(
        self,
        place: channel.Place,
        execution: Execution,
        door: channel.Executive,
        longest: float,
    ) -> None:
        self._place = place
        self._execution = execution
        self._door = door
        self._longest = longest
        self._clients: dict[str, _Client] = {}
        self._waiting: list[_Wanted] = []
        self._turns = itertools.count()
        self._looked_ns = self._said = 0
        self._carried_out = False
        first = execution.back_ends.first
        self.state = channel.ExecutiveState(
            pid=os.getpid(),
            starts=door.state().starts + 1,
            back_end=first.name,
            device=first.device,
            found=[
                f"{one.name} on {one.device}"
                for one in execution.back_ends.found.values()
            ],
        )

    def begin(self) -> None:
        """Say that it runs, and serve the clients of the executive before it."""
        self._door.say(self.state)
        for name in self._place.clients():
            self._adopt(name)

    def _adopt(self, name: str) -> None:
        client = self._enter(name)
        if client is None:
            return
        memory = client.memory
        if not memory.attach_queues() or memory.results is None:
            return
        data = batches.pack_result(memory.begun, self.state.starts, 0)
        memory.results.send(data, full=Full.DROP_OLDEST)
        self._find_batches(name)

    def serve(self) -> None:
        """Carry out one batch, or wait for one; check the clients at times."""
        now = time.monotonic_ns()
        pause = _LOCKED_NS if self._waiting else _IDLE_NS
        self._take_ring(0 if self._carried_out else now + pause)
        while self._take_ring(0):
            pass
        self._carried_out = self._carry_out()
        if now - self._looked_ns > _IDLE_NS:
            self._looked_ns = now
            self._check_clients()

    def _take_ring(self, until_ns: int) -> bool:
        """Take a ring at the door; return whether there was one in time."""
        found = self._door.door.letter(until_ns)
        if found is None:
            return False
        text, priority = found
        name, holds = channel.rung(text)
        if name in self._clients:
            self._want(name, priority, holds=holds)
        else:
            self._enter(name)
        return True

    def _want(self, name: str, priority: int, *, holds: bool) -> None:
        wanted = _Wanted(-priority, next(self._turns), name, holds)
        heapq.heappush(self._waiting, wanted)

    # -- clients -----------------------------------------------------------------------

    def _enter(self, name: str) -> _Client | None:
        """Load the library of a client, and answer it."""
        try:
            memory = channel.ClientMemory(self._place, name)
        except XmError:  # it has gone meanwhile
            return None
        if memory.is_abandoned or memory.hello is None:
            memory.destroy()
            return None
        hello = memory.hello
        try:
            loaded = self._execution.load(hello.library)
        except PbonetError as error:
            memory.answer({"error": error.to_wire()})
            return None
        memory.answer(loaded.manifest())
        client = self._clients[name] = _Client(memory, loaded)
        self._say()
        return client

    def _check_clients(self) -> None:
        """Forget clients that have died; find batches whose ring was lost."""
        for name, client in list(self._clients.items()):
            if client.memory.is_abandoned:
                self._leave(name)
        rung = {one.client for one in self._waiting}
        for name in self._clients.keys() - rung:
            self._find_batches(name)
        if self.state.batches != self._said:
            self._say()

    def _find_batches(self, name: str) -> None:
        memory = self._clients[name].memory
        try:
            count = len(memory.batches or ()) if memory.attach_queues() else 0
        except XmError:
            return
        for _ in range(count):
            self._want(name, 0, holds=False)

    def _leave(self, name: str) -> None:
        client = self._clients.pop(name)
        client.memory.destroy()
        self._waiting = [one for one in self._waiting if one.client != name]
        heapq.heapify(self._waiting)
        self._say()

    def _say(self) -> None:
        self.state.libraries = sorted(
            f"{one.loaded.place} on {one.loaded.back_end.name} "
            f"{one.loaded.back_end.device}"
            for one in self._clients.values()
        )
        self._said = self.state.batches
        self._door.say(self.state)

    # -- batches -----------------------------------------------------------------------

    def _carry_out(self) -> bool:
        """Carry out the first batch that may run; return whether there was one."""
        for one in sorted(self._waiting):
            client = self._clients.get(one.client)
            if client is None or not client.memory.attach_queues():
                self._forget(one)
                continue
            if one.holds and self._door.lock.holder == client.memory.pid:
                self._forget(one)
                self._run(one.client, client)
                return True
            if self._door.lock.try_p():
                try:
                    self._forget(one)
                    self._run(one.client, client)
                finally:
                    self._door.lock.v()
                return True
        return False

    def _forget(self, one: _Wanted) -> None:
        self._waiting.remove(one)
        heapq.heapify(self._waiting)

    def _run(self, name: str, client: _Client) -> None:
        memory, loaded = client
        if memory.batches is None or memory.results is None:
            return
        try:
            batch = memory.batches.try_receive()
            if batch is None:
                return
            memory.begun = batches.number_of(batch)
            result = self._timed(loaded, batch)
            memory.results.send(result, full=Full.DROP_OLDEST)
        except XmDestroyedError:
            self._leave(name)
        self.state.batches += 1
        if loaded.is_lost:
            raise SystemExit(DEVICE_LOST)

    def _timed(self, loaded: Loaded, batch: bytes) -> bytes:
        """Return the result of a batch; an endless one ends this process."""
        signal.setitimer(signal.ITIMER_REAL, self._longest)
        try:
            return loaded.run(batch, self.state.starts)
        finally:
            signal.setitimer(signal.ITIMER_REAL, 0.0)
