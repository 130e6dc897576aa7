"""The causes that the program knows, with what to do about them.

Errors and faults of a configuration carry their own remedies. What stands here is for
causes that are sentences only: those of the illegal-configuration flag, and what is
read from counters. ``docs/symptoms.md`` has the same texts; a test compares them.
"""

from __future__ import annotations

import re
from typing import TYPE_CHECKING, Final, NamedTuple

from pbonet.versions import REMEDY

if TYPE_CHECKING:
    from collections.abc import Mapping


class FlagCause(NamedTuple):
    """A kind of cause for which the illegal-configuration flag is up."""

    subject: str
    """The kind of its subject: ``task``, ``variable``, ``rtpu``, ``host``, or empty."""
    sentence: str
    """With ``…`` for names and numbers, as the documentation quotes it."""
    pattern: re.Pattern[str]
    """The group ``name`` is the subject."""
    remedy: str


def _cause(subject: str, sentence: str, remedy: str) -> FlagCause:
    """Return a cause whose pattern is its sentence; ``<name>`` is the subject."""
    parts = re.split(r"(<name>|…)", sentence)
    groups = {"<name>": r"(?P<name>[^\s,;]+)", "…": ".*"}
    text = "".join(groups.get(part, re.escape(part)) for part in parts)
    shown = re.sub(r"…( ?…)+", "…", sentence.replace("<name>", "…"))
    return FlagCause(subject, shown, re.compile(text), remedy)


_REPAIR: Final = "repair its cause, then `clear`, or `kill` and `spawn`"
_SPAWN: Final = "repair its cause, then `start` the job, or `spawn` it again"
_AGENT: Final = (
    "check the network and that agent; the flag goes down when it answers again"
)
FLAG_CAUSES: Final = (
    _cause(
        "variable",
        "equation 2: no task writes <name>…",
        "turn a writer on, or turn the reader off",
    ),
    _cause("variable", "the input <name> of … is stale", "find why it is too old"),
    _cause("task", "<name> is in ERROR", _REPAIR),
    _cause("task", "<name> has died", _SPAWN),
    _cause("task", "<name> has ended by itself", _SPAWN),
    _cause(
        "task",
        "<name> was lost with its RTPU process",
        "turn it on, or let another task write its variables",
    ),
    _cause("task", "<name> hangs in off", "`kill` ends it by force"),
    _cause(
        "",
        "a reconfiguration takes longer than a cycle",
        "nothing: it ends with the reconfiguration",
    ),
    _cause(
        "variable",
        "off … is done, and no task took over <name>",
        "turn on a task that writes it",
    ),
    _cause(
        "task",
        "<name> gives the constants of …: no master continues the exchange",
        "repeat the `swap` or `switch` that was broken off",
    ),
    _cause("variable", "no agent transfers <name> …", _AGENT),
    _cause("", "the agent gives no sign of life for … (ALONE)", _AGENT),
    _cause("rtpu", "no sign of life from RTPU <name> for … (ALONE)", _AGENT),
    _cause("host", "host <name> is unreachable; no task writes …", _AGENT),
    _cause("host", "the table of host <name> is of version …", REMEDY),
)
"""In the order in which they are tried; a text that fits none is a module's own."""
OWN_TEXT: Final = "read that module's events"
"""The remedy for a cause that a module has raised by ``self.task.illegal``."""

REMEDIES: Final[Mapping[str, str]] = {
    "never on": "turn it on",
    "turned off": "turn it on again, by `swap` if another task writes its variables",
    "off by itself": "read that module's events; turn it on again",
    "stands by": "nothing: it is released when its original fails",
    "died": "see in its event, and in what it printed, why it ended; then `start` the "
    "job, or `spawn` it again",
    "not spawned": "start the job, or spawn the task",
    "no cycle": "`kill` ends a cycle that hangs; a task that waits in `sync` needs its "
    "event",
    "cycles fail": "mend the module where its events say, or its inputs",
    "short maxage": "correct MAXAGE in the .svar file, or the writer's rate",
    "passed on": "find why the first of these variables is too old",
    "unwritten": "turn on a task that writes it, or set it with `write`",
    "waits": "do what waits outside `cycle`, in `sync` or in another thread",
    "too long": "lower the rate, use a faster core, or shorten `cycle`",
    "overloaded": "lower rates, or move tasks to other RTPUs; `pbonet check` shows it",
    "preempted": "raise its criticality, or move one of them to another RTPU",
    "stalled": "leave the rest of the machine a core of its own",
    "unbounded": "`pbonet adopt` writes the measured time as MAXC",
    "soft timing": "`pbonet doctor` says which rights are missing",
    "faults": "allocate and load in `init`, not in `cycle`",
    "first cycle": "load and compute once in `init`",
    "late start": "look for what else runs on that core, and for power saving",
    "another master": "end that master, or use `--take-over`",
    "restarted": "see its events: why the process ended; turn the tasks on",
    "unclaimed": "start the job",
    "no table": "start the job: `pbonet start`",
    "table lost": "`pbonet stop`, then start the job again",
    "not recorded": "name its writer in a RECORD line of the job",
    "withdrawn": "read what happened then: `pbonet log events`",
}
"""Remedies for what is read from counters, states and events."""


def flag_cause(sentence: str) -> tuple[FlagCause | None, str]:
    """Return the kind of a cause, and the name of its subject.

    Args:
        sentence: The cause, without its raiser.
    """
    for one in FLAG_CAUSES:
        if found := one.pattern.fullmatch(sentence):
            return one, found.groupdict().get("name") or ""
    return None, ""
