"""Ordered lists of signals, cut into what one RTPU is sent at once."""

from __future__ import annotations

from itertools import groupby
from typing import TYPE_CHECKING

from pbonet.pbo import State
from pbonet.xm.net import MOST_CALLERS

if TYPE_CHECKING:
    from collections.abc import Iterable, Iterator, Mapping, Sequence

    from pbonet.master.configuration import TaskModel


def handed_over(
    model: TaskModel, items: Sequence[tuple[str, str]]
) -> dict[str, list[str]]:
    """Return for tasks that go off which of their outputs a later item takes over."""
    found: dict[str, list[str]] = {}
    taken: set[str] = set()
    for task, signal in reversed(items):
        outputs = model.find(task).task.outputs
        if signal == "on":
            taken.update(outputs)
        elif signal == "off" and (theirs := [one for one in outputs if one in taken]):
            found[task] = theirs
    return found


def across(model: TaskModel, items: Sequence[tuple[str, str]]) -> dict[str, list[str]]:
    """Return tasks that take over from tasks on other RTPUs, and from which.

    These call them as soon as they have ended, and successors on their own RTPU that
    share a predecessor with such a task. Left out are those whose predecessors do not
    stand side by side in the list, and those that share a predecessor with one of
    these.
    """
    olds = _predecessors(model, items)
    far = {task for task in olds if len(_rtpus(model, [task, *olds[task]])) > 1}
    called = _sharing(olds, far)
    direct = {task for task in olds if _direct(model, items, task, olds[task])}
    called -= _sharing(olds, called - direct)
    return {task: olds[task] for task in olds if task in called}


def _rtpus(model: TaskModel, tasks: Iterable[str]) -> set[str]:
    return {model.find(task).rtpu for task in tasks}


def _sharing(olds: Mapping[str, list[str]], tasks: set[str]) -> set[str]:
    """Return these tasks and all that share a predecessor with one of them."""
    found = set(tasks)
    while more := {
        task
        for task in olds.keys() - found
        if any(set(olds[task]) & set(olds[other]) for other in found)
    }:
        found |= more
    return found


def _predecessors(
    model: TaskModel, items: Sequence[tuple[str, str]]
) -> dict[str, list[str]]:
    """Return from which of those before it each task that comes on takes over."""
    gone: dict[str, set[str]] = {}
    found: dict[str, list[str]] = {}
    for task, signal in items:
        outputs = set(model.find(task).task.outputs)
        if signal == "off":
            gone[task] = outputs
        elif signal == "on":
            found[task] = [old for old, theirs in gone.items() if theirs & outputs]
    return {task: olds for task, olds in found.items() if olds}


def _direct(
    model: TaskModel, items: Sequence[tuple[str, str]], task: str, olds: list[str]
) -> bool:
    """Return whether a task can stand by for others that call it."""
    names = [name for name, _ in items]
    first = names.index(olds[0])
    return (
        model.find(task).state is State.OFF
        and all(model.find(old).is_on for old in olds)
        and all(names.count(one) == 1 for one in (task, *olds))
        and names[first : first + len(olds)] == olds
        and len(olds) <= MOST_CALLERS
    )


def steps(
    model: TaskModel,
    items: Sequence[tuple[str, str]],
    successors: Mapping[str, list[str]],
) -> Iterator[dict[str, list[tuple[str, str]]]]:
    """Yield the parts that are sent at once, in order, by RTPU.

    Tasks of several RTPUs that leave for the same successors do so together; everything
    else is cut wherever the next item is for another RTPU.
    """
    begin = 0
    for first, last in _together(items, successors):
        parts: dict[str, list[tuple[str, str]]] = {}
        for task, signal in items[first:last]:
            parts.setdefault(model.find(task).rtpu, []).append((task, signal))
        if len(parts) > 1:
            yield from _runs(model, items[begin:first])
            yield parts
            begin = last
    yield from _runs(model, items[begin:])


def _together(
    items: Sequence[tuple[str, str]], successors: Mapping[str, list[str]]
) -> list[tuple[int, int]]:
    """Return where those begin and end that leave together, in order."""
    names = [task for task, _ in items]
    spans: list[tuple[int, int]] = []
    for olds in sorted(successors.values(), key=lambda olds: names.index(olds[0])):
        first = names.index(olds[0])
        last = first + len(olds)
        if spans and first < spans[-1][1]:
            spans[-1] = spans[-1][0], max(last, spans[-1][1])
        else:
            spans.append((first, last))
    return spans


def _runs(
    model: TaskModel, items: Sequence[tuple[str, str]]
) -> Iterator[dict[str, list[tuple[str, str]]]]:
    """Yield the items cut wherever the next is for another RTPU."""
    for rtpu, part in groupby(items, key=lambda item: model.find(item[0]).rtpu):
        yield {rtpu: list(part)}
