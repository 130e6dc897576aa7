"""Fields of `status` (Stewart 1994, sections 4.4.1 and 6.7.1).

An agent only ever adds up: its counters run from the moment the task was turned on and
are never reset, because several interfaces read one task. "Since the last status" is
made here, by subtracting what the same interface saw last time.
"""

from __future__ import annotations

import math
from collections import deque
from typing import TYPE_CHECKING, Final, TypeAlias

from msgspec import Struct, structs

from pbonet.errors import StateError, did_you_mean

if TYPE_CHECKING:
    from collections.abc import Iterable

    from pbonet.xm.net import TaskStatus

Value: TypeAlias = str | int | float | bool | None


class Field(Struct, frozen=True):
    """One column of the status table."""

    name: str
    unit: str
    doc: str


FIELDS: Final = (
    Field("rmod", "", "RMOD name of the task"),
    Field("rtpu", "", "RTPU on which the task executes"),
    Field("tid", "", "task id: the number of its process"),
    Field("S", "", "P periodic, Y synchronous, S sporadic, D deferrable server"),
    Field("crit", "", "criticality; ? after it if no MAXC is known"),
    Field("state", "", "OFF, ON or ERROR"),
    Field("cycle", "", "cycles executed since the last status"),
    Field("miss", "", "cycles missed since the last status"),
    Field("refF", "Hz", "reference frequency"),
    Field("refT", "s", "reference period, 1/refF"),
    Field("mezF", "Hz", "cycles executed per second"),
    Field("mezT", "s", "measured period: time per cycle, executed, failed or missed"),
    Field("ptime", "s", "profiling time: since the last status, or since on"),
    Field("totC", "s", "CPU time used within the profiling time"),
    Field("tick", "s", "resolution of the profile"),
    Field("minU", "%", "CPU share of the shortest cycle: minC per period"),
    Field("maxU", "%", "CPU share of the longest cycle: maxC per period"),
    Field("avgU", "%", "CPU share of the mean cycle: avgC per period"),
    Field("minC", "s", "shortest CPU time of a cycle since on or reset; not the first"),
    Field("maxC", "s", "longest CPU time of a cycle since on or reset; not the first"),
    Field("avgC", "s", "mean CPU time of one cycle"),
    Field("warn", "", "warnings since the last status"),
    Field("failed", "", "cycles that ended in an error, since the last status"),
    Field("firstC", "s", "CPU time of the first cycle since on"),
    Field("nowC", "s", "CPU time of the present cycle so far"),
    Field("prio", "", "user priority, from the data flow"),
    Field("jitter", "s", "longest delay from release to cycle, since spawned"),
    Field("faults", "", "minor page faults since on"),
    Field("retries", "", "copy-ins that reached the retry bound, since spawned"),
    Field("xfer", "%", "share of the CPU time spent on transfers of variables"),
    Field("module", "", "module that the RMOD names"),
    Field("version", "", "version of the module's code that was loaded"),
    Field("rank", "", "present criticality; it differs after a failure"),
    Field("reserve", "s", "CPU time reserved for a cycle, or for a server's period"),
    Field("fail", "", "timing failures since the last status"),
    Field(
        "over",
        "",
        "reserves used up, and events much too early, since the last status",
    ),
    Field("abort", "", "cycles that the handler aborted, since the last status"),
    Field("skip", "", "releases left out after a failure, since the last status"),
    Field("handler", "", "calls of the module's handler, since the last status"),
    Field("told", "s", "longest time from a failure to its handler, since spawned"),
    Field(
        "safe",
        "",
        "cycles with safe values in place of late outputs, since the last status",
    ),
    Field("held", "", "critical sections overruled, since the last status"),
    Field("sections", "", "timed sections: calls and mean CPU time, since spawned"),
)
"""The fields of the thesis in its order, then those that pbonet adds."""

NAMES: Final = tuple(field.name for field in FIELDS)
DEFAULT: Final = (
    *("rmod", "rtpu", "S", "crit", "state", "cycle", "miss", "failed", "refF", "mezF"),
    *("avgC", "maxC", "avgU", "maxU", "warn"),
)
"""The fields that are shown by default."""

_WINDOW: Final = 1.0
"""Seconds over which rates and shares are measured."""


