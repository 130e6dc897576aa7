"""The agent's executives: one process for each special purpose processor."""

from __future__ import annotations

import contextlib
import logging
import os
import select
import signal
import subprocess
import threading
import time
from typing import TYPE_CHECKING, Final

from pbonet.errors import PbonetError, Severity
from pbonet.io.spp import ExecutiveConfig, Started, channel
from pbonet.node.wire import process_setup, rtpu_messages
from pbonet.xm.net import messages as m

if TYPE_CHECKING:
    from collections.abc import Callable, Iterable

    from pbonet.config import AgentConfig

log = logging.getLogger("pbonet.node")

WINDOW: Final = 60.0
"""An executive that is lost twice in so many seconds is not started again."""
LINES: Final = 20
"""Lines of routines' output in a second that become events; more are counted."""
_LOOK: Final = 0.2
_LONGEST_LINE: Final = 500
_PART: Final = 65536


class _Output:
    """Prints of routines as lines, and not too many of them.

    Args:
        tell: Called with each line.
    """

    def __init__(self, tell: Callable[[str], None]) -> None:
        self._tell = tell
        self._rest = b""
        self._since = 0.0
        self._count = 0

    def take(self, data: bytes) -> None:
        """Take bytes as they come."""
        *lines, self._rest = (self._rest + data).split(b"\n")
        self._rest = self._rest[-_LONGEST_LINE:]
        now = time.monotonic()
        for line in lines:
            if now - self._since > 1.0:
                self._report_more()
                self._since, self._count = now, 0
            self._count += 1
            if self._count <= LINES and line.strip():
                self._tell(line.decode(errors="replace")[:_LONGEST_LINE])

    def _report_more(self) -> None:
        if self._count > LINES:
            self._tell(f"and {self._count - LINES} more lines")

    def end(self) -> None:
        """Tell what is left."""
        self.take(b"\n" if self._rest else b"")
        self._report_more()


