"""The versions of what machines send each other, and what two programs have in common.

Each layer has a format, and a version, of its own. `LAYERS` is what this pbonet
understands; an agent tells it in its answer to `hello`.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Final, NamedTuple

if TYPE_CHECKING:
    from collections.abc import Iterable, Mapping


class Range(NamedTuple):
    """The versions of one layer that a program understands."""

    oldest: int
    newest: int

    def __contains__(self, version: object) -> bool:
        """Return whether it understands a version."""
        return isinstance(version, int) and self.oldest <= version <= self.newest

    def __str__(self) -> str:
        """Return the version or versions as text."""
        if self.oldest == self.newest:
            return f"version {self.oldest}"
        return f"versions {self.oldest} to {self.newest}"


LAYERS: Final = {
    "commands": Range(1, 1),
    "table": Range(1, 1),
    "links": Range(1, 1),
}
"""Requests and their answers; packets of the table; records of links (`tbuf`)."""
UNTOLD: Final = Range(1, 1)
"""Versions of a layer that an agent does not name."""
_LOSS: Final = {
    "commands": "between them only hello and stop work",
    "table": "no values are exchanged between them",
    "links": "no records are exchanged between them",
}
REMEDY: Final = (
    "run the same pbonet version on every machine; docs/deployment.md says in which "
    "order to upgrade"
)


def common(one: Range, other: Range) -> int | None:
    """Return the highest version that both understand; None if there is none."""
    newest = min(one.newest, other.newest)
    return newest if newest >= max(one.oldest, other.oldest) else None


def spoken(mine: Range, others: Iterable[Range | None]) -> int:
    """Return the version in which to send something to several at once.

    It is the highest that all understand, except those that understand none of mine.
    While it is unknown what one understands (None), it is my oldest.
    """
    newest = mine.newest
    for other in others:
        if other is None:
            return mine.oldest
        both = common(mine, other)
        newest = newest if both is None else min(newest, both)
    return newest


def mismatches(programs: Mapping[str, Mapping[str, Range]]) -> list[str]:
    """Say of which layers some programs have no version in common, and which these are.

    Args:
        programs: By name, the layers that each has, and what it understands of them.
    """
    found: list[str] = []
    for layer in LAYERS:
        sides: dict[Range, list[str]] = {}
        for name, ranges in programs.items():
            if layer in ranges:
                sides.setdefault(ranges[layer], []).append(name)
        wanted = sorted(sides)
        found += [
            _text(layer, (one, sides[one]), (other, sides[other]))
            for n, one in enumerate(wanted)
            for other in wanted[n + 1 :]
            if common(one, other) is None
        ]
    return found + _unheard({
        n: r["table"] for n, r in programs.items() if "table" in r
    })


def _unheard(tables: Mapping[str, Range]) -> list[str]:
    """Say which programs are sent packets of another version than one they understand.

    A packet goes to all at once, in one version. One that understands both of two
    which have none in common is heard by one of them only.
    """
    found: list[str] = []
    for name, mine in tables.items():
        version = spoken(mine, tables.values())
        deaf = [
            other
            for other, theirs in tables.items()
            if version not in theirs and common(mine, theirs) is not None
        ]
        if deaf:
            found.append(
                f"{name} sends tables in version {version}, for all at once, which "
                f"{', '.join(deaf)} cannot read; no values of it arrive there"
            )
    return found


def _text(
    layer: str, one: tuple[Range, list[str]], other: tuple[Range, list[str]]
) -> str:
    sides = [f"{', '.join(names)} {side}" for side, names in (one, other)]
    return f"no common version of {layer}: {'; '.join(sides)}; {_LOSS[layer]}"
