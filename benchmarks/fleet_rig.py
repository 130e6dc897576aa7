"""Many machines on one: routers, agents with folders of their own, bare sessions."""

from __future__ import annotations

import contextlib
import json
import os
import signal
import socket
import subprocess
import sys
import tempfile
import time
from pathlib import Path
from typing import TYPE_CHECKING, Any

from pbonet.errors import UnreachableError
from pbonet.xm.net import session

if TYPE_CHECKING:
    from collections.abc import Callable, Iterable, Sequence

SHM = Path("/dev/shm")  # noqa: S108 - where shared memory is
DOMAIN = "scale"
SETTLE = 300.0
"""Seconds after which something that was waited for counts as failed."""
BATCH = 2
"""Agents that are started together; a machine of two cores starts no more in time."""
CPU_CLOCK = 2
"""CPUCLOCK_SCHED: which of a process's clocks."""
HOLDER = """
import json, sys, threading, zenoh
told = json.loads(sys.argv[1])
kept, over = [], threading.Event()
for name, group in told["sessions"]:
    routers = told["routers"][group % len(told["routers"]):] + told["routers"]
    settings = dict(told["settings"], connect=dict(
        told["settings"]["connect"], endpoints=routers))
    link = zenoh.open(zenoh.Config.from_json5(json.dumps(settings)))
    key = f"pbonet/{told['domain']}/rtpu/{name}/"
    kept += [link.declare_queryable(key + leaf, lambda query, key=key + leaf:
             query.reply(key, b"")) for leaf in ("sbs", "mail", "status")]
    kept.append(link.liveliness().declare_token(key + "alive"))
    if group < told["active"]:
        beat = f"pbonet/{told['domain']}/sbs/group{group}/beat/"
        kept.append(link.declare_subscriber(beat + "*", zenoh.handlers.RingChannel(1)))
        kept.append(link.declare_publisher(beat + name))
    kept.append(link)
print("ready", flush=True)
beats = [one for one in kept if isinstance(one, zenoh.Publisher)]
threading.Thread(target=lambda: (sys.stdin.readline(), over.set()), daemon=True).start()
while not over.wait(0.1 if beats else None):
    for one in beats:
        one.put(b"0123456789abcdef")
for one in kept:
    if isinstance(one, zenoh.Session):
        one.close()
"""
"""Holds sessions as agents have them: a token, queryables, for some signs of life."""


def free_ports(count: int) -> list[int]:
    """Return ports that no program has now."""
    with contextlib.ExitStack() as held:
        taken = [held.enter_context(socket.socket()) for _ in range(count)]
        for one in taken:
            one.bind(("127.0.0.1", 0))
        return [one.getsockname()[1] for one in taken]


def cpu(processes: Iterable[int]) -> float:
    """Return the CPU seconds of processes that live, with those of ended threads."""
    spent = 0.0
    for pid in processes:
        with contextlib.suppress(OSError):  # clock_getcpuclockid(3) of Linux
            spent += time.clock_gettime(~pid << 3 | CPU_CLOCK)
    return spent


def memory(pid: int) -> float:
    """Return a process's own share of memory (PSS) in MB."""
    text = Path(f"/proc/{pid}/smaps_rollup").read_text(encoding="ascii")
    line = next(one for one in text.splitlines() if one.startswith("Pss:"))
    return int(line.split()[1]) / 1024


def sockets(pid: int) -> int:
    """Return how many sockets a process has."""
    found = 0
    for one in Path(f"/proc/{pid}/fd").iterdir():
        with contextlib.suppress(OSError):
            found += str(one.readlink()).startswith("socket:")
    return found


def packets() -> int:
    """Return the packets that went over the loopback device."""
    for line in Path("/proc/net/dev").read_text(encoding="ascii").splitlines():
        name, _, numbers = line.partition(":")
        if name.strip() == "lo":
            return int(numbers.split()[1])
    return 0