class Profile(Struct, frozen=True, kw_only=True):
    """One task's status as an interface shows it."""

    task: str
    fields: dict[str, Value]
    warning: str = ""
    """The newest warning since the last status; shown once."""
    error: str = ""
    """Shown as long as the task is in ERROR."""
    timing: str = ""
    """Timing failures since the last status."""
    waits: str = ""
    """How long its cycles wait for something other than the core."""
    standby: str = ""
    """The task that it is the fallback of, and whether it stands by."""
    restarted: str = ""
    """The agent's treatment of it when it was lost, until it is ON."""

    def only(self, names: Iterable[str]) -> Profile:
        """Return it with these fields alone."""
        return structs.replace(self, fields={n: self.fields[n] for n in names})


class Baselines:
    """Counters as one interface last showed them, to show the change since."""

    def __init__(self) -> None:
        self._seen: dict[str, TaskStatus] = {}

    def since(self, statuses: Iterable[TaskStatus]) -> list[Profile]:
        """Return the profiles since the last call for the same tasks."""
        profiles: list[Profile] = []
        for status in statuses:
            before = self._seen.get(status.task)
            profiles.append(profile(status, before))
            self._seen[status.task] = status
        return profiles

    def forget(self) -> None:
        """Start again: the next profiles are since the tasks were turned on."""
        self._seen.clear()


def profile(now: TaskStatus, before: TaskStatus | None = None) -> Profile:
    """Return what happened to a task between two readings of its status.

    Args:
        now: The later status.
        before: The earlier one; None, or one from before the task was last turned on,
            means since it was turned on.
    """
    since = before if before is not None and _continues(now, before) else None
    cycle = now.cycle - (since.cycle if since else 0)
    miss = now.miss - (since.miss if since else 0)
    failed = now.failed - (since.failed if since else 0)
    released = cycle + miss + failed
    warn = now.warn - (since.warn if since else 0)
    ptime = now.ptime - (since.ptime if since else 0.0)
    tot_c = now.tot_c - (since.tot_c if since else 0.0)
    period = 1.0 / now.ref_f if now.ref_f > 0 else _ratio(ptime, released)
    avg_c = _ratio(tot_c, cycle)
    min_c, max_c = (now.min_c, now.max_c) if now.cycle else (None, None)
    fields: dict[str, Value] = {
        "rmod": now.rmod,
        "rtpu": now.rtpu,
        "tid": now.tid,
        "S": now.S,
        "crit": f"{now.crit}?" if now.crit_assumed else now.crit,
        "state": now.state,
        "cycle": cycle,
        "miss": miss,
        "refF": now.ref_f or None,
        "refT": _ratio(1.0, now.ref_f),
        "mezF": _ratio(cycle, ptime),
        "mezT": _ratio(ptime, released),
        "ptime": ptime,
        "totC": tot_c,
        "tick": now.tick,
        "minU": _percent(min_c, period),
        "maxU": _percent(max_c, period),
        "avgU": _percent(avg_c, period),
        "minC": min_c,
        "maxC": max_c,
        "avgC": avg_c,
        "warn": warn,
        "failed": failed,
        "firstC": now.first_c or None,
        "nowC": now.now_c,
        "prio": now.priority,
        "jitter": now.jitter_max,
        "faults": now.faults,
        "retries": now.retries,
        "xfer": _percent(
            now.transfer_in + now.transfer_out, _ratio(now.tot_c, now.cycle)
        ),
        "module": now.module,
        "version": now.version,
        **_timing_fields(now, before),
    }
    return Profile(
        task=now.task,
        fields=fields,
        warning=now.warning if warn > 0 else "",
        error=now.error if now.state == "ERROR" else "",
        timing=_timing_text(now, before),
        waits=now.waits,
        standby=_standby_text(now),
        restarted=now.restarted,
    )


def _spawned_before(now: TaskStatus, before: TaskStatus | None) -> TaskStatus | None:
    """Return the earlier status if it is of the same process.

    What is counted since the task was spawned continues when it is turned on again.
    """
    return before if before is not None and before.tid == now.tid else None


def _timing_fields(now: TaskStatus, before: TaskStatus | None) -> dict[str, Value]:
    since = _spawned_before(now, before)

    def news(name: str) -> int:
        count: int = getattr(now, name)
        return count - (getattr(since, name) if since else 0)

    return {
        "rank": now.rank,
        "reserve": now.reserve or None,
        "fail": sum(_failures(now, since).values()),
        "over": news("overruns"),
        "abort": news("aborted"),
        "skip": news("skipped"),
        "handler": news("handlers"),
        "told": now.delivery_max or None,
        "safe": news("made_safe"),
        "held": news("held_off"),
        "sections": "; ".join(
            f"{name} {one.count} x {one.total / one.count * 1e3:.3g} ms"
            for name, one in now.sections.items()
            if one.count
        ),
    }


