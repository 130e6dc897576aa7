"""Drivers over devices of a real kernel, run by scripts/umlrun.py; prints results.

It needs the modules vcan, can-raw, can-j1939, i2c-dev, tmp006, ti-adc081c, and
i2c-stub with chips at 0x40, 0x48 and 0x54.
"""

from __future__ import annotations

import json
import os
import subprocess
import sys
import tempfile
import time
from pathlib import Path

import msgspec
import smbus2

from pbonet.errors import DeviceError
from pbonet.io.drivers import (
    Entry,
    Frame,
    Group,
    Mode,
    Wait,
    database,
    open_device,
    port_claims,
)

BUS = next((str(one) for one in Path("/dev").glob("i2c-*")), "no bus")
DEVICES = {
    "can": Entry(driver="can", address="vcan0", ports=4, settings={"fd": True}),
    "drive": Entry(
        driver="can",
        address="vcan0",
        first=4,
        settings={"filters": ["181/7FF", "18FF0000/1FFF0000"]},
    ),
    "ecu": Entry(driver="j1939", address="vcan0", ports=3, settings={"source": 0x20}),
    "tool": Entry(driver="j1939", address="vcan0", first=3, settings={"source": 0x21}),
    "nocan": Entry(driver="can", address="vcan7"),
    "words": Entry(
        driver="i2c",
        address=f"{BUS}:0x48",
        settings={"registers": [1, 2, 5], "bits": 16, "order": "big"},
    ),
    "bytes": Entry(
        driver="i2c",
        address=f"{BUS}:0x48",
        first=3,
        settings={"registers": [1, 2, 5, 1, 9]},
    ),
    "burst": Entry(
        driver="i2c",
        address=f"{BUS}:0x48",
        first=8,
        settings={"registers": [*range(32, 72), 80], "burst": True},
    ),
    "nochip": Entry(driver="i2c", address=f"{BUS}:0x50", settings={"registers": [0]}),
    "nobus": Entry(driver="i2c", address="/dev/null:0x50", settings={"registers": [0]}),
}


def link(*words):
    subprocess.run(["ip", "link", *words], check=True)


def refused(call, *args, **named):
    try:
        return f"it gave {call(*args, **named)}"
    except DeviceError as error:
        return str(error)


def collected(device, count):
    """Wait until so many frames have come; the kernel may pass them on later."""
    found = []
    while len(found) < count:
        found += device.read(count - len(found))
    return found


PROGRAM = """
import msgspec, sys, time
from pbonet.io.drivers import Entry, Frame, Group, Mode, database, open_device
entry = msgspec.json.decode(sys.argv[1], type=Entry)
safe, go = {
    "can": ([Frame(0, b"\\2\\0")], [Frame(0x201, b"go")]),
    "j1939": ([Group(0xFEF3, bytes(100))], [Group(0xFEF1, b"go")]),
}[entry.driver]
with database.using({"x": entry}, "uml/acts"):
    x = open_device("x", 2, mode=Mode.WRITE, safe=safe)
    x.write(go)
    print("ready", flush=True)
    time.sleep(600)
"""


def killed(name, seen):
    """Return what a program that was killed leaves on the bus."""
    entry = msgspec.json.encode(DEVICES[name]).decode()
    with (
        seen,
        subprocess.Popen(
            [sys.executable, "-c", PROGRAM, entry], stdout=subprocess.PIPE
        ) as program,
    ):
        program.stdout.readline()
        program.kill()
        frames = collected(seen, 2)
        while list(port_claims.users(DEVICES[name], range(2, 3))):
            time.sleep(0.01)
    return [(one[0], list(one.data)) for one in frames]


DRIVES = """
import time
from pbonet.io.drivers import Entry, database
from pbonet.modules.robot_interfaces.can_speed import CanSpeed
from pbonet.testing import Bench
told = {"device": "can0", "nodes": (1, 5), "counts": (2000.0,), "rated": (0.5,)}
entry = Entry(driver="can", address="vcan0", first=6)
with database.using({"can0": entry}, "uml/drives"):
    bench = Bench(CanSpeed, params=told, ndof=2, freq=100, critical=True)
    bench.on()
    bench.step()
    print("ready", flush=True)
    time.sleep(600)
"""


