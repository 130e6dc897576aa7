"""Links between tasks: what they add to a writer's cycle, and how late records arrive.

    python -m benchmarks.tbuf_tasks [--rounds N] [--seconds S] [--json FILE]

Two agents with shared memory of their own, linked by TCP, stand for two machines, with
RTPU processes, dispatchers and tasks as always. The writer is a task of 1 kHz which
writes a record in every cycle of every second block of cycles, so that what writing
adds is seen against the same task in the same minute. The reader on the other machine
is a synchronous task, awake when a record has come.

    added       to the writer's median cycle, from its call to the end of its commit:
                without a reader, with one on the same machine, with one on the other;
                and to its processor time, what is behind the cycle included; beside
                it what one numpy.copyto of the same bytes adds to such a cycle
    latency     from the writer's cycle to the reader's, beside raw zenoh's put and
                callback between two processes in the same rounds
"""

from __future__ import annotations

import argparse
import json
import os
import tempfile
import textwrap
import time
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from benchmarks import hosts, rtbench, tbuf
from pbonet.node.ring._ring import Ring
from pbonet.xm.net import messages as m

if TYPE_CHECKING:
    from collections.abc import Iterable

SIZES = (48, 1024)
RATE, BLOCK = 1000, 50
MOST_NS, SLOWEST = 100.0, 1.5
"""Goals: of what a write adds to the cycle, and of the latency in raw zenoh's."""
KEPT = 200_000
SOURCE = '''
"""Writes a record in every cycle of every second block of cycles."""

from functools import partial
from typing import Annotated as A

import numpy as np

from pbonet import Params, PortBasedObject, param, tbuf


class Which(Params):
    """Which link it is."""

    link: A[str, param("none", "its name")]
    size: A[int, param("none", "bytes of a record")]
    blocks: A[int, param("none", "cycles of a block; 0: one for ever")] = 0
    copies: A[int, param("none", "1: copies the bytes in place of writing them")] = 0


class LinkSource(PortBasedObject[Which]):
    """Writes records."""

    def init(self) -> None:
        size = self.params.size
        self._link = tbuf.Writer(self.params.link, ("u1", size))
        copy = partial(np.copyto, np.zeros(size, "u1"), np.ones(size, "u1"))
        self._do = copy if self.params.copies else self._link.write

    def on(self) -> None:
        self._count = 0

    def cycle(self, dt: float) -> None:
        blocks = self.params.blocks
        writes = not blocks or self._count // blocks % 2
        self._count += 1
        if writes:
            self._do()

    def kill(self) -> None:
        self._link.close()
'''
SINK = '''
"""Takes records as they come, and notes how late they are."""

import time
from typing import Annotated as A

import numpy as np

from pbonet import Params, PortBasedObject, param, tbuf


class Where(Params):
    """Which link it is, and where its notes go."""

    link: A[str, param("none", "its name")]
    size: A[int, param("none", "bytes of a record")]
    notes: A[str, param("none", "file of one nanosecond count a record")]


class LinkSink(PortBasedObject[Where]):
    """Takes records."""

    def init(self) -> None:
        self._link = tbuf.Reader(self.params.link, ("u1", self.params.size))
        self._late = np.memmap(self.params.notes, dtype=np.int64, mode="r+")
        self._count = 0

    def sync(self) -> None:
        self._link.wait(time.monotonic_ns() + 50_000_000)

    def cycle(self, dt: float) -> None:
        now = time.monotonic_ns()
        if self._link.read() and self._count < len(self._late):
            self._late[self._count] = now - self._link.stamp_ns
            self._count += 1

    def kill(self) -> None:
        self._link.close()
'''
RMOD = """
MODULE {module}
DESC of the benchmark
INCONST none
OUTCONST none
INVAR none
OUTVAR none
TASKTYPE {kind}
FREQ {rate}
LOCAL
{local}
EOF
"""


def rmod(module: str, kind: str, **local: object) -> str:
    """Return the text of a module's file."""
    lines = "\n".join(f"{name} {value}" for name, value in local.items())
    return RMOD.format(module=module, kind=kind, rate=RATE, local=lines)


