"""Faults between machines, judged by the robot's own record.

Three network namespaces with a cable between any two, and clocks hours apart: a source
on a writes the time, a controller on b passes it on with its own time, and a robot
interface on c (500 Hz, CRITICAL, MAXAGE 0.05) writes down each cycle: when it was, what
it acted on, and whether it was `cycle` or `stable`. All hosts share the clock by which
they write (CLOCK_TAI), and tasks are judged by their monotonic clocks, which differ.
Their wall clocks are set by `wall_clock.c`.

A row is a kind of fault, repeated: cuts of several lengths, in one direction or both,
random loss, the wall clock of a running machine set by an hour, an agent, an RTPU
process or a machine killed, a machine that comes back with its clock an hour ahead. It
shows the oldest command and the oldest sample of the source that `cycle` acted on, when
`stable` came first, how much longer than the cut nothing was controlled, and how long
after the end of the fault all was well. For cables that carry too little it shows how
often `cycle` and `stable` took turns. Then b is cut off, and `status` and `stop` are
asked on a: what they said, and what was so.

Ends with status 3 when a goal is missed.

    python -m benchmarks.faults [--cuts 50] [--random 200] [--json FILE] [--quick]
"""

from __future__ import annotations

import argparse
import contextlib
import json
import math
import os
import random
import signal
import subprocess
import sys
import tempfile
import time
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np

from benchmarks import rtbench
from benchmarks.hosts import DOMAIN, SHM, Side, wait
from benchmarks.steering import VARIABLE
from pbonet.errors import PbonetError
from pbonet.master import Subsystem
from pbonet.node.ring._ring import Ring
from pbonet.testing.lan import Lan, missing
from pbonet.xm.net import messages as m, session
from pbonet.xm.net.rpc import Client

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator

CLOCKS = {"b": 3600.0, "c": 7200.0}
"""By host, by how many seconds its clock is ahead of that of a."""
HOSTS: dict[str, str] = dict(zip(("one", "two", "three"), "abc", strict=True))
"""By agent."""
TASKS = {"source": "one", "control": "two", "robot": "three"}
MAXAGE = 0.05
STALL = 0.02
"""Seconds between a copy-in and `cycle`, for which a machine may stand still."""
LENGTHS = (0.05, 0.2, 0.5, 1.0)
RATES = (50e3, 100e3, 150e3)
"""Bytes a second of a narrow cable; the controller's table needs about 120 kB/s."""
NARROW_TIME = 6.0
MOST_CHANGES = 2.0
"""Goal: changes between `cycle` and `stable` a second, on a narrow cable."""
WELL = 0.3
"""Seconds without `stable` after which all is well."""
LIMIT = 30.0
PORT = 7447
STEP = 3600.0
"""Seconds by which wall clocks are set."""
MODULE = '''\
"""A part of the benchmark of faults."""

import time
from typing import Annotated as A

from pbonet import InVar, OutVar, PortBasedObject, Vector


class {name}(PortBasedObject):
    """y = (the source's time, the controller's, the robot's, 1 in stable)."""

{port}    y: A[Vector, OutVar("Y", "4", "none", "three times in s, and where")]

    def cycle(self, dt: float) -> None:
        {copy}
        self.y[{mine}] = time.clock_gettime(time.CLOCK_TAI)

    def stable(self, dt: float) -> None:
        {copy}
        self.y[{mine}] = time.clock_gettime(time.CLOCK_TAI)
        self.y[3] = 1.0
'''
IN = '    x: A[Vector, InVar("X", "4", "none", "the same of the one before")]\n'
RMOD = """\
MODULE {module}
DESC of the benchmark
{aliases}
INCONST none
OUTCONST none
INVAR {invar}
OUTVAR Y
TASKTYPE periodic
FREQ 500
{critical}
EOF
"""


class Cycles(NamedTuple):
    """What the robot has written down, a row each cycle."""

    source: np.ndarray
    command: np.ndarray
    now: np.ndarray
    stable: np.ndarray


def now() -> float:
    """Return the time by which all hosts write, in seconds."""
    return time.clock_gettime(time.CLOCK_TAI)


class Outcome(NamedTuple):
    """What one fault did; in seconds."""

    command: float
    """Age of the oldest command that `cycle` acted on."""
    source: float
    """The same of the source's sample."""
    stable: float
    """From the fault to the first `stable`; nan: none."""
    hole: float
    """By how much longer than the fault no new sample was acted on."""
    heal: float
    """From the end of the fault until the last `stable`."""


