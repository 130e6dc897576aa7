"""Starts an RTPU process: by exec, on a core, with its output in case of failure."""

from __future__ import annotations

import contextlib
import os
import secrets
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
GIVE_UP_PERIOD = 0.05
"""Seconds between two looks whether a start was given up."""
LOG_TAIL = 4000


def start(
    places: run_folder.Places,
    config: rtpu_messages.RtpuConfig,
    given_up: Callable[[], bool],
) -> subprocess.Popen[bytes]:
    """Start an RTPU process and return it when it accepts agents.

    Args:
        places: Its files.
        config: Its settings.
        given_up: Returns whether it is not wanted any more, and must not be waited for.

    Raises:
        PbonetError: The start failed.
        OSError: The system cannot create a process.
    """
    read, write = os.pipe()
    config = msgspec.structs.replace(config, ready_fd=write)
    command = [sys.executable, "-P", "-m", "pbonet.node.rtpu.rtpu_process"]
    try:
        try:
            with places.log.open("wb") as log:
                process = subprocess.Popen(
                    [*command, msgspec.json.encode(config).decode()],
                    env={
                        **process_setup.environment(),
                        process_setup.MARK: secrets.token_hex(8),
                    },
                    pass_fds=[write],
                    stdin=subprocess.DEVNULL,
                    stdout=log,
                    stderr=log,
                    start_new_session=True,
                )
        finally:
            os.close(write)
        _wait_until_ready(places, process, read, given_up)
    finally:
        os.close(read)
    return process


def _wait_until_ready(
    places: run_folder.Places,
    process: subprocess.Popen[bytes],
    read: int,
    given_up: Callable[[], bool],
) -> None:
    """Wait for the message with the result of the start.

    Raises:
        PbonetError: The start failed.
    """
    deadline = time.monotonic() + START_TIME
    data = b""
    while (left := deadline - time.monotonic()) > 0.0 and not given_up():
        if not readable(read, min(left, GIVE_UP_PERIOD)):
            continue
        part = os.read(read, 65536)
        if not part:
            break
        data += part
    if not data:
        process.kill()
        code = process.wait()
        raise NodeError(
            "the RTPU process did not start",
            got=f"exit code {code}",
            debug=log_tail(places),
            remedy="--debug shows its output",
        )
    ready = msgspec.msgpack.decode(data, type=rtpu_messages.Ready)
    if ready.error is not None:
        with contextlib.suppress(subprocess.TimeoutExpired):
            process.wait(5.0)
        error = PbonetError.from_wire(ready.error)
        error.debug = error.debug or log_tail(places)
        raise error


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
