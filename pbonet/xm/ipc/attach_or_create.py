"""Attach to a resource, or make it: its users may start in any order."""

from __future__ import annotations

from typing import TYPE_CHECKING, TypeVar

from pbonet.errors import XmExistsError, XmLayoutError, XmMissingError

from ._ipc import Policy, Queue, Semaphore
from .segments import Segment

if TYPE_CHECKING:
    from collections.abc import Callable

    from .names import Name


T = TypeVar("T", Semaphore, Queue, Segment)


def semaphore(
    name: str | Name,
    *,
    initial: int | None = None,
    maximum: int | None = None,
    binary: bool | None = None,
) -> Semaphore:
    """Attach to a semaphore; make it if there is none and `initial` is given.

    Args:
        name: ``RTPU:RESOURCE``, or ``RESOURCE`` for the task's own RTPU.
        initial: Its value when it is made; a binary one is free (1) or taken (0).
        maximum: Its highest value, 2**31 - 1 by default.
        binary: Whether it protects a critical section: the holder is known, and if it
            dies the next P returns `Taken.HOLDER_DIED`.

    Raises:
        XmNameError: `name` is malformed.
        UnreachableError: No reachable machine has the RTPU.
        XmMissingError: There is none, and no `initial` was given.
        XmLayoutError: It exists with another maximum, or is not what `binary` says.
        XmError: Its file cannot be used.
    """

    def make() -> Semaphore:
        if initial is None:
            return Semaphore.attach(name)  # which says what is missing
        return Semaphore.create(
            name, initial=initial, maximum=maximum, binary=bool(binary)
        )

    return _open(lambda: Semaphore.attach(name), make, maximum=maximum, binary=binary)


def queue(
    name: str | Name,
    *,
    policy: Policy | None = None,
    messages: int | None = None,
    blocks: int | None = None,
    block: int | None = None,
) -> Queue:
    """Attach to a message queue; make it if there is none.

    Args:
        name: ``RTPU:RESOURCE``, or ``RESOURCE`` for the task's own RTPU.
        policy: Order in which messages are received; FIFO by default.
        messages: Maximum number of messages; 64 by default.
        blocks: Number of blocks that the messages share; `messages` by default.
        block: Bytes of a block; 64. A longer message takes several.

    Raises:
        XmNameError: `name` is malformed.
        UnreachableError: No reachable machine has the RTPU.
        XmLayoutError: It exists with a setting that differs from one given here.
        XmError: Its file cannot be used.
    """

    def make() -> Queue:
        return Queue.create(
            name,
            policy=Policy.FIFO if policy is None else policy,
            messages=64 if messages is None else messages,
            blocks=blocks,
            block=64 if block is None else block,
        )

    return _open(
        lambda: Queue.attach(name),
        make,
        policy=policy,
        messages=messages,
        blocks=blocks,
        block=block,
    )


def segment(name: str | Name, size: int | None = None) -> Segment:
    """Attach to a shared memory segment; make it if there is none and `size` is given.

    Args:
        name: ``RTPU:RESOURCE``, or ``RESOURCE`` for the task's own RTPU.
        size: Size in bytes.

    Raises:
        XmNameError: `name` is malformed.
        UnreachableError: The RTPU is not on this machine.
        XmMissingError: There is none, and no `size` was given.
        XmLayoutError: It exists with another size.
        XmError: Its file cannot be used.
    """

    def make() -> Segment:
        if size is None:
            return Segment.attach(name)  # which says what is missing
        return Segment.create(name, size)

    return _open(lambda: Segment.attach(name), make, size=size)


def _open(attach: Callable[[], T], make: Callable[[], T], **wanted: object) -> T:
    """Attach or make, whatever other processes do meanwhile; refuse other settings."""
    while True:
        try:
            return _checked(attach(), wanted)
        except XmMissingError:
            pass
        try:
            return make()
        except XmExistsError:
            continue


def _checked(found: T, wanted: dict[str, object]) -> T:
    for key, value in wanted.items():
        if value is not None and getattr(found, key) != value:
            got = getattr(found, key)
            found.close()
            raise XmLayoutError(
                "it exists with another setting",
                where=found.name,
                expected=f"{key} {value}",
                got=f"{key} {got}",
                remedy="use the same settings everywhere, or destroy it first",
            )
    return found
