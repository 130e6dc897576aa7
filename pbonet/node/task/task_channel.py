"""A task's messages to the RTPU process, and its module's view of time."""

from __future__ import annotations

import contextlib
import fcntl
import os
import select
import signal
import socket
from collections import Counter, deque
from typing import TYPE_CHECKING

from pbonet.errors import MethodError, PbonetError, Severity
from pbonet.node.wire import UNTOLD, rtpu_messages, severity
from pbonet.pbo import Notice, Signal, State, TaskContext, signal_names
from pbonet.xm.net import event_codes

if TYPE_CHECKING:
    from collections.abc import Callable, Generator

    from pbonet.errors import WireError
    from pbonet.node.rt import Slot
    from pbonet.outside import ModuleAnswers

    from .executor import Executor
    from .step_failures import Raised

LONGEST_TEXT = 5000
"""Characters that are sent of each text if a notice is too long."""
MOST_OWED = 64
"""Packets of which a module's signal to another task may be the last that is kept."""
INTERRUPT = signal.SIGUSR2
ORPHAN_SIGNAL = signal.SIGUSR1
"""Sent by the kernel when the parent has ended; handled in native code."""
F_SETSIG = 10
_SIZE = socket.MSG_PEEK | socket.MSG_TRUNC | socket.MSG_DONTWAIT
"""Flags to learn the size of the next packet, which stays."""


class Interrupted(BaseException):
    """Ends a module's wait in `sync` because a message arrived."""


def interrupt_waits(sock: socket.socket, arrived: Callable[[], None]) -> None:
    """Let the kernel send a signal when a message arrives on `sock`, or its end.

    Args:
        sock: The task's socket.
        arrived: Called in the main thread, at any point; may raise
            `Interrupted` to end it.
    """
    signal.signal(INTERRUPT, lambda _number, _frame: arrived())
    # If both come at once, the first decides whether the kernel restarts the wait.
    signal.siginterrupt(ORPHAN_SIGNAL, True)  # noqa: FBT003 - the library's
    fcntl.fcntl(sock, fcntl.F_SETOWN, os.getpid())
    fcntl.fcntl(sock, F_SETSIG, int(INTERRUPT))
    flags = fcntl.fcntl(sock, fcntl.F_GETFL)
    fcntl.fcntl(sock, fcntl.F_SETFL, flags | os.O_ASYNC)


