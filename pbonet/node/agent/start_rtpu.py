"""How an RTPU process is started: by exec, on a core, and what it wrote if it fails."""

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
    from collections.abc import Sequence
    from pathlib import Path

    from pbonet.xm.net import run_folder

START_TIME = 30.0
"""Seconds that an RTPU process may take to come up on a busy machine."""
LOG_TAIL = 4000


def start(
    places: run_folder.Places, config: rtpu_messages.RtpuConfig
) -> subprocess.Popen[bytes]:
    """Start an RTPU process and return it when it takes agents.

    Raises:
        PbonetError: What prevented the start.
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
                    env=process_setup.environment(),
                    pass_fds=[write],
                    stdin=subprocess.DEVNULL,
                    stdout=log,
                    stderr=log,
                    start_new_session=True,
                )
        finally:
            os.close(write)
        _wait_until_ready(places, process, read)
    finally:
        os.close(read)
    return process


def _wait_until_ready(
    places: run_folder.Places, process: subprocess.Popen[bytes], read: int
) -> None:
    """Wait for the one message with the result of the start.

    Raises:
        PbonetError: What prevented the start.
    """
    deadline = time.monotonic() + START_TIME
    data = b""
    while readable(read, max(deadline - time.monotonic(), 0.0)):
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
            remedy="--debug shows what it wrote",
        )
    ready = msgspec.msgpack.decode(data, type=rtpu_messages.Ready)
    if ready.error is not None:
        with contextlib.suppress(subprocess.TimeoutExpired):
            process.wait(5.0)
        error = PbonetError.from_wire(ready.error)
        error.debug = error.debug or log_tail(places)
        raise error


def log_tail(places: run_folder.Places) -> str:
    """Return the end of what the RTPU process wrote."""
    with contextlib.suppress(OSError):
        return places.log.read_text(errors="replace")[-LOG_TAIL:].strip()
    return ""


def readable(fd: int, seconds: float) -> bool:
    """Return whether there is something to read in time; `select` has no large fds."""
    waiting = select.poll()
    waiting.register(fd, select.POLLIN)
    return bool(waiting.poll(seconds * 1000))


def used_cores(folder: Path) -> Sequence[int]:
    """Return the cores that RTPU processes of this machine use, with repetitions."""
    states = (cleanup.read(path) for path in folder.glob("*/*.state"))
    return [state.core for state in states if state is not None and state.alive]


def choose_core(places: run_folder.Places) -> int:
    """Return the core for an RTPU that names none: a free one, the last ones first.

    The first core is left to everything else, unless it is the only one. An RTPU whose
    process still runs, for an agent that comes and takes it over, stays where it is.
    """
    mine = cleanup.read(places.state)
    if mine is not None and mine.alive:
        return mine.core
    allowed = sorted(os.sched_getaffinity(0))
    candidates = allowed[1:] or allowed
    used = used_cores(places.folder.parent)
    return min(candidates, key=lambda core: (used.count(core), -core))
