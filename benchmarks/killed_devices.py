"""How soon a device has its safe values after SIGKILL of the process that drove it.

A program opens a device with safe values and is killed. Measured are the times until
the safe values are on the bus, and until the port is free; of a device without safe
values, which no guard has, until the port is free. Median and largest in ms.

    python -m benchmarks.devices --killed [--tries 50]
"""

from __future__ import annotations

import json
import mmap
import os
import signal
import socket
import statistics
import subprocess
import sys
import tempfile
import time
from pathlib import Path
from typing import TYPE_CHECKING, NamedTuple

import msgspec

from pbonet.io.drivers import Entry, port_claims

if TYPE_CHECKING:
    from collections.abc import Callable

PROGRAM = """
import ast, json, sys, time
from pbonet.config import Entry
from pbonet.io.drivers import Mode, database, open_device
import msgspec
entry = msgspec.convert(json.loads(sys.argv[1]), Entry)
acts, safe = map(ast.literal_eval, sys.argv[2:])
with database.using({"x": entry}):
    device = open_device("x", mode=Mode.WRITE, safe=safe)
    device.write(acts)
    print("ready", flush=True)
    time.sleep(600)
"""
LIMIT = 30.0
"""Seconds after which a try has failed."""


_LOOK = 1e-4
"""Seconds between two looks, which leave the processor to what is measured."""


class Case(NamedTuple):
    """A device, what is written, and what waits until that is on the bus."""

    name: str
    entry: Entry
    acts: object
    safe: object
    wait: Callable[[int], None]
    """It waits for the first byte, or the register."""


class Registers:
    """A Modbus server of one register, which takes one write for each connection."""

    def __init__(self) -> None:
        self._listening = socket.create_server(("127.0.0.1", 0))
        self._listening.settimeout(LIMIT)
        self.address = f"127.0.0.1:{self._listening.getsockname()[1]}"

    def serve(self, value: int) -> None:
        """Serve the next connection; return when this value was written."""
        with self._listening.accept()[0] as one:
            one.settimeout(LIMIT)
            request = one.recv(64)  # function 16: the value is at the end
            one.sendall(request[:4] + b"\0\6" + request[6:12])
            if int.from_bytes(request[-2:], "big") != value:
                raise RuntimeError(f"another request: {request.hex()}")


def cases(folder: Path) -> list[Case]:
    """Return the devices."""
    memory = folder / "memory"
    memory.write_bytes(bytes(4096))
    with memory.open("r+b") as file:
        seen = mmap.mmap(file.fileno(), 4096)
    far = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
    far.bind(("127.0.0.1", 0))
    far.settimeout(LIMIT)
    registers = Registers()

    def of_memory(first: int) -> None:
        while seen[0] != first:
            time.sleep(_LOOK)

    def of_udp(first: int) -> None:
        while far.recv(64)[0] != first:
            pass

    where = f"127.0.0.1:{far.getsockname()[1]}"
    entries = {
        "file": Entry(driver="file", address=str(memory)),
        "udp": Entry(driver="udp", address=where),
        "modbus, TCP": Entry(driver="modbus", address=registers.address),
    }
    return [
        Case("file", entries["file"], b"\1", {0: b"\2"}, of_memory),
        Case("udp", entries["udp"], b"\1", b"\2", of_udp),
        Case("modbus, TCP", entries["modbus, TCP"], [1], [2], registers.serve),
        Case("file, none", entries["file"], b"\1", None, of_memory),
    ]


def tried(case: Case) -> tuple[float, float]:
    """Return the ms until the safe values are there, and until the port is free."""
    words = [json.dumps(msgspec.to_builtins(case.entry)), *map(repr, case[2:4])]
    with subprocess.Popen(
        [sys.executable, "-c", PROGRAM, *words], stdout=subprocess.PIPE
    ) as program:
        case.wait(1)
        if program.stdout is None or not program.stdout.readline():
            raise RuntimeError("the program has ended")
        begin = time.perf_counter()
        os.kill(program.pid, signal.SIGKILL)
        if case.safe is not None:
            case.wait(2)
        safe = time.perf_counter()
        while list(port_claims.users(case.entry, range(1))):
            time.sleep(_LOOK)
        free = time.perf_counter()
    return (safe - begin) * 1e3, (free - begin) * 1e3


def measure(tries: int) -> None:
    """Measure and print."""
    sys.stdout.write("| device | safe, median | largest | free, median | largest |\n")
    sys.stdout.write("|---|---|---|---|---|\n")
    with tempfile.TemporaryDirectory() as run:
        os.environ["PBONET_RUN_DIR"] = run
        Path(run).chmod(0o700)
        for case in cases(Path(run)):
            times = [tried(case) for _ in range(tries)]
            safe, free = (
                f"{statistics.median(one):.1f} | {max(one):.1f}"
                for one in zip(*times, strict=True)
            )
            if case.safe is None:
                safe = " | "
            sys.stdout.write(f"| {case.name} | {safe} | {free} |\n")
