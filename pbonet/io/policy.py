"""Whether devices may be opened: always, except inside `no_devices`.

The simulator and the replay of a log run modules in virtual time; a device answers in
real time and would make two runs differ, so it must not even be opened.
"""

from __future__ import annotations

from contextlib import contextmanager
from contextvars import ContextVar
from typing import TYPE_CHECKING

from pbonet.errors import DeviceError

if TYPE_CHECKING:
    from collections.abc import Generator

_refusal: ContextVar[str] = ContextVar("pbonet_no_devices", default="")


@contextmanager
def no_devices(reason: str) -> Generator[None]:
    """Refuse every opening of a device inside the block.

    Args:
        reason: The reason, for the error's text; ``"this is a simulation"``.
    """
    token = _refusal.set(reason)
    try:
        yield
    finally:
        _refusal.reset(token)


def devices_allowed() -> bool:
    """Return whether a device may be opened here and now."""
    return not _refusal.get()


def require_devices(where: str) -> None:
    """Return if devices may be opened.

    Raises:
        DeviceError: They may not; `where` names the device that was asked for.
    """
    if reason := _refusal.get():
        raise DeviceError(
            "no device is opened",
            where=where,
            got=reason,
            remedy="put the module that simulates it in its place",
        )
