"""Swaps between two machines: what who stays loses, and when the writer changes.

Two network namespaces with a cable between them, an agent on each with shared memory of
its own, and the clock that both share. A controller on the one machine and one on the
other take each other's place again and again (`Subsystem.swap`). What they write is
read by a task on each machine, so that on one of them it comes by the mirror. A
controller counts on from the value that it finds in its ``on``, and says who it is;
the readers write down whom they see, so that their records tell in which cycle a
machine had the new writer, whether the count ever went back, and whether the old
writer was ever seen again behind the new one.

What the readers miss is judged as in `benchmarks.swap`, with a C loop on each core. A
row of datagrams tells what the cable itself takes. Ends with status 3 when a goal is
missed.

    python -m benchmarks.swap_hosts [--swaps 300] [--hz 1000] [--json FILE]
"""

from __future__ import annotations

import argparse
import json
import os
import subprocess
import tempfile
import time
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from benchmarks import rtbench
from benchmarks.hosts import DOMAIN, SHM, Side, wait
from benchmarks.steering import VARIABLE, wait_for_records
from benchmarks.swap import (
    GAP,
    LOST,
    RATE,
    RMOD,
    STAY,
    Stalls,
    Trace,
    Watched,
    report,
)
from pbonet.master import Subsystem
from pbonet.node.ring._ring import Ring
from pbonet.testing.lan import Lan, missing
from pbonet.xm.net import session

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator

    from pbonet.node.ring._ring import Record

READERS: dict[str, str] = dict(zip(STAY, ("one", "two"), strict=True))
"""Of these each has one: the machine by the reader's name."""
WRITERS = ("a", "b")
SWAP_TIME = 0.06
"""Seconds that a swap takes, about: so much longer runs the time without swaps."""
SEEN = "last cycle to seen on {}"
WRONG = "wrong values"
BACK = "times that a reader saw the count go back"
JUMPS = "swaps in which the new one did not count on"
WRITER = '''\
"""Who writes in the benchmark of swaps between machines."""

from typing import Annotated as A

from pbonet import OutVar, Params, PortBasedObject, Vector, param


class Who(Params):
    """Who writes."""

    who: A[float, param("none", "a number")]


class Counting(PortBasedObject[Who]):
    """y = (the count that it found, going on, and who counts)."""

    y: A[Vector, OutVar("Y", "2", "none", "count, and who counts")]

    def cycle(self, dt: float) -> None:
        self.y[0] += 1.0
        self.y[1] = self.params.who
'''
READER = '''\
"""Who reads in the benchmark of swaps between machines."""

from typing import Annotated as A

from pbonet import InVar, OutVar, PortBasedObject, Vector


class Reading(PortBasedObject):
    """y = x."""

    x: A[Vector, InVar("X", "2", "none", "what is read")]
    y: A[Vector, OutVar("Y", "2", "none", "the same")]

    def cycle(self, dt: float) -> None:
        self.y[:] = self.x
'''

ECHO = """
import socket, sys
room = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
room.bind((sys.argv[1], 9))
while True:
    room.sendto(*room.recvfrom(64))
"""
PING = """
import socket, sys, time
way = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
way.settimeout(0.2)
way.connect((sys.argv[1], 9))
while True:
    begun = time.perf_counter()
    try:
        way.send(bytes(48))
        way.recv(64)
    except OSError:  # the other one has not begun
        time.sleep(0.01)
        continue
    print(time.perf_counter() - begun, flush=True)
    time.sleep(0.001)
"""
PORT = 7447
CABLE = "datagram there and back, ms"
ROUNDS = 1000
"""Of the datagrams."""


class Machines:
    """Two hosts with an agent each, on a core of its own where there are two.

    Args:
        lan: The hosts.
        folder: Where their own folders are made; has the library.
    """

    def __init__(self, lan: Lan, folder: Path) -> None:
        cores = sorted(os.sched_getaffinity(0))
        self.cores = {"one": cores[0], "two": cores[-1]}
        self.sides = [
            Side(name, folder, lan[host].command())
            for name, host in zip(self.cores, ("a", "b"), strict=True)
        ]
        try:
            self._start(lan, cores, str(folder))
        except BaseException:
            self.close()
            raise

    def _start(self, lan: Lan, cores: list[int], library: str) -> None:
        """Start the agents, and wait until each sees the other."""
        one, two = self.sides
        one.start(listen=f"tcp/0.0.0.0:{PORT}", library=library, core=cores[0])
        way = f"tcp/{lan['a'].address('b')}:{PORT}"
        two.start(connect=way, library=library, core=cores[-1])
        for side in self.sides:
            wait(side.socket_there, f"agent {side.name}")
        with session.client(DOMAIN, connect=[one.socket], local=False) as link:
            wait(lambda: len(session.rtpus(link, DOMAIN)) == len(self.sides), "both")

    def enter(self, number: int) -> None:
        """Have shared memory be that of one of the two from here on."""
        os.environ["PBONET_SHM_DIR"] = str(self.sides[number].shm_dir)

    def close(self) -> None:
        """End the agents."""
        for side in self.sides:
            side.end()