class Robot:
    """The robot's record.

    Args:
        ring: Of its task.
    """

    def __init__(self, ring: Ring) -> None:
        self._ring = ring
        self._rows: list[np.ndarray] = []

    def take(self) -> np.ndarray:
        """Return the rows that have come since the last call of `reset`."""
        for one in self._ring.drain():
            if len(one.data) == 32 and not one.lost:
                self._rows.append(np.frombuffer(one.data, float))
        return np.array(self._rows).reshape(-1, 4)

    def reset(self) -> None:
        """Forget the rows."""
        self.take()
        self._rows.clear()

    def is_well(self, since: float) -> bool:
        """Return whether only `cycle` ran for a while, and acts on new commands."""
        rows, at = self.take(), now()
        late = rows[rows[:, 2] > max(at - WELL, since)]
        enough = len(late) and late[-1, 2] - late[0, 2] > WELL * 0.8
        return bool(enough) and not late[:, 3].any() and late[-1, 1] > at - WELL


def outcome(rows: np.ndarray, begin: float, end: float) -> Outcome:
    """Judge a fault by the robot's rows around it."""
    cycles = Cycles(*rows.T)
    acted = cycles.stable == 0.0
    ages = cycles.now - cycles.command
    sources = cycles.now - cycles.source
    stable = cycles.now[(~acted) & (cycles.now > begin)]
    new = acted & (np.diff(cycles.source, prepend=0.0) > 0.0)
    times = cycles.now[new]
    gaps = np.diff(times)
    return Outcome(
        float(ages[acted].max()),
        float(sources[acted].max()),
        float(stable[0] - begin) if len(stable) else float("nan"),
        float(max(gaps.max() - (end - begin), 0.0)),
        float(max(stable[-1] - end, 0.0)) if len(stable) else 0.0,
    )


