"""Records of a task one by one, and the comparison of values."""

from __future__ import annotations

import struct
from typing import TYPE_CHECKING, Any, Final

import msgspec
import numpy as np

from pbonet.errors import LogError
from pbonet.log import CDR, Did, Step, StepSchema
from pbonet.outside import Player, files_read

if TYPE_CHECKING:
    from collections.abc import Sequence

    from numpy.typing import NDArray

    from pbonet.log import Log, TaskLife
    from pbonet.outside import ReadFile

    from ._verdict import Verdict

HEAD: Final = struct.Struct("<QqqqqQQQQII")
DID: Final = msgspec.json.Decoder(Did)
_KIND_AT: Final = len(CDR) + HEAD.size - 4


def kind_of(message: bytes) -> int:
    """Return the kind of a record."""
    return message[_KIND_AT]  # little endian, and there are few


def did(message: bytes) -> Did | None:
    """Return the `Did` of a record; None if it is of another kind."""
    if kind_of(message) != Step.DID:
        return None
    return DID.decode(StepSchema.data(message))


def not_again(life: TaskLife) -> str:
    """Return why a task cannot be run again; empty: it can."""
    if not life.about.rmod:
        return "its RMOD is not recorded"
    if not _from_birth(life):
        return (
            f"{life.part.path.name} begins amid the task's life: what its module held "
            "then is not recorded"
        )
    return ""


def _from_birth(life: TaskLife) -> bool:
    first = next((one for one in life.records if kind_of(one) != Step.HEARD), None)
    done = None if first is None else did(first)
    return done is not None and done.what == "spawn"


def files_of_life(life: TaskLife) -> list[ReadFile]:
    """Return the files that a task's module read before its first cycle."""
    player = Player()
    for one in life.records:
        if kind_of(one) == Step.CYCLE:
            break
        if kind_of(one) == Step.HEARD:
            player.feed(StepSchema.data(one))
    return files_read(player)


def cycles_of(life: TaskLife) -> int:
    """Return how many cycles of a task are on record."""
    return int((life.schema.heads(life.commits)["kind"] == Step.CYCLE).sum())


def must_have_cycles(
    log: Log, verdicts: Sequence[Verdict], named: Sequence[str]
) -> None:
    """See to it that something was there to be run again: of each task that is named.

    Raises:
        LogError: There is no cycle.
    """
    without = [one.task for one in verdicts if not one.recorded]
    if not without or (not named and len(without) < len(verdicts)):
        return
    raise LogError(
        f"the log has no cycle of {', '.join(without)}",
        where=str(log.path),
        expected="cycles that can be run again",
        remedy="record the run while the task is ON",
    )


def alike(then: NDArray[Any], now: NDArray[Any], rtol: float) -> NDArray[np.bool_]:
    """Return for each element whether it is the same, including NaN and signs of 0."""
    bits = np.dtype(f"V{then.dtype.itemsize}")
    same = np.array(
        [a == b for a, b in zip(then.view(bits), now.view(bits), strict=True)], bool
    )
    if rtol and then.dtype.kind == "f":
        same |= np.isclose(then, now, rtol=rtol, atol=0.0, equal_nan=True)
    return same
