"""What a driver costs inside `cycle`, beside the bare library or system call.

One call each, of data that are there already, in turns with the bare call; opened as in
a task that is recorded. Median and 99 % quantile in us.

    python -m benchmarks.devices [--calls 1000]

With ``--killed``: how soon a device is safe, and free, after SIGKILL of its program
(`killed_devices`).
"""

from __future__ import annotations

import argparse
import os
import socket
import statistics
import sys
import tempfile
import time
import tty
from contextlib import ExitStack
from pathlib import Path
from threading import Thread
from unittest import mock

import can

from benchmarks import device_buses, device_libraries, killed_devices
from benchmarks.device_libraries import Case
from pbonet.io.drivers import (
    Entry,
    Mode,
    Wait,
    database,
    dynamixel_driver,
    iio_buffer_driver,
    joystick_driver,
    open_device,
)
from pbonet.outside import Tape, using

GOAL = 50.0
"""us that a driver may take in a cycle beside the bare call."""
MISSED = 3


def cases(stack: ExitStack) -> list[Case]:
    """Open all devices, and return what is measured."""
    folder = Path(stack.enter_context(tempfile.TemporaryDirectory()))
    (folder / "in_voltage0_raw").write_text("1234\n")
    (folder / "memory").write_bytes(bytes(4096))
    names = ("event0", "event1", "buffered")
    events, other_events, samples = (pipe(stack, folder / name) for name in names)
    buffered(stack, folder)
    master, slave = terminal(stack)
    servo, servo_slave = terminal(stack)
    other_servo, other_slave = terminal(stack)
    answers = Thread(target=answer_ping, args=(servo,))
    answers.start()
    far = stack.enter_context(socket.socket(socket.AF_INET, socket.SOCK_DGRAM))
    far.bind(("127.0.0.1", 0))
    entries = {
        "adc": Entry(driver="iio_adc", address=str(folder)),
        "memory": Entry(driver="file", address=str(folder / "memory")),
        "line": Entry(driver="serial", address=os.ttyname(slave)),
        "udp": Entry(driver="udp", address=f"127.0.0.1:{far.getsockname()[1]}"),
        "stick": Entry(driver="joystick", address=str(folder / "event0")),
        "buffer": Entry(driver="iio_buffer", address=str(folder)),
        "servo": Entry(
            driver="dynamixel",
            address=os.ttyname(servo_slave),
            settings={"servos": [1], "registers": [[132, 4]], "timeout": 60.0},
        ),
        "can": Entry(driver="can", address="bench", settings={"interface": "virtual"}),
    }
    stack.enter_context(database.using(entries))
    told = {"adc": Wait.ALL, "memory": Wait.ALL, "stick": Wait.ALL}
    opened = {
        name: stack.enter_context(
            open_device(name, mode=Mode.RW if name == "udp" else Mode.READ,
                        wait=told.get(name, Wait.NONE), safe=None)
        )
        for name in entries
    }  # fmt: skip
    raw = os.open(folder / "in_voltage0_raw", os.O_RDONLY)
    plain = os.open(folder / "memory", os.O_RDONLY)
    stack.callback(os.close, raw)
    stack.callback(os.close, plain)
    opened["udp"].write(b"x")
    _, where = far.recvfrom(1)
    near = stack.enter_context(socket.socket(socket.AF_INET, socket.SOCK_DGRAM))
    near.bind(("127.0.0.1", 0))
    near.setblocking(False)  # noqa: FBT003
    buses = [can.Bus(channel="bench", interface="virtual") for _ in range(2)]
    for one in buses:
        stack.callback(one.shutdown)
    frame = can.Message(arbitration_id=1, data=bytes(8), is_extended_id=False)

    def datagrams() -> None:
        far.sendto(bytes(64), where)
        far.sendto(bytes(64), near.getsockname())

    answers.join()
    adc, memory, line, udp, stick, buffer, turned, bus = (
        opened[name].read for name in entries
    )
    event = joystick_driver.EVENT.pack(0, 0, joystick_driver.ABS, 0, 1)
    plain_events, plain_samples = (
        os.open(folder / name, os.O_RDONLY | os.O_NONBLOCK) for name in names[1:]
    )
    for fd in (plain_events, plain_samples):
        stack.callback(os.close, fd)

    ask = dynamixel_driver.packet(0xFE, 0x82, b"\x84\0\4\0\1")
    status = dynamixel_driver.packet(1, dynamixel_driver.STATUS, bytes(5))
    turned()  # the first request
    os.write(other_slave, ask)

    def answered() -> None:
        for end in (servo, other_servo):
            os.read(end, len(ask))
            os.write(end, status)

    def press() -> None:
        os.write(events, event)
        os.write(other_events, event)

    return [
        Case("iio_adc, one channel", int, adc, lambda: int(os.pread(raw, 16, 0))),
        Case(
            *("file, 64 bytes", int, lambda: memory(64)),
            lambda: os.pread(plain, 64, 0),
        ),
        Case(
            *("serial, 64 bytes", lambda: os.write(master, bytes(128))),
            *(lambda: line(64), lambda: os.read(slave, 64)),
        ),
        Case("udp, 64 bytes", datagrams, lambda: udp(64), lambda: near.recv(64)),
        Case(
            *("joystick, one event", press),
            *(stick, lambda: os.read(plain_events, 24)),
        ),
        Case(
            *("iio_buffer, one sample", lambda: os.write(samples, bytes(32))),
            *(lambda: buffer(1), lambda: os.read(plain_samples, 16)),
        ),
        Case(
            *("dynamixel, one servo", answered),
            *(turned, lambda: (os.read(other_slave, 99), os.write(other_slave, ask))),
        ),
        Case(
            *("can (virtual), one frame", lambda: buses[0].send(frame)),
            *(lambda: bus(1), lambda: buses[1].recv(0)),
        ),
        *device_libraries.cases(stack, folder),
        *device_buses.cases(stack),
    ]  # fmt: skip


