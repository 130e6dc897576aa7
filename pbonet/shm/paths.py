"""The folder of the shared memory files of this user, and their names in it."""

from __future__ import annotations

import os
from pathlib import Path


def folder() -> Path:
    """Return ``PBONET_SHM_DIR``, or ``/dev/shm`` if that is unset or empty."""
    return Path(os.environ.get("PBONET_SHM_DIR") or "/dev/shm")  # noqa: S108 - its place


def own(name: str) -> str:
    """Return the name of a file of this user, or a common prefix of several."""
    return f"pbonet.{os.geteuid()}.{name}"


def path_of(name: str) -> Path:
    """Return the path of this user's file `name`."""
    return folder() / own(name)
