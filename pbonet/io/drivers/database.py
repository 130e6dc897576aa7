"""The devices that tasks of this process can open, by logical name.

An agent has them from its ``agent.toml`` and hands them to each of its tasks. A program
or a test names them itself.
"""

from __future__ import annotations

from contextlib import contextmanager
from difflib import get_close_matches
from typing import TYPE_CHECKING

from pbonet.errors import DeviceError

if TYPE_CHECKING:
    from collections.abc import Generator, Mapping

    from pbonet.config import Entry

_entries: dict[str, Entry] = {}
_owner = [""]


def use(entries: Mapping[str, Entry], owner: str) -> None:
    """Set the devices of this process.

    Args:
        entries: By logical name.
        owner: The user that `pbonet devices` shows, as ``RTPU/TASK``.
    """
    _entries.clear()
    _entries.update(entries)
    _owner[0] = owner


@contextmanager
def using(entries: Mapping[str, Entry], owner: str = "") -> Generator[None]:
    """Set the devices of this process in a block."""
    before = dict(_entries), _owner[0]
    use(entries, owner)
    try:
        yield
    finally:
        use(*before)


def owner() -> str:
    """Return the user whose openings these are."""
    return _owner[0]


def entry(name: str) -> Entry:
    """Return what the database says of a device.

    Raises:
        DeviceError: There is none of that name.
    """
    found = _entries.get(name)
    if found is None:
        near = get_close_matches(name, _entries, 1)
        raise DeviceError(
            f"there is no device {name} on this machine",
            where=owner(),
            expected=" ".join(sorted(_entries)) or "a device of agent.toml",
            remedy=f"did you mean {near[0]}?"
            if near
            else f"write [device.{name}] into the agent's agent.toml",
        )
    return found
