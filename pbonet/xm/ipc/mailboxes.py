"""User-defined mailbox interrupts with a value (Stewart 1994, section 5.3.1).

A task or program on an RTPU installs a mailbox and a handler; any process on any
machine can send to it. Interrupts are kept in order until they are handled, even while
there is no receiver; if the mailbox is full the sender gets an error. A cycle is never
interrupted: a task checks the mailbox, or waits in `sync`; a program may use a thread.
"""

from __future__ import annotations

import logging
import struct
import threading
import time
from typing import TYPE_CHECKING

from pbonet import shm
from pbonet.errors import (
    StateError,
    XmDestroyedError,
    XmMissingError,
    XmNameError,
    XmQueueFullError,
    XmTakenError,
    did_you_mean,
)
from pbonet.outside import Outside, active, using
from pbonet.xm.net import Interrupt

from . import names, remote_channel
from ._ipc import Full, Policy, Queue
from .attach_or_create import queue, semaphore

if TYPE_CHECKING:
    from collections.abc import Callable

    from .names import Name

log = logging.getLogger("pbonet.xm")

PREFIX = "mbox."
"""Prefix of the names of a mailbox's queue and semaphore."""
DEPTH = 64
KEPT = 32
"""Number of mailboxes to which a sending process stays attached."""
_VALUE = struct.Struct("<q")
_LOOK_NS = 100_000_000


def _resource(text: str | int) -> Name:
    """Return the name of a mailbox's queue and semaphore."""
    name = names.parse(str(text))
    return name._replace(resource=PREFIX + name.resource)


class Mailbox(shm.Closeable):
    """A mailbox on this process's own RTPU (``xmMboxInstall``).

    Args:
        name: ``NAME``, a number, or ``RTPU:NAME`` of an RTPU on this machine.
        handler: Called with each value, in the thread of `serve` or of `start`.
        depth: Maximum number of waiting interrupts.

    Attributes:
        handled: Number of interrupts handled by this process.
        failed: Number of those whose handler raised in the thread of `start`.

    Raises:
        XmNameError: `name` is malformed, or of another machine.
        XmTakenError: The mailbox already has a handler.
        XmLayoutError: It exists with another depth.
    """

    def __init__(
        self,
        name: str | int,
        handler: Callable[[int], object] | None = None,
        *,
        depth: int = DEPTH,
    ) -> None:
        found = _resource(name)
        self.name = str(names.parse(str(name)))
        if not names.is_here(found):
            raise XmNameError(
                "a mailbox is handled on its own RTPU",
                where=self.name,
                expected="a name of this machine",
                remedy=f"handle it on {found.rtpu}; send to it with xm.interrupt",
            )
        self._handler = handler
        self._queue = queue(str(found), policy=Policy.FIFO, messages=depth, block=8)
        self._place = semaphore(str(found), initial=1, binary=True)
        self.handled = self.failed = 0
        self._thread: threading.Thread | None = None
        self._over = False
        if not self._place.try_p():
            holder = self._place.holder
            self._queue.close()
            self._place.close()
            raise XmTakenError(
                "the mailbox already has a handler",
                where=self.name,
                got=f"process {holder}",
                remedy="end that one first, or choose another name",
            )

    @property
    def pending(self) -> int:
        """Number of interrupts that wait to be handled."""
        return len(self._queue)

    @property
    def sent(self) -> int:
        """Number of interrupts received since the mailbox was first installed."""
        return self._queue.sent

    @property
    def refused(self) -> int:
        """Number of interrupts refused because it was full; senders got an error."""
        return self._queue.dropped

    def wait(self, until_ns: int | None = None) -> bool:
        """Wait for an interrupt and leave it there; for a module's `sync`.

        Args:
            until_ns: Time-out, CLOCK_MONOTONIC nanoseconds; None for none.

        Returns:
            Whether there is one.
        """
        return self._queue.wait(until_ns)

    def take(self, until_ns: int | None = 0) -> int | None:
        """Return the value of the next interrupt, None at the time-out."""
        data = self._queue.receive(until_ns)
        if data is None:
            return None
        self.handled += 1
        return int(_VALUE.unpack(data)[0])

    def serve(self, until_ns: int | None = 0) -> int:
        """Call the handler for the waiting interrupts, not for later ones.

        Args:
            until_ns: Time-out of the wait for the first.

        Returns:
            The number of interrupts.

        Raises:
            StateError: There is no handler.
        """
        handler, count = self._must_handle(), 0
        for _ in range(max(1, self.pending)):
            value = self.take(until_ns if count == 0 else 0)
            if value is None:
                break
            count += 1
            handler(value)
        return count

    def start(self) -> None:
        """Call the handler in a thread until `close`; for programs, not for tasks.

        Raises:
            StateError: There is no handler, or this is a task.
        """
        self._must_handle()
        if names.home().subsystem:
            raise StateError(
                "a task handles interrupts in its own methods",
                where=self.name,
                got="start",
                remedy="wait in sync and call serve in cycle: another thread would "
                "hold up the cycles",
            )
        if self._thread is None:
            self._thread = threading.Thread(
                target=self._work, name=f"pbonet {self.name}", daemon=True
            )
            self._thread.start()

    def _must_handle(self) -> Callable[[int], object]:
        if self._handler is None:
            raise StateError(
                "the mailbox has no handler",
                where=self.name,
                remedy="give one to xm.Mailbox, or use take",
            )
        return self._handler

    def _work(self) -> None:
        while not self._over:
            try:
                self.serve(time.monotonic_ns() + _LOOK_NS)
            except XmDestroyedError:
                return
            except Exception:  # later interrupts are still handled
                self.failed += 1
                log.exception("%s: the handler has failed", self.name)

    def close(self) -> None:
        """Stop handling; further interrupts wait for the next process to install it."""
        self._over = True
        if self._thread is not None and self._thread is not threading.current_thread():
            self._thread.join()
        if self._place.holder is not None:
            self._place.v()
        self._queue.close()
        self._place.close()

    def destroy(self) -> None:
        """Remove it with its waiting interrupts; senders get an error."""
        self._over = True
        self._queue.destroy()
        self._place.destroy()


