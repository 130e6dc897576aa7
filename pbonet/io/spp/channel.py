"""How a client and the executive reach each other: shared memory of this machine.

An executive has a door, where clients ring with their priority, a binary semaphore for
exclusive use, and a segment that says what it runs on. A client has a segment that says
which library it uses, a queue of batches and a queue of results. All are resources of
the RTPU (`pbonet.xm`), so none waits for a process that has died.
"""

from __future__ import annotations

import contextlib
import os
import struct
from typing import TYPE_CHECKING, Any, Final, NamedTuple

import msgspec
from msgspec import Struct

from pbonet.errors import XmError, XmMissingError
from pbonet.outside import using as taping
from pbonet.xm import Full, Policy, Queue, Segment, queue, segment, semaphore
from pbonet.xm.ipc import names
from pbonet.xm.net import run_folder

if TYPE_CHECKING:
    from pathlib import Path

    from pbonet.xm import Semaphore

_RINGS: Final = 512
_ABOUT: Final = 4096
_LENGTH: Final = struct.Struct("<Q")
_BEGUN: Final = struct.Struct("<Q")
_RING: Final = struct.Struct("<B55s")
_BLOCK: Final = 4096
_RESULTS_SPARE: Final = 3
_MANIFEST: Final = 1 << 16


class Place(NamedTuple):
    """Where an executive is."""

    domain: str
    rtpu: str
    name: str
    """As in ``[spp.NAME]``; of a program's own with its process."""

    def resource(self, name: str = "") -> names.Name:
        """Return the name of one of its resources."""
        whole = f"spp.{self.name}"
        whole += f".{name}" if name else ""
        return names.Name(self.domain, self.rtpu, whole)

    def lock(self) -> Path:
        """Return the file that the executive holds locked while it lives."""
        folder = run_folder.folder() / self.domain
        folder.mkdir(mode=0o700, exist_ok=True)
        return folder / f"{self.rtpu}.{self.name}.spp"

    def is_running(self) -> bool:
        """Return whether an executive runs."""
        return run_folder.is_held(self.lock())

    def clients(self) -> list[str]:
        """Return its clients: those whose memory is there."""
        prefix = f"{self.resource()}."
        there = names.standing("shm", self.domain)
        return [one.removeprefix(prefix) for one in there if one.startswith(prefix)]

    def remove(self) -> None:
        """Remove the memory of an executive that has ended, and of its clients."""
        with taping(None):
            for client in self.clients():
                with contextlib.suppress(XmError):
                    ClientMemory(self, client).destroy()
            Executive(self).destroy()
        self.lock().unlink(missing_ok=True)


class ExecutiveState(Struct, kw_only=True):
    """Description of an executive by itself."""

    pid: int = 0
    starts: int = 0
    """How often one of this name was started."""
    back_end: str = ""
    """The first choice of libraries; empty while it starts."""
    device: str = ""
    found: list[str] = []
    """All back ends that it has, as ``NAME on DEVICE``."""
    error: dict[str, str] = {}
    """Why it cannot run."""
    libraries: list[str] = []
    """Libraries of its clients, as ``FILE on BACK_END DEVICE``."""
    batches: int = 0
    """Batches carried out, as of the last half second."""


class Hello(Struct, kw_only=True):
    """Description of a client by itself."""

    library: str
    pid: int
    owner: str


class Executive:
    """The door of an executive, and what belongs to it; both sides open it.

    Args:
        place: Where it is.

    Raises:
        XmError: Its memory cannot be used.
    """

    def __init__(self, place: Place) -> None:
        self.door: Queue = queue(
            place.resource("door"),
            policy=Policy.HPF,
            messages=_RINGS,
            block=_RING.size,
        )
        self.lock: Semaphore = semaphore(place.resource("lock"), initial=1, binary=True)
        self._about: Segment = segment(place.resource(), _ABOUT)

    def ring(self, client: bytes, priority: int, *, holds: bool) -> None:
        """Tell the executive that a client has a batch, or is new."""
        self.door.send(_RING.pack(holds, client), priority, full=Full.DROP)

    def close(self) -> None:
        """Detach."""
        for one in (self.door, self.lock, self._about):
            one.close()

    def destroy(self) -> None:
        """Remove it."""
        for one in (self.door, self.lock, self._about):
            one.destroy()

    def state(self) -> ExecutiveState:
        """Return what the executive says of itself."""
        return _read(self._about, ExecutiveState) or ExecutiveState()

    def say(self, state: ExecutiveState) -> None:
        """Say what the executive runs on."""
        _write(self._about, state)


