"""Requests to a resource of another machine (Stewart 1994, section 5.4).

The agent of the RTPU that has the resource acts for the client: it attaches, and waits
in line, in the client's place. A client declares a liveliness token
(`key_expressions.customer`); when that disappears, the agent drops all of the client's
handles and waits.
"""

from __future__ import annotations

from typing import Any

from msgspec import Struct

from .messages import Request

LONGEST = (1 << 20) - 4096
"""Maximum size of a message to another machine, in bytes."""
LONGEST_UNANSWERED = 1 << 16
"""The same of one whose sender does not wait; a socket takes it at once."""


class XmRequest(Request):
    """Base of requests about resources."""


class Attach(XmRequest, tag="xm_attach"):
    """Attach to a semaphore or queue, or make it. Result: `Attached`."""

    name: str
    """Name without the RTPU."""
    kind: str
    """``sem`` or ``queue``."""
    create: dict[str, Any] | None = None
    """The settings if it is to be made; None attaches only."""


class Detach(XmRequest, tag="xm_detach"):
    """Detach, and destroy if requested. Result: None."""

    handle: int
    destroy: bool = False


class Take(XmRequest, tag="xm_take"):
    """P, or receive. Result: `Took`, which the client must settle."""

    handle: int
    take: str
    """The client's name for this operation."""
    wait: float = 0.0
    """Time-out in seconds."""
    priority: int = 0
    most: int = LONGEST
    """Maximum size of a message in bytes; a longer one stays."""


class Settle(XmRequest, tag="xm_settle"):
    """Keep what was taken, or return it; a wait under way ends. Result: None."""

    take: str
    keep: bool


class Await(XmRequest, tag="xm_await"):
    """Wait for a message and leave it there. Result: whether there is one."""

    handle: int
    take: str
    wait: float = 0.0
    priority: int = 0


class Give(XmRequest, tag="xm_give"):
    """V. Result: whether the value was below its maximum."""

    handle: int = 0
    name: str = ""
    """Name without the RTPU, instead of a handle; of a sender that does not wait."""


class Put(XmRequest, tag="xm_put"):
    """Send a message. Result: whether it was put in the queue."""

    data: bytes
    handle: int = 0
    take: str = ""
    name: str = ""
    """Name without the RTPU, instead of a handle; of a sender that does not wait."""
    priority: int = 0
    full: int = 0
    wait: float = 0.0
    wait_priority: int = 0


class Look(XmRequest, tag="xm_look"):
    """Ask for a resource's state. Result: `Seen`."""

    handle: int


class Overview(XmRequest, tag="xm_overview"):
    """List the resources of an RTPU. Result: list of `Resource`."""

    kind: str
    """``sem``, ``queue`` or ``mailbox``."""


class Interrupt(XmRequest, tag="xm_interrupt"):
    """Send a mailbox interrupt. Result: None."""

    name: str
    """Name without the RTPU."""
    value: int = 1


class Attached(Struct, kw_only=True):
    """A resource to which the agent is attached for the client."""

    handle: int
    settings: dict[str, int]


class Took(Struct, kw_only=True):
    """The result of a `Take`."""

    code: int
    """A value of `Taken`; for a queue 1 if there is a message."""
    data: bytes = b""
    priority: int = 0


class Seen(Struct, kw_only=True):
    """The state of a resource."""

    waiting: int
    value: int = 0
    """Value of a semaphore; number of messages in a queue."""
    holder: int | None = None
    free: tuple[int, int] = (0, 0)
    dropped: int = 0
    sent: int = 0


class Resource(Struct, kw_only=True):
    """A resource of an RTPU and its state."""

    name: str
    """Name without the RTPU."""
    kind: str
    """``sem``, ``queue`` or ``mailbox``."""
    settings: dict[str, int] = {}
    seen: Seen | None = None
    """None: it cannot be used, and `error` has the reason."""
    error: str = ""


AnyXmRequest = (
    Attach | Detach | Take | Settle | Await | Give | Put | Look | Overview | Interrupt
)
