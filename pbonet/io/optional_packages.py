"""Packages that only some modules need, and which pbonet's extras bring."""

from __future__ import annotations

import os
import sys
from contextlib import contextmanager
from importlib import import_module
from typing import TYPE_CHECKING, Any

from pbonet.errors import DeviceError

if TYPE_CHECKING:
    from collections.abc import Generator


@contextmanager
def from_extra(extra: str, purpose: str) -> Generator[None]:
    """Name the extra that brings what is imported in this block.

    Args:
        extra: The extra of pbonet.
        purpose: What needs the package.

    Raises:
        DeviceError: The package is not installed, or does not import.
    """
    try:
        yield
    except ImportError as error:
        raise DeviceError(
            f"{purpose} needs a package that does not import",
            got=str(error),
            remedy=f"pip install 'pbonet[{extra}]'",
        ) from None


def load_mujoco(purpose: str) -> Any:  # noqa: ANN401 - it has no stubs
    """Return the package mujoco.

    Its import prepares drawing on a screen unless `MUJOCO_GL` says otherwise, and
    starts another program for that, which a replay refuses. pbonet draws without a
    screen, so that part is left out where the variable is not set.

    Args:
        purpose: What needs the package.

    Raises:
        DeviceError: It is not installed, or does not import.
    """
    chosen = "MUJOCO_GL" in os.environ or "mujoco" in sys.modules
    if not chosen:
        os.environ["MUJOCO_GL"] = "disable"
    try:
        with from_extra("mujoco", purpose):
            return import_module("mujoco")
    finally:
        if not chosen:
            del os.environ["MUJOCO_GL"]
