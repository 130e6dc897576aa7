"""Things that a task opens by name, such as devices: only some RTPUs have them.

A parameter says of what kind its name is (``param(..., device=True)``), and each agent
tells the names that it has of each kind. A kind that an agent does not tell is not
judged: the agent is older, or nothing is known of it.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, NamedTuple

from .records import Code, Problem

if TYPE_CHECKING:
    from collections.abc import Iterator, Mapping, Sequence

    from pbonet.config import Place, Rmod
    from pbonet.pbo import ModuleInfo

    from .records import Configuration, Task

    Names = Mapping[str, Mapping[str, Sequence[str]]]
    """By RTPU and kind."""


class Named(NamedTuple):
    """A name in a parameter of a task."""

    kind: str
    """The kind of thing, such as ``device``; also the table of ``agent.toml``."""
    name: str
    param: str
    place: Place | None
    """The line that says it; None: it is the default."""


def named_things(rmod: Rmod, info: ModuleInfo | None) -> list[Named]:
    """Return what a task opens by name."""
    said = {key.lower(): line for key, line in rmod.settings.items()}
    found: list[Named] = []
    for param in info.params if info else ():
        if not param.names:
            continue
        line = said.get(param.name.lower())
        words = param.default.split() if line is None else map(str, line.words)
        place = None if line is None else line.place
        found += [Named(param.names, word, param.name, place) for word in words]
    return found


def only_home(wanted: Sequence[Named], rtpus: Sequence[str], names: Names) -> str:
    """Return the first RTPU that has all these things; empty if none is known to."""
    for rtpu in rtpus:
        have = names.get(rtpu, {})
        if wanted and all(one.name in have.get(one.kind, ()) for one in wanted):
            return rtpu
    return ""


def check_names(now: Configuration, tasks: Sequence[Task]) -> Iterator[Problem]:
    """Yield the things that tasks name and that their RTPUs do not have.

    Args:
        now: The configuration.
        tasks: Those that are to be spawned: the others have opened theirs.
    """
    for task in tasks:
        for one in named_things(task.rmod, task.info):
            have = now.names.get(task.rtpu, {}).get(one.kind)
            if have is not None and one.name not in have:
                yield _not_there(now.names, task, one, have)


def _not_there(names: Names, task: Task, one: Named, have: Sequence[str]) -> Problem:
    at = one.place or f"the default of {one.param}"
    place = task.job_places.get("TASK") or one.place or task.rmod.file
    return Problem(
        code=Code.NOT_ON_RTPU,
        what=f"{task.rtpu} has no {one.kind} {one.name}, which {task.name} opens",
        where=str(place),
        expected=f"a {one.kind} of {task.rtpu}: {' '.join(sorted(have)) or 'none'}",
        got=f"{one.name} ({at})",
        remedy=_remedy(names, task, one),
        tasks=(task.name,),
        ports=(one.param,),
    )


def _remedy(names: Names, task: Task, one: Named) -> str:
    owners: dict[str, list[str]] = {}
    for rtpu, kinds in names.items():
        for name in kinds.get(one.kind, ()):
            owners.setdefault(name, []).append(rtpu)
    if one.name in owners:
        there = owners[one.name]
        return (
            f"{one.name} stands on {' and '.join(there)}; put the task there: "
            f"TASK {task.rmod.name} {there[0]}"
        )
    import difflib  # only where something is wrong

    near = [
        f"{name} (on {' and '.join(owners[name])})"
        for name in difflib.get_close_matches(one.name, owners)
    ]
    return (
        f"no RTPU of the subsystem has it: write [{one.kind}.{one.name}] into the "
        "agent.toml of the machine that does"
        + (f"; did you mean {' or '.join(near)}?" if near else "")
    )
