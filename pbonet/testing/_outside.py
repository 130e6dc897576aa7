"""Inputs of a replayed module from outside the table: its record, and nothing else.

Nothing outside is touched. What pbonet itself cannot record (sockets of its own, device
files, other programs) is refused where it is opened, so that the verdict can say it.
"""

from __future__ import annotations

import math
import os
import stat
import sys
import threading
from contextlib import ExitStack, contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final

from pbonet.io import no_devices
from pbonet.outside import ModuleAnswers, NotRecordedError, Player, using
from pbonet.pbo import (
    Counted,
    PythonWatch,
    TaskContext,
    check_criticality,
    check_deadline,
)
from pbonet.xm.ipc import names

from ._chance import noting

if TYPE_CHECKING:
    from collections.abc import Callable, Generator

    from pbonet.log import TaskAbout

    from ._chance import Chance

_HARMLESS: Final = ("/dev/null", "/dev/zero", "/dev/random", "/dev/urandom", "/dev/tty")
_SEPARATE: Final = frozenset({
    "os.exec",
    "os.fork",
    "os.forkpty",
    "os.posix_spawn",
    "os.system",
    "subprocess.Popen",
})


class Time(Counted):
    """The recorded time, cycles and criticality of a module.

    Args:
        told: The recorded information about the task itself.
        clock: Gives nanoseconds between cycles.
    """

    def __init__(self, told: ModuleAnswers, clock: Callable[[], int]) -> None:
        self._told = told
        super().__init__(clock)

    @property
    def crit(self) -> int:
        """The criticality that the dispatcher ranked the task by."""
        return self._told.now("crit", int, 0)

    @crit.setter
    def crit(self, value: int) -> None:
        """Returns what was recorded, whatever its arguments are."""


class Context(TaskContext):
    """The ``self.task`` of a module that is run again.

    Args:
        told: The recorded information about the task itself.
        args: As for `TaskContext`.
        more: As for `TaskContext`.
    """

    def __init__(self, told: ModuleAnswers, *args: Any, **more: Any) -> None:  # noqa: ANN401
        super().__init__(*args, **more)
        self._told = told
        self.is_stale = lambda _port: told.ask(bool, default=False)
        self.age_of = lambda _port: told.ask(float, default=math.inf)

    @property
    def sigmask(self) -> int:
        """Signals that the master did not want from this task, as bits."""
        return self._told.now("sigmask", int, 0)

    def _wanted(self, bits: int) -> int:
        """Return the signals; in a run the slot masks them, and asks nothing."""
        return bits


class Watch(PythonWatch):
    """Recorded criticality and deadline; a handler's settings have no effect.

    Args:
        told: The recorded information about the task itself.
        task: The task.
    """

    def __init__(self, told: ModuleAnswers, task: TaskContext) -> None:
        super().__init__(task)
        self._told = told
        self._of = task

    @property
    def criticality(self) -> int:
        """The task's criticality for the dispatcher."""
        return self._told.now("criticality", int, -1)

    @criticality.setter
    def criticality(self, value: int) -> None:
        check_criticality(self._of, value)

    @property
    def deadline(self) -> float:
        """Seconds from the release of the cycle to its deadline."""
        return self._told.now("deadline", float, -1.0)

    @deadline.setter
    def deadline(self, value: float) -> None:
        check_deadline(self._of, value)


def of_task(player: Player | None, *, timing: bool) -> ModuleAnswers:
    """Return the recorded information about the task, of its first sources."""
    with using(player):
        return ModuleAnswers(timing=timing)


@contextmanager
def only(player: Player | None, about: TaskAbout, chance: Chance) -> Generator[None]:
    """Answer from the record in this block, and open nothing.

    Args:
        player: The recorded answers; None: older logs have none.
        about: Description of the task.
        chance: Notes random numbers that are in no log.
    """
    with ExitStack() as stack:
        if player is None:
            stack.enter_context(no_devices("this is a replay"))
        else:
            home = names.living_on(
                about.rtpu, domain=about.domain, subsystem=about.subsystem
            )
            stack.enter_context(home)
        stack.enter_context(using(player))
        stack.enter_context(_guard.on())
        stack.enter_context(noting(chance))
        yield


class _Guard:
    """Refuse, in one thread, to open sources that no log has."""

    def __init__(self) -> None:
        self._thread = 0
        self._hooked = False

    @contextmanager
    def on(self) -> Generator[None]:
        if not self._hooked:  # a hook stays as long as its process
            sys.addaudithook(self._on_audit)
            self._hooked = True
        before, self._thread = self._thread, threading.get_ident()
        try:
            yield
        finally:
            self._thread = before

    def _on_audit(self, event: str, args: tuple[Any, ...]) -> None:
        if not self._thread or self._thread != threading.get_ident():
            return
        if event == "open":
            if _is_device(args[0]):
                self._refuse(f"the device {args[0]}")
        elif event in {"socket.__new__", "socket.connect", "socket.bind"}:
            self._refuse("a socket")
        elif event in _SEPARATE:
            self._refuse("another program")

    def _refuse(self, what: str) -> None:
        raise NotRecordedError(
            f"it opens {what}, whose results are in no log "
            "(pbonet.io.Outside records it)"
        )


def _is_device(path: str | bytes | os.PathLike[str] | int) -> bool:
    if isinstance(path, (bytes, os.PathLike)):
        path = os.fsdecode(path)
    if not isinstance(path, str) or path in _HARMLESS:
        return False
    try:
        mode = Path(path).stat().st_mode
    except OSError:
        return path.startswith("/dev/")
    return not (stat.S_ISREG(mode) or stat.S_ISDIR(mode))


_guard = _Guard()
