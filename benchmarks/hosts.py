"""Two machines: a table on both, commands, what is lost and comes back, and the cost.

Two agents, each with shared memory of its own, joined by one TCP link: to pbonet they
are two machines. A process commits groups into the table of the first as a task would,
and another watches the table of the second. In the same run, in turns, the same bytes
go by a plain zenoh put and callback between two processes, and a plain queryable
answers.

As root two network namespaces with a cable take the place of the loopback for what is
lost: the agent of the writer is killed, the cable is pulled and plugged in again, or
all vanishes that it shall carry.

    python -m benchmarks.hosts [--only latency commands cpu flag loss] [--seconds 6]
        [--times 5] [--json FILE]
"""

from __future__ import annotations

import argparse
import json
import os
import signal
import subprocess
import sys
import tempfile
import time
from pathlib import Path
from typing import TYPE_CHECKING, Any

import msgspec
import numpy as np
import zenoh

from benchmarks import rtbench
from benchmarks.plain import raw
from pbonet.config.model import AgentConfig
from pbonet.svar import Table
from pbonet.testing.lan import Lan, missing
from pbonet.xm.net import key_expressions, messages as m, session
from pbonet.xm.net.rpc import Client

if TYPE_CHECKING:
    from collections.abc import Callable, Generator, Sequence

DOMAIN, SUBSYSTEM = "bench", "cell"
SOLO = "solo"
"""A subsystem with a table on one machine only."""
QUERYABLE = "queryable"
RELAY = "queryable that asks another one first"
WRITE, WRITE_GOAL = "write", 1.3
"""A write to a table on one machine, and its longest time in round trips."""
SPREAD = "write, known to the other machine"
GROUPS = 20
SHM = "/dev/shm"  # noqa: S108 - where shared memory is
SVAR = "".join(
    f"NAME V{i}\nTYPE double\nDESC written\nUNITS none\nNELEM 6\nMAXAGE 0.5\n\n"
    for i in range(GROUPS)
)
AGENT = """
import sys, msgspec
from pbonet.config.model import AgentConfig
from pbonet.node.agent.agent_main import main
sys.exit(main(msgspec.json.decode(sys.argv[1], type=AgentConfig)))
"""
WRITER = """
import os, sys, time
from pbonet.svar import Table
from pbonet.testing.lan import Lan, missing
count, rate, seconds = int(sys.argv[2]), float(sys.argv[3]), float(sys.argv[4])
table = Table.attach(sys.argv[1])
tasks = [table.local(f"w{i}", os.getpid(), outvar=[f"V{i}"]) for i in range(count)]
for task in tasks: task.claim()
due, n = time.monotonic(), 0
end = due + seconds
while due < end:
    due += 1 / rate
    time.sleep(max(due - time.monotonic(), 0))
    n += 1
    for task in tasks:
        task.commit(time.monotonic_ns(), n)
"""


