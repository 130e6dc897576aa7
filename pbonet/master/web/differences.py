"""Changes since the last message: of values, and of states of tasks and RTPUs."""

from __future__ import annotations

from array import array
from typing import TYPE_CHECKING, Any, Final, NamedTuple

from pbonet.master.subsystem import Window
from pbonet.node.wire import lifecycle
from pbonet.pbo import State
from pbonet.xm.net import messages as m

if TYPE_CHECKING:
    from collections.abc import Iterable, Mapping, Sequence

Data = dict[str, Any]
_TOTALS = ("cycle", "miss", "failed", "warn")
"""Fields that are totals since the task was turned on, not of the last second."""
_UNSEEN = ("nowC", "ptime", "totC")
"""Fields that change in each status and say nothing that the others do not."""
_SAME_TIME: Final = 1.0
"""Seconds by which the time of one sample may differ when it is asked for again."""


class _Sent(NamedTuple):
    """The value of a variable as it was sent."""

    mark: tuple[str | None, int, bool]
    numbers: Sequence[float]
    time: float | None

    def is_like(self, other: _Sent) -> bool:
        """Return whether another one is the same sample.

        A table that was made again counts from the beginning again, so that the count
        alone may be that of an older value.
        """
        if self.mark != other.mark or (self.time is None) is not (other.time is None):
            return False
        apart = abs((self.time or 0.0) - (other.time or 0.0))
        mine, theirs = (
            array("d", one).tobytes() for one in (self.numbers, other.numbers)
        )
        return apart < _SAME_TIME and mine == theirs  # NaN is like NaN


class Values:
    """The values that were sent, to send only what is new.

    One is new when another task wrote it, or it was written again, or its staleness
    has changed; also when the clock was set. Its age is not sent again: who has its
    time knows it.
    """

    def __init__(self) -> None:
        self._sent: dict[str, _Sent] = {}

    def new(self, values: Iterable[m.VarValue], now: float) -> dict[str, Data]:
        """Return the values that are new, by variable, each with its sample time.

        Args:
            values: As an RTPU has answered.
            now: The time at which it answered, seconds since 1970.
        """
        found: dict[str, Data] = {}
        for value in values:
            mark = (value.writer, value.seq, value.stale)
            at = None if value.age is None else now - value.age
            sample = _Sent(mark, value.values, at)
            before = self._sent.get(value.name)
            if before is not None and sample.is_like(before):
                continue
            self._sent[value.name] = sample
            found[value.name] = {
                "t": at,
                "v": list(value.values),
                "writer": value.writer or "",
                "age": value.age,
                "stale": value.stale,
            }
        return found


class States:
    """The status of tasks and RTPUs that was sent, to send only what has changed."""

    def __init__(self) -> None:
        self._window = Window()
        self._tasks: dict[str, Data] = {}
        self._rtpus: dict[str, Data] = {}

    def __contains__(self, task: str) -> bool:
        """Return whether a task was in the last status."""
        return task in self._tasks

    def new(
        self, statuses: Mapping[str, m.RtpuStatus], silent: Iterable[str], now: float
    ) -> Data:
        """Return the message with what has changed since the last call.

        Args:
            statuses: By RTPU, of those that answered.
            silent: RTPUs that did not.
            now: Seconds since 1970.
        """
        tasks = {
            one.task: self._task(one)
            for rtpu in statuses.values()
            for one in rtpu.tasks
        }
        unheard = set(silent)
        for name, task in self._tasks.items():
            if task["rtpu"] in unheard and name not in tasks:
                tasks[name] = task  # nothing new is known of it
        rtpus = {name: self._rtpu(one) for name, one in statuses.items()}
        for name in unheard:
            rtpus[name] = {**self._rtpus.get(name, {"rtpu": name}), "silent": True}
        message = {
            "kind": "status",
            "t": now,
            "whole": False,
            "rtpus": [r for n, r in rtpus.items() if self._rtpus.get(n) != r],
            "tasks": [t for n, t in tasks.items() if self._tasks.get(n) != t],
            "gone": sorted(self._tasks.keys() - tasks.keys()),
        }
        self._tasks, self._rtpus = tasks, rtpus
        return message

    def whole(self, now: float) -> Data:
        """Return the message with all that is known."""
        return {
            "kind": "status",
            "t": now,
            "whole": True,
            "rtpus": list(self._rtpus.values()),
            "tasks": list(self._tasks.values()),
            "gone": [],
        }

    def _task(self, status: m.TaskStatus) -> Data:
        rates = self._window.rates(status)
        fields: Data = {name: _short(value) for name, value in rates.items()}
        fields |= {name: getattr(status, name) for name in _TOTALS}
        for name in _UNSEEN:
            fields.pop(name, None)
        return {
            "task": status.task,
            "rtpu": status.rtpu,
            "state": str(status.state),
            "signals": signals(status.state),
            "fields": fields,
            "error": status.error if status.state == State.ERROR else "",
            "warning": status.warning,
            "waits": status.waits,
            "standby": status.stands_by,
            "fallback_of": status.fallback_of,
            "restarted": status.restarted,
        }

    def _rtpu(self, status: m.RtpuStatus) -> Data:
        return {
            "rtpu": status.rtpu,
            "backend": status.backend,
            "scheduler": status.scheduler,
            "util": _short(status.util),
            "dispatcher": _short(status.dispatcher),
            "illegal": status.illegal,
            "stalls": status.stalls,
            "stall_age": _short(status.stall_age),
            "load": _short(self._window.load(status.tasks)),
            "log": status.log,
            "silent": False,
        }


def _short(value: object) -> object:
    """Return a number with the digits that are shown, so that it seldom changes."""
    return float(f"{value:.3g}") if isinstance(value, float) else value


def signals(state: str) -> list[str]:
    """Return the signals that a master can send to a task in a state."""
    events = lifecycle.valid(State(state))
    return [str(event) for event in events if event in lifecycle.FROM_OUTSIDE]
