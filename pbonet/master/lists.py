"""Ordered lists of signals, cut into what one RTPU is sent at once."""

from __future__ import annotations

from typing import TYPE_CHECKING

from pbonet.pbo import State
from pbonet.xm.messages import MOST_CALLERS

if TYPE_CHECKING:
    from collections.abc import Iterator, Sequence

    from pbonet.master.picture import Picture


def handed_over(picture: Picture, items: Sequence[tuple[str, str]]) -> list[str]:
    """Return the tasks that go off and whose outputs a later item takes over."""
    found: list[str] = []
    taken: set[str] = set()
    for task, signal in reversed(items):
        outputs = picture.find(task).task.outputs
        if signal == "on":
            taken.update(outputs)
        elif signal == "off" and taken.intersection(outputs):
            found.append(task)
    return found


def across(picture: Picture, items: Sequence[tuple[str, str]]) -> dict[str, list[str]]:
    """Return tasks that take over from tasks on one other RTPU, and from which.

    They can be called by these as soon as they have ended. Left out are those that take
    over from several RTPUs or from their own, that share a predecessor with one of
    these, and whose predecessors do not stand side by side in the list.
    """
    olds = _predecessors(picture, items)
    left_out = {heir for heir in olds if not _direct(picture, items, heir, olds[heir])}
    while more := {
        heir
        for heir in olds.keys() - left_out
        if any(set(olds[heir]) & set(olds[other]) for other in left_out)
    }:
        left_out |= more
    return {heir: olds[heir] for heir in olds if heir not in left_out}


def _predecessors(
    picture: Picture, items: Sequence[tuple[str, str]]
) -> dict[str, list[str]]:
    """Return from which of those before it each task that comes on takes over."""
    gone: dict[str, set[str]] = {}
    found: dict[str, list[str]] = {}
    for task, signal in items:
        outputs = set(picture.find(task).task.outputs)
        if signal == "off":
            gone[task] = outputs
        elif signal == "on":
            found[task] = [old for old, theirs in gone.items() if theirs & outputs]
    return {task: olds for task, olds in found.items() if olds}


def _direct(
    picture: Picture, items: Sequence[tuple[str, str]], heir: str, olds: list[str]
) -> bool:
    """Tell whether a task can stand by for others of one other RTPU."""
    names = [task for task, _ in items]
    rtpus = {picture.find(old).rtpu for old in olds}
    first = names.index(olds[0])
    return (
        len(rtpus) == 1
        and picture.find(heir).rtpu not in rtpus
        and picture.find(heir).state is State.OFF
        and all(picture.find(old).is_on for old in olds)
        and all(names.count(task) == 1 for task in (heir, *olds))
        and names[first : first + len(olds)] == olds
        and len(olds) <= MOST_CALLERS
    )


def runs(
    picture: Picture, items: Sequence[tuple[str, str]]
) -> Iterator[tuple[str, list[tuple[str, str]]]]:
    """Yield the items cut wherever the next is for another RTPU."""
    part: list[tuple[str, str]] = []
    where = ""
    for task, signal in items:
        rtpu = picture.find(task).rtpu
        if part and rtpu != where:
            yield where, part
            part = []
        where = rtpu
        part.append((task, signal))
    if part:
        yield where, part
