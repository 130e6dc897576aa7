"""The executive: takes batches in the order of priorities, one at a time (7.4.2)."""

from __future__ import annotations

import os
import signal
import time
from typing import TYPE_CHECKING, Final

from pbonet.errors import SppError, XmDestroyedError, XmError
from pbonet.io.spp import batches, channel

if TYPE_CHECKING:
    from pbonet.io.spp import Execution, Loaded

DEVICE_LOST: Final = 3
"""Exit status when a back end cannot be used any more by this process."""
LOAD_TIME: Final = 90.0
"""Seconds after which loading a library ends this process; no client waits so long."""
_IDLE_NS: Final = 500_000_000
"""How often it checks for clients that have died."""
_LOCKED_NS: Final = 2_000_000
"""How often it tries the lock, while batches wait for that."""


class _Client:
    """A client, with its library, and how many of its batches wait.

    Args:
        memory: Its memory.
        loaded: Its library.
    """

    def __init__(self, memory: channel.ClientMemory, loaded: Loaded) -> None:
        self.memory, self.loaded = memory, loaded
        self.waiting = 0

    def count(self) -> None:
        """Count the batches that it has handed over since."""
        buffers = self.memory.find_buffers()
        if buffers is None:
            return
        while buffers.handed_over.try_p():
            self.waiting += 1
        # One that was counted by `_adopt` before its V is not counted twice.
        self.waiting = min(self.waiting, buffers.submitted - buffers.begun)


def _refuse_what_ended_another(hello: channel.Hello) -> None:
    """Refuse a library that was being loaded when the executive before this ended."""
    if hello.is_loading:
        raise SppError(
            "the executive ended while it loaded the library",
            where=hello.library,
            remedy="correct what the file runs when it is loaded",
        )


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
        self._checked_ns = self._said = 0
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
        """Serve a client of the executive before; what that had begun is lost."""
        client = self._enter(name)
        buffers = client.memory.find_buffers() if client is not None else None
        if client is None or buffers is None:
            return
        client.count()
        client.waiting = buffers.submitted - buffers.begun
        if buffers.begun != buffers.finished:
            number = buffers.begun
            buffers.finish(batches.pack_result(number, self.state.starts, 0))
        buffers.done.v()  # in case the one before ended just before it did this

    def serve(self) -> None:
        """Carry out one batch, or wait for one; check the clients at times."""
        now = time.monotonic_ns()
        waits = any(one.waiting for one in self._clients.values())
        pause = _LOCKED_NS if waits else _IDLE_NS
        bell = self._door.bell
        if not self._carried_out and bell.p(now + pause):
            while bell.try_p():
                pass
        while (name := self._door.door.try_receive()) is not None:
            self._enter(name.decode())
        self._count()
        self._carried_out = self._carry_out()
        if now - self._checked_ns > _IDLE_NS:
            self._checked_ns = now
            self._check_clients()

    def _count(self) -> None:
        for name, client in list(self._clients.items()):
            try:
                client.count()
            except XmDestroyedError:
                self._leave(name)

    # -- clients -----------------------------------------------------------------------

    def _enter(self, name: str) -> _Client | None:
        """Load the library of a client, and answer it."""
        if name in self._clients:
            return self._clients[name]
        try:
            memory = channel.ClientMemory(self._place, name)
        except XmError:  # it has gone meanwhile
            return None
        if memory.is_abandoned or memory.hello is None:
            memory.destroy()
            return None
        loaded = self._load(memory, memory.hello)
        if loaded is None:
            return None
        client = self._clients[name] = _Client(memory, loaded)
        self._say()
        return client

    def _load(
        self, memory: channel.ClientMemory, hello: channel.Hello
    ) -> Loaded | None:
        """Load a client's library, and answer it; None: it cannot be used."""
        loaded: Loaded | None = None
        try:
            try:
                _refuse_what_ended_another(hello)
                memory.say_loading(is_loading=True)
                signal.setitimer(signal.ITIMER_REAL, max(LOAD_TIME, self._longest))
                loaded = self._execution.load(hello.library)
                memory.answer(loaded.manifest())
            except SppError as error:
                loaded = None
                memory.answer({"error": batches.short_wire(error)})
            memory.say_loading(is_loading=False)
        except XmDestroyedError:  # it did not wait so long
            return None
        finally:
            signal.setitimer(signal.ITIMER_REAL, 0.0)
        return loaded

    def _check_clients(self) -> None:
        """Forget clients that have died; say how much was done."""
        for name, client in list(self._clients.items()):
            if client.memory.is_abandoned:
                self._leave(name)
        if self.state.batches != self._said:
            self._say()

    def _leave(self, name: str) -> None:
        client = self._clients.pop(name)
        client.loaded.close()
        client.memory.destroy()
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
        due = [
            (buffers.wanted(), name)
            for name, one in self._clients.items()
            if one.waiting and (buffers := one.memory.find_buffers()) is not None
        ]
        for wanted, name in sorted(due):
            client = self._clients[name]
            if wanted.holds and self._door.lock.holder == client.memory.pid:
                self._run(client)
                return True
            if self._door.lock.try_p():
                try:
                    self._run(client)
                finally:
                    self._door.lock.v()
                return True
        return False

    def _run(self, client: _Client) -> None:
        buffers = client.memory.buffers
        client.waiting -= 1
        if buffers is None:
            return
        batch = buffers.begin()
        signal.setitimer(signal.ITIMER_REAL, self._longest)  # it ends this process
        try:
            result = client.loaded.run(batch, self.state.starts)
        finally:
            signal.setitimer(signal.ITIMER_REAL, 0.0)
        try:
            buffers.finish(result)
        except XmDestroyedError:
            client.waiting = 0  # found by `_count`
        self.state.batches += 1
        if client.loaded.is_lost:
            raise SystemExit(DEVICE_LOST)