class Side:
    """One machine: folders of its own, and an agent.

    Args:
        name: Of the agent.
        folder: Where its own folders are made.
        inside: What is put before its commands, to run them in a network of its own.
    """

    def __init__(self, name: str, folder: Path, inside: list[str]) -> None:
        self.name, self.inside = name, inside
        self.run_dir, self.shm_dir = folder / f"{name}.run", folder / f"{name}.shm"
        for made in (self.run_dir, self.shm_dir):
            made.mkdir(mode=0o700)
        self.agent: subprocess.Popen[bytes] | None = None
        self._writers: list[subprocess.Popen[bytes]] = []
        self.more: dict[str, str] = {}
        """Of its environment, beside the folders."""

    @property
    def environment(self) -> dict[str, str]:
        """The environment of its processes."""
        folders = {"PBONET_RUN_DIR": self.run_dir, "PBONET_SHM_DIR": self.shm_dir}
        paths = {key: str(path) for key, path in folders.items()}
        return {**os.environ, **paths, **self.more}

    def start(
        self,
        listen: str = "",
        connect: str | Sequence[str] = (),
        library: str = "",
        core: int | None = None,
    ) -> None:
        """Start its agent, on the last core unless another one is named."""
        config = AgentConfig(
            name=self.name, domain=DOMAIN, grace=20.0, insecure=True,
            listen=(listen,) if listen else (),
            connect=(connect,) if isinstance(connect, str) else tuple(connect),
            core=max(os.sched_getaffinity(0)) if core is None else core,
            libraries=(library,) if library else (),
        )  # fmt: skip
        text = msgspec.json.encode(config).decode()
        self.agent = self.run(AGENT, text, stdout=subprocess.DEVNULL)

    def end(self, limit: float = 30.0) -> None:
        """End its writers, and its agent, by force if it does not obey."""
        for writer in self._writers:
            writer.kill()
            writer.wait()
        if self.agent is None:
            return
        self.agent.send_signal(signal.SIGTERM)
        try:
            self.agent.wait(limit)
        except subprocess.TimeoutExpired:
            self.agent.kill()
            self.agent.wait()

    def run(
        self, code: str, *words: str, stdout: int | None = None
    ) -> subprocess.Popen[bytes]:
        """Start a Python program on it."""
        command = [*self.inside, sys.executable, "-c", code, *words]
        return subprocess.Popen(command, env=self.environment, stdout=stdout)

    @property
    def socket(self) -> str:
        """Its agent's endpoint for its own machine."""
        return f"unixsock-stream/{self.run_dir / DOMAIN / self.name}.sock"

    def socket_there(self) -> bool:
        """Tell whether its agent listens."""
        return Path(self.socket.partition("/")[2]).exists()

    def attach(self) -> Table:
        """Attach to its table."""
        os.environ["PBONET_SHM_DIR"] = str(self.shm_dir)
        return Table.attach(f"{DOMAIN}.{SUBSYSTEM}")

    def write(self, count: int, rate: float, seconds: float) -> subprocess.Popen[bytes]:
        """Start a process that commits `count` groups at `rate` Hz."""
        words = (f"{DOMAIN}.{SUBSYSTEM}", str(count), str(rate), str(seconds))
        self._writers.append(self.run(WRITER, *words))
        return self._writers[-1]

    def cpu(self) -> float:
        """Return the processor seconds that its agent has used."""
        assert self.agent is not None
        fields = Path(f"/proc/{self.agent.pid}/stat").read_text().rpartition(")")[2]
        return sum(map(int, fields.split()[11:13])) / os.sysconf("SC_CLK_TCK")


class Pair:
    """Two machines with a table on both.

    Args:
        ways: By side, what is put before its commands.
        listen: What the first one listens on.
        connect: What the second one dials.
        library: Where both have modules.
    """

    def __init__(
        self, ways: list[list[str]], listen: str, connect: str, library: str = ""
    ) -> None:
        self._folder = tempfile.TemporaryDirectory(prefix="pbench-", dir=SHM)
        folder = Path(self._folder.name)
        self.sides = [
            Side(name, folder, way)
            for name, way in zip(("one", "two"), ways, strict=True)
        ]
        self.one, self.two = self.sides
        self.listen, self.connect = listen, connect
        self._link: zenoh.Session | None = None
        try:
            self._come_up(library)
        except BaseException:  # an interrupt, too, would leave agents behind
            self.close()
            raise

    def _come_up(self, library: str) -> None:
        self.one.start(listen=self.listen, library=library)
        wait(self.one.socket_there, "agent one")
        self.two.start(connect=self.connect, library=library)
        wait(self.two.socket_there, "agent two")
        self._link = session.client(
            DOMAIN, connect=[self.two.socket], timeout=20.0, local=False
        )
        self.client = Client(self._link, DOMAIN, "bench")
        wait(lambda: len(self.client.rtpus()) == len(self.sides), "both agents")
        self._tokens = [
            self._link.liveliness().declare_token(
                key_expressions.master(DOMAIN, name, "bench")
            )
            for name in (SUBSYSTEM, SOLO)
        ]
        self.epochs: dict[tuple[str, str], int] = {}
        self.open(SUBSYSTEM, "one", keep=True)
        self.open(SUBSYSTEM, "two", keep=False)

    def open(self, subsystem: str, name: str, *, keep: bool) -> None:
        """Claim an RTPU for a subsystem, and open its table there."""
        claim = m.Claim(
            subsystem=subsystem, usage="shared", svar=SVAR + "EOF\n",
            svar_name="b.svar", keep=keep,
        )  # fmt: skip
        epoch = self.client.call(name, claim, m.Claimed).epoch
        self.epochs[subsystem, name] = epoch

    def close(self) -> None:
        """End everything, as far as it came up."""
        if self._link is not None:
            self._link.close()  # type: ignore[no-untyped-call]
        for side in self.sides:
            side.end()
        self._folder.cleanup()


def wait(condition: Callable[[], Any], what: str, limit: float = 30.0) -> float:
    """Wait for a condition; return the seconds that it took."""
    begin = time.monotonic()
    while not condition():
        assert time.monotonic() < begin + limit, f"not within {limit:g} s: {what}"
        time.sleep(0.0005)
    return time.monotonic() - begin


