"""Requests to a resource of another machine (Stewart 1994, section 5.4).

The agent of the RTPU that has the resource stands in for whoever asks: it attaches, and
waits in the line, in the client's place. A client shows a liveliness token
(`keys.customer`); when that goes, so does all that stands for it.
"""

from __future__ import annotations

from typing import Any

from msgspec import Struct

from .messages import Request

LONGEST = (1 << 20) - 4096
"""Bytes of a message that travels."""


class XmRequest(Request):
    """Base of requests about resources."""


class Attach(XmRequest, tag="xm_attach"):
    """Attach to a semaphore or queue, or make it. Result: `Attached`."""

    name: str
    """Without the RTPU."""
    kind: str
    """``sem`` or ``queue``."""
    create: dict[str, Any] | None = None
    """The settings of one that is made; None attaches."""


class Detach(XmRequest, tag="xm_detach"):
    """Let go, and destroy if told so. Result: None."""

    handle: int
    destroy: bool = False


class Take(XmRequest, tag="xm_take"):
    """P, or receive. Result: `Took`; to be settled by the client."""

    handle: int
    take: str
    """A name that the client gives it."""
    wait: float = 0.0
    """Seconds in the line."""
    priority: int = 0
    most: int = LONGEST
    """Bytes of a message at most; a longer one stays."""


class Settle(XmRequest, tag="xm_settle"):
    """Keep what was taken, or give it back; a wait under way ends. Result: None."""

    take: str
    keep: bool


class Await(XmRequest, tag="xm_await"):
    """Wait for a message and leave it there. Result: whether there is one."""

    handle: int
    take: str
    wait: float = 0.0
    priority: int = 0


class Give(XmRequest, tag="xm_give"):
    """V. Result: whether it was below its maximum."""

    handle: int


class Put(XmRequest, tag="xm_put"):
    """Send a message. Result: whether it is in."""

    handle: int
    take: str
    data: bytes
    priority: int = 0
    full: int = 0
    wait: float = 0.0
    wait_priority: int = 0


class Look(XmRequest, tag="xm_look"):
    """Ask how a resource stands. Result: `Seen`."""

    handle: int


class Interrupt(XmRequest, tag="xm_interrupt"):
    """Send a mailbox interrupt. Result: None."""

    name: str
    """Without the RTPU."""
    value: int = 1


class Attached(Struct, kw_only=True):
    """A resource that the agent is attached to in the client's place."""

    handle: int
    settings: dict[str, int]


class Took(Struct, kw_only=True):
    """The result of a `Take`."""

    code: int
    """As `Taken` says; of a queue 1 for a message."""
    data: bytes = b""
    priority: int = 0


class Seen(Struct, kw_only=True):
    """How a resource stands."""

    waiting: int
    value: int = 0
    """Of a semaphore; of a queue its messages."""
    holder: int | None = None
    free: tuple[int, int] = (0, 0)
    dropped: int = 0
    sent: int = 0


AnyXmRequest = Attach | Detach | Take | Settle | Await | Give | Put | Look | Interrupt