class Apart(Watched):
    """What the readers miss, each on its own machine.

    Args:
        machines: Where they are.
        folder: For the loop's program.
    """

    def __init__(self, machines: Machines, folder: Path) -> None:
        self._cores: list[tuple[Stalls, Trace]] = []
        for number, core in enumerate(machines.cores.values()):
            machines.enter(number)
            self._cores.append((Stalls(folder, core), Trace(core, STAY)))


class Seen:
    """What a reader has written down.

    Args:
        ring: Its records.
    """

    def __init__(self, ring: Ring) -> None:
        self._ring = ring
        self._last = 0.0
        self.back = 0
        """Times that it saw the count go back, as when it sees who has left."""

    def first(self, who: float, seconds: float = 5.0) -> int:
        """Return when the first cycle began that saw who writes."""
        end = time.monotonic() + seconds
        while time.monotonic() < end:
            begun = [start for start, one in self.take() if one == who]
            if begun:
                return begun[0]
            time.sleep(0.001)
        raise TimeoutError(f"nobody saw {who:g} within {seconds} s")

    def take(self) -> list[tuple[int, float]]:
        """Return what has come: when the cycle began, and who counted."""
        found: list[tuple[int, float]] = []
        for one in self._ring.drain():
            if not one.kind:
                count, who = map(float, np.frombuffer(one.data, float, 2))
                self.back += count < self._last
                self._last = count
                found.append((one.start_ns, who))
        return found


def write_files(folder: Path, hz: float) -> Path:
    """Write modules and subsystem, of writers of `hz`; return its ``.sbs`` file."""
    names = ("Y", *(f"SEEN_{name}" for name in READERS))
    variables = [
        VARIABLE.format(name=name, kind="double", units="none", nelem=2)
        for name in names
    ]
    common = {"rate": hz, "invar": "none"}
    files = {
        "counting.py": WRITER,
        "reading.py": READER,
        "b.svar": "\n".join(variables) + "\nEOF\n",
        "b.sbs": "SUBSYSTEM b\nSVARFILE b.svar\nRTPU one\nRTPU two\nEOF\n",
    }
    for who, name in enumerate(WRITERS, 1):
        files[f"{name}.rmod"] = RMOD.format(
            module="counting", aliases="", outvar="Y", local=f"LOCAL\nWHO {who}",
            **common,
        ).replace("INCONST   NDOF", "INCONST   none")  # fmt: skip
    for name in READERS:
        files[f"{name}.rmod"] = RMOD.format(
            module="reading", aliases=f"SVARALIAS X=Y\nSVARALIAS Y=SEEN_{name}",
            outvar="Y", local="", rate=RATE, invar="X",
        ).replace("INCONST   NDOF", "INCONST   none")  # fmt: skip
    for name, text in files.items():
        (folder / name).write_text(text, encoding="utf-8")
    return folder / "b.sbs"


def start(subsystem: Subsystem) -> None:
    """Have a and both readers run, and b stand by."""
    where = dict(zip(WRITERS, ("one", "two"), strict=True)) | READERS
    for task, rtpu in where.items():
        subsystem.spawn(task, rtpu)
    subsystem.reconfig([("a", "on"), *((task, "on") for task in READERS)])
    subsystem.wait(0.5)


def undisturbed(subsystem: Subsystem, watched: Apart, seconds: float) -> dict[str, int]:
    """Return the counts of a time without swaps."""
    end = time.monotonic() + seconds
    while time.monotonic() < end:
        subsystem.wait(0.2)
        watched.look()
    return watched.end()


def rings_of(subsystem: Subsystem, machines: Machines) -> dict[str, Ring]:
    """Return the tasks' records, each opened where its task is."""
    found: dict[str, Ring] = {}
    for one in subsystem.status_all():
        machines.enter([*machines.cores].index(one.rtpu))
        found[one.task] = Ring.attach(one.ring)
    return found


