"""Needs of a task that its machine must meet: ``NEEDS spp cuda`` in its RMOD."""

from __future__ import annotations

import time
from typing import TYPE_CHECKING, Final

from pbonet.errors import SppError
from pbonet.xm.ipc import names

from . import channel, processors

if TYPE_CHECKING:
    from collections.abc import Iterable

START_TIME: Final = 30.0
"""Seconds in which an executive must say what it has."""
_PAUSE: Final = 0.02


def require(needs: Iterable[str]) -> None:
    """Return if processors of this machine have all that is needed.

    Args:
        needs: Devices (``cuda``) and back ends.

    Raises:
        SppError: One of them is not there.
    """
    wanted = set(needs)
    if not wanted:
        return
    there = {name: _found(name) for name in processors.entries()}
    have = {word for found in there.values() for one in found for word in _words(one)}
    for one in sorted(wanted - have):
        raise SppError(
            f"no special purpose processor of this machine has {one}",
            where=processors.owner(),
            expected=f"NEEDS spp {one}",
            got="; ".join(
                f"{name}: {', '.join(found) or 'it does not run'}"
                for name, found in there.items()
            )
            or "none in its agent.toml",
            remedy="spawn it on another RTPU, or take NEEDS out of the .rmod file",
        )


def _words(found: str) -> tuple[str, str]:
    """Return the back end and the kind of device of a line ``NAME on DEVICE``."""
    back_end, _, device = found.partition(" on ")
    return back_end, device.partition(":")[0]


def _found(name: str) -> list[str]:
    here = names.home()
    executive = channel.Executive(channel.Place(here.domain, here.rtpu, name))
    until = time.monotonic() + START_TIME
    try:
        while time.monotonic() < until:
            state = executive.state()
            if state.back_end or state.error:
                return state.found
            time.sleep(_PAUSE)
    finally:
        executive.close()
    return []
