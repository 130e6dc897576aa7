"""Calls of successors on other machines: agents make them, with the table's data.

A task that leaves cannot call a successor whose core table is on another machine. Its
last values and the release of its variables arrive there with the table. So the calls
are sent in the same packet, and made after the rest has been processed: the successor
finds the last values, and variables without an owner. A call that is lost or late is
made by the successor's own RTPU when the master sends the ``on``; see `successors`.
"""

from __future__ import annotations

import contextlib
from typing import TYPE_CHECKING

import msgspec

from pbonet.errors import PbonetError
from pbonet.node import rt
from pbonet.xm.net import Call

if TYPE_CHECKING:
    from collections.abc import Sequence

    from pbonet.svar import Table

LATEST_NS = 250_000_000
"""A call with a longer transmission time is not made, because a later decision may be
under way. Nor is a call whose transmission time is unknown."""

_decoder = msgspec.msgpack.Decoder(Call)


def packed(calls: Sequence[Call]) -> list[bytes]:
    """Return calls in the form in which they are sent with the table."""
    return [msgspec.msgpack.encode(call) for call in calls]


def make(table: Table, data: bytes, late_ns: int | None) -> bool:
    """Make a call, unless it is too late or a task writes what was handed over.

    Args:
        table: This machine's table, in which the packet has already been processed.
        data: The packed call; all machines get it, and one has the successor.
        late_ns: Its transmission time; None if the clock of the sending machine is
            not known.

    Returns:
        Whether a successor waited for it.
    """
    with contextlib.suppress(PbonetError, msgspec.MsgspecError, UnicodeDecodeError):
        call = _decoder.decode(data)
        in_time = late_ns is not None and late_ns <= LATEST_NS
        if not (in_time and _free(table, call.outputs)):
            return False
        core = rt.CoreTable(call.core, member=False)
        try:
            return core.call(call.slot, call.life, call.ticket, call.caller)
        finally:
            core.close()
    return False


def _free(table: Table, outputs: list[str]) -> bool:
    """Return whether none of these variables has an owner."""
    return all(table.info(output).owner is None for output in outputs)


__all__ = ["make", "packed"]
