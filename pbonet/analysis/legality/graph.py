"""Graphs of names: an order that puts producers first, and cycles that forbid it."""

from __future__ import annotations

from itertools import pairwise
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from collections.abc import Callable, Iterable, Mapping, Sequence

Edges = dict[str, dict[str, str]]
"""For each producer its consumers, and what flows between the two."""


def flows(
    names: Sequence[str],
    gives: Mapping[str, Iterable[str]],
    takes: Mapping[str, Iterable[str]],
) -> Edges:
    """Return the edges from writers to readers, each with its variables.

    A producer that takes its own product is its own consumer here.
    """
    edges: Edges = {name: {} for name in names}
    for consumer in names:
        for item in takes[consumer]:
            for producer in names:
                if item in gives[producer]:
                    before = edges[producer].get(consumer)
                    edges[producer][consumer] = f"{before}, {item}" if before else item
    return edges


def sort(edges: Edges) -> tuple[list[str], list[str]]:
    """Return the names with producers first, and those that cannot be ordered.

    Where the edges leave a choice, the order of `edges` stays.
    """
    waiting = dict.fromkeys(edges, 0)
    for consumers in edges.values():
        for consumer in consumers:
            waiting[consumer] += 1
    ordered: list[str] = []
    left = list(edges)
    while ready := next((name for name in left if not waiting[name]), None):
        left.remove(ready)
        ordered.append(ready)
        for consumer in edges[ready]:
            waiting[consumer] -= 1
    return ordered, left


def groups(edges: Edges) -> list[set[str]]:
    """Return the sets of names that all reach each other, larger than one name."""
    reach = {name: _reached(edges, name) for name in edges}
    found: list[set[str]] = []
    for name in edges:
        group = {other for other in reach[name] if name in reach[other]}
        if len(group) > 1 and group not in found:
            found.append(group)
    return found


def _reached(edges: Edges, start: str) -> set[str]:
    seen: set[str] = set()
    todo = [start]
    while todo:
        for consumer in edges[todo.pop()]:
            if consumer not in seen:
                seen.add(consumer)
                todo.append(consumer)
    return seen


def cycle(edges: Edges, among: Sequence[str]) -> list[str]:
    """Return one shortest cycle among the names, its first name also last.

    Empty if there is none.
    """
    best: list[str] = []
    for start in among:
        path = _way_back(edges, start)
        if path and (not best or len(path) < len(best)):
            best = path
    return best


def _way_back(edges: Edges, start: str) -> list[str]:
    came_from: dict[str, str] = {}
    todo = [start]
    for name in todo:
        for consumer in edges[name]:
            if consumer == start:
                path = [start, name]
                while path[-1] != start:
                    path.append(came_from[path[-1]])
                return path[::-1]
            if consumer not in came_from:
                came_from[consumer] = name
                todo.append(consumer)
    return []


def draw(edges: Edges, path: Sequence[str]) -> str:
    """Return a path as text: ``a --NDOF--> b --DH--> a``."""
    text = path[0]
    for producer, consumer in pairwise(path):
        text += f" --{edges[producer][consumer]}--> {consumer}"
    return text


def without_cycles(
    edges: Edges, rank: Callable[[str], tuple[bool, float, str]]
) -> Edges:
    """Return the edges with every cycle opened in front of its most important name.

    In each set of names that reach each other, the name that `rank` puts lowest takes
    nothing from the others of the set; that is repeated until no cycle is left.
    """
    kept = {
        name: {c: item for c, item in consumers.items() if c != name}
        for name, consumers in edges.items()
    }
    while found := groups(kept):
        for group in found:
            first = min(group, key=rank)
            for producer in group:
                kept[producer].pop(first, None)
    return kept
