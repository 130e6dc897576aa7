"""Calls of successors on other machines: the agent makes them, with the table's news.

A task that leaves cannot call a successor whose core table is on another machine. Its
last values, and the news of its end, arrive there with the table. So the calls travel
in the same packet, and are made when that has been taken in: the successor finds the
last values, and variables without an owner. A call that is lost or late is made by the
successor's own RTPU when the master sends the ``on``; see `successors`.
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
"""A call that was longer on its way is not made: a later decision may not have arrived
yet. Nor is a call whose delay is unknown."""

_decoder = msgspec.msgpack.Decoder(Call)


def packed(calls: Sequence[Call]) -> list[bytes]:
    """Return calls in the form in which they travel with the table."""
    return [msgspec.msgpack.encode(call) for call in calls]


def make(table: Table, data: bytes, late_ns: int | None) -> bool:
    """Make a call, unless it is too late or a task writes what was handed over.

    Args:
        table: This machine's, which knows already what went with the call.
        data: The packed call; all machines get it, and one has the successor.
        late_ns: How long it was on its way; None while the clock of the machine that
            it comes from is not known.

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
    """Return whether all of these variables are without an owner."""
    return all(table.info(output).owner is None for output in outputs)


__all__ = ["make", "packed"]
