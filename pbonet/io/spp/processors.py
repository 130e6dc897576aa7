"""The special purpose processors that tasks of this process can use, by name.

An agent has them from its ``agent.toml``, runs their executives, and hands the entries
to each of its tasks. A program or a test names them itself, and has executives of its
own.
"""

from __future__ import annotations

from contextlib import contextmanager
from typing import TYPE_CHECKING

from pbonet.errors import SppError, did_you_mean

from . import executive_start

if TYPE_CHECKING:
    from collections.abc import Generator, Mapping

    from pbonet.config import SppEntry

_entries: dict[str, SppEntry] = {}
_owner = [""]


def use(entries: Mapping[str, SppEntry], owner: str) -> None:
    """Set the processors of this process.

    Args:
        entries: By name.
        owner: The user that messages show, as ``RTPU/TASK``; empty for a program,
            which starts the executives that it uses.
    """
    _entries.clear()
    _entries.update(entries)
    _owner[0] = owner


@contextmanager
def using(entries: Mapping[str, SppEntry]) -> Generator[None]:
    """Set the processors of this process in a block; at its end executives end."""
    before = dict(_entries), _owner[0]
    use(entries, "")
    try:
        yield
    finally:
        use(*before)
        executive_start.end_all()


def entries() -> list[str]:
    """Return the names of all processors."""
    return list(_entries)


def owner() -> str:
    """Return the user of this process; empty for a program."""
    return _owner[0]


def entry(name: str) -> SppEntry:
    """Return what is said of a processor.

    Raises:
        SppError: There is none of that name.
    """
    found = _entries.get(name)
    if found is None:
        raise SppError(
            f"there is no special purpose processor {name} on this machine",
            where=owner(),
            expected=" ".join(sorted(_entries)) or "a processor of agent.toml",
            remedy=did_you_mean(name, _entries)
            or f"write [spp.{name}] into the agent's agent.toml",
        )
    return found