def terminal(stack: ExitStack) -> tuple[int, int]:
    """Return both ends of a terminal that changes no byte."""
    ends = os.openpty()
    for fd in ends:
        tty.setraw(fd)
        stack.callback(os.close, fd)
    return ends


def answer_ping(end: int) -> None:
    """Be a servo that is asked whether it is there."""
    os.read(end, 99)
    body = b"\0\6\4\x2d"
    os.write(end, dynamixel_driver.packet(1, dynamixel_driver.STATUS, body))


def pipe(stack: ExitStack, path: Path) -> int:
    """Return an end to write of a pipe that has a name."""
    os.mkfifo(path)
    fd = os.open(path, os.O_RDWR)
    stack.callback(os.close, fd)
    return fd


def buffered(stack: ExitStack, folder: Path) -> None:
    """Let a folder be that of a converter with a buffer, and answer for a joystick."""
    (folder / "scan_elements").mkdir()
    (folder / "buffer").mkdir()
    for name, kind in (("voltage0", "le:s16/16>>0"), ("timestamp", "le:s64/64>>0")):
        for part, text in (("type", kind), ("index", "0"), ("en", "0")):
            path = folder / "scan_elements" / f"in_{name}_{part}"
            path.write_text("1" if (name, part) == ("timestamp", "index") else text)
    for name in ("enable", "length"):
        (folder / "buffer" / name).write_text("0")
    (folder / folder.name).symlink_to("buffered")
    axis = joystick_driver.ABSINFO.pack(0, -100, 100, 0, 0, 0)

    def answer(_fd: int, request: int, room: bytes) -> bytes:
        return bytes(len(room)) if request == joystick_driver.GET_KEYS else axis

    for module, name, value in (
        (joystick_driver, "ioctl", answer),
        (iio_buffer_driver, "DEVICE_FILES", str(folder)),
    ):
        stack.enter_context(mock.patch.object(module, name, value))


def measured(case: Case, calls: int, tape: Tape) -> list[list[float]]:
    """Return the times of both calls, in us."""
    times: list[list[float]] = [[], []]
    for number in range(calls):
        case.prepare()
        pair = (case.driver, case.bare)
        for which in (0, 1) if number % 2 else (1, 0):
            begin = time.perf_counter_ns()
            pair[which]()
            times[which].append((time.perf_counter_ns() - begin) * 1e-3)
        tape.take()
    return times


def main() -> int:
    """Measure, print, judge."""
    words = argparse.ArgumentParser(description=(__doc__ or "").split("\n\n")[0])
    words.add_argument("--calls", type=int, default=1000)
    words.add_argument("--killed", action="store_true", help="SIGKILL of a program")
    words.add_argument("--tries", type=int, default=50, help="with --killed")
    told = words.parse_args()
    if told.killed:
        killed_devices.measure(told.tries)
        return 0
    calls = told.calls
    missed = False
    tape = Tape()
    sys.stdout.write("| driver | median | p99 | bare, median | p99 | beside it |\n")
    sys.stdout.write("|---|---|---|---|---|---|\n")
    with tempfile.TemporaryDirectory() as run, ExitStack() as stack, using(tape):
        os.environ["PBONET_RUN_DIR"] = run
        Path(run).chmod(0o700)
        for case in cases(stack):
            ours, bare = (sorted(one) for one in measured(case, calls, tape))
            over = statistics.median(ours) - statistics.median(bare)
            missed = missed or over > GOAL
            row = [statistics.median(ours), ours[int(0.99 * calls)]]
            row += [statistics.median(bare), bare[int(0.99 * calls)], over]
            sys.stdout.write(
                f"| {case.name} | {' | '.join(f'{v:.1f}' for v in row)} |\n"
            )
    sys.stdout.write(
        f"goal: at most {GOAL:g} us beside it: {'MISSED' if missed else 'met'}\n"
    )
    return MISSED if missed else 0


if __name__ == "__main__":
    sys.exit(main())