class RtpuChannel:
    """The task's end of its socket.

    Answers wait until the RTPU process receives them. What a module sends within a
    cycle never waits: if there is no room it is dropped, counted, and reported later.
    Reports of the task's state, and the first signals for other tasks, do not wait
    either, but are kept until there is room.

    Args:
        sock: Sequenced packets to the RTPU process.
    """

    def __init__(self, sock: socket.socket) -> None:
        self.sock = sock
        self.own: dict[str, int] = {}
        """Names and bits of the module's own signals."""
        self._lost: Counter[str] = Counter()
        self._owed: deque[bytes] = deque()

    @property
    def owing(self) -> list[socket.socket]:
        """The socket, if reports of the task's state wait for room there."""
        return [self.sock] if self._owed else []

    def pay(self) -> bool:
        """Send kept reports as far as there is room; return whether all were sent."""
        try:
            while self._owed:
                self.sock.send(self._owed[0], socket.MSG_DONTWAIT)
                self._owed.popleft()
        except BlockingIOError:
            return False
        except OSError:
            self._owed.clear()  # the RTPU process is gone
        return True

    def receive(self) -> bytes | None:
        """Return the next packet, b"" if the other end is closed, or None.

        It takes no more memory than the packet needs: a module may have used it up.
        """
        try:
            size = self.sock.recv_into(bytearray(1), 1, _SIZE)
            return self.sock.recv(size, socket.MSG_DONTWAIT)
        except BlockingIOError:
            return None
        except OSError:
            return b""

    def waits(self) -> bool:
        """Return whether a packet, or the end, can be received."""
        return bool(select.select([self.sock], [], [], 0)[0])

    def say(self, done: rtpu_messages.Done) -> None:
        """Answer a message; if the answer cannot be encoded, with an error."""
        done.lost = dict(self._lost)
        try:
            data = rtpu_messages.encode(done)
            if len(data) > rtpu_messages.LARGEST_PACKET:
                data = _instead(done, _too_long(data))
        except UNTOLD as error:
            data = _instead(done, _untold(error))
        try:
            for one in (*self._owed, data):
                self.sock.send(one)
        except OSError:
            return  # the RTPU process is gone, as the orphan guard reports
        self._owed.clear()
        self._lost.clear()

    def put(self, notice: Notice) -> None:
        """Send a module's signal or warning, within a cycle."""
        warned = notice.bits & Signal.WARNING
        handled = notice.handled
        self._post(
            rtpu_messages.Notice(
                severity=int(
                    Severity.WARNING if handled else severity(notice.bits),
                ),
                code="HANDLED" if handled else "WARNING" if warned else "SIGNAL",
                text=notice.text
                if warned or handled or notice.order
                else self._signal_text(notice),
                order=notice.order,
                cycle=notice.cycle,
                bits=notice.bits,
                errnum=notice.code,
                place=notice.place,
            )
        )

    def notice(
        self,
        severity: Severity,
        code: str,
        text: str,
        *,
        cycle: int = 0,
        state: str = "",
        error: PbonetError | None = None,
        about: PbonetError | None = None,
    ) -> None:
        """Send an unsolicited report; `about` holds its number and place."""
        about = about or error
        self._post(
            rtpu_messages.Notice(
                severity=int(severity),
                code=code,
                text=text,
                cycle=cycle,
                errnum=about.number if isinstance(about, MethodError) else 0,
                place=about.place if isinstance(about, MethodError) else "",
                state=state,
                error=PbonetError.to_wire(error) if error else None,
            )
        )

    def report(self, error: Raised, executor: Executor, cycle: int) -> None:
        """Report an error of a cycle and how it was handled."""
        if isinstance(error, PbonetError):
            told = error
        else:
            told = MethodError(executor.task.errmsg or str(error))
        text = event_codes.failure_text(
            executor.task.errmsg or str(error), executor.state
        )
        self.notice(
            Severity.ERROR,
            "METHOD",
            text,
            cycle=cycle,
            state=executor.state,
            error=told,
            about=executor.failure,
        )

    def _signal_text(self, notice: Notice) -> str:
        names = " ".join(signal_names(notice.bits, self.own))
        return f"{names}: {notice.text}" if notice.text else names

    def send(self, data: bytes) -> None:
        """Send an encoded report of the state, without waiting."""
        self._offer(data, owe=True)

    def _post(self, notice: rtpu_messages.Notice) -> None:
        notice.lost = dict(self._lost)
        changed = notice.state not in {"", State.ON}
        orders = notice.order is not None and len(self._owed) < MOST_OWED
        if self._offer(_packed(notice), owe=changed or orders):
            self._lost.clear()
        else:
            self._lost[notice.code] += 1

    def _offer(self, data: bytes, *, owe: bool) -> bool:
        """Send without waiting; with `owe`, later if there is no room.

        Returns:
            Whether it is sent or will be.
        """
        if self.pay():
            try:
                self.sock.send(data, socket.MSG_DONTWAIT)
            except BlockingIOError:
                pass
            except OSError:
                return False
            else:
                return True
        if owe:
            self._owed.append(data)
        return owe


def _instead(done: rtpu_messages.Done, error: PbonetError) -> bytes:
    """Return an answer with the state and the error instead of its content."""
    return rtpu_messages.encode(
        rtpu_messages.Done(n=done.n, state=done.state, error=error.to_wire())
    )


def _too_long(data: bytes) -> PbonetError:
    return PbonetError(
        "the task's answer is too long",
        expected=f"at most {rtpu_messages.LARGEST_PACKET} bytes",
        got=f"{len(data)} bytes",
        remedy="shorten its parameters and the texts of its errors",
    )


def _untold(error: BaseException) -> PbonetError:
    return PbonetError(
        "the task's answer cannot be sent",
        expected="numbers, texts, or lists of them",
        got=str(error),
        remedy="let the module's `get` return these",
    )


