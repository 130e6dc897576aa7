"""Logs made in a test: variables of every type, records as rings have them, files."""

from __future__ import annotations

import random
from pathlib import Path

import numpy as np

from pbonet.config.model import Variable
from pbonet.log import Attached, LogWriter, RunAbout, TaskAbout
from pbonet.log.cycle_columns import HEAD_DTYPE
from pbonet.log.schema import RECORD
from pbonet.svar.layout import group_of

VARIABLES = [
    Variable(name="FLAG", type="bool", nelem=3, desc="truths"),
    Variable(name="Q^", type="double", nelem=2, units="rad/s", desc="speed"),
    Variable(name="COUNT", type="short"),
    Variable(name="RAW", type="struct[5]"),
    Variable(name="W", type="float", nelem=3, units="N"),
]
PLAIN = [Variable(name="Y", type="double", nelem=6, units="m", desc="place")]


def about(task="pid", outvar=VARIABLES, **more) -> TaskAbout:
    named = {"domain": "d", "rtpu": "arm0", "subsystem": "arm", "module": "m"}
    return TaskAbout(
        **(named | {"pid": 1, "freq": 100.0, "rmod": "", "rmod_name": "pid.rmod"}),
        task=task,
        outvar=list(outvar),
        **more,
    )


def run(name="r1", **more) -> RunAbout:
    return RunAbout(run=name, job="j", subsystem="arm", domain="d", rtpu="arm0", **more)


def record(data=b"", pairs=(), inputs=b"", heard=b"", **head) -> bytes:
    """Return a record as a ring has it."""
    row = np.zeros(1, HEAD_DTYPE)
    for name, value in head.items():
        row[name] = value
    body = row.tobytes() + data + np.array(pairs, np.uint64).tobytes() + inputs
    body += heard
    size, counts = RECORD.size + len(body), (len(data), len(inputs), len(heard))
    return RECORD.pack(size, len(pairs) // 2, *counts, 0) + body


def group(variables, pick) -> tuple[bytes, dict[str, np.ndarray]]:
    """Return random values, and the group that they make in a table."""
    layout = group_of(variables, range(len(variables)))
    data, values = bytearray(layout.bytes), {}
    for variable, at in zip(variables, layout.at, strict=True):
        dtype = np.dtype(variable.dtype)
        raw = pick.randbytes(dtype.itemsize * variable.nelem)
        raw = bytes(b & 1 for b in raw) if dtype.kind == "b" else raw
        data[at : at + len(raw)] = raw
        values[variable.name] = np.frombuffer(raw, dtype)
    return bytes(data), values


def flipped(path, out, count, seed):
    """Write the file so often to another one, each time with one other bit flipped."""
    data = bytearray(path.read_bytes())
    for bit in sorted(random.Random(seed).sample(range(8 * len(data)), count)):
        data[bit // 8] ^= 1 << bit % 8
        out.write_bytes(data)
        data[bit // 8] ^= 1 << bit % 8
        yield bit


def cycles(count, variables=PLAIN, seed=1, since=0) -> bytes:
    pick, parts = random.Random(seed), []
    for n in range(since, since + count):
        data, _ = group(variables, pick)
        at, number = 10_000 * n, n + 1
        times = {"release_ns": at, "start_ns": at, "end_ns": at}
        parts.append(record(data, cycle=number, number=number, register=1, **times))
    return b"".join(parts)


def written(path, tasks=("pid",), count=500, name="r1", flush=None, **more) -> Path:
    """Write a log with so many cycles of each task."""
    writer = LogWriter(path, run(name, **more), [Attached("a.sbs", b"SUBSYSTEM a")])
    for seed, task in enumerate(tasks):
        number = writer.add_task(about(task, PLAIN))
        for first in range(0, count, 100):
            writer.add(number, cycles(min(100, count - first), seed=seed, since=first))
            if flush:
                writer.flush()
    writer.add_event({"time": 5, "severity": 30, "code": "WARNING", "text": "odd"})
    writer.close()
    return path
