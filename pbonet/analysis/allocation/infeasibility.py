"""The reasons why there is no assignment, and what would help."""

from __future__ import annotations

from typing import TYPE_CHECKING

from msgspec import structs

from pbonet.config import RtpuEntry
from pbonet.errors import VerificationError

from .assignment_costs import Flow
from .assignment_problem import EXACT, FOLLOWS, Item, Problem, keeps_deadlines
from .linear_program import Program
from .rate_choice import rounded_down

if TYPE_CHECKING:
    from collections.abc import Iterator, Sequence

    from .linear_program import Solution

ASK = 5.0
"""Seconds in which it is found out how much is missing."""
TRY = 1.0
"""Seconds in which one way out is tried."""
MOST = 6
"""Tasks, and ways out of one kind, that are named at most."""


def without_room(problem: Problem) -> None:
    """Check that each task alone keeps its deadlines on an RTPU that it may run on.

    Raises:
        VerificationError: One does not.
    """
    for item in problem.items:
        entries = [problem.entry(rtpu) for rtpu in item.tasks]
        if any(
            keeps_deadlines([item.tasks[one.name]], one, problem.core(one.name))
            for one in entries
        ):
            continue
        rtpu = entries[0].name
        share, load = item.share(rtpu), problem.load(item, rtpu)
        most = (item.task.hz or 0.0) * problem.core(rtpu).share / load if load else 0.0
        raise VerificationError(
            f"the task {item.name} alone is too much for {_names(item.tasks)}",
            where=item.task.place("MAXC"),
            expected=problem.limits,
            got=f"{share:.1%}" + (f" ({item.pin})" if item.pin else ""),
            remedy=f"run it at {_digits(most)} Hz or less, or shorten its cycle",
        )


def explained(
    problem: Problem, forbidden: Sequence[tuple[str, Sequence[str]]]
) -> VerificationError:
    """Return the error that there is no assignment, with its reason and ways out.

    Args:
        problem: The problem.
        forbidden: RTPUs, each with tasks that the schedulability test refused there.
    """
    found = _excess(problem, ASK)
    if found.impossible:
        return _no_place_apart(problem)
    if found.places is None:
        return _test_refuses(problem, forbidden)
    over = {rtpu: more for rtpu, more in found.excess.items() if more > EXACT}
    if not over:
        return _test_refuses(problem, forbidden)
    (rtpu, more), *_ = sorted(over.items(), key=lambda pair: (-pair[1], pair[0]))
    here = [i for i in problem.items if found.places[i.name] == rtpu]
    here.sort(key=lambda item: (not item.pin, -item.share(rtpu), item.name))
    shares = sum(i.share(i.present if i.present in i.tasks else rtpu) for i in here)
    dispatch = sum(problem.load(i, rtpu) - i.share(rtpu) for i in here)
    where = f"RTPU {rtpu}" if _is_pinned(here, problem, rtpu) else "all RTPUs together"
    total = sum(over.values())
    return VerificationError(
        "the tasks do not fit on the RTPUs: "
        f"{where} would have {(more if where != _ALL else total):.1%} of a core too "
        "much",
        where=here[0].task.place("TASK") if here else "",
        expected=f"{problem.limits}, with all deadlines kept",
        got=f"{shares + dispatch:.1%} on {rtpu}: "
        + ", ".join(_about(item, rtpu) for item in here[:MOST])
        + (f" and {len(here) - MOST} more" if len(here) > MOST else "")
        + (f", dispatching {dispatch:.1%}" if dispatch else ""),
        remedy=_ways_out(problem, here, rtpu, total),
    )


_ALL = "all RTPUs together"


def _is_pinned(here: Sequence[Item], problem: Problem, rtpu: str) -> bool:
    """Return whether the tasks pinned to an RTPU are too much for it by themselves."""
    held = [item for item in here if item.pin and not item.pin.startswith(FOLLOWS)]
    load = sum(problem.load(item, rtpu) for item in held)
    return load > problem.core(rtpu).share * (1 + EXACT)


def _about(item: Item, rtpu: str) -> str:
    pin = f", {item.pin}" if item.pin else ""
    return f"{item.name} {item.share(rtpu):.1%}{pin}"


def _excess(problem: Problem, seconds: float) -> Solution:
    """Return the assignment with the least load above the limits."""
    return Program(problem, Flow(problem), elastic=True).solve(seconds)