def wait(condition: Callable[[], Any], what: str, limit: float = SETTLE) -> float:
    """Wait for a condition; return the seconds that it took."""
    begin = time.monotonic()
    while not condition():
        if time.monotonic() > begin + limit:
            raise TimeoutError(f"not within {limit:g} s: {what}")
        time.sleep(0.005)
    return time.monotonic() - begin


class Routers:
    """Routers on ports of this machine; each is linked to those before it."""

    def __init__(self, count: int) -> None:
        self.ports = free_ports(count)
        self.running: dict[int, subprocess.Popen[str]] = {}

    @property
    def endpoints(self) -> list[str]:
        """Where they listen."""
        return [f"tcp/127.0.0.1:{port}" for port in self.ports]

    def start(self, number: int) -> None:
        """Start one of them, and wait until it accepts connections."""
        words = ["--listen", self.endpoints[number]]
        for one in self.endpoints[:number]:
            words += ["--connect", one]
        command = [sys.executable, "-m", "pbonet.cli", "router", *words]
        process = subprocess.Popen(command, stdout=subprocess.PIPE, text=True)
        assert process.stdout is not None
        assert "ready" in process.stdout.readline()
        self.running[number] = process

    def kill(self, number: int) -> None:
        """Kill one of them."""
        with self.running.pop(number) as process:
            process.kill()

    def pids(self) -> list[int]:
        """Return the processes of those that run."""
        return [one.pid for one in self.running.values()]

    def close(self) -> None:
        """Kill them all."""
        for number in list(self.running):
            self.kill(number)


class Machine:
    """An agent with folders of its own, as on a machine of its own.

    Args:
        name: The agent's.
        folder: Where these folders are.
        routers: Endpoints of its routers.
        machine: The name of the machine, for several agents of one.
    """

    def __init__(
        self, name: str, folder: Path, routers: Sequence[str] = (), *, machine: str = ""
    ) -> None:
        self.name, self.routers = name, list(routers)
        machine = machine or name
        self.run_dir, self.shm = folder / f"{machine}.run", folder / f"{machine}.shm"
        self.output = folder / f"{name}.out"
        for one in (self.run_dir, self.shm):
            one.mkdir(mode=0o700, exist_ok=True)
        self.agent: subprocess.Popen[bytes] | None = None

    @property
    def socket(self) -> str:
        """The endpoint of its agent for masters."""
        return f"unixsock-stream/{self.run_dir / DOMAIN / self.name}.sock"

    def start(self) -> None:
        """Start its agent, and do not wait for it."""
        words = ["--name", self.name, "--domain", DOMAIN, "--grace", "2"]
        for one in self.routers:
            words += ["--router", one]
        with self.output.open("wb") as shown:
            self.agent = subprocess.Popen(
                [sys.executable, "-m", "pbonet.cli", "agent", *words],
                env={
                    **os.environ,
                    "PBONET_RUN_DIR": str(self.run_dir),
                    "PBONET_SHM_DIR": str(self.shm),
                    "PBONET_STATE_DIR": str(self.run_dir / "state"),
                    "PBONET_CONNECT": "",
                },
                stdout=shown,
            )

    def is_ready(self) -> bool:
        """Return whether its agent says that it accepts commands."""
        return b": ready on" in self.output.read_bytes()

    @property
    def pid(self) -> int:
        """The agent's process."""
        assert self.agent is not None
        return self.agent.pid

    def kill(self) -> None:
        """Kill the agent; its RTPU process turns off by itself and ends."""
        assert self.agent is not None
        self.agent.kill()
        self.agent.wait()

    def is_running(self) -> bool:
        """Return whether its agent runs."""
        return self.agent is not None and self.agent.poll() is None

    def is_gone(self) -> bool:
        """Return whether its RTPU process has ended, too."""
        return not (self.run_dir / DOMAIN / f"{self.name}.ctl").exists()


