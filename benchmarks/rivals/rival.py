"""A rival in the question of a set of numbers: its two ends, each in a process."""

from __future__ import annotations

import importlib
import importlib.metadata
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np

if TYPE_CHECKING:
    from collections.abc import Callable, Sequence

    from numpy.typing import NDArray

ARRAYS = 6


class Writer(NamedTuple):
    """The end that publishes."""

    arrays: Sequence[NDArray[np.float64]]
    """What is filled before each call."""
    publish: Callable[[], object]


class Reader(NamedTuple):
    """The end that takes the newest set."""

    take: Callable[[], object]
    """Return the set, or None when the rival says that there is nothing new."""
    arrays: Callable[[Any], Sequence[NDArray[np.float64]]]
    """Return the numbers of what `take` returned."""
    wait: Callable[[], object] | None = None
    """As `take`, and sleeps until there is a new one; None: readers poll."""


class Rival:
    """One way to bring a set of numbers from one process to another.

    It is made in the parent of both processes, which hand nothing else to each other.

    Args:
        length: Numbers in each of the `ARRAYS` arrays of the set.
        tag: Distinguishes this run from others on the machine.
    """

    name = ""
    package = ""
    """Distribution that is needed beside pbonet's own; empty: none."""

    def __init__(self, length: int, tag: str) -> None:
        self.length = length
        self.floats = ARRAYS * length
        self.tag = tag

    def writer(self) -> Writer:
        """Open the publishing end."""
        raise NotImplementedError

    def reader(self) -> Reader:
        """Open the taking end; the publishing one is open."""
        raise NotImplementedError

    def close(self) -> None:
        """Remove what both ends leave behind; called in the parent."""


def installed(package: str) -> str:
    """Return the version of a distribution; empty when it is not installed."""
    try:
        return importlib.metadata.version(package)
    except importlib.metadata.PackageNotFoundError:
        return ""


def load(module: str) -> Any:  # noqa: ANN401 - a rival need not be installed
    """Import a module of a rival."""
    return importlib.import_module(module)


def whole(taken: Any) -> Any:  # noqa: ANN401 - what a rival returns
    """Return what was taken: it is a list of arrays."""
    return taken


def alone(taken: Any) -> list[NDArray[np.float64]]:  # noqa: ANN401 - the same
    """Return what was taken, one array, as a list."""
    return [taken]


def one_array(data: object) -> list[NDArray[np.float64]]:
    """Return the numbers in a buffer."""
    return [np.frombuffer(data, np.float64)]  # type: ignore[call-overload]
