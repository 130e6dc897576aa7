"""Starts executives, so that none outlives the process that started it."""

from __future__ import annotations

import atexit
import contextlib
import os
import subprocess
import sys
from pathlib import Path
from typing import IO, TYPE_CHECKING

import msgspec
from msgspec import Struct

from pbonet.config import SppEntry

from . import channel

if TYPE_CHECKING:
    from collections.abc import Mapping

_MODULE = "pbonet.node.spp.executive_process"
END_TIME = 5.0


class ExecutiveConfig(Struct, frozen=True, kw_only=True):
    """Settings of an executive, on its command line."""

    place: channel.Place
    entry: SppEntry
    life_fd: int = -1
    """A pipe whose other end only its parent has; it ends with that."""
    reserved: tuple[int, ...] = ()
    """Cores of RTPUs."""


class Started:
    """An executive that this process has started.

    Args:
        config: Its settings.
        folder: Where its routines open files.
        output: Where its prints go; None: where this process's go.
        environment: Its environment; by default this process's.

    Raises:
        OSError: The system has no process for it.
    """

    def __init__(
        self,
        config: ExecutiveConfig,
        *,
        folder: str | None = None,
        output: int | None = None,
        environment: Mapping[str, str] | None = None,
    ) -> None:
        with contextlib.closing(channel.Executive(config.place)) as door:
            starts = door.state().starts  # all else is of the one before
            door.say(channel.ExecutiveState(starts=starts))
        life, self._life = os.pipe()
        try:
            config = msgspec.structs.replace(config, life_fd=life)
            text = msgspec.json.encode(config).decode()
            self.process = subprocess.Popen(
                [sys.executable, "-P", "-m", _MODULE, text],
                env=_environment(os.environ if environment is None else environment),
                pass_fds=[life],
                stdin=subprocess.DEVNULL,
                stdout=output,
                stderr=output,
                cwd=folder,
                start_new_session=True,
            )
        except BaseException:
            os.close(self._life)
            raise
        finally:
            os.close(life)

    @property
    def output(self) -> IO[bytes] | None:
        """Its prints, if they go to a pipe."""
        return self.process.stdout

    def let_go(self) -> None:
        """Close this process's end of the pipe, as in a fork of its parent."""
        with contextlib.suppress(OSError):
            os.close(self._life)

    def kill(self) -> None:
        """Kill it."""
        self.process.kill()

    def wait(self) -> int:
        """Wait until it has ended; return its exit status."""
        code = self.process.wait()
        self.let_go()
        return code


def _environment(given: Mapping[str, str]) -> dict[str, str]:
    package = str(Path(__file__).resolve().parents[3])
    path = os.pathsep.join(filter(None, [package, given.get("PYTHONPATH", "")]))
    return {
        "OPENBLAS_NUM_THREADS": "1",
        "OMP_NUM_THREADS": "1",
        **given,
        "PYTHONPATH": path,
        "PYTHONUNBUFFERED": "1",
    }


_started: dict[channel.Place, Started] = {}
"""Executives of this program."""


def ensure(config: ExecutiveConfig) -> None:
    """Start the executive of a program, if none of that name runs.

    Raises:
        OSError: The system has no process for it.
    """
    if not _started:
        atexit.register(end_all)
    _remove_left(config.place)
    found = _started.get(config.place)
    if found is None or found.process.poll() is not None:
        _started[config.place] = Started(config)


def _remove_left(own: channel.Place) -> None:
    """Remove the memory of executives whose programs were killed."""
    for place in channel.places_of_programs(own.domain, own.rtpu):
        if not Path(f"/proc/{place.pid}").exists() and not place.is_running():
            place.remove()


def _after_fork() -> None:
    """Leave the executives to the parent, in a child that was forked."""
    for one in _started.values():
        one.let_go()
    _started.clear()


os.register_at_fork(after_in_child=_after_fork)


def end_all() -> None:
    """End the executives of this program."""
    while _started:
        place, one = _started.popitem()
        one.kill()
        one.wait()
        place.remove()