class Cell:
    """The three machines with their tasks.

    Args:
        folder: Where everything is; has the library.
    """

    def __init__(self, folder: Path) -> None:
        self._folder = folder
        self.lan = Lan(dict(CLOCKS))
        self.sides: dict[str, Side] = {}
        self._subsystem: Subsystem | None = None
        self._robot: Robot | None = None
        try:
            library = build_wall_clock(folder)
            for name, host in HOSTS.items():
                side = self.sides[name] = Side(name, folder, self.lan[host].command())
                self.set_wall_clock(name, 0.0)
                file = self._wall_clock(name)
                side.more = {"LD_PRELOAD": str(library), "WALL_CLOCK": str(file)}
            self._prove_wall_clocks()
            for name in HOSTS:
                self.start(name)
            self.sbs = write_files(folder)
            self.assemble()
        except BaseException:
            self.close()
            raise

    def start(self, name: str) -> None:
        """Start the agent of a machine, and wait until all see it."""
        host, lan, side = HOSTS[name], self.lan, self.sides[name]
        side.inside = lan[host].command()
        dialled = [other for other in HOSTS.values() if other < host]
        connect = [f"tcp/{lan[one].address(host)}:{PORT}" for one in dialled]
        cores = sorted(os.sched_getaffinity(0))
        side.start(
            *(f"tcp/0.0.0.0:{PORT}", connect, str(self._folder)),
            cores[list(HOSTS).index(name) % len(cores)],
        )
        wait(side.socket_there, f"agent {name}")

    def _wall_clock(self, name: str) -> Path:
        return self._folder / f"{name}.wall"

    def set_wall_clock(self, name: str, ahead: float) -> None:
        """Set the wall clock of a machine, in seconds ahead of the true time."""
        file = self._wall_clock(name)
        with file.open("r+b" if file.exists() else "wb") as opened:
            opened.write(round(ahead * 1e9).to_bytes(8, sys.byteorder, signed=True))

    def _prove_wall_clocks(self) -> None:
        """Make sure that a machine's processes have the clock that was set."""
        code = "import time; print(time.time() - time.clock_gettime(time.CLOCK_TAI))"
        for ahead in (STEP, 0.0):
            self.set_wall_clock("two", ahead)
            side = self.sides["two"]
            said = subprocess.check_output(
                [*side.inside, sys.executable, "-c", code], env=side.environment
            )
            apart = float(said) - (time.time() - now())
            assert abs(apart - ahead) < 1.0, f"wall clock {apart} s, and not {ahead}"

    def assemble(self) -> None:
        """Have all tasks run, as soon as it can be; those that run already stay."""
        wait(partial(self.all_seen, "one"), "all agents", LIMIT)
        wait(self._try_to_assemble, "all tasks", LIMIT)
        begun = now()
        wait(lambda: self.robot.is_well(begun), "the robot's cycles", LIMIT)

    def _try_to_assemble(self) -> bool:
        try:
            self._assemble()
        except PbonetError:  # something is being started again
            time.sleep(0.05)
            return False
        return True

    def _assemble(self) -> None:
        self.leave()
        master = Subsystem(
            self.sbs, domain=DOMAIN, connect=[self.sides["one"].socket],
            libraries=[self._folder], warned=lambda _text: None, record="off",
        )  # fmt: skip
        self._subsystem = master.__enter__()
        states = {one.task: one.state for one in master.status_all()}
        for task, rtpu in TASKS.items():
            if states.get(task) in {None, "NOT-CREATED", "ERROR"}:
                with contextlib.suppress(PbonetError):
                    master.control(task, "kill")
                master.spawn(task, rtpu)
        states = {one.task: one.state for one in master.status_all()}
        wanted = [(task, "on") for task in TASKS if states[task] != "ON"]
        if wanted:
            master.reconfig(wanted)
        if self._robot is None:  # no fault ends it
            (ring,) = [one.ring for one in master.status_all() if one.task == "robot"]
            os.environ["PBONET_SHM_DIR"] = str(self.sides["three"].shm_dir)
            self._robot = Robot(Ring.attach(ring))

    @property
    def robot(self) -> Robot:
        """The robot's record."""
        assert self._robot is not None
        return self._robot

    def leave(self) -> None:
        """Have no master; the tasks go on."""
        if self._subsystem is not None:
            with contextlib.suppress(PbonetError):
                self._subsystem.detach()
            self._subsystem = None

    def all_seen(self, name: str) -> bool:
        """Return whether the agent of a machine sees all others."""
        with session.client(
            DOMAIN, connect=[self.sides[name].socket], local=False
        ) as link:
            return len(session.rtpus(link, DOMAIN)) == len(HOSTS)

    def states(self, name: str) -> dict[str, str]:
        """Return the states of the tasks on a machine, asked there."""
        side = self.sides[name]
        with session.client(DOMAIN, connect=[side.socket], local=False) as link:
            found = Client(link, DOMAIN, "faults").call(
                name, m.Status(subsystem="faults"), m.RtpuStatus
            )
        return {task.task: task.state for task in found.tasks}

    def processes(self, name: str) -> list[int]:
        """Return a machine's processes."""
        wanted = f"PBONET_RUN_DIR={self.sides[name].run_dir}".encode()
        found: list[int] = []
        for entry in Path("/proc").iterdir():
            with contextlib.suppress(OSError, ValueError):
                environment = (entry / "environ").read_bytes().split(b"\0")
                if wanted in environment and int(entry.name) != os.getpid():
                    found.append(int(entry.name))
        return found

    def verb(self, *words: str) -> tuple[int, str]:
        """Run a verb of the command line on a; return its status and its words."""
        side = self.sides["one"]
        done = subprocess.run(
            [*side.inside, sys.executable, "-m", "pbonet.cli", *words,
             "--domain", DOMAIN],
            env=side.environment, capture_output=True, text=True, check=False,
            timeout=LIMIT,
        )  # fmt: skip
        return done.returncode, (done.stdout + done.stderr).strip()

    def close(self) -> None:
        """End everything."""
        self.leave()
        agents = [side.agent for side in self.sides.values() if side.agent is not None]
        for agent in agents:
            agent.terminate()
        for agent in agents:
            agent.wait(LIMIT)
        self.lan.close()


def build_wall_clock(folder: Path) -> Path:
    """Build the library that sets wall clocks; return its file."""
    made, source = folder / "wall_clock.so", Path(__file__).with_name("wall_clock.c")
    command = ["cc", "-O2", "-shared", "-fPIC", "-o", str(made), str(source), "-ldl"]
    subprocess.run(command, check=True)
    return made


