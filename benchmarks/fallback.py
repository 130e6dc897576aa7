"""From a task's death to `stable` and to its fallback's first cycle.

A real agent, a real master over zenoh, tasks of 1 kHz. One task is killed by SIGKILL,
at any phase of its period; its standby is released by the dispatcher, and a critical
task that stays goes into `stable`. What both did when stands in their rings. Ends with
status 3 when the fallback's first cycle does not begin within one period of the death
(99 times of 100), or when a critical task begins any cycle but `stable` behind the turn
in which the dispatcher learned of the death.

    python -m benchmarks.fallback [--deaths 100] [--json FILE]
"""

from __future__ import annotations

import argparse
import contextlib
import json
import os
import random
import signal
import tempfile
import time
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from benchmarks import rtbench
from benchmarks.steering import VARIABLE
from benchmarks.swap import PERIOD, RATE, RMOD
from pbonet.analysis.schedule.events import Event
from pbonet.master import Subsystem
from pbonet.master.subsystem.embedded_agents import Embedded
from pbonet.node import rt
from pbonet.node.ring._ring import Record, Ring
from pbonet.xm.net.messages import AgentInfo, Hello

if TYPE_CHECKING:
    from numpy.typing import NDArray

NAMES = (
    "death to the dispatcher's turn",
    "death to the fallback is ON",
    "death to fallback's first cycle",
    "death to stable",
    "turn to the release of stable",
    "cycles in stable",
    "other cycles behind the turn",
)
"""What is measured of each death, in periods; the last two are numbers of cycles.

A critical task is `stable` from its first release behind the turn on, which is up to a
period behind it: so `stable` may begin more than a period behind a death. From the turn
to that release it is more than one only where a release has no cycle of its own. It is
below 0 where the cycle was released before the turn and begun behind it.
"""
FIRST, OTHERS = NAMES.index("death to fallback's first cycle"), len(NAMES) - 1
WITHIN = 0.99
"""So many of the first cycles must begin within one period."""
CRITICAL = '''"""Holds still while the configuration is illegal."""

from typing import Annotated as A

from pbonet import InVar, OutVar, PortBasedObject, Vector


class Guard(PortBasedObject):
    """y = z; and the last y in `stable`."""

    z: A[Vector, InVar("Z", "6", "any", "what is passed on")]
    y: A[Vector, OutVar("Y", "6", "any", "what came in")]

    def cycle(self, dt: float) -> None:
        self.y[:] = self.z

    def stable(self, dt: float) -> None:
        pass
'''
GUARD = """\
MODULE    guard
DESC      critical
SVARALIAS Z=Y0
SVARALIAS Y=D
INCONST   none
OUTCONST  none
INVAR     Z
OUTVAR    Y
TASKTYPE  periodic
FREQ      {rate:g}
CRITICAL  yes
EOF
"""
JOB = """\
JOB  bench
DESC a task with a standby
SBS  b.sbs
TASK first bench0 FALLBACK second
TASK guard bench0
EOF
"""


def write_files(folder: Path) -> None:
    """Write the subsystem, its job and its critical module."""
    variables = [VARIABLE.format(name="NDOF", kind="int", units="none", nelem=1)]
    variables[0] += "INIT 6\n"
    variables += [
        VARIABLE.format(name=name, kind="double", units="any", nelem=6)
        for name in ("Y0", "V0", "D")
    ]
    wave = RMOD.format(
        module="sine", aliases="SVARALIAS Y=Y0\nSVARALIAS Y^=V0", invar="none",
        outvar="Y Y^", rate=RATE, local="LOCAL\nAMPLITUDE 1\nFREQ 1",
    )  # fmt: skip
    files = {
        "b.svar": "\n".join(variables) + "\nEOF\n",
        "b.sbs": "SUBSYSTEM b\nSVARFILE b.svar\nRTPU bench0\nEOF\n",
        "bench.job": JOB,
        "first.rmod": wave,
        "second.rmod": wave,
        "guard.rmod": GUARD.format(rate=RATE),
        "guard.py": CRITICAL,
    }
    for name, text in files.items():
        (folder / name).write_text(text, encoding="utf-8")


def records(ring: Ring, wanted: float) -> list[Record]:
    """Return the cycles that come within so many seconds."""
    found: list[Record] = []
    end = time.monotonic() + wanted
    while time.monotonic() < end:
        found += [record for record in ring.drain() if not record.kind]
        time.sleep(0.002)
    return found


