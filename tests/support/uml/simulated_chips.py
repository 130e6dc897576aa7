"""Drivers over devices that the kernel of scripts/umlkernel.py simulates, all of them
made here by the kernel's own interfaces; prints results. scripts/umlrun.py runs it.
"""

from __future__ import annotations

import faulthandler
import fcntl
import json
import os
import struct
import subprocess
import tempfile
import time
import traceback
from contextlib import contextmanager
from pathlib import Path

import gpiod
from buses_and_converters import collected, refused

from pbonet.io.drivers import Entry, Mode, Wait, database, open_device

CONFIG = Path("/sys/kernel/config")


def until(call):
    """Wait until a call returns something."""
    while not (found := call()):
        time.sleep(0.001)
    return found


@contextmanager
def using(**entries):
    made = {
        name: Entry(
            driver=driver, address=str(address), first=first, settings=dict(settings)
        )
        for name, (driver, address, first, settings) in entries.items()
    }
    with database.using(made, "uml/test"):
        yield


class Chip:
    """A chip of eight lines (gpio-sim); lines that are inputs have what pulls them."""

    def __init__(self, name):
        self.folder = CONFIG / "gpio-sim" / name
        (self.folder / "bank").mkdir(parents=True)
        (self.folder / "bank" / "num_lines").write_text("8\n")
        (self.folder / "live").write_text("1\n")
        name = (self.folder / "bank" / "chip_name").read_text().strip()
        device = (self.folder / "dev_name").read_text().strip()
        self.path = f"/dev/{name}"
        self._lines = Path("/sys/devices/platform") / device / name
        until(Path(self.path).exists)

    def pull(self, line, value):
        word = "pull-up" if value else "pull-down"
        (self._lines / f"sim_gpio{line}" / "pull").write_text(f"{word}\n")
        time.sleep(0.001)  # the kernel notes edges in a thread of its own

    def values(self, *lines):
        files = (self._lines / f"sim_gpio{line}" / "value" for line in lines)
        return [int(one.read_text()) for one in files]

    def remove(self):
        (self.folder / "live").write_text("0\n")


def gpio():
    chip = Chip("lines")
    with using(
        relays=("gpio", chip.path, 0, {"active_low": [1]}),
        buttons=("gpio", chip.path, 4, {}),
        pulled=("gpio", chip.path, 4, {"bias": "up"}),
        none=("gpio", "/dev/gpiochip9", 0, {}),
    ):
        found = {}
        with open_device("relays", 0, 2, mode=Mode.RW, safe=[1, 1, 0]) as relays:
            found["begin"] = chip.values(0, 1, 2)
            relays.write([0, 0, 1])
            found["written"] = [chip.values(0, 1, 2), relays.read()]
            relays.write_safe()
            found["safe"] = chip.values(0, 1, 2)
            found["ports"] = relays.status("PORTNUM")
        found["closed"] = chip.values(0, 1, 2)
        chip.pull(3, 1)
        with open_device("relays", 3, mode=Mode.WRITE, safe=None):
            found["kept"] = chip.values(3)
        chip.pull(4, 0)
        chip.pull(5, 1)
        with open_device("buttons", 0, 1, mode=Mode.READ) as buttons:
            found["read"] = buttons.read()
            chip.pull(4, 1)
            found["read again"] = buttons.read()
        chip.pull(4, 0)
        with open_device("pulled", 0, mode=Mode.READ) as pulled:
            found["biased"] = pulled.read()
        taken = gpiod.request_lines(chip.path, consumer="other", config={4: None})
        found["taken"] = refused(open_device, "buttons", mode=Mode.READ)
        taken.release()
        found["missing"] = refused(open_device, "none", mode=Mode.READ)
        found["beyond"] = refused(open_device, "buttons", 4, mode=Mode.READ)
        with open_device("relays", 0, mode=Mode.RW, safe=None) as relays:
            chip.remove()
            found["lost"] = refused(relays.read), refused(relays.read)
    return found


