"""The connection between a client and the executive: shared memory of this machine.

An executive has a bell, a semaphore that wakes it; a door, where new clients leave
their names; a binary semaphore for exclusive use; and a segment that says what it runs
on. A client has a segment that says which library it uses, and one with room for its
batches and results. Two semaphores count those that were handed over: a V is one atomic
operation and never waits, and orders what was written before it. All are resources of
the RTPU (`pbonet.xm`), so none waits for a process that has died.
"""

from __future__ import annotations

import contextlib
import os
import struct
import time
from typing import TYPE_CHECKING, Any, Final, NamedTuple

import msgspec
from msgspec import Struct

from pbonet.errors import SppError, XmError, XmMissingError
from pbonet.outside import using as taping
from pbonet.xm import Full, Queue, Segment, Semaphore, queue, segment, semaphore
from pbonet.xm.ipc import names
from pbonet.xm.net import run_folder

if TYPE_CHECKING:
    from pathlib import Path

_NAMES: Final = 128
_NAME: Final = 64
_ABOUT: Final = 1 << 16
_LENGTH: Final = struct.Struct("<Q")
_MANIFEST: Final = 1 << 16
_COUNT: Final = struct.Struct("<Q")
_SUBMITTED, _BEGUN, _FINISHED, _SIZES = 0, 8, 16, 24
"""Offsets of numbers of batches and of the sizes of slots, in a client's buffers."""
_SLOT_SIZES: Final = struct.Struct("<QQQ")
"""Depth, and the bytes of a slot for a batch and for a result."""
_SLOTS_AT: Final = 64
_SLOT: Final = struct.Struct("<QqiI")
"""Bytes, stamp, priority, and whether the client holds the lock."""


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

    @property
    def pid(self) -> int:
        """The program that it belongs to; 0: it belongs to an agent."""
        last = self.name.rpartition(".")[2]
        return int(last) if "." in self.name and last.isdecimal() else 0

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


def places_of_programs(domain: str, rtpu: str) -> list[Place]:
    """Return where executives of programs are, or were.

    Some have memory and no lock yet, others a lock and no memory any more.
    """
    files = (run_folder.folder() / domain).glob(f"{rtpu}.*.spp")
    found = {path.name.removeprefix(f"{rtpu}.").removesuffix(".spp") for path in files}
    prefix = str(Place(domain, rtpu, "").resource())
    for one in names.standing("shm", domain):
        if one.startswith(prefix):
            found.add(".".join(one.removeprefix(prefix).split(".")[:2]))
    places = [Place(domain, rtpu, name) for name in sorted(found)]
    return [place for place in places if place.pid]


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
    is_loading: bool = False
    """Whether an executive is loading its library, or ended while it did."""


