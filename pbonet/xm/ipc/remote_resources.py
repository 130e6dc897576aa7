"""Semaphores and queues of other machines, used like local ones (section 5.4).

Each operation is a request to the agent of the RTPU that has the resource. The client
acknowledges what it took, so that nothing is lost with an answer that does not arrive.
A client that was disconnected attaches again with its next operation.
"""

from __future__ import annotations

import contextlib
import os
import threading
import time
from typing import TYPE_CHECKING, Any, Self, TypeVar

from pbonet.errors import (
    PbonetError,
    XmDestroyedError,
    XmError,
    XmLapsedError,
    XmTooLongError,
)
from pbonet.xm.net import resource_messages as r

from . import names, remote_channel
from ._ipc import Full, Policy, Queue, Semaphore, Taken
from .queue_receive import Receiving

if TYPE_CHECKING:
    from collections.abc import Callable

    from _typeshed import ReadableBuffer

    from pbonet.xm.net import Request

    from .names import Name

T = TypeVar("T")

FOREVER = 1e8
"""Seconds, three years, that stand for a wait without a time-out."""
SPARE = 2.0
"""Seconds in which an agent answers, in addition to its wait."""


class RemoteResource:
    """A resource to which an agent is attached on behalf of this process.

    Args:
        name: The resource.
        kind: ``sem`` or ``queue``.
        create: The settings if it is to be made.
    """

    def __init__(self, name: Name, kind: str, create: dict[str, Any] | None) -> None:
        self.name, self._kind = name, kind
        self._carrier = remote_channel.carrier()
        self._guard = threading.Lock()
        self._handle = 0
        self.settings: dict[str, int] = {}
        self._attach(create)

    def _attach(self, create: dict[str, Any] | None = None) -> None:
        request = r.Attach(name=self.name.resource, kind=self._kind, create=create)
        got = self._call(request, r.Attached, SPARE)
        self._handle, self.settings = got.handle, got.settings

    def ask(
        self,
        make: Callable[[int], Request],
        result: type[T],
        *,
        wait: float = 0.0,
        again: bool = True,
    ) -> T:
        """Return the result of a request made by `make`.

        Args:
            make: Returns the request for a handle.
            result: Type of the result.
            wait: Maximum duration of the operation in seconds.
            again: Whether to attach and ask again if the agent has dropped the handle.

        Raises:
            XmLapsedError: The agent has dropped the handle.
            UnreachableError: The agent cannot be reached.
            XmError: The agent refuses, as the same operation would locally.
        """
        handle = self._open()
        try:
            return self._call(make(handle), result, wait + SPARE)
        except XmLapsedError:
            with self._guard:
                if handle == self._handle:
                    self._attach()
            if not again:
                raise
        return self._call(make(self._open()), result, wait + SPARE)

    def _open(self) -> int:
        if self._handle == 0:
            raise XmError(
                "it is closed", where=str(self.name), remedy="attach to it again"
            )
        return self._handle

    def take(
        self,
        make: Callable[[int, str, float], Request],
        until: int | None,
        result: type[T],
    ) -> T:
        """Wait for something; an interrupted wait takes nothing.

        Args:
            make: Returns the request for a handle, a name of the wait, and seconds.
            until: Time-out, CLOCK_MONOTONIC nanoseconds; None for none.
            result: Type of the result.
        """
        take, wait = os.urandom(8).hex(), _left(until)
        try:
            got = self.ask(lambda handle: make(handle, take, wait), result, wait=wait)
            if isinstance(got, r.Took) and got.code:
                self._settle(take, keep=True)
        except BaseException:
            self._settle(take, keep=False)
            raise
        return got

    def deliver(self, request: Request) -> bool:
        """Send a request without waiting; a failure is reported by who carries it."""
        self._open()
        self._carrier.deliver(self.name.rtpu, request)
        return True

    def _settle(self, take: str, *, keep: bool) -> None:
        with contextlib.suppress(PbonetError):
            self._carrier.post(self.name.rtpu, r.Settle(take=take, keep=keep))

    def state(self) -> r.Seen:
        """Return the state of the resource."""
        return self.ask(lambda handle: r.Look(handle=handle), r.Seen)

    def detach(self, *, destroy: bool) -> None:
        """Detach; the agent frees what it holds for us, now or when we end."""
        if self._handle:
            request = r.Detach(handle=self._handle, destroy=destroy)
            try:
                if destroy:
                    self.ask(
                        lambda handle: r.Detach(handle=handle, destroy=True), type(None)
                    )
                else:
                    self._carrier.post(self.name.rtpu, request)
            except XmDestroyedError:
                pass
            finally:
                self._handle = 0

    def _call(self, request: Request, result: type[T], timeout: float) -> T:
        return self._carrier.call(self.name.rtpu, request, result, timeout=timeout)


def _left(until: int | None) -> float:
    """Return the seconds until a time-out."""
    if until is None:
        return FOREVER
    return min(max(0.0, (until - time.monotonic_ns()) * 1e-9), FOREVER)


def _priority(priority: int | None) -> int:
    return names.home().priority() if priority is None else priority


class _There:
    """Base of all resources of other machines."""

    def __init__(self, far: RemoteResource) -> None:
        self._far = far

    def __repr__(self) -> str:
        return f"<{type(self).__name__.removeprefix('Remote')} {self.name}>"

    @property
    def name(self) -> str:
        return str(self._far.name)

    @property
    def path(self) -> str:
        return ""

    def close(self) -> None:
        self._far.detach(destroy=False)

    def destroy(self) -> None:
        self._far.detach(destroy=True)