def rung(text: bytes) -> tuple[str, bool]:
    """Return the client that rang, and whether it holds the lock."""
    holds, client = _RING.unpack(text)
    return client.rstrip(b"\0").decode(), bool(holds)


class ClientMemory:
    """The memory of one client; it makes it, and the executive attaches to it.

    Args:
        place: Where its executive is.
        name: The client, as `client_name` returns it.
        hello: What it says of itself; None: attach to what another process has made.

    Raises:
        XmError: Its memory cannot be used, or is not there.
    """

    def __init__(self, place: Place, name: str, hello: Hello | None = None) -> None:
        self._place, self.name = place, name
        own, manifest = place.resource(name), place.resource(f"{name}.manifest")
        self.hello: Hello | None = hello
        if hello is None:
            self._segment = Segment.attach(own)
            self._manifest = Queue.attach(manifest)
            self.hello = _read(self._segment, Hello, _BEGUN.size)
        else:
            self._manifest = Queue.create(
                manifest, messages=1, blocks=_MANIFEST // 64, block=64
            )
            self._segment = Segment.create(own, _ABOUT)
            _write(self._segment, hello, _BEGUN.size)
        self.batches: Queue | None = None
        self.results: Queue | None = None

    def answer(self, manifest: dict[str, Any]) -> None:
        """Tell the client what its library has, or why it cannot be used."""
        data = msgspec.msgpack.encode(manifest)
        self._manifest.send(data, full=Full.DROP_OLDEST)

    def manifest(self, until_ns: int) -> dict[str, Any] | None:
        """Return what the executive answered; None: nothing in time."""
        data = self._manifest.receive(until_ns)
        return None if data is None else msgspec.msgpack.decode(data)

    def make_queues(self, batch: int, result: int, depth: int) -> None:
        """Make the queues for batches and results, of these sizes in bytes."""
        self.batches = _queue(self._resource("in"), batch, depth)
        self.results = _queue(self._resource("out"), result, depth + _RESULTS_SPARE)

    def attach_queues(self) -> bool:
        """Attach to the client's queues; return whether there are any."""
        if self.batches is None:
            try:
                self.batches = Queue.attach(self._resource("in"))
                self.results = Queue.attach(self._resource("out"))
            except XmMissingError:
                self.batches = None
        return self.batches is not None

    def _resource(self, end: str) -> names.Name:
        return self._place.resource(f"{self.name}.{end}")

    @property
    def pid(self) -> int:
        """The client's process."""
        return self.hello.pid if self.hello is not None else 0

    @property
    def begun(self) -> int:
        """The number of the batch that the executive began last."""
        return int(_BEGUN.unpack_from(self._segment.memory)[0])

    @begun.setter
    def begun(self, number: int) -> None:
        _BEGUN.pack_into(self._segment.memory, 0, number)

    @property
    def is_abandoned(self) -> bool:
        """Whether no other process uses it."""
        try:
            return self._segment.attached < 2  # noqa: PLR2004 - client and executive
        except XmError:
            return True

    def destroy(self) -> None:
        """Remove it."""
        with contextlib.suppress(XmError):
            self.attach_queues()
        for one in (self._segment, self._manifest, self.batches, self.results):
            if one is not None:
                with contextlib.suppress(XmError):
                    one.destroy()


def client_name(number: int) -> str:
    """Return the name of a client of this process."""
    return f"{os.getpid()}-{number}"


def _queue(name: names.Name, size: int, count: int) -> Queue:
    block = min(_BLOCK, -(-size // 8) * 8)
    return Queue.create(
        name, messages=count, blocks=count * -(-size // block), block=block
    )


def _write(where: Segment, what: Struct, at: int = 0) -> None:
    data = msgspec.json.encode(what)
    memory = where.memory
    begin = at + _LENGTH.size
    if begin + len(data) > len(memory):
        return
    _LENGTH.pack_into(memory, at, 0)
    memory[begin : begin + len(data)] = data
    _LENGTH.pack_into(memory, at, len(data))


def _read(where: Segment, kind: type[Any], at: int = 0) -> Any:  # noqa: ANN401
    memory = where.memory
    (size,) = _LENGTH.unpack_from(memory, at)
    begin = at + _LENGTH.size
    try:
        return msgspec.json.decode(bytes(memory[begin : begin + size]), type=kind)
    except msgspec.MsgspecError:  # it is being written
        return None
