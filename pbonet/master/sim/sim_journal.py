"""What one task of a simulation puts on record: what its ring has in real time."""

from __future__ import annotations

import contextlib
import struct
from typing import TYPE_CHECKING, Final

from pbonet.log import RECORD, STABLE, Did, Step, pack
from pbonet.node.task import Executor, journal
from pbonet.outside import Outside, Tape, using
from pbonet.pbo import Counted

if TYPE_CHECKING:
    from collections.abc import Callable, Generator
    from typing import Any

    from pbonet.log import TaskAbout
    from pbonet.pbo import PortBasedObject, State

    from .sim_table import MemoryCopies

_HEAD: Final = struct.Struct("<QqqqqQQQQII")
_PAIR: Final = struct.Struct("<QQ")


class Tray:
    """Records as a ring has them, in memory: nothing is too fast for it."""

    lost = 0

    def __init__(self) -> None:
        self._data = bytearray()
        self._always = False
        self.wanted = True
        """Whether the next cycle stores its inputs."""

    def put(
        self,
        data: bytes,
        *,
        cycle: int = 0,
        kind: int = 0,
        now_ns: int = 0,
        uid: int = 0,
        number: int = 0,
    ) -> bool:
        """Append one record; see `pbonet.node.ring._ring.Ring`."""
        head = (cycle, now_ns, now_ns, now_ns, 0, 0, uid, number, 0, 0, int(kind))
        self._add(head, b"", data, b"", b"")
        return True

    def cycle(
        self,
        head: tuple[int, ...],
        consumed: bytes,
        data: bytes,
        inputs: bytes,
        heard: bytes,
    ) -> None:
        """Append the record of a cycle."""
        self.wanted = self._always
        self._add(head, consumed, data, inputs, heard)

    def _add(
        self,
        head: tuple[int, ...],
        consumed: bytes,
        data: bytes,
        inputs: bytes,
        heard: bytes,
    ) -> None:
        parts = (_HEAD.pack(*head), data, consumed, inputs, heard)
        size = RECORD.size + sum(map(len, parts))
        gap = -size % 8
        pairs = len(consumed) // _PAIR.size
        counts = (pairs, len(data), len(inputs), len(heard), 0)
        self._data += b"".join((RECORD.pack(size + gap, *counts), *parts, bytes(gap)))

    def take(self) -> bytes:
        """Return what there is, and forget it."""
        found = bytes(self._data)
        self._data.clear()
        return found

    def want(self, *, always: bool = False) -> None:
        """Have the next cycle store its inputs, or each cycle."""
        self._always = self._always or always
        self.wanted = True

    def close(self) -> None:
        """Do nothing: it is memory."""


class SimTime(Counted):
    """The virtual time of one task, and how many cycles it had since its spawn.

    Args:
        clock: The virtual time.
    """

    def __init__(self, clock: Callable[[], int]) -> None:
        super().__init__(clock)
        self.cycles = 0
        self.outside: Outside | None = None
        """Keeps on record what the module is told of its criticality."""
        self._told = 0

    def tick(self) -> int:
        """Return the time, which stands still while a method runs."""
        return self.now

    @contextlib.contextmanager
    def held(self) -> Generator[None]:
        """Do nothing: it stands still."""
        yield

    @property
    def crit(self) -> int:
        """The criticality that the task is ranked by."""
        if self.outside is not None:
            self._told = self.outside.ask(lambda: self._crit, default=self._told)
        return self._crit

    @crit.setter
    def crit(self, value: int) -> None:
        self._crit = value