def killed_drives(seen):
    """Return what a module that was killed leaves on the bus for its drives."""
    command = [sys.executable, "-c", DRIVES]
    with seen, subprocess.Popen(command, stdout=subprocess.PIPE) as program:
        program.stdout.readline()
        while seen.read(99):
            pass  # what it sent while it lived
        program.kill()
        return [(one.id, list(one.data)) for one in collected(seen, 2)]


def can():
    link("add", "vcan0", "type", "vcan")
    down = refused(open_device, "can")
    link("set", "vcan0", "mtu", "72", "up")
    sent = [
        Frame(0x181, b"\1\2"),
        Frame(0x18FF0012, b"", extended=True),
        Frame(0x182, bytes(range(8))),
        Frame(0x7FF, b"x" * 48, fd=True),
        Frame(0x182, remote=True),
        Frame(0x181, b"last"),
    ]
    left = killed("can", open_device("can", 3, mode=Mode.READ))
    drives = killed_drives(open_device("can", 3, mode=Mode.READ, wait=Wait.NONE))
    before = time.time_ns()
    with (
        open_device("can", 0, mode=Mode.RW, safe=None) as a,
        open_device("can", 1, mode=Mode.RW, safe=None, wait=Wait.NONE) as b,
        open_device("drive", mode=Mode.READ, wait=Wait.NONE) as drive,
        open_device("can", 2, mode=Mode.WRITE, safe=None) as deaf,
    ):
        nothing = b.read(9)
        taken = a.write(sent)
        got, filtered = collected(b, len(sent)), collected(drive, 3)
        b.write([Frame(5)])
        answer = a.read(9)
        flood = sum(a.write([Frame(1, b"12345678")]) for _ in range(2000))
        kept = len(b.read(3000))
        unheard = deaf._bus.receive(0) is None and deaf.write([Frame(1)]) == 1
        link("set", "vcan0", "down")
        lost = [refused(b.read, 1), refused(a.write, [Frame(1)]), refused(b.read, 1)]
        lost.append(refused(deaf.write, [Frame(1)]))
    link("set", "vcan0", "up")
    with open_device("can", 1, mode=Mode.RW, safe=None, wait=Wait.NONE) as b:
        again = b.write([Frame(1)])
        link("del", "vcan0")
        deleted = refused(b.read, 1)
    plain = [one._replace(stamp_ns=0) for one in got]
    return {
        "killed": left,
        "drives": drives,
        "down": down,
        "nothing": nothing,
        "taken": taken,
        "same": plain == sent,
        "stamps": all(before <= one.stamp_ns <= time.time_ns() for one in got),
        "filtered": [one.id for one in filtered],
        "answer": [one.id for one in answer],
        "flood": [flood, kept],
        "unheard": unheard,
        "lost": lost,
        "again": again,
        "deleted": deleted,
        "missing": refused(open_device, "nocan"),
    }


def i2c():
    count = 33  # more than a transfer has, and one that does not follow
    with open_device("burst", 0, count - 1, mode=Mode.RW, safe=None) as burst:
        burst.write(range(100, 100 + count))
        together = burst.read() == list(range(100, 100 + count))
    with open_device("words", 0, 2, mode=Mode.RW, safe=None, size=16) as words:
        words.write([0x1234, 0xFFFE, 7])
        found = words.read()
    with open_device("words", 1, mode=Mode.READ, size=32, signed=True) as word:
        signed = word.read()
    with open_device("bytes", 0, 1, mode=Mode.RW, safe=None, size=8) as some:
        low = some.read()
        some.write([low[0], 0xAB])
        back = some.read()
    with open_device("nochip", mode=Mode.READ) as chip:
        none = refused(chip.read)
    return {
        "together": together,
        "found": found,
        "signed": signed,
        "low": low[0],
        "back": back[1],
        "none": none,
        "nobus": refused(open_device, "nobus"),
    }


