"""Runs in virtual time, as many at once as there are cores."""

from __future__ import annotations

import contextlib
import os
import subprocess
import sys
import tempfile
import threading
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING

import msgspec

from pbonet.errors import PbonetError

from .virtual_run import Seen, Wish

if TYPE_CHECKING:
    from collections.abc import Callable, Generator, Sequence


class Runs:
    """Processes that run jobs, one for each core.

    Args:
        folder: Of their shared memory.
        told: Called with the number of runs that have ended, and of all.
    """

    def __init__(self, folder: Path, told: Callable[[int, int], None]) -> None:
        self._folder, self._told = folder, told
        self._guard = threading.Lock()
        self._idle: list[subprocess.Popen[bytes]] = []
        self._processes: list[subprocess.Popen[bytes]] = []
        self._over = False
        self._done = 0

    def results(self, wishes: Sequence[Wish]) -> list[Seen]:
        """Return the results of runs, in their order.

        Raises:
            PbonetError: A run could not be made.
        """
        self._done = 0
        pool = ThreadPoolExecutor(len(os.sched_getaffinity(0)))
        try:
            waiting = [pool.submit(self._run, wish, len(wishes)) for wish in wishes]
            return [one.result() for one in waiting]
        except BaseException:
            self.stop()
            raise
        finally:
            pool.shutdown(cancel_futures=True)

    def _run(self, wish: Wish, every: int) -> Seen:
        process = self._process()
        assert process.stdin is not None  # noqa: S101 - it is a pipe
        assert process.stdout is not None  # noqa: S101 - it is a pipe
        try:
            process.stdin.write(msgspec.json.encode(wish) + b"\n")
            process.stdin.flush()
            answer = process.stdout.readline()
        except OSError:  # it has ended
            answer = b""
        seen = _read(answer)
        with self._guard:
            self._idle.append(process)
            self._done += 1
            self._told(self._done, every)
        return seen

    def _process(self) -> subprocess.Popen[bytes]:
        """Return a process that runs nothing; a new one if none is idle."""
        with self._guard:
            if self._over:
                raise PbonetError("the run was given up", remedy="start it again")
            if self._idle:
                return self._idle.pop()
            apart = {"PBONET_SHM_DIR": str(self._folder)}
            process = subprocess.Popen(
                [sys.executable, "-P", "-m", "pbonet.master.planning.virtual_run"],
                env={**os.environ, **apart},
                stdin=subprocess.PIPE,
                stdout=subprocess.PIPE,
                stderr=subprocess.DEVNULL,
                start_new_session=True,  # Ctrl-C is for the parent, which ends them
            )
            self._processes.append(process)
            return process

    def stop(self) -> None:
        """End all processes, and wait until they have ended."""
        with self._guard:
            self._over = True
            ending, self._processes = self._processes, []
        for process in ending:
            process.kill()
        for process in ending:
            process.wait()
            for pipe in (process.stdin, process.stdout):
                if pipe is not None:
                    with contextlib.suppress(OSError):
                        pipe.close()


def _read(answer: bytes) -> Seen:
    """Return the answer of a process.

    Raises:
        PbonetError: It could not make the run.
    """
    try:
        seen = msgspec.json.decode(answer, type=Seen)
    except msgspec.DecodeError:
        raise PbonetError(
            "a run in virtual time has ended without a result",
            remedy="try 'pbonet simulate JOB --code', which shows more",
        ) from None
    if seen.fault is not None:
        raise PbonetError.from_wire(seen.fault)
    return seen


@contextmanager
def parallel_runs(told: Callable[[int, int], None]) -> Generator[Runs]:
    """Yield what runs jobs; afterwards no process and no file of them is left."""
    with tempfile.TemporaryDirectory(prefix="pbonet-tune-") as folder:
        runs = Runs(Path(folder), told)
        try:
            yield runs
        finally:
            runs.stop()
