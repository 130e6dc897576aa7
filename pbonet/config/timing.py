"""Timing in an ``.rmod`` file: rates, execution times, criticalities."""

from __future__ import annotations

from typing import TYPE_CHECKING, NamedTuple

from . import words
from .lines import fault
from .model import TaskType

if TYPE_CHECKING:
    from pbonet.errors import ConfigError

    from .blocks import Block
    from .lines import Line, Word
    from .reader import Reader

CRITICALITIES = (1, 62)
"""Lowest and highest CRIT; 0 and 63 are pbonet's own (section 4.5.1)."""

_SERVERS = {TaskType.SPORADIC, TaskType.DEFERRABLE}
_ROUNDING = 1e-9
"""CAPACITY may be above the period by this share: what PERIOD gives is rounded."""


class Timing(NamedTuple):
    """The times of an RMOD, as the fields of `Rmod`."""

    freq: float | None
    capacity: float | None
    minc: float | None
    maxc: float | None
    effc: float | None
    softness: float | None


def read_timing(reader: Reader, block: Block, tasktype: TaskType) -> Timing:
    """Return the times that a file gives, after looking whether they fit together.

    Whether an execution time fits the period is judged when the task's frequency is
    known, which may be the job's (`pbonet.analysis.legality`).

    Raises:
        ConfigError: One is missing, does not apply to the task type, or is too large.
    """
    freq = _freq(reader, block, tasktype)
    found = Timing(
        freq=freq,
        capacity=_capacity(reader, block, tasktype, freq),
        minc=_seconds(reader, block, "MINC"),
        maxc=_seconds(reader, block, "MAXC"),
        effc=_seconds(reader, block, "EFFC"),
        softness=_softness(reader, block, tasktype),
    )
    _check_soft(block, found)
    _check_order(block, found, "MINC", "MAXC")
    _check_order(block, found, "EFFC", "MAXC")
    _check_order(block, found, "MINC", "EFFC")
    return found


def frequency(reader: Reader, word: Word) -> float:
    """Return the word as a task's frequency in Hz."""
    return _within(reader, word, "Hz from 1e-06 to 1e+06")


def criticality(reader: Reader, block: Block, keyword: str) -> int | None:
    """Return the criticality after CRIT or HANDLER, None when it is not given."""
    line = block.get(keyword)
    if line is None:
        return None
    return words.whole(reader, words.single(line, "a criticality"), *CRITICALITIES)


def _within(reader: Reader, word: Word, wanted: str) -> float:
    return words.real(
        reader, word, wanted, low=1e-6, high=1e6, open_low=False, open_high=False
    )


def _freq(reader: Reader, block: Block, tasktype: TaskType) -> float | None:
    """Return the frequency in Hz, from FREQ or PERIOD."""
    freq, period = block.get("FREQ"), block.get("PERIOD")
    if freq and period:
        second = max(freq.place, period.place)
        raise fault(
            "both FREQ and PERIOD are given",
            second,
            expected="one of them",
            got=f"the other in line {min(freq.place, period.place).line}",
            remedy="remove one of them",
        )
    line = freq or period
    if line is None:
        if tasktype is not TaskType.BACKGROUND:
            raise fault(
                f"a {tasktype.value} task without FREQ and PERIOD",
                block["TASKTYPE"].place,
                expected="FREQ in Hz or PERIOD in seconds after TASKTYPE",
                got="neither",
                remedy="add the period after which its capacity is restored"
                if tasktype in _SERVERS
                else "add the task's default frequency",
            )
        return None
    if tasktype is TaskType.BACKGROUND:
        raise fault(
            f"{line.keyword} does not apply to a background task",
            line.place,
            expected=f"no {line.keyword}, because it runs when nothing else does",
            remedy="remove the line, or choose another TASKTYPE",
        )
    if line.keyword == "FREQ":
        return frequency(reader, words.single(line, "a frequency in Hz"))
    word = words.single(line, "a period in seconds")
    return 1.0 / _within(reader, word, "seconds from 1e-06 to 1e+06")


def _capacity(
    reader: Reader, block: Block, tasktype: TaskType, freq: float | None
) -> float | None:
    line = block.get("CAPACITY")
    if tasktype not in _SERVERS or not freq:
        if line is not None:
            raise _meaningless(line, tasktype, "sporadic or deferrable")
        return None
    if line is None:
        raise fault(
            f"a {tasktype.value} task without CAPACITY",
            block["TASKTYPE"].place,
            expected="CAPACITY in seconds of CPU time that it may use in each period",
            got="none",
            remedy=f"add a CAPACITY line of at most {1.0 / freq:g}",
        )
    word = words.single(line, "seconds")
    high = 1.0 / freq
    wanted = f"seconds above 0, at most {high:g}, the period"
    return words.real(
        reader, word, wanted, high=high * (1 + _ROUNDING), open_high=False
    )


def _seconds(reader: Reader, block: Block, keyword: str) -> float | None:
    """Return the execution time after a keyword, None when it is not given."""
    line = block.get(keyword)
    if line is None:
        return None
    return words.real(reader, words.single(line, "seconds"), "seconds above 0")


def _softness(reader: Reader, block: Block, tasktype: TaskType) -> float | None:
    line = block.get("SOFTNESS")
    if line is None:
        return None
    if tasktype is not TaskType.PERIODIC:
        raise _meaningless(line, tasktype, "periodic")
    word = words.single(line, "a fraction of the cycles")
    return words.real(
        reader,
        word,
        "0 (no cycle may miss) up to, not including, 1",
        high=1.0,
        open_low=False,
    )


def _meaningless(line: Line, tasktype: TaskType, wanted: str) -> ConfigError:
    return fault(
        f"{line.keyword} does not apply to a {tasktype.value} task",
        line.place,
        expected=f"{line.keyword} with TASKTYPE {wanted} only",
        remedy="remove the line, or choose another TASKTYPE",
    )


def _check_soft(block: Block, found: Timing) -> None:
    """Refuse EFFC for a task that must not miss a cycle: MAXC is what counts."""
    if found.effc is not None and not found.softness:
        raise fault(
            "EFFC does not apply to a task without SOFTNESS",
            block["EFFC"].place,
            expected="a hard task to have MAXC reserved, a soft one EFFC",
            got="no SOFTNESS above 0",
            remedy="add SOFTNESS, or remove the line",
        )


def _check_order(block: Block, found: Timing, less: str, more: str) -> None:
    low, high = _value(found, less), _value(found, more)
    if low is not None and high is not None and low > high:
        raise fault(
            f"{less} is above {more}",
            block[less].place,
            expected=f"at most {high} s, which is {more}",
            got=f"{low} s",
            remedy="exchange the values or correct one",
        )


def _value(found: Timing, keyword: str) -> float | None:
    value: float | None = getattr(found, keyword.lower())
    return value