def j1939():
    down = refused(open_device, "tool", mode=Mode.RW, safe=None)
    link("add", "vcan0", "type", "vcan")
    link("set", "vcan0", "up")
    left = killed("ecu", open_device("tool", 1, mode=Mode.READ))
    many = [Group(0xEF00, bytes(range(250)) * 7, 0x20)]
    with (
        open_device("ecu", 0, mode=Mode.RW, safe=None) as ecu,
        open_device("ecu", 1, mode=Mode.READ, wait=Wait.NONE) as same,
        open_device("tool", mode=Mode.RW, safe=None) as tool,
    ):
        before = time.time_ns()
        tool.write([Group(0xFEF1, b"12345678"), Group(0xFEF2, bytes(100))])
        heard = collected(ecu, 2)
        stamps = all(before <= one.stamp_ns <= time.time_ns() for one in heard)
        tool.write(many)
        (large,) = collected(ecu, 1)
        others = [one.pgn for one in same.read(9)]
        ecu.write([Group(0xEF00, b"back", 0x21)])
        back = collected(tool, 1)[0]
        tool.write([Group(0xEF00, bytes(100), 0x33)])
        nobody = None
        while nobody is None:
            told = refused(tool.write, [Group(0xFEF1, b"x")])
            nobody = told if "destination" in told else None
            time.sleep(0.01)
        again = tool.write([Group(0xFEF1, b"x")])
        link("set", "vcan0", "down")
        lost = refused(collected, ecu, 999), refused(tool.write, [Group(1 << 8, b"x")])
    return {
        "down": down,
        "killed": left,
        "heard": [(one.pgn, len(one.data), one.source) for one in heard],
        "stamps": stamps,
        "large": [large.data == many[0].data, large.destination, large.source],
        "others": others,
        "back": [back.data.decode(), back.destination, back.source],
        "nobody": nobody,
        "again": again,
        "lost": lost,
    }


def iio():
    """Let the kernel's drivers find a thermometer and a converter on the stub's bus."""
    number = BUS.rpartition("-")[2]
    bus = Path(f"/sys/bus/i2c/devices/i2c-{number}")
    with smbus2.SMBus(BUS) as raw:
        for address, register, value in (
            *((0x40, 0xFE, 0x5449), (0x40, 0xFF, 0x0067), (0x40, 2, 0x7480)),
            *((0x40, 0, -4660 & 0xFFFF), (0x40, 1, 0x0C80), (0x54, 0, 0x0AB0)),
        ):
            swapped = (value & 0xFF) << 8 | value >> 8
            raw.write_word_data(address, register, swapped)
    folders = {}
    for name, address in (("tmp006", 0x40), ("adc081c", 0x54)):
        (bus / "new_device").write_text(f"{name} {address:#x}")
        (found,) = (bus / f"{number}-{address:04x}").glob("iio:device*")
        folders[name] = f"/sys/bus/iio/devices/{found.name}"
    entries = {
        name: Entry(driver=driver, address=folders[chip])
        for name, driver, chip in (
            ("heat", "iio_adc", "tmp006"),
            ("adc", "iio_adc", "adc081c"),
            ("buffer", "iio_buffer", "adc081c"),
            ("none", "iio_buffer", "tmp006"),
        )
    }
    sysfs = Path(folders["adc081c"])
    with database.using(entries, "uml/test"):
        with open_device("heat", 0, 1, mode=Mode.READ, signed=True) as heat:
            heats = heat.read()
        with open_device("adc", mode=Mode.READ) as adc:
            values, bits = adc.read(), adc.status("PORTSIZE")
            no_trigger = refused(open_device, "buffer", mode=Mode.READ)
            chosen = (sysfs / "scan_elements" / "in_voltage_en").read_text().strip()
            with open_device("buffer") as buffer:
                known = buffer.status("PORTNUM"), buffer.status("PORTSIZE")
            after = adc.read()
            none = refused(open_device, "none", mode=Mode.READ)
            (bus / "delete_device").write_text("0x54")
            lost = refused(adc.read)
        return {
            "heats": heats,
            "values": [values, after],
            "bits": bits,
            "no_trigger": no_trigger,
            "chosen": chosen,
            "known": known,
            "none": none,
            "lost": lost,
        }


if __name__ == "__main__":
    os.environ["PBONET_RUN_DIR"] = tempfile.mkdtemp(dir="/run")
    with database.using(DEVICES, "uml/test"):
        print(json.dumps({"can": can(), "i2c": i2c(), "j1939": j1939(), "iio": iio()}))