def _failures(now: TaskStatus, since: TaskStatus | None) -> dict[str, int]:
    """Return the timing failures by kind since the earlier status."""
    then = since.failures if since else {}
    return {kind: n - then.get(kind, 0) for kind, n in now.failures.items()}


def _standby_text(now: TaskStatus) -> str:
    """Return the original if the task is a fallback; else empty."""
    if not now.fallback_of:
        return ""
    what = "stands by for" if now.stands_by else "the fallback of"
    text = f"{what} {now.fallback_of}"
    if now.original_rtpu:
        text += f" on {now.original_rtpu}"
    if now.takeover:
        text += f", takes over after {now.takeover:g} s without it"
    return text


def _timing_text(now: TaskStatus, before: TaskStatus | None) -> str:
    """Return the failures since an earlier status in words; empty without any."""
    since = _spawned_before(now, before)
    fields = _timing_fields(now, before)
    failures = _failures(now, since)
    parts = [f"{n} {kind}" for kind, n in failures.items() if n]
    overruns = now.overruns - (since.overruns if since else 0)
    untold = max(0, overruns - failures.get("maxexec", 0))
    words = {
        "events far too early" if now.S == "Y" else "capacity used up": untold,
        "aborted": fields["abort"],
        "skipped": fields["skip"],
        "overlong critical sections": fields["held"],
    }
    parts += [f"{count} {text}" for text, count in words.items() if count]
    if parts and now.rank != now.crit and now.state == "ON":
        parts.append(f"criticality {now.rank} now")
    return ", ".join(parts)


def _continues(now: TaskStatus, before: TaskStatus) -> bool:
    """Return whether the counters of `now` continue from those of `before`."""
    return (
        now.tid == before.tid
        and now.on_ns == before.on_ns
        and now.cycle >= before.cycle
        and now.miss >= before.miss
        and now.failed >= before.failed
        and now.warn >= before.warn
        and now.ptime >= before.ptime
        and now.tot_c >= before.tot_c
    )


def _ratio(part: float, whole: float | None) -> float | None:
    """Return part/whole; None when there is nothing to divide by."""
    return part / whole if whole else None


def _percent(part: float | None, whole: float | None) -> float | None:
    return 100.0 * part / whole if part is not None and whole else None


def columns(words: list[str]) -> tuple[str, ...]:
    """Return the columns that words name; they may hold several with commas or spaces.

    Raises:
        StateError: One of them is no field.
    """
    names = " ".join(words).replace(",", " ").split()
    if names == ["all"]:
        return NAMES
    if names == ["default"]:
        return DEFAULT
    for name in names:
        if name not in NAMES:
            raise StateError(
                f"status has no field {name}",
                expected="names out of " + " ".join(NAMES),
                remedy=did_you_mean(name, NAMES),
            )
    return tuple(dict.fromkeys(names))


class Window:
    """Keep statuses, to compute rates over the last second."""

    def __init__(self) -> None:
        self._seen: dict[str, deque[TaskStatus]] = {}

    def rates(self, status: TaskStatus) -> dict[str, Value]:
        """Return the status fields over the last second; call it once per status."""
        seen = self._seen.setdefault(status.task, deque())
        seen.append(status)
        while len(seen) > 1 and status.now - seen[1].now > _WINDOW * 1e9:
            seen.popleft()
        return profile(status, seen[0] if len(seen) > 1 else None).fields

    def load(self, tasks: Iterable[TaskStatus]) -> float:
        """Return the share of a core that tasks took over the last second.

        Args:
            tasks: Those of one core, as the last `rates` saw them.
        """
        share = 0.0
        for task in tasks:
            seen = self._seen.get(task.task, ())
            if task.state == "ON" and seen:
                fields = profile(task, seen[0] if len(seen) > 1 else None).fields
                spent, passed = fields["totC"], fields["ptime"]
                if isinstance(spent, float) and isinstance(passed, float) and passed:
                    share += spent / passed
        return share


def delay_quantile(histogram: list[int], share: float) -> float | None:
    """Return the delay that `share` of the releases stayed below, in seconds.

    Args:
        histogram: Bin k counts delays below 2**k microseconds, as `TaskStatus.jitter`.
        share: Between 0 and 1.

    Returns:
        The upper edge of the bin in which the quantile lies; None without releases.
    """
    total = sum(histogram)
    if not total:
        return None
    wanted = math.ceil(share * total)
    seen = 0
    for exponent, count in enumerate(histogram):
        seen += count
        if seen >= wanted:
            return float(2**exponent) * 1e-6
    return None
