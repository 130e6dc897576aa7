"""The answer to a question about a subsystem or a recorded run."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

from msgspec import structs

from pbonet.errors import (
    NoAnswerError,
    SeveralError,
    StateError,
    UnreachableError,
)

from .explanations import explain
from .question import asked_by

if TYPE_CHECKING:
    from collections.abc import Sequence

    from pbonet.master.configuration import Place
    from pbonet.master.subsystem import Subsystem

    from .cause_chain import Explanation
    from .facts import Facts
    from .question import Question


def answer(
    path: str | Path, words: Sequence[str], place: Place, *, trace: float = 0.0
) -> Explanation:
    """Return what explains something.

    Args:
        path: The subsystem's ``.sbs`` file, a ``.job`` file that names it, or a log or
            the folder of a run.
        words: What is asked; none: about the flag.
        place: Where the subsystem is.
        trace: Seconds for which the next miss of a task is waited for, while the kernel
            says who has the core; 0: it is not asked.

    Raises:
        StateError: The words ask nothing that can be explained.
        PbonetError: A file is wrong, or no agent can be reached.
    """
    asked = asked_by(words, trace)
    path = Path(path)
    if path.suffix == ".mcap" or path.is_dir():
        if trace:
            raise StateError(
                "a recorded run has no core that could be followed",
                where=str(path),
                remedy="leave the trace out, or ask about the running subsystem",
            )
        from .log_facts import read_log

        return explain(read_log(path), asked)
    return explain(_read_running(path, asked, place), asked)


def answer_of(
    subsystem: Subsystem, words: Sequence[str], *, trace: float = 0.0
) -> Explanation:
    """Return what explains something of an open subsystem.

    Args:
        subsystem: It may lack RTPUs.
        words: What is asked; none: about the flag.
        trace: As for `answer`.

    Raises:
        StateError: The words ask nothing that can be explained.
    """
    asked = asked_by(words, trace)
    return explain(_read(subsystem, asked), asked)


def _read(subsystem: Subsystem, asked: Question) -> Facts:
    from .ask_facts import Extent, ask  # a log needs no subsystem

    job = asked.name if asked.kind == "start" else ""
    traced = (asked.name, asked.trace) if asked.trace else None
    return ask(subsystem, Extent.of(asked), job, traced=traced)


def _read_running(path: Path, asked: Question, place: Place) -> Facts:
    """Return the facts of a subsystem, also if none of its RTPUs answers."""
    from pbonet.master.subsystem import Subsystem

    from .ask_facts import unreached

    place = structs.replace(place, take_over=False, confirm=None)
    subsystem = Subsystem(
        path,
        **place.arguments,
        kind="explain",
        watch=True,
        partly=True,
        warned=lambda _: None,  # what does not answer is a fact
    )
    try:
        subsystem.open(once=True)
    except (UnreachableError, NoAnswerError, SeveralError) as error:
        return unreached(subsystem, error)
    try:
        return _read(subsystem, asked)
    finally:
        subsystem.detach()