def edges():
    chip = Chip("edges")
    with using(
        edges=("gpio_edges", chip.path, 6, {"buffer": 16}),
        falling=("gpio_edges", chip.path, 6, {"edges": "falling"}),
    ):
        found = {}
        chip.pull(6, 0)
        with open_device("edges", 0, 1, mode=Mode.READ) as seen:
            before, got = time.time_ns(), []
            for line, value in ((6, 1), (7, 1), (6, 0)):
                chip.pull(line, value)
                got += collected(seen, 1)  # the kernel joins edges that follow closely
            found["edges"] = [[one.port, one.rising] for one in got]
            stamps = [one.stamp_ns for one in got]
            found["in order"] = before <= stamps[0] < stamps[2] <= time.time_ns()

            def dropped():
                for k in range(100):
                    chip.pull(6, (k + 1) % 2)
                found["held"] = len(seen.read(64))
                return seen.status("DROPPED")

            found["dropped"] = until(dropped)
        with open_device("falling", mode=Mode.READ, wait=Wait.NONE) as seen:

            def fell():
                chip.pull(6, 1)
                chip.pull(6, 0)
                return seen.read(9)

            one = until(fell)[0]
            found["falling"] = [one.port, one.rising]
        with open_device("edges", 1, mode=Mode.READ) as seen:
            chip.remove()
            found["lost"] = refused(seen.read, 1)
    return found


UI_DEV_CREATE, UI_DEV_DESTROY = 0x5501, 0x5502
UI_SET_EVBIT, UI_SET_KEYBIT, UI_SET_ABSBIT = 0x40045564, 0x40045565, 0x40045567
EVENT = struct.Struct("@llHHi")


class Stick:
    """A joystick of two axes and two buttons (uinput)."""

    def __init__(self):
        before = set(Path("/dev/input").glob("event*"))
        self.fd = os.open("/dev/uinput", os.O_WRONLY)
        for request, value in (
            *((UI_SET_EVBIT, 1), (UI_SET_EVBIT, 3)),
            *((UI_SET_KEYBIT, 304), (UI_SET_KEYBIT, 305)),
            *((UI_SET_ABSBIT, 0), (UI_SET_ABSBIT, 1)),
        ):
            fcntl.ioctl(self.fd, request, value)
        ranges = [0] * 256
        ranges[0:2], ranges[64:66] = [255, 100], [0, -100]
        head = struct.pack("80s4HI", b"stick", 3, 1, 1, 1, 0)
        os.write(self.fd, head + struct.pack("256i", *ranges))
        fcntl.ioctl(self.fd, UI_DEV_CREATE)
        (self.path,) = until(lambda: set(Path("/dev/input").glob("event*")) - before)

    def send(self, *events):
        for kind, code, value in (*events, (0, 0, 0)):
            os.write(self.fd, EVENT.pack(0, 0, kind, code, value))

    def remove(self):
        fcntl.ioctl(self.fd, UI_DEV_DESTROY)
        os.close(self.fd)


def joystick():
    stick = Stick()
    stick.send((3, 0, 128), (1, 305, 1))
    codes = {"axes": [0, 1], "buttons": [304, 305]}
    with using(
        stick=("joystick", stick.path, 0, codes),
        wheel=("joystick", stick.path, 0, {"axes": [5], "buttons": []}),
    ):
        found = {"no axis": refused(open_device, "wheel", mode=Mode.READ)}
        with open_device("stick", 0, 3, mode=Mode.READ, signed=True) as device:
            found["begin"] = device.read()
            found["ranges"] = [list(device.status("RANGE", k)) for k in range(4)]
            stick.send((3, 1, -100), (1, 304, 1), (1, 305, 0))
            found["moved"] = device.read()
            for k in range(2000):  # more than the kernel keeps
                stick.send((3, 0, k % 200))
            stick.send((3, 0, 17))
            until(lambda: device.read()[0] == 17)
            found["flooded"] = device.read()
            stick.remove()
            found["lost"] = refused(device.read), refused(device.read)
        found["missing"] = refused(open_device, "stick", mode=Mode.READ)
    return found


