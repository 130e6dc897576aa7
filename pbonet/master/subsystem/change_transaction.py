"""One command at a time, by a master that holds the claim."""

from __future__ import annotations

from typing import TYPE_CHECKING

if TYPE_CHECKING:
    import threading
    from collections.abc import Sequence

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
