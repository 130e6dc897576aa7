"""Files and processes to clean up if the RTPU process is killed, and the clean-up.

The RTPU process writes down what it makes: tasks, rings, tables. After it was killed,
its agent (at once) or the next RTPU process of that name reads this, waits for the
tasks to end (each turns itself off within a second), ends those that do not, and
removes what is left in shared memory.
"""

from __future__ import annotations

import contextlib
import os
import signal
import time
from typing import TYPE_CHECKING

import msgspec
from msgspec import Struct

from pbonet.errors import NodeError, PbonetError
from pbonet.node import rt
from pbonet.node.wire import core_trace, process_setup
from pbonet.svar import table_files
from pbonet.xm import sweep
from pbonet.xm.net import run_folder

from .orphaned_rings import remove_ring
from .tables import remove_unused

if TYPE_CHECKING:
    from collections.abc import Iterable
    from pathlib import Path

PATIENCE = 1.5
"""Seconds that orphaned tasks get to end; they end themselves within one."""
KILL_TIME = 5.0
"""Seconds in which a killed task ends, even on a machine that stalls."""
_LOOK = 0.01


class TaskLeft(Struct, array_like=True):
    """The process of a task."""

    pid: int
    started: int


class Leftovers(Struct, kw_only=True):
    """The content of a state file."""

    pid: int
    started: int
    core: int
    epoch: int = 0
    tables: list[str] = []
    tasks: list[TaskLeft] = []
    rings: list[str] = []
    """Of these tasks, and of those that were being created."""
    mark: str = ""
    """Its `process_setup.MARK`."""
    agent_pid: int = 0
    """The agent that uses it; 0: none."""
    agent_started: int = 0

    @property
    def alive(self) -> bool:
        """Whether the RTPU process that wrote this still runs."""
        return process_setup.is_alive(self.pid, self.started)

    @property
    def agent(self) -> int:
        """The process of the live agent that uses it; 0: none."""
        used = self.alive and process_setup.is_alive(self.agent_pid, self.agent_started)
        return self.agent_pid if used else 0


def write(path: Path, state: Leftovers) -> None:
    """Replace the state file, whole or not at all.

    Raises:
        NodeError: The runtime folder cannot be written to.
    """
    fresh = path.with_suffix(".state.new")
    try:
        fresh.write_bytes(msgspec.json.encode(state))
        fresh.rename(path)
    except OSError as error:
        raise NodeError(
            "the runtime folder cannot be written to",
            where=str(path),
            got=error.strerror or str(error),
            remedy="make room there",
        ) from None


def read(path: Path) -> Leftovers | None:
    """Return what the state file says; None when there is none that can be read."""
    try:
        return msgspec.json.decode(path.read_bytes(), type=Leftovers)
    except (OSError, msgspec.MsgspecError):
        return None


def clean(places: run_folder.Places, patience: float = PATIENCE) -> list[str]:
    """Clean up after a killed RTPU process of that name; return what was done.

    Does nothing while one is alive.
    """
    state = read(places.state)
    if state is None:
        places.remove(places.ctl, places.state)
        return _sweep_mail(places)
    if state.alive:
        return []
    done = _end_tasks(state, patience)
    done += remove_rings(state.rings)
    for name in state.tables:
        done += _remove_table(name)
    done += _sweep_mail(places)
    done += _sweep_core(state.core)
    done += [f"the trace {name} of a core was removed" for name in core_trace.sweep()]
    sweep_claims()
    places.remove(places.ctl, places.state)
    return done


def clean_after(places: run_folder.Places) -> list[str]:
    """Clean up after a killed RTPU process, from outside; return what was done."""
    done = clean(places)
    if not run_folder.is_held(places.ctl_lock):
        places.remove(places.ctl_lock, places.log)
    return done


def _end_tasks(state: Leftovers, patience: float) -> list[str]:
    """Wait for the tasks, end those that stay; return what was done.

    What they use is theirs until they are gone, also when they were killed.
    """
    done: list[str] = []
    left = _outlive(state.tasks, patience)
    for task in left:
        with contextlib.suppress(ProcessLookupError):
            os.kill(task.pid, signal.SIGKILL)
        done.append(f"process {task.pid} did not end and was killed")
    _outlive(left, KILL_TIME)
    if count := process_setup.end_marked(state.mark):
        done.append(f"{count} processes that tasks had started were killed")
    return done


def _outlive(tasks: list[TaskLeft], patience: float) -> list[TaskLeft]:
    """Wait for the tasks to end; return those that still live."""
    deadline = time.monotonic() + patience
    while left := [
        one for one in tasks if process_setup.is_alive(one.pid, one.started)
    ]:
        if time.monotonic() > deadline:
            break
        time.sleep(_LOOK)
    return left


def remove_rings(names: Iterable[str]) -> list[str]:
    """Remove the rings of tasks that are gone; return what was done."""
    done: list[str] = []
    for name in names:
        with contextlib.suppress(OSError):
            if remove_ring(name):
                done.append(f"ring {name} was removed")
    return done


def _remove_table(name: str) -> list[str]:
    path = table_files.path_of(name)
    if path.exists() and remove_unused(path):
        return [f"table {name} was removed"]
    return []


def _sweep_mail(places: run_folder.Places) -> list[str]:
    """Remove unused semaphores and queues; return what was done."""
    swept = sweep(places.name, places.domain)
    return [f"express mail {places.name}:{name} was removed" for name in swept]


def _sweep_core(core: int) -> list[str]:
    """Let the core table drop its dead members, and its file if none is left."""
    with contextlib.suppress(PbonetError, OSError):
        rt.CoreTable(core, member=True).close()
    return []


def sweep_claims() -> None:
    """Remove the files of I/O devices that no process has open."""
    for path in run_folder.claims().iterdir():
        remove_unused(path)
