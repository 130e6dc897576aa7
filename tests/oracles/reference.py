"""A process that does nothing but wake up, to tell a fault from a machine that stalled.

A task that was late proves nothing on a machine that others use as well: the virtual
machine may have stood still, or somebody else's real-time processes may have had the
core. A loop on the same core at the same level was late then too; what it lost, a task
may lose. A task's level is a label that changes as others come and go, so the loop has
that of the task which it stands beside, and looks it up whenever it wakes up.
"""

from __future__ import annotations

import json
import subprocess
import sys
from typing import Self

PERIOD = 0.005
LOOP = """
import json, os, select, sys, time
core, level, period, least, beside = map(int, sys.argv[1:])
os.sched_setaffinity(0, {core})
def take(level):
    try:
        os.sched_setscheduler(0, os.SCHED_FIFO, os.sched_param(level))
    except OSError:
        pass
take(level)
late, asked, due = [], False, time.monotonic_ns()
print(flush=True)
while True:
    if beside:
        try:
            wanted = max(os.sched_getparam(beside).sched_priority, 1)
        except OSError:
            beside = 0
        else:
            if wanted != level:
                level = wanted
                take(level)
    due += period
    if (left := due - time.monotonic_ns()) > 0:
        time.sleep(left * 1e-9)
    over = time.monotonic_ns() - due
    if over > least:
        late.append((due, due + over))
    if over > period:
        due += over // period * period
    if asked:
        print(json.dumps(late), flush=True)
        asked = False
    if select.select([0], [], [], 0)[0]:
        if not os.read(0, 1):
            break
        asked = True
"""


class Reference:
    """The loop, from entering to leaving the context.

    Args:
        core: Where.
        level: Of SCHED_FIFO, where that can be had.
        beside: The process of a task whose level it has instead, as that changes.
        late: Seconds behind its time from which on a wake-up counts as late.
    """

    def __init__(
        self, core: int, level: int = 1, *, beside: int = 0, late: float = PERIOD
    ) -> None:
        times = (round(PERIOD * 1e9), round(late * 1e9))
        settings = map(str, (core, level, *times, beside))
        self._process = subprocess.Popen(
            [sys.executable, "-I", "-S", "-c", LOOP, *settings],
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            bufsize=0,
        )
        self._process.stdout.readline()

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *exc: object) -> None:
        self._process.communicate()

    def away(self) -> list[tuple[int, int]]:
        """Return when it should have run and when it did, in ns, where it was late."""
        self._process.stdin.write(b"?")
        return [(due, ran) for due, ran in json.loads(self._process.stdout.readline())]

    def stalls(self) -> list[float]:
        """Return by how much it was late so far, in seconds, where that is much."""
        return [(ran - due) * 1e-9 for due, ran in self.away()]

    def longest(self) -> float:
        """Return the longest stall in seconds."""
        return max(self.stalls(), default=0.0)

    def lost(self, freq: float) -> int:
        """Return how many cycles at `freq` Hz may have fallen into the stalls.

        A cycle that a stall only touches may be lost as well, on either side.
        """
        return sum(2 + int(stall * freq) for stall in self.stalls())