_guard = threading.Lock()
_boxes: dict[Name, Queue] = {}


def interrupt(name: str | int, value: int = 1, *, answer: bool = True) -> None:
    """Send an interrupt to a mailbox on any machine (``xmMboxSend``).

    Args:
        name: ``RTPU:NAME``, or ``NAME`` on this process's own RTPU; or a number.
        value: Value for the handler, a signed 64-bit integer.
        answer: Whether to wait for the answer of another machine. Without one,
            interrupts arrive in their order, and a failure is an event, NOT_DELIVERED.

    Raises:
        XmMissingError: The mailbox is not installed.
        XmQueueFullError: It is full: earlier interrupts were not handled yet.
        UnreachableError: The RTPU cannot be reached.
        XmFullError: Without an answer: the agent takes no interrupts now.
        ValueError: The value is out of range.
    """
    if not -(1 << 63) <= value < 1 << 63:
        raise ValueError(f"the value {value} has more than 64 bits")
    box = _resource(name)
    if active():
        out = Outside(f"mailbox {_shown(box)}")
        out.ask(_interrupt, box, value, answer, default=None)
    else:
        _interrupt(box, value, answer)


def _interrupt(box: Name, value: int, answer: bool) -> None:  # noqa: FBT001 - recorded
    if names.is_here(box):
        with using(None):
            interrupt_here(box, value)
        return
    request = Interrupt(name=box.resource.removeprefix(PREFIX), value=value)
    if answer:
        remote_channel.carrier().call(box.rtpu, request, type(None), timeout=2.0)
    else:
        remote_channel.carrier().deliver(box.rtpu, request)


def interrupt_here(box: Name, value: int) -> None:
    """Send to a mailbox of this machine; `box` names its queue and semaphore.

    Raises:
        XmMissingError: The mailbox is not installed.
        XmQueueFullError: It is full.
    """
    with _guard:
        try:
            sent = _box(box).send(_VALUE.pack(value), full=Full.DROP)
        except XmDestroyedError:
            _boxes.pop(box).close()
            sent = _box(box).send(_VALUE.pack(value), full=Full.DROP)
        depth = _boxes[box].messages
    if not sent:
        raise XmQueueFullError(
            "the mailbox is full",
            where=_shown(box),
            got=f"{depth} interrupts that were not handled yet",
            remedy="handle them more often, or install it with a larger depth",
        )


def forget() -> None:
    """Detach from all mailboxes that were sent to."""
    with _guard:
        while _boxes:
            _boxes.popitem()[1].close()


def _box(box: Name) -> Queue:
    if box not in _boxes:
        try:
            found = Queue.attach(box)
        except XmMissingError:
            raise _missing(box) from None
        while len(_boxes) >= KEPT:
            _boxes.pop(next(iter(_boxes))).close()
        _boxes[box] = found
    return _boxes[box]


def _shown(box: Name) -> str:
    return f"{box.rtpu}:{box.resource.removeprefix(PREFIX)}"


def _missing(box: Name) -> XmMissingError:
    mark = f":{PREFIX}"
    there = [
        text.replace(mark, ":")
        for text in names.standing("queue", box.domain)
        if mark in text
    ]
    return XmMissingError(
        "no mailbox of this name is installed",
        where=_shown(box),
        got=f"{', '.join(there) or 'none at all'}",
        remedy=did_you_mean(_shown(box), there)
        or "install it there: xm.Mailbox(name, handler)",
    )