def iio():
    (CONFIG / "iio/devices/dummy/one").mkdir()
    (CONFIG / "iio/triggers/hrtimer/clock").mkdir()
    folders = Path("/sys/bus/iio/devices")
    (folder,) = folders.glob("iio:device*")
    (clock,) = folders.glob("trigger*")
    (clock / "sampling_frequency").write_text("500\n")
    until(Path("/dev", folder.name).exists)
    buffered = {"trigger": "clock", "length": 64}
    with using(
        adc=("iio_adc", folder, 0, {"channels": ["voltage0", "accel_x"]}),
        all=("iio_adc", folder, 0, {}),
        dac=("iio_dac", folder, 0, {}),
        buffer=("iio_buffer", folder, 0, buffered),
        wrong=("iio_buffer", folder, 0, {"trigger": "no such clock"}),
    ):
        found = {"no trigger": refused(open_device, "wrong", mode=Mode.READ)}
        with open_device("adc", 0, 1, mode=Mode.READ, signed=True) as adc:
            found["adc"] = adc.read(), [adc.status("PORTSIZE", k) for k in (0, 1)]
        with open_device("all", mode=Mode.NONE) as adc:
            found["channels"] = adc.status("PORTNUM")
        with open_device("dac", mode=Mode.WRITE, safe=[5]) as dac:
            dac.write([1234])
            raw = folder / "out_voltage0_raw"
            found["dac"] = int(raw.read_text())
        found["dac safe"] = int(raw.read_text())
        before = time.time_ns()
        with open_device("buffer", 0, 3, mode=Mode.READ, signed=True) as buffer:
            got = collected(buffer, 20)
            found["samples"] = [list(got[0].values), list(got[-1].values)]
            stamps = [one.stamp_ns for one in got]
            found["in order"] = before <= stamps[0] and stamps == sorted(stamps)
            found["bits"] = [buffer.status("PORTSIZE", k) for k in range(4)]
            found["running"] = refused(open_device, "buffer", mode=Mode.READ)
        with open_device("buffer", 1, mode=Mode.READ, signed=True) as buffer:
            found["one channel"] = list(collected(buffer, 1)[0].values)
            (CONFIG / "iio/devices/dummy/one").rmdir()
            found["lost"] = refused(lambda: [buffer.read(64) for _ in range(9)])
    return found


def spi():
    path = "/dev/spidev0.0"
    with using(
        bus=("spi", path, 0, {"mode": 3, "speed": 1000000, "cs_high": True}),
        turned=("spi", path, 0, {"lsb_first": True}),
        none=("spi", "/dev/spidev9.9", 0, {}),
    ):
        found = {
            "refused": refused(open_device, "turned", mode=Mode.READ),
            "missing": refused(open_device, "none", mode=Mode.READ),
        }
        with open_device("bus", mode=Mode.RW, safe=b"\0\7") as bus:
            found["answer"] = list(bus.transfer(bytes(range(200)))) == [*range(200)]
            found["most"] = bus.transfer(b"\x55" * 4096) == b"\x55" * 4096
            found["read"] = list(bus.read(3))
            found["write"] = bus.write(b"abc")
        with open_device("bus", mode=Mode.RW, safe=None) as bus:
            Path("/sys/bus/spi/drivers/spidev/unbind").write_text("spi0.0")
            found["lost"] = refused(bus.transfer, b"a"), refused(bus.transfer, b"a")
    return found


def main():
    faulthandler.dump_traceback_later(60, exit=True)  # a wait for what never comes
    os.environ["PBONET_RUN_DIR"] = tempfile.mkdtemp(dir="/run")
    subprocess.run(["mount", "-t", "configfs", "configfs", CONFIG], check=True)
    results = {}
    for part in (gpio, edges, joystick, iio, spi):
        try:
            results[part.__name__] = part()
        except Exception:  # noqa: BLE001 - the others are run all the same
            results[part.__name__] = {"failed": traceback.format_exc()}
    print(json.dumps(results))


if __name__ == "__main__":
    main()