def write_files(folder: Path) -> Path:
    """Write modules and subsystem; return its ``.sbs`` file."""
    before = dict(zip(TASKS, ("", "S", "U"), strict=True))
    written = dict(zip(TASKS, ("S", "U", "Y"), strict=True))
    files = {
        "faults.svar": "\n".join(
            VARIABLE.format(name=name, kind="double", units="none", nelem=4)
            + f"MAXAGE {MAXAGE}\n" * (name != "Y")
            for name in written.values()
        )
        + "\nEOF\n",
        "faults.sbs": "SUBSYSTEM faults\nSVARFILE faults.svar\n"
        + "".join(f"RTPU {name}\n" for name in HOSTS)
        + "EOF\n",
    }
    for number, (task, read) in enumerate(before.items()):
        aliases = [f"SVARALIAS X={read}"] * bool(read) + [
            f"SVARALIAS Y={written[task]}"
        ]
        files[f"{task}.py"] = MODULE.format(
            name=task.capitalize(), port=IN if read else "", mine=number,
            copy="self.y[:3] = self.x[:3]; self.y[3] = 0.0" if read else "pass",
        )  # fmt: skip
        files[f"{task}.rmod"] = RMOD.format(
            module=task, aliases="\n".join(aliases), invar="X" if read else "none",
            critical="CRITICAL yes" if task == "robot" else "",
        )  # fmt: skip
    for name, text in files.items():
        (folder / name).write_text(text, encoding="utf-8")
    return folder / "faults.sbs"


# -- the faults ------------------------------------------------------------------------


def both(lan: Lan, one: str, other: str, share: float = 1.0) -> None:
    """Lose packets in both directions."""
    lan.lose(one, other, share)
    lan.lose(other, one, share)


def interruption(
    cell: Cell, part: Callable[[Lan], None], hosts: str, seconds: float
) -> Outcome:
    """Interrupt a cable for a time."""
    cell.robot.reset()
    time.sleep(0.2)
    begin = now()
    part(cell.lan)
    time.sleep(max(begin + seconds - now(), 0.0))
    end = now()
    cell.lan.heal(*hosts)
    wait(lambda: cell.robot.is_well(end), "healing", LIMIT)
    return outcome(cell.robot.take(), begin, end)


