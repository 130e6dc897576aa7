"""The folder of the shared memory files of this user, and their names in it."""

from __future__ import annotations

import os
from pathlib import Path


def folder() -> Path:
    """Return ``PBONET_SHM_DIR``, or ``/dev/shm`` where that is unset or empty."""
    return Path(os.environ.get("PBONET_SHM_DIR") or "/dev/shm")  # noqa: S108 - its place


def own(name: str) -> str:
    """Return the name of a file of this user, or the beginning of several."""
    return f"pbonet.{os.geteuid()}.{name}"


def path_of(name: str) -> Path:
    """Return the file of this user that `name` is in."""
    return folder() / own(name)