class Executive:
    """The door of an executive, and what belongs to it; both sides open it.

    Args:
        place: Where it is.

    Raises:
        XmError: Its memory cannot be used.
    """

    def __init__(self, place: Place) -> None:
        door, bell = place.resource("door"), place.resource("bell")
        self.door: Queue = queue(door, messages=_NAMES, block=_NAME)
        self.bell: Semaphore = semaphore(bell, initial=0)
        lock = place.resource("lock")
        self.lock: Semaphore = semaphore(lock, initial=1, binary=True)
        self._about: Segment = segment(place.resource(), _ABOUT)

    def enter(self, client: str) -> None:
        """Tell the executive that there is a new client."""
        self.door.send(client.encode(), until_ns=None)
        self.bell.v()

    def close(self) -> None:
        """Detach."""
        for one in (self.door, self.bell, self.lock, self._about):
            one.close()

    def destroy(self) -> None:
        """Remove it."""
        for one in (self.door, self.bell, self.lock, self._about):
            one.destroy()

    def state(self) -> ExecutiveState:
        """Return what the executive says of itself."""
        return _read(self._about, ExecutiveState) or ExecutiveState()

    def say(self, state: ExecutiveState) -> None:
        """Say what the executive runs on."""
        _write(self._about, state)


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
            self.hello = _read(self._segment, Hello)
        else:
            self._manifest = Queue.create(
                manifest, messages=1, blocks=_MANIFEST // 64, block=64
            )
            self._segment = Segment.create(own, _ABOUT)
            _write(self._segment, hello)
        self.buffers: Buffers | None = None

    def say_loading(self, *, is_loading: bool) -> None:
        """Note that its library is being loaded, for an executive after this one."""
        if self.hello is not None:
            self.hello.is_loading = is_loading
            _write(self._segment, self.hello)

    def answer(self, manifest: dict[str, Any]) -> None:
        """Tell the client what its library has, or why it cannot be used.

        Raises:
            SppError: It has too many variables and routines.
            XmDestroyedError: The client has left.
        """
        data = msgspec.msgpack.encode(manifest)
        if len(data) > _MANIFEST:
            raise SppError(
                "the library has too many variables and routines",
                where=self.hello.library if self.hello is not None else "",
                expected=f"at most {_MANIFEST} bytes for names and shapes",
                got=str(len(data)),
                remedy="put several numbers into one variable",
            )
        self._manifest.send(data, full=Full.DROP_OLDEST)

    def manifest(self, until_ns: int) -> dict[str, Any] | None:
        """Return what the executive answered; None: nothing in time."""
        data = self._manifest.receive(until_ns)
        return None if data is None else msgspec.msgpack.decode(data)

    def make_buffers(self, depth: int, batch: int, result: int) -> Buffers:
        """Make room for batches and results of these sizes in bytes."""
        name = self._place.resource(f"{self.name}.buffers")
        self.buffers = Buffers(name, (depth, _rounded(batch), _rounded(result)))
        return self.buffers

    def find_buffers(self) -> Buffers | None:
        """Return the client's buffers; None: it has not made them yet."""
        if self.buffers is None:
            name = self._place.resource(f"{self.name}.buffers")
            with contextlib.suppress(XmMissingError):
                found = Buffers(name)
                if found.is_whole:
                    self.buffers = found
                else:
                    found.close()
        return self.buffers

    @property
    def pid(self) -> int:
        """The client's process."""
        return self.hello.pid if self.hello is not None else 0

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
            self.find_buffers()
        for one in (self._segment, self._manifest, self.buffers):
            if one is not None:
                with contextlib.suppress(XmError):
                    one.destroy()


class Wanted(NamedTuple):
    """The order in which a batch is due; the first one is next."""

    rank: int
    """Its priority, negated."""
    stamp_ns: int
    holds: bool
    """Whether its client held the lock when it handed the batch over."""