def quantiles(values: list[float]) -> dict[str, float]:
    """Return count, median and 99th percentile in microseconds, of seconds."""
    found = np.quantile(np.array(values) * 1e6, [0.5, 0.99])
    return {"n": len(values), "p50": float(found[0]), "p99": float(found[1])}


def watch(table: Table, seconds: float) -> list[float]:
    """Return how old each new commit of V0 was when it was first seen."""
    room = bytearray(48)
    ages: list[float] = []
    last, end = -1, time.monotonic() + seconds
    while time.monotonic() < end:
        seen = table.peek(0, room)
        if seen is not None and seen[5] != last and seen[2]:
            last = seen[5]
            ages.append((time.monotonic_ns() - seen[2]) * 1e-9)
        time.sleep(0.00002)
    return ages


def latency(pair: Pair, seconds: float) -> dict[str, Any]:
    """Measure a mirrored table beside a put and its callback, 48 bytes."""
    found: dict[str, Any] = {}
    table = pair.two.attach()
    for rate in (200.0, 1000.0):
        mirrored: list[float] = []
        plain: list[float] = []
        for _ in range(2):
            writer = pair.one.write(1, rate, seconds + 1.5)
            time.sleep(1.0)
            mirrored += watch(table, seconds)
            writer.wait()

            def heard(sample: zenoh.Sample) -> None:
                sent = int.from_bytes(sample.payload.to_bytes()[:8], "little")
                plain.append((time.monotonic_ns() - sent) * 1e-9)  # noqa: B023

            with raw("put", str(rate), str(seconds)) as link:
                handler = zenoh.handlers.Callback(heard, indirect=False)
                link.declare_subscriber("bench/put", handler)
                time.sleep(seconds)
        found[f"{rate:g} Hz"] = {
            "table": quantiles(mirrored),
            "put": quantiles(plain),
        }
    table.close()
    return found


def commands(pair: Pair, seconds: float) -> dict[str, Any]:
    """Measure commands beside a plain queryable that answers at once."""

    def status() -> None:
        pair.client.call("two", m.Status(subsystem=SUBSYSTEM), m.RtpuStatus)

    def display() -> None:
        request = m.Display(subsystem=SUBSYSTEM, names=["V19"])
        pair.client.call("two", request, list[m.VarValue])

    def hello() -> None:
        pair.client.call("two", m.Hello(), m.AgentInfo)

    pair.open(SOLO, "two", keep=True)
    with raw("echo") as link:

        def ask(key: str) -> bool:
            return bool(list(link.get(key, payload=bytes(100), timeout=2.0)))

        wait(lambda: ask("bench/echo") and ask("bench/relay"), "echo and relay")
        asked: dict[str, Callable[[], object]] = {
            QUERYABLE: lambda: ask("bench/echo"),
            "hello": hello,
            "status": status,
            "display": display,
            WRITE: lambda: _write(pair, SOLO, "two"),
            RELAY: lambda: ask("bench/relay"),
            SPREAD: lambda: _write(pair, SUBSYSTEM, "one"),
        }
        taken: dict[str, list[float]] = {name: [] for name in asked}
        for name, call in [*asked.items(), *asked.items()]:
            for _ in range(round(70 * seconds)):
                begin = time.perf_counter()
                call()
                taken[name].append(time.perf_counter() - begin)
    return {name: quantiles(values) for name, values in taken.items()}


def _write(pair: Pair, subsystem: str, rtpu: str) -> None:
    epoch = pair.epochs[subsystem, rtpu]
    request = m.Write(subsystem=subsystem, epoch=epoch, name="V19", values=[1.0] * 6)
    pair.client.call(rtpu, request, m.VarValue)


def cpu(pair: Pair, seconds: float) -> dict[str, Any]:
    """Measure the agents' share of a core: idle, and with 20 groups at 200 Hz."""

    def shares() -> dict[str, float]:
        before = [side.cpu() for side in (pair.one, pair.two)]
        time.sleep(seconds)
        after = [side.cpu() for side in (pair.one, pair.two)]
        shares = [(b - a) / seconds for a, b in zip(before, after, strict=True)]
        return {"sends": shares[0], "takes": shares[1]}

    found = {"idle": shares()}
    writer = pair.one.write(GROUPS, 200.0, seconds + 4.0)
    time.sleep(2.0)
    found["20 groups, 200 Hz"] = shares()
    writer.wait()
    return found


