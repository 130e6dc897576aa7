"""Devices that a test makes up, each at the edge of its library or of the kernel.

A rig has the device's entry, the mode in which it is opened, and what can happen to it.
"""

from __future__ import annotations

import errno
import os

import gpiod
from msgspec.structs import replace

from pbonet.io.drivers import Entry, Mode


def gone(*_):
    raise OSError(errno.ENODEV, os.strerror(errno.ENODEV))


class Rig:
    """A device of a driver; the defaults fit ports that are read."""

    mode = Mode.READ
    library = extra = ""
    """The package without which it cannot be opened."""
    ports = 1
    """How many it has."""
    wrong = None
    """A mode that it does not have."""
    lost = "No such device"
    """What is told when it is lost."""

    def __init__(self, monkeypatch, tmp_path):
        self.patch, self.folder = monkeypatch, tmp_path

    def missing(self):
        """Return the entry of one that is not there."""
        return replace(self.entry(), address=str(self.folder / "none"))

    def use(self, device):
        """Return what the device gives."""
        return device.read()


def entry(driver, address, first=0, ports=0, **settings):
    return Entry(
        driver=driver, address=str(address), first=first, ports=ports, settings=settings
    )


class Lines:
    """What a chip gives for requested lines; edges come by a pipe."""

    def __init__(self, chip, config, size):
        self.chip, self.config, self.size = chip, config, size
        self.fd, self._there = os.pipe()
        self.edges, self.number = [], 0
        for line, one in config.items():
            assert isinstance(one, gpiod.LineSettings)
            if one.direction == gpiod.line.Direction.OUTPUT:
                chip.values[line] = [one.output_value.value]

    def get_values(self, lines):
        self.chip.check()
        return [gpiod.line.Value(self.chip.values.get(k, [0])[-1]) for k in lines]

    def set_values(self, values):
        self.chip.check()
        assert set(values) <= set(self.config)
        for line, value in values.items():
            self.chip.values.setdefault(line, []).append(value.value)

    def edge(self, line, rising, stamp_ns):
        self.number += 1
        kind = gpiod.EdgeEvent.Type.RISING_EDGE if rising else 2
        self.edges.append(gpiod.EdgeEvent(kind, stamp_ns, line, self.number, 1))
        del self.edges[: -self.size]
        os.write(self._there, b"x")

    def wait_edge_events(self, seconds):
        assert seconds == 0
        self.chip.check()
        return bool(self.edges)

    def read_edge_events(self, limit):
        found, self.edges = self.edges[:limit], self.edges[limit:]
        return found

    def release(self):
        self.chip.requests.remove(self)
        os.close(self.fd)
        os.close(self._there)


class Chip:
    """A chip of eight lines at the edge of gpiod."""

    num_lines = 8

    def __init__(self, path):
        self.path, self.values, self.requests, self.lost = str(path), {}, [], False

    def __call__(self, path):
        if path != self.path:
            raise FileNotFoundError(errno.ENOENT, os.strerror(errno.ENOENT))
        return self

    def __enter__(self):
        return self

    def __exit__(self, *_):
        pass

    def get_info(self):
        return self

    def check(self):
        if self.lost:
            gone()

    def request_lines(self, config, consumer, event_buffer_size=16):
        assert consumer == "pbonet x"
        used = {line for one in self.requests for line in one.config}
        if used & set(config):
            raise OSError(errno.EBUSY, os.strerror(errno.EBUSY))
        self.requests.append(Lines(self, config, event_buffer_size))
        return self.requests[-1]


class Gpio(Rig):
    library, extra = "gpiod", "gpio"
    ports = 6
    driver = "gpio"

    def __init__(self, monkeypatch, tmp_path):
        super().__init__(monkeypatch, tmp_path)
        self.chip = Chip(tmp_path / "gpiochip0")
        monkeypatch.setattr(gpiod, "Chip", self.chip)

    def entry(self, **settings):
        return entry(self.driver, self.chip.path, first=2, **settings)

    def prepare(self):
        self.chip.values = {3: [1]}

    def lose(self):
        self.chip.lost = True


class GpioEdges(Gpio):
    driver = "gpio_edges"
    wrong = Mode.RW

    def prepare(self):
        self.chip.requests[0].edge(3, True, 7)

    def use(self, device):
        return device.read(1)


RIGS = {
    "gpio": Gpio,
    "gpio_edges": GpioEdges,
}