def cuts(count: int) -> Iterator[tuple[str, Callable[[Cell], Outcome], int]]:
    """Yield interruptions: a name, what to do, and how often."""
    directions: dict[str, tuple[Callable[[Lan], None], str]] = {
        "b - c": (partial(both, one="b", other="c"), "bc"),
        "b to c": (partial(Lan.lose, sender="b", receiver="c"), "bc"),
        "c to b": (partial(Lan.lose, sender="c", receiver="b"), "bc"),
        "a - b": (partial(both, one="a", other="b"), "ab"),
        "b - c, cable pulled": (partial(Lan.cut, one="b", other="c"), "bc"),
    }
    for name, (part, hosts) in directions.items():
        for seconds in LENGTHS:
            what = partial(interruption, part=part, hosts=hosts, seconds=seconds)
            few = count if name == "b - c" else max(count // 5, 1)
            yield f"cut {seconds * 1e3:.0f} ms, {name}", what, few


def lossy(cell: Cell, chance: random.Random) -> Outcome:
    """Cut a cable that loses 20 % of what is sent, before and after the cut."""
    both(cell.lan, "b", "c", 0.2)
    time.sleep(0.1)
    cell.robot.reset()
    begin = now()
    for sender, receiver in ("bc", "cb"):
        cell.lan.lose(sender, receiver)
    time.sleep(chance.uniform(0.02, 0.4))
    end = now()
    for sender, receiver in ("bc", "cb"):
        cell.lan.lose(sender, receiver, 0.2)
    time.sleep(0.3)
    cell.lan.heal("b", "c")
    wait(lambda: cell.robot.is_well(end), "healing", LIMIT)
    return outcome(cell.robot.take(), begin, end)


def narrow(cell: Cell, rate: float) -> dict[str, float]:
    """Let the cable before the robot carry little for a time; return what it did."""
    cell.robot.reset()
    begin = now()
    cell.lan.narrow("b", "c", rate)
    time.sleep(NARROW_TIME)
    end = now()
    cell.lan.narrow("b", "c", math.inf)
    rows = cell.robot.take()
    wait(lambda: cell.robot.is_well(end), "healing", LIMIT)
    cycles = Cycles(*rows[(rows[:, 2] > begin) & (rows[:, 2] < end)].T)
    acted = cycles.stable == 0.0
    ages = (cycles.now - cycles.command)[acted]
    return {
        "rate": rate,
        "changes": float(np.count_nonzero(np.diff(cycles.stable))) / NARROW_TIME,
        "stable": float(1.0 - acted.mean()),
        "command": float(ages.max(initial=0.0)),
    }


def stepped(cell: Cell, name: str, ahead: float) -> Outcome:
    """Set the wall clock of a machine that runs, and set it right again."""
    cell.robot.reset()
    time.sleep(0.2)
    begin = now()
    cell.set_wall_clock(name, ahead)
    time.sleep(0.7)
    cell.set_wall_clock(name, 0.0)
    end = now()
    wait(lambda: cell.robot.is_well(end), "cycles", LIMIT)
    return outcome(cell.robot.take(), begin, begin)


def steps(count: int) -> Iterator[tuple[str, Callable[[Cell], Outcome], int]]:
    """Yield steps of wall clocks, as `cuts`, and first what happens without any."""
    yield "nothing", partial(stepped, name="two", ahead=0.0), 2 * count
    for name, host in HOSTS.items():
        for ahead in (STEP, -STEP):
            what = partial(stepped, name=name, ahead=ahead)
            yield f"wall clock of {host} {ahead / 3600:+.0f} h", what, count


def killed(cell: Cell, what: str) -> Outcome:
    """Kill a part of b, and bring it back."""
    side = cell.sides["two"]
    assert side.agent is not None
    cell.robot.reset()
    time.sleep(0.2)
    with session.client(DOMAIN, connect=[side.socket], local=False) as link:
        info = Client(link, DOMAIN, "faults").call("two", m.Hello(), m.AgentInfo)
    victims = {
        "agent": [side.agent.pid],
        "RTPU process": [info.rtpu_pid],
        "machine": cell.processes("two"),
        "machine, clock": cell.processes("two"),
    }[what]
    begin = now()
    for pid in victims:
        with contextlib.suppress(OSError):
            os.kill(pid, signal.SIGKILL)
    if what != "RTPU process":
        side.agent.wait(LIMIT)
    if what.endswith("clock"):
        cell.lan["b"].ahead += 3600.0
    time.sleep(0.5)
    end = now()
    if what != "RTPU process":
        cell.start("two")
    robot = cell.robot
    cell.assemble()
    return outcome(robot.take(), begin, end)


def stopping(cell: Cell) -> list[dict[str, Any]]:
    """Cut b off; return what `status` and `stop` said on a, and what was so."""
    for host in "ac":
        both(cell.lan, host, "b")
    time.sleep(0.6)
    found: list[dict[str, Any]] = []
    for words in (("status", str(cell.sbs)), ("stop", "faults")):
        begun = now()
        status, said = cell.verb(*words)
        found.append({
            "verb": f"{words[0]}, b cut off", "status": status, "said": said,
            "seconds": now() - begun, "so": every_state(cell),
        })  # fmt: skip
    for host in "ac":
        cell.lan.heal(host, "b")
    wait(partial(cell.all_seen, "one"), "all agents", LIMIT)
    time.sleep(2.0)
    status, said = cell.verb("status", str(cell.sbs))
    found.append({
        "verb": "status, healed", "status": status, "said": said, "seconds": 0.0,
        "so": every_state(cell),
    })  # fmt: skip
    return found


def every_state(cell: Cell) -> dict[str, str]:
    """Return the state of every task, asked on its own machine."""
    found: dict[str, str] = {}
    for name in HOSTS:
        try:
            found |= cell.states(name)
        except PbonetError as error:
            found[name] = str(error)
    return found


# -- the report ------------------------------------------------------------------------


def row(name: str, many: list[Outcome]) -> str:
    """Return a line of the table."""

    def both_of(values: list[float]) -> str:
        known = [1e3 * one for one in values if one == one]  # noqa: PLR0124 - not nan
        if not known:
            return f"{'-':>15}"
        p90 = float(np.quantile(known, 0.9))
        return f"{np.median(known):>5.0f}{p90:>5.0f}{max(known):>5.0f}"

    fields = zip(*many, strict=True)
    return f"{name:<32}{len(many):>4} " + " ".join(both_of(list(f)) for f in fields)


def goals(found: dict[str, list[Outcome]]) -> Iterator[str]:
    """Yield a line for each goal."""
    oldest = max(one.command for many in found.values() for one in many)
    yield rtbench.verdict(
        "oldest command that a cycle acted on, s,", oldest, MAXAGE + STALL
    )
    for name, many in found.items():
        if name.endswith("ms, b - c"):
            p90 = float(np.quantile([one.hole for one in many], 0.9))
            yield rtbench.verdict(f"{name}: hole beyond the cut, p90, s,", p90, 0.15)
    holes = [o.hole for name, many in found.items() if "wall" in name for o in many]
    middle = float(np.median(holes))
    yield rtbench.verdict("wall clock set: hole, median, s,", middle, MAXAGE)


def narrow_goals(found: list[dict[str, float]]) -> Iterator[str]:
    """Print what narrow cables did, and yield a line for each goal."""
    for one in found:
        print(
            f"cable of {one['rate'] / 1e3:.0f} kB/s, b - c: {one['changes']:.1f} "
            f"changes between cycle and stable a second, {one['stable']:.0%} stable, "
            f"oldest command {1e3 * one['command']:.0f} ms"
        )
    most = max(one["changes"] for one in found)
    yield rtbench.verdict("narrow cable: changes a second", most, MOST_CHANGES)
    oldest = max(one["command"] for one in found)
    yield rtbench.verdict("narrow cable: oldest command, s,", oldest, MAXAGE + STALL)


def measure(cell: Cell, count: int, randoms: int, seed: int) -> dict[str, Any]:
    """Run the table, and print it as it grows."""
    found: dict[str, list[Outcome]] = {}
    chance = random.Random(seed)

    def add(name: str, what: Callable[[Cell], Outcome], times: int) -> None:
        many = found.setdefault(name, [])
        for _ in range(times):
            many.append(what(cell))
            time.sleep(chance.uniform(0.0, 0.1))
        print(row(name, many), flush=True)

    columns = (
        "oldest command",
        "oldest sample",
        "to stable",
        "hole - cut",
        "healed in",
    )
    heads = " ".join(f"{name:>15}" for name in columns)
    print(f"{'milliseconds: median, p90, max':<32}     {heads}")
    for name, what, times in (*cuts(count), *steps(max(count // 5, 1))):
        add(name, what, times)
    add("cut 20-400 ms, 20 % loss, b - c", partial(lossy, chance=chance), randoms)
    cables = [narrow(cell, rate) for rate in RATES]
    for part in ("agent", "RTPU process", "machine", "machine, clock"):
        add(f"{part} of b killed", partial(killed, what=part), max(count // 10, 1))
    said = stopping(cell)
    for one in said:
        print(
            f"\n{one['verb']}: status {one['status']} in {one['seconds']:.1f} s; "
            "it was "
            + ", ".join(f"{task} {state}" for task, state in one["so"].items())
        )
        print("    " + one["said"].replace("\n", "\n    "))
    return {"rows": found, "cables": cables, "said": said}


def main() -> None:
    """Measure and report; status 3 when a goal is missed."""
    parser = argparse.ArgumentParser(description="Faults between machines.")
    parser.add_argument("--cuts", type=int, default=50, help="of each length")
    parser.add_argument("--random", type=int, default=200, help="cuts with loss")
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--quick", action="store_true", help="each fault once")
    parser.add_argument("--json", type=Path)
    args = parser.parse_args()
    if reason := missing():
        print(f"skipped: {reason}")
        return
    count, randoms = (1, 1) if args.quick else (args.cuts, args.random)
    print(rtbench.machine())
    with tempfile.TemporaryDirectory(prefix="pbench-", dir=SHM) as name:
        os.environ["PBONET_RUN_DIR"] = str(Path(name) / "run")
        cell = Cell(Path(name))
        try:
            found = measure(cell, count, randoms, args.seed)
        finally:
            cell.close()
    if args.json:
        rows = {k: [o._asdict() for o in many] for k, many in found["rows"].items()}
        text = json.dumps({**found, "rows": rows}, indent=1)
        args.json.write_text(text, encoding="utf-8")
    rtbench.judge([*goals(found["rows"]), *narrow_goals(found["cables"])])


if __name__ == "__main__":
    main()