def loss(times: int) -> dict[str, Any]:
    """Measure how soon a loss is seen, and how soon all is well again."""
    if reason := missing():
        return {"skipped": reason}
    lan = Lan()
    cables = {"cable pulled": (Lan.cut, "plugged in"),
              "packets vanish": (Lan.mute, "and pass again")}  # fmt: skip
    found: dict[str, list[float]] = {}

    def add(name: str, seconds: float) -> None:
        found.setdefault(name, []).append(seconds)

    ways = [lan[name].command() for name in ("a", "b")]
    pair = Pair(ways, "tcp/0.0.0.0:7447", "tcp/10.77.1.1:7447")
    try:
        pair.one.write(1, 200.0, 30.0 * times)
        table = pair.two.attach()
        wait(lambda: fresh(table), "news")
        for _ in range(times):
            for name, (part, healed) in cables.items():
                part(lan, "a", "b")
                add(name, wait(lambda: table.illegal, "flag"))
                lan.heal("a", "b")
                add(healed, wait(lambda: fresh(table), "news"))
            assert pair.one.agent is not None
            pair.one.agent.kill()
            add("agent killed", wait(lambda: table.illegal, "flag"))
            pair.one.agent.wait()
            pair.one.start(listen=pair.listen)
            add("taken over", wait(lambda: fresh(table), "news"))
    finally:
        pair.close()
        lan.close()
    return summed(found)


def summed(found: dict[str, list[float]]) -> dict[str, Any]:
    """Return medians and maxima."""
    return {
        name: {"median": float(np.median(values)), "longest": max(values)}
        for name, values in found.items()
    }


def flag(pair: Pair, seconds: float) -> dict[str, Any]:
    """Measure how soon a flag that is raised on one machine stands on the other."""
    here, there = pair.one.attach(), pair.two.attach()
    taken: dict[str, list[float]] = {"raised": [], "cleared": []}
    for n in range(round(20 * seconds)):
        time.sleep(0.02 + n % 7 * 0.003)  # not in step with anybody's looks
        here.raise_illegal("a flag", "bench")
        taken["raised"].append(wait(lambda: there.illegal, "flag"))
        here.clear_illegal("bench", "a flag")
        taken["cleared"].append(wait(lambda: not there.illegal, "no flag"))
    for table in (here, there):
        table.close()
    return summed(taken)


def fresh(table: Table) -> bool:
    """Tell whether the other machine's variable is brought up to date."""
    info = table.info("V0")
    return not table.illegal and info.owner is not None and not info.stale


def goals(found: dict[str, Any]) -> Generator[str, None, None]:
    """Yield a line for each goal whose part was measured."""
    asked = found.get("commands", {})
    for name in [name for name in asked if name not in {QUERYABLE, RELAY}]:
        rival = RELAY if name == SPREAD else QUERYABLE
        ratio = asked[name]["p50"] / asked[rival]["p50"]
        most = WRITE_GOAL if name == WRITE else 1.5
        yield rtbench.verdict(f"{name}, in round trips of a {rival},", ratio, most)
    for who, share in found.get("cpu", {}).get("idle", {}).items():
        yield rtbench.verdict(f"idle agent that {who}, % of a core,", 100 * share, 1.0)
    for part, name, most in (
        ("flag", "raised", 0.05), ("loss", "agent killed", 0.05),
        ("loss", "cable pulled", 0.5), ("loss", "packets vanish", 0.5),
    ):  # fmt: skip
        if name in found.get(part, {}):
            longest = found[part][name]["longest"]
            yield rtbench.verdict(
                f"{name}, seconds until the flag is up,", longest, most
            )


def main() -> None:
    """Measure, print, and write a file where one is named."""
    parser = argparse.ArgumentParser(description=__doc__)
    parts = ("latency", "commands", "cpu", "flag", "loss")
    parser.add_argument("--only", nargs="+", choices=parts, default=parts)
    parser.add_argument("--seconds", type=float, default=6.0)
    parser.add_argument("--times", type=int, default=5)
    parser.add_argument("--json", type=Path)
    options = parser.parse_args()
    found: dict[str, Any] = {}
    if set(options.only) - {"loss"}:
        pair = Pair([[], []], "tcp/127.0.0.1:17460", "tcp/127.0.0.1:17460")
        try:
            for name, measure in (
                ("latency", latency), ("cpu", cpu), ("commands", commands),
                ("flag", flag),
            ):  # fmt: skip
                if name in options.only:
                    found[name] = measure(pair, options.seconds)
        finally:
            pair.close()
    if "loss" in options.only:
        found["loss"] = loss(options.times)
    text = json.dumps(found, indent=2)
    print(text)
    if options.json:
        options.json.write_text(text, encoding="utf-8")
    rtbench.judge(goals(found))


if __name__ == "__main__":
    main()