def _fits(problem: Problem) -> bool:
    found = _excess(problem, TRY)
    return found.places is not None and sum(found.excess.values()) <= EXACT


def _ways_out(problem: Problem, here: Sequence[Item], rtpu: str, excess: float) -> str:
    """Return changes of which each one makes room, as was tried."""
    found = [*_unpinned(problem, here), *_slower(problem, here, rtpu, excess)]
    more = structs.replace(
        problem,
        rtpus=(*problem.rtpus, RtpuEntry(name=_NEW)),
        machines={**problem.machines, _NEW: _NEW},
        items=tuple(_anywhere(i) if not i.pin else i for i in problem.items),
    )
    if _fits(more):
        found.append("add an RTPU to the .sbs file")
    if not found:
        return (
            f"no single change is enough: {excess:.1%} of a core is missing; add "
            "RTPUs, lower several frequencies, or shorten cycles"
        )
    return "; or ".join(found)


_NEW = "one-more"


def _anywhere(item: Item) -> Item:
    return structs.replace(item, tasks={**item.tasks, _NEW: item.task})


def _unpinned(problem: Problem, here: Sequence[Item]) -> Iterator[str]:
    names = [entry.name for entry in problem.rtpus]
    for item in [one for one in here if one.pin.startswith(FIXED)][:MOST]:
        free = structs.replace(
            item, pin="", tasks=dict.fromkeys(names, item.task) | dict(item.tasks)
        )
        if _fits(_with(problem, free)):
            yield f"let {item.name} run elsewhere ({item.pin})"


def _slower(
    problem: Problem, here: Sequence[Item], rtpu: str, excess: float
) -> Iterator[str]:
    """Yield tasks of which each, at a lower frequency, makes enough room."""
    for item in sorted(here, key=lambda one: -one.share(rtpu))[:MOST]:
        share, hz = item.share(rtpu), item.task.hz
        if not hz or excess >= share or item.task.rmod.capacity is not None:
            continue
        slow = hz * (1 - excess / share) * (1 - 1e-6)
        tasks = {r: structs.replace(t, freq=slow) for r, t in item.tasks.items()}
        if _fits(_with(problem, structs.replace(item, tasks=tasks))):
            yield f"run {item.name} at {_digits(slow)} Hz or less, now {hz:g}"
            return


def _with(problem: Problem, item: Item) -> Problem:
    items = tuple(item if i.name == item.name else i for i in problem.items)
    return structs.replace(problem, items=items)


def _no_place_apart(problem: Problem) -> VerificationError:
    apart = [one for one in problem.standbys if one.apart]
    names = _names([one.name for one in apart])
    machines = sorted({*problem.machines.values()})
    return VerificationError(
        f"no machine is left for {names}, which must stand by on another machine than "
        "the original",
        where=apart[0].task.place("TASK") if apart else "",
        expected="an original that is not on the keeper's machine "
        f"({problem.machines[problem.keeper]}), and a standby on another machine "
        "(TAKEOVER)",
        got=f"machines: {', '.join(machines)}; "
        + ", ".join(
            f"{i.name} {i.pin}"
            for one in apart
            for i in (problem.by_name[one.fallback_of], one)
            if i.pin
        ),
        remedy="take FIXED away from one of them, name another MASTER in the .sbs "
        "file, add a machine, or remove TAKEOVER",
    )


def _test_refuses(
    problem: Problem, forbidden: Sequence[tuple[str, Sequence[str]]]
) -> VerificationError:
    """Return the error that loads would fit, and deadlines would not be kept."""
    least = sorted(forbidden, key=lambda pair: len(pair[1]))[:3]
    sets = "; ".join(
        f"{' and '.join(names)} on {rtpu} ({problem.entry(rtpu).scheduler.value})"
        for rtpu, names in least
    )
    return VerificationError(
        "no assignment keeps all deadlines, though the cores have time enough",
        where=problem.rtpus[0].name,
        expected="sets of tasks that the schedulability test accepts",
        got=f"refused among others: {sets}",
        remedy="use SCHEDULER MUF, make servers smaller, take CRIT out of RMODs, or "
        "lower a frequency",
    )


FIXED = "FIXED"
"""Begins the reason of a pin that the user can take away."""


def _names(names: object) -> str:
    return " and ".join(map(str, names))  # type: ignore[call-overload]


def _digits(hz: float) -> str:
    """Return a frequency as text, rounded down to three digits."""
    return f"{rounded_down(hz):g}"