class Tasks:
    """A writer on one machine, and a reader on one of the two.

    Args:
        pair: The machines.
        folder: Where notes go.
    """

    def __init__(self, pair: hosts.Pair, folder: Path) -> None:
        self._pair, self._notes = pair, folder / "notes"

    def ask(self, name: str, request: Any) -> m.TaskStatus:  # noqa: ANN401
        """Send a request to an agent under the subsystem's claim."""
        request.subsystem = hosts.SUBSYSTEM
        request.epoch = self._pair.epochs[hosts.SUBSYSTEM, name]
        return self._pair.client.call(name, request, m.TaskStatus, timeout=20.0)

    def begin(self, name: str, task: str, text: str) -> m.TaskStatus:
        """Spawn a task and turn it on."""
        made = self.ask(name, m.Spawn(task=task, rmod=text, rmod_name=f"{task}.rmod"))
        self.ask(name, m.Control(task=task, signal="on"))
        return made

    def end(self, name: str, task: str) -> None:
        """Turn a task off, and end it."""
        for signal in ("off", "kill"):
            self.ask(name, m.Control(task=task, signal=signal))

    def sink(self, name: str, size: int) -> None:
        """Begin the reader on one machine."""
        np.zeros(KEPT, np.int64).tofile(self._notes)
        text = rmod(
            "link_sink", "synchronous",
            link=f"{hosts.SUBSYSTEM}:x", size=size, notes=self._notes,
        )  # fmt: skip
        self.begin(name, "sink", text)

    def added(
        self, size: int, where: str, seconds: float, *, copies: int = 0
    ) -> tuple[list[float], list[float]]:
        """Return by how many nanoseconds each block's median cycle is longer.

        Returns:
            By the clock, from its begin to its end; and by its processor time.
        """
        if where:
            self.sink(where, size)
        text = rmod(
            "link_source", "periodic", link="x", size=size, blocks=BLOCK, copies=copies
        )
        made = self.begin("one", "source", text)
        os.environ["PBONET_SHM_DIR"] = str(self._pair.one.shm_dir)
        ring = Ring.attach(made.ring)
        cycles: list[tuple[int, int]] = []
        end = time.monotonic() + seconds
        while time.monotonic() < end:
            time.sleep(0.1)
            cycles += [
                (r.end_ns - r.start_ns, r.cpu_ns) for r in ring.drain() if not r.kind
            ]
        ring.close()
        self.end("one", "source")
        if where:
            self.end(where, "sink")
        whole = np.array(cycles[: len(cycles) // (2 * BLOCK) * 2 * BLOCK])
        blocks = np.median(whole.reshape(-1, 2, BLOCK, 2), axis=2)
        more = blocks[1:, 1] - blocks[1:, 0]
        return list(more[:, 0]), list(more[:, 1])

    def latencies(self, size: int, seconds: float) -> list[float]:
        """Return how late records were for the reader on the other machine, in us."""
        self.sink("two", size)
        self.begin(
            "one", "source", rmod("link_source", "periodic", link="x", size=size)
        )
        time.sleep(0.5 + seconds)  # the link comes up
        self.end("one", "source")
        self.end("two", "sink")
        late = np.fromfile(self._notes, np.int64)
        return list(late[late > 0][-round(seconds * RATE) :] / 1000)


def raw(size: int, seconds: float) -> list[float]:
    """Return how late raw zenoh's callbacks are, in microseconds."""
    port, env = tbuf.free_port(), dict(os.environ)
    source = tbuf.Program(tbuf.PUT, env, size=size, port=port)
    sink = tbuf.Program(tbuf.CALLBACK, env, size=size, port=port)
    sink.go(seconds + 2 * tbuf.WARM_UP)
    time.sleep(tbuf.WARM_UP)
    source.go(seconds)
    source.result()
    late: Any = sink.result()
    for program in (source, sink):
        program.end()
    return [ns / 1000 for ns in late]


READERS = {"no reader": "", "a reader here": "one", "a reader there": "two"}
COPY = "numpy.copyto"


def measure(rounds: int, seconds: float) -> dict[str, list[float]]:
    """Return nanoseconds added and microseconds of latency, by case."""
    found: dict[str, list[float]] = {}
    with tempfile.TemporaryDirectory() as folder:
        for name, text in (("link_source", SOURCE), ("link_sink", SINK)):
            Path(folder, f"{name}.py").write_text(textwrap.dedent(text))
        where = f"tcp/127.0.0.1:{tbuf.free_port()}"
        pair = hosts.Pair([[], []], where, where, library=folder)
        tasks = Tasks(pair, Path(folder))
        try:
            for _ in range(rounds):
                for size in SIZES:
                    for name, reader in {COPY: "", **READERS}.items():
                        copies = int(name == COPY)
                        both = tasks.added(size, reader, seconds, copies=copies)
                        for what, more in zip(
                            ("added", "CPU added"), both, strict=True
                        ):
                            key = f"{what}, {size} B, {name}"
                            found.setdefault(key, []).extend(more)
                    for who, late in (
                        ("pbonet", tasks.latencies(size, seconds)),
                        ("raw zenoh", raw(size, seconds)),
                    ):
                        found.setdefault(f"latency, {size} B, {who}", []).extend(late)
        finally:
            pair.close()
    return found


def goals(found: dict[str, list[float]]) -> Iterable[str]:
    """Yield a line for each goal."""
    for size in SIZES:
        for name in list(READERS)[1:]:
            got = float(np.median(found[f"added, {size} B, {name}"]))
            yield rtbench.verdict(f"ns added, {size} B, {name}", got, MOST_NS)
        ours, theirs = (
            float(np.median(found[f"latency, {size} B, {who}"]))
            for who in ("pbonet", "raw zenoh")
        )
        text = f"median latency, {size} B, in raw zenoh's"
        yield rtbench.verdict(text, ours / theirs, SLOWEST)


def main() -> None:
    """Measure and report; status 3 when a goal is missed."""
    parser = argparse.ArgumentParser(description="Links between tasks.")
    parser.add_argument("--rounds", type=int, default=4)
    parser.add_argument("--seconds", type=float, default=3.0)
    parser.add_argument("--json", type=Path)
    options = parser.parse_args()
    found = measure(options.rounds, options.seconds)
    print(rtbench.machine())
    for name, values in found.items():
        p50, p99 = np.quantile(values, [0.5, 0.99])
        unit = "us" if name.startswith("latency") else "ns"
        print(f"{name:32} p50 {p50:7.0f}  p99 {p99:7.0f} {unit}  n {len(values)}")
    if options.json:
        options.json.write_text(json.dumps(found), encoding="utf-8")
    rtbench.judge(goals(found))


if __name__ == "__main__":
    main()
