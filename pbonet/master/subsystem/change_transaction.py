"""What the parts of `Subsystem` have of each other, and what changes stand in."""

from __future__ import annotations

from typing import TYPE_CHECKING, Protocol

if TYPE_CHECKING:
    import threading
    from collections.abc import Sequence

    from pbonet.master.configuration import Clock, Files

    from .rtpu_clients import Fleet
    from .subsystem_tasks import Crew


class Changing:
    """One command at a time, by a master that holds the claim, on a fresh picture.

    Args:
        crew: The subsystem's tasks.
        busy: Held meanwhile.
        strict: Whether every RTPU must say how its tasks stand.
        claimed: False for a command that only tells what it would do.
        rtpus: Those that are asked how their tasks stand; None: all.
    """

    def __init__(
        self,
        crew: Crew,
        busy: threading.RLock,
        *,
        strict: bool,
        claimed: bool = True,
        rtpus: Sequence[str] | None = None,
    ) -> None:
        self._crew = crew
        self._busy = busy
        self._strict = strict
        self._claimed = claimed
        self._rtpus = rtpus

    def __enter__(self) -> Crew:
        if self._claimed:
            self._crew.fleet.must_be_claimed()
        self._busy.acquire()
        try:
            if self._rtpus != []:
                self._crew.refresh(strict=self._strict, rtpus=self._rtpus)
        except BaseException:
            self._busy.release()
            raise
        return self._crew

    def __exit__(self, *_: object) -> None:
        self._busy.release()


class Opened(Protocol):
    """An open subsystem, as the parts that `Subsystem` is made of see it."""

    files: Files
    clock: Clock
    stopped: threading.Event

    @property
    def name(self) -> str:
        """The subsystem's name."""
        ...

    @property
    def crew(self) -> Crew:
        """Its tasks."""
        ...

    @property
    def fleet(self) -> Fleet:
        """Its RTPUs."""
        ...

    def _warn(self, text: str) -> None:
        """Tell a warning."""
        ...

    def _changing(
        self,
        *,
        strict: bool = True,
        claimed: bool = True,
        rtpus: Sequence[str] | None = None,
    ) -> Changing:
        """Return what a command that changes it stands in."""
        ...