class _Watched:
    """One executive, started again once if it is lost.

    Args:
        config: Its settings.
        folder: Where its routines open files.
        notice: Called with a severity, a code and a text.
    """

    def __init__(
        self,
        config: ExecutiveConfig,
        folder: str | None,
        notice: Callable[[Severity, str, str], None],
    ) -> None:
        self.name = config.place.name
        self._config, self._folder, self.notice = config, folder, notice
        self._door = channel.Executive(config.place)
        self._ending = threading.Event()
        self._guard = threading.Lock()
        self._process: Started | None = None
        self._lost: list[float] = []
        self._why = ""
        """Why it does not run."""
        self._thread = threading.Thread(
            target=self._watch, name=f"pbonet spp {self.name}", daemon=True
        )
        self._thread.start()

    @property
    def pid(self) -> int:
        """Its process; 0: there is none."""
        process = self._process
        return process.process.pid if process is not None else 0

    def status(self) -> m.SppStatus:
        """Return its state."""
        state, pid = self._door.state(), self.pid
        runs = pid != 0 and state.pid == pid
        return m.SppStatus(
            name=self.name,
            back_end=state.back_end if runs else "",
            device=state.device if runs else "",
            pid=pid,
            starts=state.starts,
            batches=state.batches,
            libraries=state.libraries if runs else [],
            error=self._why,
        )

    def _watch(self) -> None:
        again = True
        while again and not self._ending.is_set():
            try:
                process = self._start()
            except OSError as error:
                self._stays_down(f"could not be started: {error}")
                return
            if process is not None:
                self._listen(process)
                again = self._again(process.wait())

    def _start(self) -> Started | None:
        with self._guard:
            if self._ending.is_set():
                return None
            self._process = Started(
                self._config, folder=self._folder, output=subprocess.PIPE
            )
            return self._process

    def _listen(self, process: Started) -> None:
        """Pass its output on until it ends; say what it runs on when that is known."""
        output = _Output(lambda text: self.notice(Severity.INFO, "SPP_OUTPUT", text))
        told = ""
        assert process.output is not None  # noqa: S101 - it is a pipe
        with process.output as said:
            fd = said.fileno()
            waiting = select.poll()
            waiting.register(fd, select.POLLIN)
            while process.process.poll() is None:
                if waiting.poll(_LOOK * 1000):
                    data = os.read(fd, _PART)
                    output.take(data)
                    if not data:
                        break
                told = self._say(process.process.pid, told)
            with contextlib.suppress(OSError):
                os.set_blocking(fd, False)
                output.take(os.read(fd, _PART))
            self._say(process.process.pid, told)
        output.end()

    def _say(self, pid: int, told: str) -> str:
        """Report what it runs on, and each library once; return what was reported."""
        state = self._door.state()
        if state.pid != pid or not state.back_end:
            return told
        entry = self._config.entry
        text = f"runs {state.back_end} on {state.device} (driver {entry.driver}, "
        text += f"device {entry.device} in agent.toml)"
        if state.libraries:
            text += f": {', '.join(state.libraries)}"
        if text != told:
            self.notice(Severity.INFO, "SPP_READY", text)
        return text

    def _again(self, code: int) -> bool:
        """Decide whether an executive that has ended is started again."""
        with self._guard:
            self._process = None
            if self._ending.is_set():
                return False
        error = self._door.state().error
        if error:
            self._stays_down(str(PbonetError.from_wire(error)))  # type: ignore[arg-type]
            return False
        how = process_setup.describe_end(code)
        if code == -signal.SIGALRM:
            how = f"a batch took more than {self._config.entry.longest:g} s"
        now = time.monotonic()
        self._lost = [t for t in self._lost if now - t < WINDOW] + [now]
        if len(self._lost) > 1:
            self._stays_down(f"ended: {how}; it was lost twice in {WINDOW:g} s")
            return False
        text = f"ended: {how}; another one is started, its variables are zero again"
        self.notice(Severity.ERROR, "SPP_DIED", text)
        return True

    def _stays_down(self, why: str) -> None:
        self._why = why
        text = f"{why}; it is not started again"
        self.notice(Severity.ERROR, "SPP_DIED", text)

    def stop(self) -> None:
        """End it."""
        with self._guard:
            self._ending.set()
            if self._process is not None:
                self._process.kill()
        self._thread.join()
        self._door.close()

    def remove(self) -> None:
        """Remove its memory, when it has ended."""
        with contextlib.suppress(PbonetError):
            self._config.place.remove()


class Executives:
    """Runs the executive of each special purpose processor.

    Args:
        config: The machine's configuration.
        note: Passes a note to the RTPU process.
    """

    def __init__(
        self, config: AgentConfig, note: Callable[[rtpu_messages.Note], None]
    ) -> None:
        self._config = config
        self._note = note
        self._watched: list[_Watched] = []

    def start(self, reserved: Iterable[int]) -> None:
        """Start them.

        Args:
            reserved: Cores of RTPUs, which they leave alone.

        Raises:
            PbonetError: Their shared memory cannot be used.
        """
        for name, entry in self._config.spp.items():
            place = channel.Place(self._config.domain, self._config.name or "", name)
            config = ExecutiveConfig(
                place=place, entry=entry, reserved=tuple(set(reserved))
            )
            notice = self._noticer(name)
            self._watched.append(_Watched(config, self._config.files, notice))

    def _noticer(self, name: str) -> Callable[[Severity, str, str], None]:
        def report(severity: Severity, code: str, text: str) -> None:
            log.log(severity, "%s: spp %s: %s", self._config.name, name, text)
            self._note(rtpu_messages.Note(int(severity), code, f"spp {name}: {text}"))

        return report

    def processes(self) -> dict[int, str]:
        """Return their processes, with what each one is."""
        return {
            one.pid: f"the executive of spp {one.name}"
            for one in self._watched
            if one.pid
        }

    def status(self) -> list[m.SppStatus]:
        """Return the state of each."""
        return [one.status() for one in self._watched]

    def stop(self, *, sweep: bool = True) -> None:
        """End them.

        Args:
            sweep: Remove their memory; otherwise tasks go on, and the next agent's
                executives serve them.
        """
        watched, self._watched = self._watched, []
        for one in watched:
            one.stop()
            if sweep:
                one.remove()