def engaged(core: rt.CoreTable, slot: int, since: int) -> tuple[int, int]:
    """Return when the dispatcher engaged a slot, and when it saw it armed."""
    _, _, found = core.trace(since)
    now = turn = 0
    for record in found:
        if record.kind == Event.TURN:
            now = record.a
        elif record.slot == slot and record.kind == Event.ENGAGE:
            turn = now
        elif turn and record.slot == slot and record.kind == Event.MODE:
            return turn, now
    return turn, 0


def kill(pid: int) -> int:
    """Kill a process; return when. Nothing without a level comes in between."""
    with contextlib.suppress(PermissionError):
        os.sched_setscheduler(0, os.SCHED_FIFO, os.sched_param(1))
    killed = time.monotonic_ns()
    os.kill(pid, signal.SIGKILL)
    os.sched_setscheduler(0, os.SCHED_OTHER, os.sched_param(0))
    return killed


def one(subsystem: Subsystem, original: str, standby: str) -> list[float]:
    """Kill a task; return what `NAMES` says, in periods."""
    status = {status.task: status for status in subsystem.status_all()}
    rings = {name: Ring.attach(status[name].ring) for name in (standby, "guard")}
    agent = subsystem.clients.call("bench0", Hello(), AgentInfo)
    core = rt.CoreTable(agent.core, member=False)
    try:
        time.sleep(random.uniform(0.01, 0.02))
        for ring in rings.values():
            ring.drain()
        since, _, _ = core.trace()
        slot = next(
            i for i in core.slots() if core.snapshot(i).task.split("/")[-1] == standby
        )
        killed = kill(status[original].tid)
        guard = records(rings["guard"], 0.25)
        turn, armed = engaged(core, slot, since)
        begun = records(rings[standby], 0.01)
        first = next(one.start_ns for one in begun if one.start_ns > killed)
        held = [one for one in guard if one.stable and one.start_ns > killed]
        stable = held[0].start_ns if held else float("nan")
        wait = held[0].release_ns - turn if held else float("nan")
        others = [one for one in guard if turn < one.start_ns < stable]
        times = [*(at - killed for at in (turn, armed, first, stable)), wait]
        return [*(ns / PERIOD for ns in times), float(len(held)), float(len(others))]
    finally:
        core.close()
        for ring in rings.values():
            ring.close()


def deaths(subsystem: Subsystem, count: int) -> list[list[float]]:
    """Kill so many tasks, each of which has a standby."""
    found: list[list[float]] = []
    for _ in range(count):
        subsystem.start("bench")
        end = time.monotonic() + 5.0
        while not subsystem.status("second").stands_by and time.monotonic() < end:
            time.sleep(0.01)
        found.append(one(subsystem, "first", "second"))
        subsystem.control("second", "kill")  # the next start spawns both anew
    return found


def goals(found: NDArray[np.float64]) -> list[str]:
    """Return one line for each goal: what was asked, what was measured."""
    late = float(np.quantile(found[:, FIRST], WITHIN))
    others = int(found[:, OTHERS].sum())
    return [
        f"- {100 * WITHIN:g} of 100 first cycles within 1 period: {late:.2f}, "
        + ("met" if late <= 1.0 else "NOT met"),
        f"- no cycle but `stable` behind the turn: {others}, "
        + ("NOT met" if others else "met"),
    ]


def main() -> None:
    """Measure and report; status 3 when a goal is missed."""
    parser = argparse.ArgumentParser(description="From a death to the fallback.")
    parser.add_argument("--deaths", type=int, default=100)
    parser.add_argument("--json", type=Path)
    args = parser.parse_args()
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        os.environ["PBONET_RUN_DIR"] = str(folder / "run")
        write_files(folder)
        with Embedded("default", libraries=[str(folder)]) as agents:
            agents.start(["bench0"])
            with Subsystem(
                folder / "b.sbs",
                libraries=[str(folder)],
                warned=lambda _text: None,
                record="off",
            ) as subsystem:
                found = np.array(deaths(subsystem, args.deaths))
    print(rtbench.machine())
    print(f"{args.deaths} deaths by SIGKILL, tasks of {RATE:.0f} Hz")
    print(f"periods of {PERIOD / 1e6:g} ms {'p50':>20} {'p90':>8} {'max':>8}")
    for key, values in zip(NAMES, found.T, strict=True):
        seen = np.asarray(values[~np.isnan(values)], np.float64)
        p50, p90 = (float(np.quantile(seen, share)) for share in (0.5, 0.9))
        missing = f"  ({len(values) - len(seen)} without)" * (len(seen) < len(values))
        print(f"  {key:32} {p50:8.2f} {p90:8.2f} {seen.max():8.2f}{missing}")
    lines = goals(found)
    if args.json:
        args.json.write_text(json.dumps(found.tolist()), encoding="utf-8")
    rtbench.judge(lines)


if __name__ == "__main__":
    main()
