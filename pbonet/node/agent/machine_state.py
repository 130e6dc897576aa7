"""The clock of this machine, its folders and disk, and how fast its memory copies."""

from __future__ import annotations

import os
import time
from functools import cache
from pathlib import Path
from typing import Final

from pbonet import shm
from pbonet.xm.net import messages as m

_BLOCK: Final = 8 << 20
"""Bytes of a copy: more than a core's own caches hold."""
_COPIES: Final = 4
"""The first one also makes the pages present."""
_STEP: Final = 1e8
"""Bytes a second to which it is rounded: a measurement is not more exact."""


@cache
def copy_speed() -> float:
    """Return the bytes a second that one core copies in memory; it takes some ms.

    It is the bound of equation 7 (Stewart 1994, section 5.5). CPU time is measured, so
    that other processes do not count.
    """
    source, target = bytearray(b"\1") * _BLOCK, memoryview(bytearray(_BLOCK))
    speed = _BLOCK / min(_copy_time(source, target) for _ in range(_COPIES))
    return max(round(speed / _STEP), 1) * _STEP


def _copy_time(source: bytearray, target: memoryview) -> float:
    begin = time.thread_time_ns()
    target[:] = source
    return max(time.thread_time_ns() - begin, 1) * 1e-9


def machine_info(runs: str) -> m.MachineInfo:
    """Return the time of day, and the space in a folder that may not exist yet.

    Args:
        runs: The folder.
    """
    folder = Path(runs)
    for place in (folder, *folder.parents):
        try:
            disk = os.statvfs(place)
        except OSError:
            continue
        return m.MachineInfo(
            wall=time.time(),
            runs=runs,
            disk_free=disk.f_bavail * disk.f_frsize,
            disk_size=disk.f_blocks * disk.f_frsize,
        )
    return m.MachineInfo(wall=time.time(), runs=runs)


class NeededFolders:
    """The folders that an agent needs while it runs.

    Args:
        runtime: Its runtime folder.
    """

    def __init__(self, runtime: Path) -> None:
        self._folders = (
            (runtime, "the runtime folder", "PBONET_RUN_DIR"),
            (shm.folder(), "the folder of the shared memory", "PBONET_SHM_DIR"),
        )
        self._there = [_identity(path) for path, _, _ in self._folders]

    def lost(self) -> str:
        """Return which one was removed and what to do; empty: they are all there.

        One that was made again has none of the files that the agent needs.
        """
        for (path, what, variable), known in zip(
            self._folders, self._there, strict=True
        ):
            try:
                found = _identity(path)
            except OSError:  # as for lack of memory: that says nothing about it
                continue
            if found != known:
                return (
                    f"{what} {path} was removed, so that nothing can reach the RTPU: "
                    "its tasks are turned off, and it ends; set "
                    f"{variable} to a folder that nothing cleans, and start it again"
                )
        return ""


def _identity(path: Path) -> tuple[int, int] | None:
    try:
        found = path.stat()
    except (FileNotFoundError, NotADirectoryError):
        return None
    return found.st_dev, found.st_ino