class SimJournal(journal.Journal):
    """The copies of a simulated task, and a record of each, those of cycles included.

    Args:
        copies: What copies.
        about: Whose they are.
        time: The task's.
        uid: The number of its register, another one for each spawn.
    """

    def __init__(
        self, copies: MemoryCopies, about: TaskAbout, time: SimTime, uid: int
    ) -> None:
        copies.uid = uid
        self.tray, self.tape = Tray(), Tape()
        self.about = about
        about.timing = False  # nothing fails in time of itself, and nobody tells of it
        super().__init__(copies, self.tray, about, time, self.tape)
        self._copies = copies
        self._times = time
        self._tape = self.tape
        self._cycling: tuple[int, int, bool] | None = None
        self._consumed = self._inputs = b""
        self._outside: list[tuple[int, int]] = []
        with using(self.tape):
            self.outside = time.outside = Outside("task")

    @contextlib.contextmanager
    def doing(self, did: Did) -> Generator[None]:
        """Put on record what is about to be done."""
        before, self._cycling = self._cycling, None
        if did.what == "on":
            self.tray.want()
        try:
            with using(self.tape), super().doing(did):
                yield
        finally:
            self._cycling = before

    @contextlib.contextmanager
    def cycle(self, release_ns: int, dt_ns: int, *, stable: bool) -> Generator[None]:
        """Put on record the cycle that runs in this block, if it commits."""
        self._cycling = release_ns, dt_ns, stable
        try:
            with using(self.tape):
                yield
        finally:
            self._cycling = None
            self._times.cycles += 1

    def copy_in(self) -> int:
        """Copy the in-vars in; returns flags."""
        if self._cycling is None:
            return super().copy_in()
        flags = self._copies.copy_in()
        pairs = self._copies.consumed()
        outside = [pair for pair in pairs if not pair[0]]
        if outside != self._outside:
            self._outside = outside
            self.tray.wanted = True
        self._consumed = b"".join(_PAIR.pack(*pair) for pair in pairs)
        self._inputs = b""
        if self.tray.wanted:
            self._inputs = pack(self.about.invar, self._copies.array)
        return flags

    def commit(self, now_ns: int = 0, cycle: int = 0) -> int:
        """Copy the out-vars out; returns flags."""
        if self._cycling is None:
            return super().commit(now_ns, cycle)
        release, dt, stable = self._cycling
        flags = self._copies.commit(now_ns, cycle)
        if not flags:
            now, number = self._times.now, self._times.cycles + 1
            key = self._copies.out_uid, self._copies.out_number
            marks = STABLE if stable else 0
            head = (number, release, now, now, dt, 0, *key, 0, marks, int(Step.CYCLE))
            data = pack(self.about.outvar, self._copies.array)
            heard = self.tape.take()
            self.tray.cycle(head, self._consumed, data, self._inputs, heard)
        return flags


class SimExecutor(Executor):
    """An executor that says of each thing it does why, where that is recorded.

    Args:
        instance: As for `Executor`.
        copies: The task's.
        illegal: As for `Executor`.
        journal: The copies, and a record of each; None: nothing is recorded.

    Attributes:
        faulted: What the last cycle raised; whoever tells of it takes it.
    """

    def __init__(
        self,
        instance: PortBasedObject[Any],
        copies: MemoryCopies,
        *,
        illegal: Callable[[], bool] | None,
        journal: SimJournal | None,
    ) -> None:
        super().__init__(instance, journal or copies, illegal=illegal)
        self.journal = journal
        self.faulted: BaseException | None = None

    def _doing(self, did: Did) -> contextlib.AbstractContextManager[None]:
        return self.journal.doing(did) if self.journal else contextlib.nullcontext()

    def spawn(self) -> State:
        """Run `init`; see `Executor.spawn`."""
        with self._doing(Did("spawn")):
            return super().spawn()

    def signal(
        self, name: str, arg: str = "", *, handover: bool = False, cede: bool = False
    ) -> State:
        """Carry out a signal; see `Executor.signal`."""
        with self._doing(Did(name, arg=arg, handover=handover, cede=cede)):
            return super().signal(name, arg, handover=handover, cede=cede)

    def set(self, name: str, words: tuple[str, ...], *, where: str = "") -> object:
        """Change a parameter; see `Executor.set`."""
        with self._doing(Did("set", name=name, arg=" ".join(words))):
            return super().set(name, words, where=where)

    def run_cycle(self, dt_ns: int, now_ns: int, *, stable: bool) -> None:
        """Do one cycle; see `Executor.cycle`."""
        if self.journal is None:
            self.cycle(dt_ns * 1e-9, now_ns)
            return
        with self.journal.cycle(now_ns, dt_ns, stable=stable):
            self.cycle(dt_ns * 1e-9, now_ns)

    def fault(self, error: BaseException, method: str = "cycle") -> State:
        """Have `error` deal with what a cycle raised; see `Executor.fault`."""
        self.faulted = error
        with self._doing(Did("fault", name=method, arg=str(error))):
            return super().fault(error, method)

    def abort(self) -> State:
        """Begin anew behind a cycle that was ended; see `Executor.abort`."""
        with self._doing(Did("abort")):
            return super().abort()
