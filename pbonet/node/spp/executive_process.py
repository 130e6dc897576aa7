"""The process of an executive: its limits, its end, and its loop."""

from __future__ import annotations

import contextlib
import fcntl
import os
import resource
import signal
import sys
from pathlib import Path
from typing import Final

import msgspec

from pbonet.errors import DuplicateNameError, PbonetError
from pbonet.io.spp import Execution, ExecutiveConfig, channel
from pbonet.xm.net import run_folder

from .executive import Executive

_F_SETSIG: Final = 10
START_TIME: Final = 5.0
"""Seconds for which an executive before this one may still end."""
_MEGABYTE: Final = 1_000_000


def main(config: ExecutiveConfig) -> int:
    """Serve until the process is ended; return the exit status."""
    _end_with_parent(config.life_fd)
    _stay_off(config.reserved)
    _be_first_to_go()
    name = config.place.name
    try:
        door = channel.Executive(config.place)
        text = f"executive {name}, process {os.getpid()}"
        lock = run_folder.NameLock(config.place.lock(), text, patience=START_TIME)
    except DuplicateNameError as error:
        sys.stderr.write(f"{error}\n")
        return 1
    try:
        execution = Execution(config.entry, name)
    except PbonetError as error:
        state = door.state()
        state.pid, state.back_end, state.device = os.getpid(), "", ""
        state.error = {k: str(v) for k, v in error.to_wire().items()}
        door.say(state)
        return 1
    memory = round(config.entry.memory * _MEGABYTE)
    if memory:
        _limit(execution, memory)
    executive = Executive(config.place, execution, door, config.entry.longest)
    executive.begin()
    try:
        while True:
            executive.serve()
    finally:
        lock.release()


def _end_with_parent(fd: int) -> None:
    """Have the kernel kill this process when the other end of a pipe is closed.

    This needs no thread, and no attention of a routine that never ends.
    """
    if fd < 0:
        return
    fcntl.fcntl(fd, fcntl.F_SETOWN, os.getpid())
    fcntl.fcntl(fd, _F_SETSIG, signal.SIGKILL)
    flags = fcntl.fcntl(fd, fcntl.F_GETFL)
    fcntl.fcntl(fd, fcntl.F_SETFL, flags | os.O_ASYNC | os.O_NONBLOCK)
    try:
        gone = not os.read(fd, 1)  # it was closed before
    except BlockingIOError:
        gone = False
    if gone:
        os._exit(0)


def _stay_off(cores: tuple[int, ...]) -> None:
    """Leave these cores to tasks, if others are left."""
    allowed = os.sched_getaffinity(0)
    os.sched_setaffinity(0, (allowed - set(cores)) or allowed)
    os.sched_setscheduler(0, os.SCHED_OTHER, os.sched_param(0))


def _be_first_to_go() -> None:
    """When the machine runs out of memory, this process ends, and not a task."""
    with contextlib.suppress(OSError):  # some containers do not allow it
        Path("/proc/self/oom_score_adj").write_text("1000", encoding="ascii")


def _limit(execution: Execution, memory: int) -> None:
    """Bound what libraries can use, beside what the back ends use already."""
    status = Path("/proc/self/status").read_text(encoding="ascii")
    (line,) = (one for one in status.splitlines() if one.startswith("VmData:"))
    most = int(line.split()[1]) * 1024 + memory
    resource.setrlimit(resource.RLIMIT_DATA, (most, most))
    for one in execution.back_ends.found.values():
        one.limit(memory)


if __name__ == "__main__":
    sys.exit(main(msgspec.json.decode(sys.argv[1], type=ExecutiveConfig)))
