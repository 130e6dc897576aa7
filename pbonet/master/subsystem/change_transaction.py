"""One command at a time, by a master that holds the claim."""

from __future__ import annotations

from typing import TYPE_CHECKING

if TYPE_CHECKING:
    import threading
    from collections.abc import Sequence

    from .subsystem_tasks import SubsystemTasks


class ChangeTransaction:
    """One command at a time, by a master that holds the claim, on present task states.

    Args:
        task_set: The subsystem's tasks.
        busy: Held meanwhile.
        strict: Whether the states of all tasks must be known.
        partly: Whether those on the RTPUs that answer are enough for that.
        claimed: False for a command that only tells what it would do.
        rtpus: Those that are asked how their tasks stand; None: all.
    """

    def __init__(
        self,
        task_set: SubsystemTasks,
        busy: threading.RLock,
        *,
        strict: bool,
        partly: bool,
        claimed: bool = True,
        rtpus: Sequence[str] | None = None,
    ) -> None:
        self._task_set = task_set
        self._busy = busy
        self._strict = strict
        self._partly = partly
        self._before = False
        self._claimed = claimed
        self._rtpus = rtpus

    def __enter__(self) -> SubsystemTasks:
        if self._claimed:
            self._task_set.clients.must_be_claimed()
        self._busy.acquire()
        self._before, self._task_set.partly = self._task_set.partly, self._partly
        try:
            if self._rtpus != []:
                self._task_set.refresh(strict=self._strict, rtpus=self._rtpus)
        except BaseException:
            self.__exit__()
            raise
        return self._task_set

    def __exit__(self, *_: object) -> None:
        self._task_set.partly = self._before
        self._busy.release()
