"""The tasks that are ON on a machine whose agents end for a while, and where they go.

One whose job has a fallback on another machine goes there, and comes back. The others
are turned off, and started again by their job. ``RESTART on`` in the job says that a
task may be interrupted; for others the operator is asked.
"""

from __future__ import annotations

import time
from typing import TYPE_CHECKING, Any, Final

from msgspec import Struct

from pbonet.config import read_job, read_rmod, read_sbs
from pbonet.errors import (
    NoAnswerError,
    NodeError,
    PbonetError,
    SeveralError,
    UnreachableError,
)
from pbonet.xm.net import messages as m, rpc, session

if TYPE_CHECKING:
    from collections.abc import Iterable, Iterator, Mapping, Sequence
    from pathlib import Path

    from pbonet.config import JobTask
    from pbonet.master.configuration import Place

_EVERY: Final = 0.3


class Task(Struct, frozen=True, kw_only=True):
    """A task that is ON."""

    name: str
    subsystem: str
    rtpu: str
    job: Path | None
    """The job that has it; None: none that is named."""
    restart: str
    fallback: str
    """Its fallback on another machine; empty: none."""

    @property
    def declared(self) -> bool:
        """Whether its job says that it may be interrupted, or where it goes."""
        return bool(self.fallback) or (self.job is not None and self.restart == "on")

    def __str__(self) -> str:
        """Return what becomes of it."""
        told = f"{self.name} of {self.subsystem} on {self.rtpu}"
        if self.fallback:
            return f"{told}: {self.fallback} takes its place, and gives it back"
        if self.job is None:
            return f"{told} is turned off; no job that is named starts it again"
        by = f"{self.job.name} starts it again (RESTART {self.restart})"
        return f"{told} is turned off; {by}"


class Moves(Struct, frozen=True, kw_only=True):
    """The tasks of one machine."""

    tasks: list[Task]

    def lines(self) -> list[str]:
        """Return what becomes of each."""
        return [str(task) for task in self.tasks]

    def back(self) -> str:
        """Return which ones are ON again."""
        names = [one.name for one in self.tasks if one.job is not None]
        return f"{', '.join(names)} ON again" if names else "there were none to start"

    def left(self) -> list[str]:
        """Return how places are given back, when a machine's turn was not finished."""
        return [
            f"{one.fallback} may have the place of {one.name}, and keeps it: when "
            f"{one.rtpu} is back, 'pbonet swap {one.job} {one.fallback} {one.name}'"
            for one in self.tasks
            if one.fallback and one.job is not None
        ]

    @property
    def jobs(self) -> list[Path]:
        """The jobs that are started again."""
        return list(dict.fromkeys(one.job for one in self.tasks if one.job is not None))


def agents(place: Place) -> dict[str, m.AgentInfo]:
    """Return the agents that answer; none if no one can be reached."""
    from pbonet.master.subsystem import client_name

    try:
        opened = session.client(place.domain, connect=place.connect)
    except UnreachableError:
        return {}
    client = rpc.Client(opened, place.domain, client_name("upgrade"))
    try:
        found, _ = client.call_all(
            {name: m.Hello() for name in client.rtpus()}, m.AgentInfo
        )
    except PbonetError:
        return {}
    else:
        return found
    finally:
        client.close()


def moves(
    rtpus: Mapping[str, Sequence[str]],
    homes: Mapping[str, str],
    jobs: Iterable[Path],
    place: Place,
) -> dict[str, Moves]:
    """Return what becomes of the tasks that are ON, by machine.

    Args:
        rtpus: By machine, the RTPUs whose agents run.
        homes: The machine of each RTPU.
        jobs: The jobs that are started again.
        place: How agents are reached.

    Raises:
        UnreachableError: An agent that runs does not answer.
        ConfigError: A job is wrong.
    """
    if not any(rtpus.values()):
        return {name: Moves(tasks=[]) for name in rtpus}
    declared = dict(_declared(jobs, homes))
    found = agents(place)
    silent = sorted({r for some in rtpus.values() for r in some} - {*found})
    if silent:
        raise UnreachableError(
            f"{', '.join(silent)}: the agents run, and do not answer here",
            where=f"domain {place.domain}",
            got=f"answers of {', '.join(sorted(found)) or 'none'}",
            remedy="name one of them with --connect, your keys with --keys, and their "
            "domain with --domain; 'pbonet fleet' tries the same",
        )
    return {
        name: Moves(tasks=[*_tasks(found, some, declared)])
        for name, some in rtpus.items()
    }