def swaps(
    subsystem: Subsystem, machines: Machines, make: Callable[[], Apart], count: int
) -> tuple[dict[str, Any], dict[str, list[int]]]:
    """Swap a and b again and again; return counts, and times in ns."""
    rings = rings_of(subsystem, machines)
    readers = {name: Seen(rings[name]) for name in READERS}
    wait_for_records(rings["a"])
    watched = make()
    times: dict[str, list[int]] = {}
    steps: list[float] = []
    old, new = WRITERS
    try:
        for _ in range(count):
            watched.look()
            for reader in readers.values():
                reader.take()
            begun = time.monotonic_ns()
            subsystem.swap(old, new)
            answered = time.monotonic_ns()
            begins = wait_for_records(rings[new])[0]
            last = wait_for_records(rings[old])[-1]
            who = WRITERS.index(new) + 1.0
            steps.append(counted(begins) - counted(last))
            taken = {
                "command to first cycle": begins.start_ns - begun,
                GAP: begins.start_ns - last.start_ns,
                **{SEEN.format(READERS[name]): one.first(who) - last.start_ns
                   for name, one in readers.items()},
                "command to answer": answered - begun,
            }  # fmt: skip
            for name, ns in taken.items():
                times.setdefault(name, []).append(ns)
            old, new = new, old
    finally:
        counts = watched.end()
        for ring in rings.values():
            ring.close()
    subsystem.reconfig([(task, "off") for task in (old, *READERS)])
    wrong = {
        BACK: sum(reader.back for reader in readers.values()),
        JUMPS: sum(step != 1.0 for step in steps),
    }
    return {**counts, WRONG: wrong}, times


def counted(record: Record) -> float:
    """Return the count that a writer committed."""
    return float(np.frombuffer(record.data, float, 2)[0])


def ping(machines: Machines, lan: Lan) -> dict[str, float]:
    """Return what a datagram takes from one machine to the other and back, in ms."""
    one, two = machines.sides
    echo = two.run(ECHO, lan["b"].address("a"))
    asker = one.run(PING, lan["b"].address("a"), stdout=subprocess.PIPE)
    assert asker.stdout is not None
    try:
        taken = [1e3 * float(asker.stdout.readline()) for _ in range(ROUNDS)]
    finally:
        for process in (asker, echo):
            process.kill()
            process.wait()
        asker.stdout.close()
    p50, p99 = np.quantile(taken, [0.5, 0.99])
    return {"p50": float(p50), "p99": float(p99)}


def goals(found: dict[str, Any], cable: dict[str, float], hz: float) -> Iterator[str]:
    """Yield a line for each goal."""
    yield rtbench.verdict("cycles that readers lose, but for stalls,", found[LOST], 0)
    for what, count in found[WRONG].items():
        yield rtbench.verdict(f"{what},", count, 0)
    most = 2 + cable["p50"] / 2 / (1e3 / hz)
    for name in (GAP, *(SEEN.format(READERS[name]) for name in READERS)):
        gap = float(np.median(np.asarray(found[name], np.float64)))
        yield rtbench.verdict(f"periods from {name}, median,", gap, most)


def measure(folder: Path, lan: Lan, count: int, hz: float) -> dict[str, Any]:
    """Run everything; return what was found."""
    os.environ["PBONET_RUN_DIR"] = str(folder / "run")
    sbs = write_files(folder, hz)
    machines = Machines(lan, folder)
    try:
        found: dict[str, Any] = {CABLE: ping(machines, lan)}
        with Subsystem(
            sbs, domain=DOMAIN, connect=[machines.sides[0].socket], libraries=[folder],
            warned=lambda _text: None, record="off",
        ) as subsystem:  # fmt: skip
            start(subsystem)
            make = partial(Apart, machines, folder)
            quiet = undisturbed(subsystem, make(), count * SWAP_TIME)
            counts, times = swaps(subsystem, machines, make, count)
    finally:
        machines.close()
    periods = {name: [ns * hz / 1e9 for ns in many] for name, many in times.items()}
    return {**found, **counts, **periods, "without swaps": quiet}


def main() -> None:
    """Measure and report; status 3 when a goal is missed."""
    parser = argparse.ArgumentParser(description="Swaps between two machines.")
    parser.add_argument("--swaps", type=int, default=300)
    parser.add_argument("--hz", type=float, default=RATE, help="of the writers")
    parser.add_argument("--json", type=Path)
    args = parser.parse_args()
    if reason := missing():
        print(f"skipped: {reason}")
        return
    lan = Lan()
    try:
        with tempfile.TemporaryDirectory(prefix="pbench-", dir=SHM) as name:
            found = measure(Path(name), lan, args.swaps, args.hz)
    finally:
        lan.close()
    quiet, cable = found["without swaps"], found[CABLE]
    aside = {"without swaps", CABLE, WRONG}
    print(rtbench.machine())
    print(
        f"{args.swaps} swaps between two machines, {args.hz:g} Hz; "
        f"a reader of {RATE:g} Hz on each:"
    )
    shown = {key: value for key, value in found.items() if key not in aside}
    print("\n".join(report(quiet, shown, 1e9 / args.hz)))
    print(f"{CABLE}: median {cable['p50']:.3f}, p99 {cable['p99']:.3f}")
    if args.json:
        args.json.write_text(json.dumps(found, indent=1), encoding="utf-8")
    rtbench.judge(goals(found, cable, args.hz))


if __name__ == "__main__":
    main()
