"""Swaps between two machines: what a list that goes by messages costs.

Two agents, each with shared memory of its own, joined by a TCP link on the loopback: to
pbonet they are two machines. Two controllers of 1 kHz, one on each, take each other's
place again and again. No heir can be called from another machine, so the `on` follows
the answer to the `off` by a message; in between the variables keep their values, and
nobody writes them. When cycles began stands in the tasks' own rings.

    python -m benchmarks.swap_machines [--swaps 100] [--json FILE]
"""

from __future__ import annotations

import argparse
import json
import os
import signal
import socket
import tempfile
import time
from pathlib import Path
from typing import TYPE_CHECKING, Self

import numpy as np

from benchmarks import rtbench
from benchmarks.hosts import DOMAIN, SHM, Side, wait
from benchmarks.steering import wait_for_records
from benchmarks.swap import GAP, PERIOD, RATE, write_files
from pbonet.master import Subsystem
from pbonet.node._ring import Ring

if TYPE_CHECKING:
    from collections.abc import Iterator

NAMES = ("command to first cycle", GAP, "command to answer")


def free_port() -> int:
    """Return a port that nobody listens on."""
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        number: int = probe.getsockname()[1]
        return number


class Machines:
    """Two of them, from entering the block.

    Args:
        folder: For what is theirs.
    """

    def __init__(self, folder: Path) -> None:
        self.sides = [Side(name, folder, []) for name in ("one", "two")]

    def __enter__(self) -> Self:
        where = f"tcp/127.0.0.1:{free_port()}"
        for side, way in zip(self.sides, ("listen", "connect"), strict=True):
            side.start(**{way: where})
            wait(side.socket_there, f"agent {side.name}")
        return self

    def __exit__(self, *_: object) -> None:
        for side in self.sides:
            if side.agent is not None:
                side.agent.send_signal(signal.SIGTERM)
                side.agent.wait(30.0)

    def rings(self, subsystem: Subsystem) -> dict[str, Ring]:
        """Return the rings of tasks a, on the first one, and b, on the second."""
        found: dict[str, Ring] = {}
        for task, side in zip("ab", self.sides, strict=True):
            os.environ["PBONET_SHM_DIR"] = str(side.shm_dir)
            found[task] = Ring.attach(subsystem.status(task).ring)
        return found


def swaps(
    subsystem: Subsystem, rings: dict[str, Ring], count: int
) -> Iterator[tuple[float, ...]]:
    """Swap a and b again and again; yield what `NAMES` says, in periods."""
    wait_for_records(rings["a"])
    old, new = "a", "b"
    for _ in range(count):
        begun = time.monotonic_ns()
        subsystem.swap(old, new)
        answer = time.monotonic_ns()
        first = wait_for_records(rings[new])[0].start_ns
        last = wait_for_records(rings[old])[-1].start_ns
        yield tuple(ns / PERIOD for ns in (first - begun, first - last, answer - begun))
        old, new = new, old


def main() -> None:
    """Measure and report."""
    parser = argparse.ArgumentParser(description="Swaps between two machines.")
    parser.add_argument("--swaps", type=int, default=100)
    parser.add_argument("--json", type=Path)
    args = parser.parse_args()
    made = tempfile.TemporaryDirectory(prefix="pbench-", dir=SHM)
    with made as name, Machines(Path(name)) as machines:
        names = [side.name for side in machines.sides]
        sbs = write_files(Path(name), names)
        os.environ["PBONET_RUN_DIR"] = str(machines.sides[0].run_dir)
        connect = [machines.sides[0].socket]
        with Subsystem(
            sbs, domain=DOMAIN, connect=connect, warned=lambda _: None, record="off"
        ) as subsystem:
            for task, rtpu in zip("ab", names, strict=True):
                subsystem.spawn(task, rtpu)
            subsystem.control("a", "on")
            rings = machines.rings(subsystem)
            found = np.array(list(swaps(subsystem, rings, args.swaps)))
            for ring in rings.values():
                ring.close()
    print(rtbench.machine())
    print(f"{args.swaps} swaps between two machines, tasks of {RATE:.0f} Hz")
    print(f"periods of {PERIOD / 1e6:g} ms {'p50':>20} {'p90':>8} {'max':>8}")
    for key, values in zip(NAMES, found.T, strict=True):
        p50, p90 = np.quantile(values, [0.5, 0.9])
        print(f"  {key:28} {p50:8.2f} {p90:8.2f} {values.max():8.2f}")
    if args.json:
        args.json.write_text(json.dumps(found.tolist()), encoding="utf-8")


if __name__ == "__main__":
    main()