class RemoteSemaphore(_There, Semaphore):
    """A semaphore of another machine."""

    @classmethod
    def create_there(cls, name: Name, initial: int, maximum: int, binary: bool) -> Self:  # noqa: FBT001
        """Make one on another machine; the settings have been checked."""
        create = {"initial": initial, "maximum": maximum, "binary": bool(binary)}
        return cls(RemoteResource(name, "sem", create))

    @classmethod
    def attach_there(cls, name: Name) -> Self:
        """Attach to one on another machine."""
        return cls(RemoteResource(name, "sem", None))

    @property
    def maximum(self) -> int:
        return self._far.settings["maximum"]

    @property
    def binary(self) -> bool:
        return bool(self._far.settings["binary"])

    @property
    def value(self) -> int:
        return self._far.state().value

    @property
    def holder(self) -> int | None:
        return self._far.state().holder

    @property
    def waiting(self) -> int:
        return self._far.state().waiting

    def p(
        self,
        until_ns: int | None = None,
        *,
        priority: int | None = None,
        still: Callable[[], bool] | None = None,  # noqa: ARG002 - for local waits
    ) -> Taken:
        rank = _priority(priority)

        def make(handle: int, take: str, wait: float) -> Request:
            return r.Take(handle=handle, take=take, wait=wait, priority=rank)

        return Taken(self._far.take(make, until_ns, r.Took).code)

    def try_p(self) -> Taken:
        return self.p(0)

    def v(self, *, answer: bool = True) -> bool:
        if not answer:
            return self._far.deliver(r.Give(name=self._far.name.resource))
        # After a lost link the critical section is lost, too: report it, do not repeat.
        return self._far.ask(
            lambda handle: r.Give(handle=handle), bool, again=not self.binary
        )


class RemoteQueue(Receiving, _There, Queue):
    """A message queue of another machine."""

    _MOST = r.LONGEST

    def __init__(self, far: RemoteResource) -> None:
        super().__init__(far)
        self._last = 0

    @classmethod
    def create_there(
        cls, name: Name, policy: Policy, messages: int, blocks: int, block: int
    ) -> Self:
        """Make one on another machine; the settings have been checked."""
        create = {
            "policy": int(policy),
            "messages": messages,
            "blocks": blocks,
            "block": block,
        }
        return cls(RemoteResource(name, "queue", create))

    @classmethod
    def attach_there(cls, name: Name) -> Self:
        """Attach to one on another machine."""
        return cls(RemoteResource(name, "queue", None))

    @property
    def policy(self) -> Policy:
        return Policy(self._far.settings["policy"])

    @property
    def messages(self) -> int:
        return self._far.settings["messages"]

    @property
    def blocks(self) -> int:
        return self._far.settings["blocks"]

    @property
    def block(self) -> int:
        return self._far.settings["block"]

    @property
    def waiting(self) -> int:
        return self._far.state().waiting

    @property
    def free(self) -> tuple[int, int]:
        return self._far.state().free

    @property
    def sent(self) -> int:
        return self._far.state().sent

    @property
    def dropped(self) -> int:
        return self._far.state().dropped

    @property
    def last_priority(self) -> int:
        return self._last

    def __len__(self) -> int:
        return self._far.state().value

    def send(
        self,
        data: ReadableBuffer,
        priority: int = 0,
        *,
        full: Full = Full.REFUSE,
        until_ns: int | None = 0,
        wait_priority: int | None = None,
        still: Callable[[], bool] | None = None,  # noqa: ARG002 - for local waits
        answer: bool = True,
    ) -> bool:
        payload = bytes(data)
        if not answer:
            return self._deliver(payload, priority, full, until_ns)
        rank = _priority(wait_priority)
        self._check_length(len(payload), r.LONGEST)

        def make(handle: int, take: str, wait: float) -> Request:
            return r.Put(
                handle=handle,
                take=take,
                data=payload,
                priority=priority,
                full=int(full),
                wait=wait,
                wait_priority=rank,
            )

        return self._far.take(make, until_ns, bool)

    def _deliver(
        self, payload: bytes, priority: int, full: Full, until_ns: int | None
    ) -> bool:
        if until_ns != 0:
            raise ValueError(
                f"{self.name}: a message that is sent without waiting for the answer "
                "cannot wait for room: leave until_ns out"
            )
        self._check_length(len(payload), r.LONGEST_UNANSWERED)
        return self._far.deliver(
            r.Put(
                name=self._far.name.resource,
                data=payload,
                priority=priority,
                full=int(full),
            )
        )

    def _check_length(self, length: int, most: int) -> None:
        if length > most:
            raise XmTooLongError(
                "the message is too long to be sent to another machine",
                where=self.name,
                expected=f"at most {most} bytes",
                got=f"{length} bytes",
                remedy="send it in parts, or write a file there (pbonet://)",
            )

    def letter(
        self,
        until_ns: int | None = None,
        *,
        priority: int | None = None,
        most: int = r.LONGEST,
        still: Callable[[], bool] | None = None,  # noqa: ARG002 - for local waits
    ) -> tuple[bytes, int] | None:
        rank = _priority(priority)

        def make(handle: int, take: str, wait: float) -> Request:
            return r.Take(handle=handle, take=take, wait=wait, priority=rank, most=most)

        got = self._far.take(make, until_ns, r.Took)
        if not got.code:
            return None
        self._last = got.priority
        return got.data, got.priority

    def wait(
        self,
        until_ns: int | None = None,
        *,
        priority: int | None = None,
        still: Callable[[], bool] | None = None,  # noqa: ARG002 - for local waits
    ) -> bool:
        rank = _priority(priority)

        def make(handle: int, take: str, wait: float) -> Request:
            return r.Await(handle=handle, take=take, wait=wait, priority=rank)

        return self._far.take(make, until_ns, bool)
