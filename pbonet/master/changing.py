"""What every command that changes a subsystem stands in."""

from __future__ import annotations

from typing import TYPE_CHECKING

if TYPE_CHECKING:
    import threading

    from pbonet.master.crew import Crew


class Changing:
    """One command at a time, by a master that holds the claim, on a fresh picture."""

    def __init__(self, crew: Crew, busy: threading.RLock, *, strict: bool) -> None:
        self._crew = crew
        self._busy = busy
        self._strict = strict

    def __enter__(self) -> Crew:
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
