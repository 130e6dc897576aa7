"""Ordered lists of signals, cut into what one RTPU is sent at once."""

from __future__ import annotations

from typing import TYPE_CHECKING

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
