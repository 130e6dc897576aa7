"""Rings of tasks that have ended, which no recorder has begun to empty yet.

A recorder that is being started takes some tenths of a second to come. The ring of a
task that ends before that gets a unique name, so that another task of the same name may
be spawned; the recorder that empties it removes it. A ring that no recorder empties is
removed by the agent when it ends, otherwise by the next RTPU process of that name.
"""

from __future__ import annotations

import contextlib
import fcntl
import glob
from pathlib import Path
from typing import TYPE_CHECKING, Final

from pbonet import shm
from pbonet.errors import NodeError
from pbonet.node.ring import Ring

if TYPE_CHECKING:
    from pbonet.node.wire import Recording

    from .task_handle import Task

MOST: Final = 16
"""Rings of an RTPU that wait for a recorder; more are not left."""
MOST_BYTES: Final = 1 << 26
"""When these have so many bytes, no further one is left."""
_ENDING: Final = ".ring"
_LEFT: Final = "~"
"""Occurs in no name of a domain, subsystem, task or RTPU."""


def let_ring_go(task: Task, recording: Recording | None) -> None:
    """Remove the ring of a task that is gone, or leave it to a recorder to come.

    Args:
        task: Its process has ended.
        recording: What is to be recorded of its subsystem.

    Raises:
        OSError: It cannot be removed.
    """
    try:
        ring = Ring.attach(task.facts.ring)
    except (NodeError, ValueError):  # it ended before it had one, or as it made it
        remove_ring(task.facts.ring)
        return
    if (
        recording is not None
        and recording.tasks.get(task.name, recording.mode) != "off"
        and _leave(Path(ring.path), recording, task.child.pid)
    ):
        ring.close()
    else:
        ring.destroy()


def remove_ring(name: str) -> bool:
    """Remove the ring of a task that is gone, finished or not; return if there was one.

    Raises:
        OSError: It cannot be removed.
    """
    path = shm.path_of(name + _ENDING)
    there = path.exists()
    path.unlink(missing_ok=True)
    return there


def ring_damage(task: Task) -> str:
    """Return how the file of a task's ring was truncated; empty: it was not."""
    path = shm.path_of(task.facts.ring + _ENDING)
    try:
        Ring.attach(task.facts.ring).close()
    except (NodeError, ValueError):
        with contextlib.suppress(FileNotFoundError):
            return (
                f"{path}: the file, in which its cycles are recorded, was truncated "
                f"(got {path.stat().st_size} bytes); find out what writes to files in "
                "shared memory, then kill the task and spawn it again"
            )
    return ""


def _leave(path: Path, recording: Recording, pid: int) -> bool:
    """Give a ring another name; return False where it need not or cannot wait."""
    left = _left(recording.domain, recording.rtpu)
    if len(left) >= MOST or sum(map(_size, left)) >= MOST_BYTES:
        return False
    plain = path.name.removesuffix(_ENDING)
    name = f"{plain}{_LEFT}{recording.rtpu}.{pid}{_ENDING}"
    try:
        with path.open("rb") as file:
            # Its follower holds this lock, and needs no name for the rest.
            fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
            path.rename(path.with_name(name))
    except OSError:
        return False
    return True


def _size(path: Path) -> int:
    try:
        return path.stat().st_size
    except OSError:
        return 0  # a recorder has removed it


def is_left(name: str) -> bool:
    """Return whether a ring of this name waits for a recorder, its task being gone."""
    return _LEFT in name


def sweep(domain: str, rtpu: str) -> None:
    """Remove all rings that an RTPU left and no recorder took."""
    for path in _left(domain, rtpu):
        with contextlib.suppress(OSError):
            path.unlink()


def _left(domain: str, rtpu: str) -> list[Path]:
    domain, rtpu = glob.escape(domain), glob.escape(rtpu)
    pattern = shm.own(f"{domain}.*{_LEFT}{rtpu}.*{_ENDING}")
    return list(shm.folder().glob(pattern))