def _packed(notice: rtpu_messages.Notice) -> bytes:
    """Return a notice in bytes; if that is not possible, a shortened one."""
    with contextlib.suppress(*UNTOLD):
        data = rtpu_messages.encode(notice)
        if len(data) <= rtpu_messages.LARGEST_PACKET:
            return data
    return rtpu_messages.encode(
        rtpu_messages.Notice(
            severity=notice.severity,
            code=notice.code,
            text=_shortened(notice.text),
            cycle=notice.cycle,
            bits=notice.bits,
            errnum=notice.errnum,
            place=_shortened(notice.place),
            lost=notice.lost,
            state=notice.state,
            error=_short_error(notice.error) if notice.error else None,
        )
    )


def _short_error(wired: WireError) -> WireError:
    """Return an error with its texts shortened, and without parts."""
    error = PbonetError.from_wire(wired)
    for key in ("what", "where", "expected", "got", "remedy", "debug"):
        setattr(error, key, _shortened(getattr(error, key)))
    return PbonetError.to_wire(error)


def _shortened(given: object) -> str:
    """Return the beginning and the end of a text that is too long to be sent."""
    text = str(given)
    left_out = len(text) - LONGEST_TEXT
    if left_out <= 0:
        return text
    half = LONGEST_TEXT // 2
    return f"{text[:half]} [{left_out} characters left out] {text[-half:]}"


class SlotTime:
    """Time, cycle count and criticality of a slot; see `pbonet.pbo.Schedule`.

    Args:
        slot: The task's slot.
        told: Records the values that the module gets and that no cycle's record holds.
    """

    def __init__(self, slot: Slot, told: ModuleAnswers) -> None:
        self._slot = slot
        self._told = told
        self._base = slot.cycles
        self._held = 0
        self.cycling = False

    def turned_on(self) -> None:
        """Count cycles from now."""
        self._base = self._slot.cycles

    @property
    def now(self) -> int:
        """The release of the current cycle; between cycles, when the method began."""
        if self.cycling:
            return self._slot.release_ns
        return self._held or self._slot.now_ns

    @contextlib.contextmanager
    def held(self) -> Generator[None]:
        """Freeze time between cycles, so that a log can record it."""
        self.tick()
        try:
            yield
        finally:
            self._held = 0

    def tick(self) -> int:
        """Read the time, freeze it at that value, and return it."""
        self._held = self._slot.now_ns
        return self._held

    @property
    def cycles(self) -> int:
        """Cycles executed since the task was spawned."""
        return self._slot.cycles

    @property
    def cyclecount(self) -> int:
        """Cycles executed since the task was turned on."""
        return self._slot.cycles - self._base

    @property
    def returned(self) -> str:
        """The method in C that has just returned, while its failures are handled."""
        return self._slot.failures.returned

    @property
    def crit(self) -> int:
        """The criticality by which the dispatcher ranks the task."""
        failures = self._slot.failures
        return self._told.now("crit", lambda: failures.own_criticality, 0)


class Context(TaskContext):
    """``self.task`` in a task's process: asking for OFF wakes the runtime.

    Signals are counted in the task's slot, so that none is lost.
    """

    on_off: Callable[[], None] | None = None
    slot: Slot
    told: ModuleAnswers

    @property
    def stamp_ns(self) -> int:
        """Measurement time of the outputs; see `TaskContext.stamp_ns`."""
        return self.slot.stamp_ns

    @stamp_ns.setter
    def stamp_ns(self, value: int) -> None:
        self.slot.stamp_ns = value

    @property
    def sigmask(self) -> int:
        """Signals of this task that the master ignores, as bits."""
        return self.told.now("sigmask", lambda: self.slot.sigmask, 0)

    def signal(self, signal: Signal | int, text: str = "") -> None:
        """Send `signal` to the master; see `TaskContext.signal`."""
        super().signal(signal, text)
        if self.off_requested and self.on_off is not None:
            self.on_off()

    def _wanted(self, bits: int) -> int:
        return self.slot.signal(bits)
