"""Packages that only some modules need, and which pbonet's extras bring."""

from __future__ import annotations

from contextlib import contextmanager
from typing import TYPE_CHECKING

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
