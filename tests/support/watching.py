"""Waiting for conditions, and finding what was left behind; used by many tests."""

from __future__ import annotations

import contextlib
import os
import random
import shutil
import socket
import time
from pathlib import Path

END_TIME = 60.0
"""Seconds for what comes soon, on a machine that stalls for some of them."""


def processes_of(variable: str, value: str) -> list[tuple[int, str]]:
    """Return the processes that were started with this environment, zombies not."""
    wanted = f"{variable}={value}".encode()
    found = []
    for entry in Path("/proc").iterdir():
        if not entry.name.isdigit() or int(entry.name) == os.getpid():
            continue
        try:
            if wanted in (entry / "environ").read_bytes().split(b"\0"):
                command = (entry / "cmdline").read_bytes().replace(b"\0", b" ").decode()
                found.append((int(entry.name), command))
        except OSError:
            continue  # it has ended, or is somebody else's
    return found


def free_port() -> int:
    """Return a TCP port of the loopback that nobody listens on just now.

    It is none of those that the kernel gives to outgoing connections: one of these
    could have it before whoever is to listen there.
    """
    while True:
        port = random.randrange(20_000, 32_000)
        with socket.socket() as probe, contextlib.suppress(OSError):
            probe.bind(("127.0.0.1", port))
            return port


def wait_for(condition, what: str, limit: float = END_TIME):
    """Return what `condition` returns as soon as that is true; fail after `limit`."""
    deadline = time.monotonic() + limit
    while not (result := condition()):
        assert time.monotonic() < deadline, f"not within {limit:g} s: {what}"
        time.sleep(0.005)
    return result


def clean_folder(folder: Path, variable: str) -> None:
    """Fail when processes of this environment or files in the folder are left."""
    deadline = time.monotonic() + END_TIME
    while (left := processes_of(variable, str(folder))) and time.monotonic() < deadline:
        time.sleep(0.02)
    for pid, _ in left:
        os.kill(pid, 9)
    files = [str(path) for path in folder.rglob("*") if not path.is_dir()]
    shutil.rmtree(folder)
    assert not left, f"processes left: {left}"
    assert not files, f"files left: {files}"


def states(subsystem):
    """Return the state of each task of a `Subsystem`."""
    return {status.task: status.state for status in subsystem.status_all()}


def causes(subsystem):
    """Return why the illegal-configuration flag of a `Subsystem` is up."""
    return [cause for rtpu in subsystem.rtpu_status() for cause in rtpu.illegal]