class Buffers:
    """A client's batches and results, each in a slot of its own.

    Batch n is in slot n modulo `depth`. The client hands over no more than `depth`
    batches before it takes a result, so a slot is free when it is used again.

    Args:
        name: Its resource.
        sizes: Depth, and the bytes of a batch and of a result; None: attach to it.

    Raises:
        XmError: Its memory cannot be used, or is not there.
    """

    def __init__(
        self, name: names.Name, sizes: tuple[int, int, int] | None = None
    ) -> None:
        handed = name._replace(resource=f"{name.resource}.in")
        done = name._replace(resource=f"{name.resource}.out")
        if sizes is None:
            # The segment is made last, and its sizes are written after that.
            self._segment = Segment.attach(name)
            self.handed_over = Semaphore.attach(handed)
            self.done = Semaphore.attach(done)
        else:
            self.handed_over = Semaphore.create(handed, initial=0)
            self.done = Semaphore.create(done, initial=0)
            depth, batch, result = sizes
            slots = depth * batch + (depth + 1) * result
            self._segment = Segment.create(name, _SLOTS_AT + slots)
            _SLOT_SIZES.pack_into(self._segment.memory, _SIZES, *sizes)
        self._memory = self._segment.memory
        self._depth, self._batch, self._result = _SLOT_SIZES.unpack_from(
            self._memory, _SIZES
        )
        self._results_at = _SLOTS_AT + self._depth * self._batch

    @property
    def is_whole(self) -> bool:
        """Whether the client has written its sizes."""
        return bool(self._depth and self._batch and self._result)

    def _number(self, at: int) -> int:
        return int(_COUNT.unpack_from(self._memory, at)[0])

    @property
    def submitted(self) -> int:
        """The number of the last batch that was handed over."""
        return self._number(_SUBMITTED)

    @property
    def begun(self) -> int:
        """The number of the batch that the executive began last."""
        return self._number(_BEGUN)

    @property
    def finished(self) -> int:
        """The number of the batch whose result came last."""
        return self._number(_FINISHED)

    # -- the client --------------------------------------------------------------------

    def submit(
        self, number: int, batch: memoryview, priority: int, *, holds: bool
    ) -> None:
        """Hand a batch over."""
        at = _SLOTS_AT + number % self._depth * self._batch
        begin = at + _SLOT.size
        self._memory[begin : begin + len(batch)] = batch
        stamp_ns = time.monotonic_ns()
        _SLOT.pack_into(self._memory, at, len(batch), stamp_ns, priority, holds)
        _COUNT.pack_into(self._memory, _SUBMITTED, number)
        self.handed_over.v()

    def result(self, number: int) -> bytes:
        """Return the result of a batch."""
        at = self._results_at + number % (self._depth + 1) * self._result
        size = int(_COUNT.unpack_from(self._memory, at)[0])
        begin = at + _COUNT.size
        return bytes(self._memory[begin : begin + size])

    # -- the executive -----------------------------------------------------------------

    def wanted(self) -> Wanted:
        """Return when the next batch is due, which was handed over."""
        at = _SLOTS_AT + (self.begun + 1) % self._depth * self._batch
        _, stamp_ns, priority, holds = _SLOT.unpack_from(self._memory, at)
        return Wanted(-priority, stamp_ns, bool(holds))

    def begin(self) -> memoryview:
        """Return the next batch, and note that it is begun."""
        number = self.begun + 1
        at = _SLOTS_AT + number % self._depth * self._batch
        size = _SLOT.unpack_from(self._memory, at)[0]
        _COUNT.pack_into(self._memory, _BEGUN, number)
        begin = at + _SLOT.size
        return self._memory[begin : begin + size]

    def finish(self, result: bytes) -> None:
        """Give the client the result of the batch that was begun last."""
        number = self.begun
        at = self._results_at + number % (self._depth + 1) * self._result
        begin = at + _COUNT.size
        self._memory[begin : begin + len(result)] = result
        _COUNT.pack_into(self._memory, at, len(result))
        _COUNT.pack_into(self._memory, _FINISHED, number)
        self.done.v()

    def close(self) -> None:
        """Detach."""
        for one in (self._segment, self.handed_over, self.done):
            one.close()

    def destroy(self) -> None:
        """Remove it."""
        del self._memory
        for one in (self._segment, self.handed_over, self.done):
            with contextlib.suppress(XmError):
                one.destroy()


def client_name(number: int) -> str:
    """Return the name of a client of this process."""
    return f"{os.getpid()}-{number}"


def _rounded(size: int) -> int:
    """Return the bytes of a slot for so many bytes: whole lines of the cache."""
    return -(-(size + _SLOT.size) // 64) * 64


def _write(where: Segment, what: Struct) -> None:
    data = msgspec.json.encode(what)
    memory = where.memory
    begin = _LENGTH.size
    if begin + len(data) > len(memory):
        return
    _LENGTH.pack_into(memory, 0, 0)
    memory[begin : begin + len(data)] = data
    _LENGTH.pack_into(memory, 0, len(data))


def _read(where: Segment, kind: type[Any]) -> Any:  # noqa: ANN401
    memory = where.memory
    (size,) = _LENGTH.unpack_from(memory, 0)
    begin = _LENGTH.size
    try:
        return msgspec.json.decode(bytes(memory[begin : begin + size]), type=kind)
    except msgspec.MsgspecError:  # it is being written
        return None
