"""The source of what a page shows: a subsystem that runs, or a recorded run."""

from __future__ import annotations

from abc import ABC, abstractmethod
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from collections.abc import Callable, Iterable

    Data = dict[str, Any]


class Source(ABC):
    """Tells browsers what there is, and what has changed.

    Its own thread calls what `start` was given; everything else may be called from
    another one.
    """

    about: Data
    """Its part of the first message: ``name``, ``job``, ``hz`` and ``log``."""
    variables: frozenset[str]
    """The variables that can be watched."""

    @abstractmethod
    def start(self, told: Callable[[Data], None]) -> None:
        """Begin; each message for all browsers is handed to `told`."""

    @abstractmethod
    def close(self) -> None:
        """End."""

    @abstractmethod
    def want(self, names: Iterable[str]) -> None:
        """Tell the values of these variables from now on."""

    @abstractmethod
    def first(self) -> list[Data]:
        """Return the first messages for a new browser."""

    @abstractmethod
    def history(self, names: Iterable[str]) -> list[Data]:
        """Return what was so far, of variables that a browser watches from now on."""