class Fleet:
    """Agents, started a few at a time."""

    def __init__(self, routers: Routers) -> None:
        self._folder = tempfile.TemporaryDirectory(prefix="pscale-", dir=SHM)
        self.routers = routers
        self.machines: list[Machine] = []
        self.started_again = 0
        """Starts that failed."""
        self.found = 0.0
        """Seconds from the readiness of the last agents until all were seen."""

    def grow(self, count: int) -> None:
        """Have so many machines, and start the agents that are missing."""
        for number in range(len(self.machines), count):
            ends = self.routers.endpoints
            first = number % len(ends)
            order = [*ends[first:], *ends[:first]]
            self.machines.append(Machine(f"m{number}", Path(self._folder.name), order))
            self.machines[-1].start()
            if number % BATCH == BATCH - 1:
                self.wait_seen()
        wait(lambda: all(one.is_ready() for one in self.machines), "their readiness")
        self.found = self.wait_seen()

    def seen(self) -> set[str]:
        """Return the agents that a client of a router sees."""
        with (
            contextlib.suppress(UnreachableError),  # it is too busy to answer
            session.client(
                DOMAIN, connect=self.alive_routers(), timeout=20.0, local=False
            ) as link,
        ):
            return set(session.rtpus(link, DOMAIN, timeout=5.0))
        return set()

    def alive_routers(self) -> list[str]:
        """Return the endpoints of the routers that run."""
        return [self.routers.endpoints[one] for one in self.routers.running]

    def names(self) -> set[str]:
        """Return the names of all machines' agents."""
        return {one.name for one in self.machines}

    def wait_seen(self) -> float:
        """Wait until every agent is seen; return the seconds that it took.

        On a busy machine an agent may give its start up. It is started again.
        """

        def all_there() -> bool:
            for one in self.machines:
                if not one.is_running():
                    one.start()
                    self.started_again += 1
            return self.seen() >= self.names()

        return wait(all_there, "every agent")

    def pids(self) -> list[int]:
        """Return the processes of the agents."""
        return [one.pid for one in self.machines]

    def close(self) -> None:
        """End all agents, and remove their folders."""
        running = [one.agent for one in self.machines if one.agent is not None]
        for number in range(0, len(running), 10):
            for one in running[number : number + 10]:
                one.send_signal(signal.SIGTERM)
            for one in running[number : number + 10]:
                with contextlib.suppress(subprocess.TimeoutExpired):
                    one.wait(60.0)
                one.kill()  # its tasks end by themselves
        wait(lambda: all(one.is_gone() for one in self.machines), "their ends")
        self._folder.cleanup()


class Sessions:
    """Bare sessions of zenoh with what agents declare, some in each process.

    Args:
        routers: The routers; sessions of a group have one in common.
        count: How many sessions.
        each: How many in a process.
        active: Of how many groups of four the members send signs of life.
    """

    def __init__(
        self, routers: Routers, count: int, *, each: int, active: int = 0
    ) -> None:
        self.count = count
        settings = {
            "mode": "client",
            "connect": {"timeout_ms": 0},
            "scouting": {
                "multicast": {"enabled": False},
                "gossip": {"enabled": False},
            },
            "transport": {
                "shared_memory": {"enabled": False},
                "link": {"tx": {"lease": session.LEASE_MS, "keep_alive": 4}},
            },
        }
        told: dict[str, Any] = {
            "domain": "bare",
            "settings": settings,
            "active": active,
        }
        told["routers"] = routers.endpoints
        self.processes: list[subprocess.Popen[str]] = []
        for first in range(0, count, each):
            last = min(first + each, count)
            told["sessions"] = [(f"s{n}", n // 4) for n in range(first, last)]
            process = subprocess.Popen(
                [sys.executable, "-c", HOLDER, json.dumps(told)],
                stdin=subprocess.PIPE,
                stdout=subprocess.PIPE,
                text=True,
            )
            self.processes.append(process)
            assert process.stdout is not None
            assert "ready" in process.stdout.readline()

    def pids(self) -> list[int]:
        """Return their processes."""
        return [one.pid for one in self.processes]

    def close(self) -> None:
        """End them."""
        for one in self.processes:
            one.communicate("end\n")
