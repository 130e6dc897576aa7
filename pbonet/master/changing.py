"""What every command that changes a subsystem stands in."""

from __future__ import annotations

from typing import TYPE_CHECKING

if TYPE_CHECKING:
    import threading

    from pbonet.master.crew import Crew


class Changing:
    """One command at a time, by a master that holds the claim, on a fresh picture.

    Args:
        crew: The subsystem's tasks.
        busy: Held meanwhile.
        strict: Whether every RTPU must say how its tasks stand.
        claimed: False for a command that only tells what it would do.
    """

    def __init__(
        self, crew: Crew, busy: threading.RLock, *, strict: bool, claimed: bool = True
    ) -> None:
        self._crew = crew
        self._busy = busy
        self._strict = strict
        self._claimed = claimed

    def __enter__(self) -> Crew:
        if self._claimed:
            self._crew.fleet.must_be_claimed()
        self._busy.acquire()
        try:
            self._crew.refresh(strict=self._strict)
        except BaseException:
            self._busy.release()
            raise
        return self._crew

    def __exit__(self, *_: object) -> None:
        self._busy.release()
