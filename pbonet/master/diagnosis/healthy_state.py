"""The state of something for which no cause was found: since when, and its figures."""

from __future__ import annotations

from typing import TYPE_CHECKING

from pbonet.pbo import State

from .event_causes import clock

if TYPE_CHECKING:
    from collections.abc import Callable

    from pbonet.xm.net import TaskStatus

    from .facts import Facts
    from .question import Question


_PLACES = 10
"""Cycles after missed releases that are named."""


def healthy(facts: Facts, asked: Question) -> tuple[str, ...]:
    """Return that something is well, and its figures; nothing: that is not known.

    Args:
        facts: Those in which no cause was found.
        asked: The question, with its kind.
    """
    parts: dict[str, Callable[[Facts, Question], list[str]]] = {
        "flag": _flag,
        "start": _start,
        "task": _task,
        "miss": _missed,
        "variable": _variable,
        "rtpu": _rtpu,
    }
    figures = parts[asked.kind](facts, asked)
    if not figures:
        return ()
    read = "nothing that was read is wrong" if facts.unknown else "nothing is wrong"
    return (f"{read}: {figures[0]}", *figures[1:])


def _flag(facts: Facts, _: Question) -> list[str]:
    if facts.from_log:
        return ["no task or RTPU raised it"]
    if not facts.rtpus or facts.silent:
        return []
    down = facts.news(("LEGAL",))
    since = f", last withdrawn at {clock(down[0].wall)}" if down else ""
    return [
        f"{' and '.join(facts.rtpus)} answer, and none has raised it{since}",
        "read on: `pbonet status` has the tasks, `pbonet top` all of it live",
    ]


def _start(facts: Facts, asked: Question) -> list[str]:
    if facts.from_log:
        planned = facts.planned.job if facts.planned is not None else ""
        known = asked.name in {"", planned, facts.subsystem}
        return ["no step of it failed"] if known else []
    return [
        "the files are right, the configuration is legal, and the RTPUs are there",
        "read on: `pbonet check` has the schedule of each RTPU",
    ]


def _task(facts: Facts, asked: Question) -> list[str]:
    status = facts.task(asked.name)
    if status is None or status.state != State.ON:
        return []
    on = "was" if facts.from_log else "is"
    read_on = "read on: `pbonet status` has more figures, `pbonet display` the values"
    if facts.from_log:
        read_on = "read on: `pbonet log info` has more figures"
    return [f"it {on} ON{_since(facts, status)}", *_figures(status), read_on]


def _missed(facts: Facts, asked: Question) -> list[str]:
    status = facts.task(asked.name)
    if status is None or (asked.cycle and not facts.has_cycle(asked.name, asked.cycle)):
        return []
    if asked.cycle and (gaps := facts.gaps.get(asked.name)):
        return [_elsewhere({one.cycle for one in gaps}, asked.cycle)]
    if status.miss or any(status.failures.values()):
        return []
    return _figures(status)


def _elsewhere(cycles: set[int], asked: int) -> str:
    """Return before which cycles releases were missed, those nearest to one."""
    nearest = sorted(cycles, key=lambda cycle: (abs(cycle - asked), cycle))[:_PLACES]
    places = ", ".join(map(str, sorted(nearest)))
    rest = len(cycles) - len(nearest)
    more = f", and {rest} more" if rest else ""
    return f"what it has missed was before cycle {places}{more}"


def _since(facts: Facts, status: TaskStatus) -> str:
    """Return for how long a task has been ON, and since when, as far as is known."""
    began = facts.on_since.get(status.task)
    at = f" since {clock(began)}" if began is not None else ""
    if facts.from_log or not (status.on_ns and status.now):
        return at
    return f"{at}, for {(status.now - status.on_ns) * 1e-9:.4g} s"


def _figures(status: TaskStatus) -> list[str]:
    """Return what a task that misses nothing has done."""
    rate = ""
    if status.ref_f:
        rate = f" at {status.ref_f:g} Hz"
        rate += f" (measured: {status.mez_f:.4g} Hz)" if status.mez_f else ""
    done = f"{status.cycle} cycles{rate}, none missed"
    if not (status.cycle and status.max_c):  # virtual time has no CPU times
        return [done]
    mean = status.tot_c / status.cycle
    return [
        done,
        f"a cycle takes {mean * 1e3:.3g} ms of CPU time, at most "
        f"{status.max_c * 1e3:.3g} ms",
    ]


def _variable(facts: Facts, asked: Question) -> list[str]:
    name = asked.name
    value = facts.values.get(name)
    if value is None or value.age is None or facts.is_old(name):
        return []
    writer = (value.writer or "").rpartition("/")[2]
    if any(one.name == name and one.constant for one in facts.graph.variables):
        given = f", which {writer} gave" if writer else ""
        return [f"it is a constant, and has its value{given}"]
    status = facts.task(writer)
    if status is None:
        return ["it has its value" + (f" of {writer}" if writer else "")]
    rate = f" at {status.ref_f:g} Hz" if status.ref_f else ""
    writes = "wrote" if facts.from_log else "writes"
    lines = [f"{writer} on {status.rtpu} {writes} it{rate}"]
    if not facts.from_log:
        lines.append("read on: `pbonet display` has its values")
    return lines


def _rtpu(facts: Facts, asked: Question) -> list[str]:
    name = asked.name
    there = facts.on_rtpu(name)
    if name not in facts.rtpus:
        return []
    on = sum(one.state == State.ON for one in there)
    scheduler = facts.rtpus[name].scheduler
    info = facts.agents.get(name)
    where = f", on core {info.core} of {info.host}" if info is not None else ""
    how = f" under {scheduler}" if scheduler else ""
    was = "were" if facts.from_log else "are"
    lines = [f"{on} of its {len(there)} tasks {was} ON{how}{where}"]
    if not facts.from_log:
        lines.append("read on: `pbonet status` has its load and its tasks")
    return lines
