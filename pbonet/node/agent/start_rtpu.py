"""Starts an RTPU process: by exec, on a core, with its output in case of failure."""

from __future__ import annotations

import contextlib
import os
import select
import subprocess
import sys
import time
from typing import TYPE_CHECKING

import msgspec

from pbonet.errors import NodeError, PbonetError
from pbonet.node.rtpu import cleanup
from pbonet.node.wire import process_setup, rtpu_messages

if TYPE_CHECKING:
    from collections.abc import Callable, Sequence
    from pathlib import Path

    from pbonet.xm.net import run_folder

START_TIME = 30.0
"""Seconds in which an RTPU process must start, even on a busy machine."""
END_TIME = 5.0
"""Seconds in which one that is not wanted any more must end."""
GIVE_UP_PERIOD = 0.05
"""Seconds between two looks whether a start was given up."""
LOG_TAIL = 4000


class Starting:
    """An RTPU process from its start until it accepts agents.

    Args:
        places: Its files.
        config: Its settings.

    Raises:
        OSError: The system cannot create a process.
    """

    def __init__(
        self, places: run_folder.Places, config: rtpu_messages.RtpuConfig
    ) -> None:
        self._places = places
        self._read, write = os.pipe()
        config = msgspec.structs.replace(config, ready_fd=write, agent=os.getpid())
        command = [sys.executable, "-P", "-m", "pbonet.node.rtpu.rtpu_process"]
        try:
            with places.log.open("wb") as log:
                self.process = subprocess.Popen(
                    [*command, msgspec.json.encode(config).decode()],
                    env={
                        **process_setup.environment(),
                        process_setup.MARK: os.urandom(8).hex(),
                    },
                    pass_fds=[write],
                    stdin=subprocess.DEVNULL,
                    stdout=log,
                    stderr=log,
                    start_new_session=True,
                )
        except BaseException:
            os.close(self._read)
            raise
        finally:
            os.close(write)

    def wait(self, given_up: Callable[[], bool]) -> subprocess.Popen[bytes]:
        """Return the process when it accepts agents.

        Args:
            given_up: Returns whether it is not wanted any more, and must not be waited
                for.

        Raises:
            PbonetError: The start failed.
        """
        try:
            self._must_be_ready(self._result(given_up))
        finally:
            os.close(self._read)
        return self.process

    def _result(self, given_up: Callable[[], bool]) -> bytes:
        """Return the message with the result of the start; nothing if none comes."""
        deadline = time.monotonic() + START_TIME
        data = b""
        while (left := deadline - time.monotonic()) > 0.0 and not given_up():
            if not readable(self._read, min(left, GIVE_UP_PERIOD)):
                continue
            part = os.read(self._read, 65536)
            if not part:
                break
            data += part
        return data

    def _must_be_ready(self, data: bytes) -> None:
        """Judge that message.

        Raises:
            PbonetError: The start failed.
        """
        if not data:
            self.process.kill()
            code = self.process.wait()
            raise NodeError(
                "the RTPU process did not start",
                got=f"exit code {code}",
                debug=log_tail(self._places),
                remedy="--debug shows its output",
            )
        ready = msgspec.msgpack.decode(data, type=rtpu_messages.Ready)
        if ready.error is not None:
            with contextlib.suppress(subprocess.TimeoutExpired):
                self.process.wait(5.0)
            error = PbonetError.from_wire(ready.error)
            error.debug = error.debug or log_tail(self._places)
            raise error

    def end(self) -> None:
        """End the process before it is ready, and remove what it left."""
        os.close(self._read)
        self.process.terminate()
        try:
            self.process.wait(END_TIME)
        except subprocess.TimeoutExpired:
            self.process.kill()
            self.process.wait()
        cleanup.clean_after(self._places)


def log_tail(places: run_folder.Places) -> str:
    """Return the end of the RTPU process's output."""
    with contextlib.suppress(OSError):
        return places.log.read_text(errors="replace")[-LOG_TAIL:].strip()
    return ""


def readable(fd: int, seconds: float) -> bool:
    """Return whether `fd` can be read in time; `select` is limited to small fds."""
    waiting = select.poll()
    waiting.register(fd, select.POLLIN)
    return bool(waiting.poll(seconds * 1000))


def used_cores(folder: Path) -> Sequence[int]:
    """Return the cores used by RTPU processes of this machine, with repetitions."""
    states = (cleanup.read(path) for path in folder.glob("*/*.state"))
    return [state.core for state in states if state is not None and state.alive]


def choose_core(places: run_folder.Places) -> int:
    """Return the core for an RTPU without a configured one: a free one, highest first.

    The first core is left to other programs, unless it is the only one. An RTPU whose
    process still runs, and can be taken over, keeps its core.
    """
    mine = cleanup.read(places.state)
    if mine is not None and mine.alive:
        return mine.core
    allowed = sorted(os.sched_getaffinity(0))
    candidates = allowed[1:] or allowed
    used = used_cores(places.folder.parent)
    return min(candidates, key=lambda core: (used.count(core), -core))
