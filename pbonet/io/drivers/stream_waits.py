"""Waiting on a stream device: the same rules for any non-blocking descriptor."""

from __future__ import annotations

import errno
import os
import select
import time
from collections.abc import Sequence
from typing import TYPE_CHECKING, Any, Final, TypeVar, cast

from .modes import Wait

if TYPE_CHECKING:
    from collections.abc import Callable

P = TypeVar("P")
S = TypeVar("S", bound=Sequence[Any])
_AGAIN: Final = 0.001
"""Seconds after which what has no room is tried again."""


def read_all(
    fd: int, take: Callable[[int], bytes], count: int, wait: Wait, held: bytearray
) -> bytes:
    """Return up to `count` bytes by the rules of `wait`.

    Args:
        fd: The descriptor that becomes readable.
        take: Returns up to so many bytes that have arrived; empty if none has.
        count: How many bytes are wanted.
        wait: ALL waits for all of them, ONE for one; NONE returns what is there, and
            NOALL all of them or nothing.
        held: Bytes that arrived and were not returned; kept between calls.

    Raises:
        OSError: The device is gone; bytes that came before stay in `held`.
    """
    ready = _ready(fd, take, count, wait, held)
    data = bytes(held[:ready])
    del held[:ready]
    return data


def read_pieces(
    fd: int, take: Callable[[int], list[P]], count: int, wait: Wait, held: list[P]
) -> list[P]:
    """Return up to `count` pieces by the rules of `wait`; see `read_all`.

    Raises:
        OSError: The device is gone; what came before stays in `held`.
    """
    ready = _ready(fd, take, count, wait, held)
    pieces = held[:ready]
    del held[:ready]
    return pieces


def _ready(
    fd: int,
    take: Callable[[int], Any],
    count: int,
    wait: Wait,
    held: Any,  # noqa: ANN401
) -> int:
    """Return how many of those that are held are returned now."""
    need = {Wait.ALL: count, Wait.ONE: min(count, 1)}.get(wait, 0)
    while True:
        if len(held) < count:
            held += take(count - len(held))
        if len(held) >= need:
            break
        select.select([fd], [], [])
    if wait is Wait.NOALL and len(held) < count:
        return 0
    return min(count, len(held))


def write_all(
    fd: int,
    give: Callable[[S], int],
    data: S,
    wait: Wait,
    patience: float | None = None,
) -> int:
    """Hand bytes or pieces over by the rules of `wait`; return how many were taken.

    NOALL is for datagrams and buffers that take all or nothing: what `give` takes.

    Args:
        fd: The descriptor that becomes writable.
        give: Hands over what there is room for; returns how many bytes.
        data: The bytes.
        wait: How it waits.
        patience: Seconds for which it waits; None: without end.

    Raises:
        OSError: The device is gone, or took nothing for so long.
    """
    done = 0
    need = {Wait.ALL: len(data), Wait.ONE: min(len(data), 1)}.get(wait, 0)
    end = None if patience is None else time.monotonic() + patience
    while True:
        given = give(cast("S", data[done:]))
        done += given
        if done >= need:
            return done
        left = None if end is None else max(0.0, end - time.monotonic())
        select.select([], [fd], [], left)
        if end is not None and time.monotonic() >= end:
            raise no_room()
        if not given:
            time.sleep(_AGAIN)  # a bus may be writable, and yet have no room


def no_room() -> OSError:
    """Return the error of a device that takes no more for too long."""
    return OSError(errno.ETIMEDOUT, os.strerror(errno.ETIMEDOUT))
