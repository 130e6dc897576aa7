"""What a module that is run again hears from outside: its record, and nothing else.

Nothing outside is touched. What pbonet itself cannot record (sockets of its own, device
files, other programs) is refused where it is opened, so that the verdict can say it.
"""

from __future__ import annotations

import os
import stat
import sys
import threading
from contextlib import ExitStack, contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final

from pbonet.io import no_devices
from pbonet.outside import NotRecordedError, Outside, Player, using
from pbonet.pbo import Counted, TaskContext
from pbonet.xm import names

if TYPE_CHECKING:
    from collections.abc import Callable, Generator

    from pbonet.log import TaskAbout

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
    """The time, the cycles and the criticality that a module was told.

    Args:
        outside: What was heard of the task itself.
        clock: Gives nanoseconds between cycles.
    """

    _crit = 0

    def __init__(self, outside: Outside, clock: Callable[[], int]) -> None:
        self._outside = outside
        super().__init__(clock)

    @property
    def crit(self) -> int:
        """The criticality that the dispatcher ranked the task by."""
        self._crit = self._outside.ask(int, default=self._crit)
        return self._crit

    @crit.setter
    def crit(self, value: int) -> None:
        self._crit = value


class Context(TaskContext):
    """``self.task`` of a module that is run again.

    Args:
        outside: What was heard of the task itself.
        args: As for `TaskContext`.
        more: As for `TaskContext`.
    """

    _sigmask = 0

    def __init__(self, outside: Outside, *args: Any, **more: Any) -> None:  # noqa: ANN401
        super().__init__(*args, **more)
        self._outside = outside
        self.is_stale = lambda _port: outside.ask(bool, default=False)

    @property
    def sigmask(self) -> int:
        """Signals that the master did not want from this task, as bits."""
        self._sigmask = self._outside.ask(int, default=self._sigmask)
        return self._sigmask


def of_task(player: Player | None) -> Outside:
    """Return what was heard of the task itself: the first source of each task."""
    with using(player):
        return Outside("task")


@contextmanager
def only(player: Player | None, about: TaskAbout) -> Generator[None]:
    """Have what runs in this block hear what is on record, and open nothing.

    Args:
        player: What was heard; None: older logs do not say.
        about: Whose task it was.
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
        yield


class _Guard:
    """Refuses to open what stands in no log, in one thread, while it is on."""

    def __init__(self) -> None:
        self._thread = 0
        self._hooked = False

    @contextmanager
    def on(self) -> Generator[None]:
        if not self._hooked:  # a hook stays as long as its process
            sys.addaudithook(self._look)
            self._hooked = True
        before, self._thread = self._thread, threading.get_ident()
        try:
            yield
        finally:
            self._thread = before

    def _look(self, event: str, args: tuple[Any, ...]) -> None:
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
            f"it opens {what}, and what that gives is in no log "
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