def _declared(
    jobs: Iterable[Path], homes: Mapping[str, str]
) -> Iterator[tuple[tuple[str, str], tuple[Path, JobTask, str]]]:
    """Yield what jobs say of tasks, with fallbacks that are on another machine."""
    for path in jobs:
        job = read_job(path)
        sbs = read_sbs(path.parent / job.sbs)
        for task in job.tasks:
            own = task.rtpu or _rtpu_of(path, task.rmod)
            other = _rtpu_of(path, task.fallback) if task.fallback else ""
            away = other and homes.get(other) != homes.get(own)
            said = path, task, (task.fallback or "") if away else ""
            yield (sbs.subsystem, task.rmod), said


def _rtpu_of(job: Path, rmod: str) -> str:
    """Return the RTPU that an RMOD beside a job names; empty if it names none."""
    path = job.parent / f"{rmod}.rmod"
    return (read_rmod(path).rtpu or "") if path.exists() else ""


def _tasks(
    found: Mapping[str, m.AgentInfo],
    rtpus: Iterable[str],
    declared: Mapping[tuple[str, str], tuple[Path, JobTask, str]],
) -> Iterator[Task]:
    for rtpu in rtpus:
        for subsystem, names in found[rtpu].on.items():
            for name in names:
                job, said, fallback = declared.get((subsystem, name), (None, None, ""))
                yield Task(
                    name=name,
                    subsystem=subsystem,
                    rtpu=rtpu,
                    job=job,
                    restart=said.restart if said is not None else "off",
                    fallback=fallback,
                )


def must_be_allowed(found: Mapping[str, Moves], *, yes: bool) -> None:
    """Raise if tasks would be turned off without anybody having said that they may."""
    asked = {
        name: tasks
        for name, some in found.items()
        if (tasks := [task for task in some.tasks if not task.declared])
    }
    if asked and not yes:
        raise NodeError(
            "tasks that are ON would be turned off",
            where=", ".join(asked),
            got="; ".join(str(task) for tasks in asked.values() for task in tasks),
            remedy="repeat it with --yes, turn them off or swap them first, or say "
            "RESTART on, or a FALLBACK on another machine, in the job",
        )


def move_away(found: Moves, place: Place) -> None:
    """Have fallbacks on other machines take the place of tasks.

    Raises:
        PbonetError: One cannot; those before it stay where they are now.
    """
    for task in found.tasks:
        if task.fallback and task.job is not None:
            _command(
                task.job, "swap", {"old": [task.name], "new": [task.fallback]}, place
            )


def move_back(found: Moves, place: Place, end: float) -> None:
    """Give tasks their place again, and start jobs; wait until all are ON.

    Args:
        found: The tasks.
        place: How agents are reached.
        end: When they have not come back, of `time.monotonic`.

    Raises:
        PbonetError: A job cannot be started, or a task is not ON in time.
    """
    for task in found.tasks:
        if task.fallback and task.job is not None:
            _command(
                task.job, "swap", {"old": [task.fallback], "new": [task.name]}, place
            )
    for job in found.jobs:
        _start(job, place, end)
    wanted = {(t.rtpu, t.subsystem, t.name) for t in found.tasks if t.job is not None}
    while lacking := wanted - _on(place):
        if time.monotonic() > end:
            names = ", ".join(sorted(name for *_, name in lacking))
            raise NodeError(
                f"{names}: not ON again",
                where=", ".join(str(job) for job in found.jobs),
                remedy="'pbonet explain FILE.sbs TASK' says why",
            )
        time.sleep(_EVERY)


def _start(job: Path, place: Place, end: float) -> None:
    """Start a job; while RTPUs do not answer yet, again.

    Raises:
        PbonetError: It was refused, or they do not answer in time.
    """
    while True:
        try:
            _command(job, "start", {"job": str(job)}, place)
        except PbonetError as error:
            if time.monotonic() > end or not _unanswered(error):
                raise
            time.sleep(_EVERY)
        else:
            return


def _unanswered(error: PbonetError) -> bool:
    if isinstance(error, SeveralError):
        return all(map(_unanswered, error.errors))
    return isinstance(error, (NoAnswerError, UnreachableError))


def _on(place: Place) -> set[tuple[str, str, str]]:
    return {
        (rtpu, subsystem, name)
        for rtpu, info in agents(place).items()
        for subsystem, names in info.on.items()
        for name in names
    }


def _command(job: Path, name: str, args: dict[str, Any], place: Place) -> None:
    from pbonet.master.console import oneshot

    oneshot.run(job, name, args, place)
