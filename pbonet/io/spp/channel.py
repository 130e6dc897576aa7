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
from typing import TYPE_CHECKING, Any, Final

import msgspec
from msgspec import Struct

from pbonet.errors import XmDestroyedError, XmError, XmMissingError
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


class ExecutiveState(Struct, kw_only=True):
    """What an executive says of itself."""

    pid: int = 0
    starts: int = 0
    """How often one of this name was started."""
    back_end: str = ""
    """The first choice of libraries; empty while it starts."""
    device: str = ""
    found: list[str] = []
    """All back ends that it has, as ``NAME DEVICE``."""
    error: dict[str, Any] | None = None
    """Why it cannot run."""
    libraries: list[str] = []
    """What its clients use, as ``FILE on BACK_END DEVICE``."""
    batches: int = 0


class Hello(Struct, kw_only=True):
    """What a client says of itself."""

    library: str
    pid: int
    owner: str
    depth: int


class Executive:
    """The door of an executive, and what belongs to it; both sides open it.

    Args:
        name: As in ``[spp.NAME]``; of a program's own with its process.

    Raises:
        XmError: Its memory cannot be used.
    """

    def __init__(self, name: str) -> None:
        base = f"spp.{name}"
        self.door: Queue = queue(
            f"{base}.door", policy=Policy.HPF, messages=_RINGS, block=_RING.size
        )
        self.lock: Semaphore = semaphore(f"{base}.lock", initial=1, binary=True)
        self._about: Segment = segment(base, _ABOUT)

    def ring(self, client: str, priority: int, *, holds: bool) -> None:
        """Tell the executive that a client has a batch, or is new."""
        text = _RING.pack(holds, client.encode())
        self.door.send(text, priority, full=Full.DROP)

    def close(self) -> None:
        """Detach."""
        self.door.close()
        self.lock.close()
        self._about.close()

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


def remove(name: str) -> None:
    """Remove the memory of an executive that has ended."""
    here = names.home()
    with taping(None):
        for client in clients(here.domain, here.rtpu, name):
            with contextlib.suppress(XmError):
                ClientMemory(client).destroy()
        Executive(name).destroy()
    lock_path(here.domain, here.rtpu, name).unlink(missing_ok=True)


def rung(text: bytes) -> tuple[str, bool]:
    """Return the client that rang, and whether it holds the lock."""
    holds, client = _RING.unpack(text)
    return client.rstrip(b"\0").decode(), bool(holds)


def lock_path(domain: str, rtpu: str, name: str) -> Path:
    """Return the file that an executive holds locked while it lives."""
    folder = run_folder.folder() / domain
    folder.mkdir(mode=0o700, exist_ok=True)
    return folder / f"{rtpu}.{name}.spp"


def is_running(name: str) -> bool:
    """Return whether an executive runs on the RTPU of this process."""
    here = names.home()
    return run_folder.is_held(lock_path(here.domain, here.rtpu, name))


class ClientMemory:
    """The memory of one client; it makes it, and the executive attaches to it.

    Args:
        name: The client: ``spp.NAME.PID.NUMBER``.
        hello: What it says of itself; None: attach to what another process has made.

    Raises:
        XmError: Its memory cannot be used, or is not there.
    """

    def __init__(self, name: str, hello: Hello | None = None) -> None:
        self.name = name
        if hello is None:
            self._segment = Segment.attach(name)
            self._manifest = Queue.attach(f"{name}.manifest")
            self.hello: Hello | None = _read(self._segment, Hello, _BEGUN.size)
        else:
            self._manifest = Queue.create(
                f"{name}.manifest", messages=1, blocks=_MANIFEST // 64, block=64
            )
            self._segment = Segment.create(name, _ABOUT)
            _write(self._segment, hello, _BEGUN.size)
            self.hello = hello
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
        self.batches = _queue(f"{self.name}.in", batch, depth)
        self.results = _queue(f"{self.name}.out", result, depth + _RESULTS_SPARE)

    def attach_queues(self) -> bool:
        """Attach to the client's queues; return whether there are any."""
        if self.batches is None:
            try:
                self.results = Queue.attach(f"{self.name}.out")
                self.batches = Queue.attach(f"{self.name}.in")
            except XmMissingError:
                return False
        return True

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
        for one in (self._segment, self._manifest, self.batches, self.results):
            if one is not None:
                try:
                    one.destroy()
                except XmDestroyedError:
                    one.close()


def clients(domain: str, rtpu: str, name: str) -> list[str]:
    """Return the clients of an executive that left or use memory."""
    prefix = f"{rtpu}:spp.{name}."
    found = (
        one.removeprefix(f"{rtpu}:")
        for one in names.standing("shm", domain)
        if one.startswith(prefix)
    )
    return [one for one in found if one.removeprefix(f"spp.{name}.").count(".") == 1]


def client_name(name: str, number: int) -> str:
    """Return the name of a client of this process."""
    return f"spp.{name}.{os.getpid()}.{number}"


def _queue(name: str, size: int, count: int) -> Queue:
    block = min(_BLOCK, -(-size // 8) * 8)
    return Queue.create(
        name, messages=count, blocks=count * -(-size // block), block=block
    )


def _write(where: Segment, what: Struct, at: int = 0) -> None:
    data = msgspec.json.encode(what)[: where.size - at - _LENGTH.size]
    memory = where.memory
    begin = at + _LENGTH.size
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
