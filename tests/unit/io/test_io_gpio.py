"""Lines of a chip and their edges; gpiod's chip is replaced."""

from __future__ import annotations

import errno
import threading

import gpiod
import pytest
from device_rigs import Gpio, GpioEdges, Lines

from pbonet.errors import DeviceError
from pbonet.io.drivers import Mode, Wait, database, open_device
from pbonet.io.drivers.gpio_driver import Edge


@pytest.fixture
def devices(monkeypatch, tmp_path):
    monkeypatch.setenv("PBONET_RUN_DIR", str(tmp_path / "run"))

    def use(rig, **settings):
        one = rig(monkeypatch, tmp_path)
        database.use({"x": one.entry(**settings)}, "arm0/reads")
        return one.chip

    yield use
    database.use({}, "")


def test_an_output_has_its_safe_value_when_it_becomes_one(devices):
    chip = devices(Gpio, active_low=[5], drive="open-drain", bias="up")
    with open_device("x", 1, 3, mode=Mode.RW, safe=[0, 1, 0]) as lines:
        assert chip.values == {3: [0], 4: [1], 5: [0]}, "in the request itself"
        config = chip.requests[0].config
        assert [config[k].active_low for k in (3, 4, 5)] == [False, False, True]
        assert config[3].drive == gpiod.line.Drive.OPEN_DRAIN
        assert config[3].bias == gpiod.line.Bias.PULL_UP
        lines.write([1, 1, 0])
        assert chip.values == {3: [0, 1], 4: [1, 1], 5: [0, 0]}
        assert lines.read() == [1, 1, 0]
    assert chip.values == {3: [0, 1, 0], 4: [1, 1, 1], 5: [0, 0, 0]}
    assert chip.requests == []


def test_an_output_without_safe_values_keeps_the_value_of_its_line(devices):
    chip = devices(Gpio, drive="open-source")
    chip.values = {3: [1], 4: [0]}
    with open_device("x", 1, 2, mode=Mode.WRITE, safe=None) as lines:
        (request,) = chip.requests
        assert request.config[3].direction == gpiod.line.Direction.OUTPUT
        assert request.config[3].drive == gpiod.line.Drive.OPEN_SOURCE
        lines.write([1, 1])
    assert chip.values == {3: [1, 1, 1], 4: [0, 0, 1]}


def test_lines_that_cannot_become_outputs_are_given_back(devices, monkeypatch):
    chip = devices(Gpio)

    def refuse(*_):
        raise OSError(errno.EPERM, "Operation not permitted")

    monkeypatch.setattr(Lines, "reconfigure_lines", refuse)
    with pytest.raises(DeviceError, match="the lines cannot be had"):
        open_device("x", mode=Mode.WRITE, safe=None)
    assert chip.requests == []


def test_an_input_is_never_driven(devices):
    chip = devices(Gpio)
    chip.values[2] = [1]
    with open_device("x", 0, 1, mode=Mode.READ) as lines:
        assert lines.read() == [1, 0]
        assert chip.requests[0].config[2].direction == gpiod.line.Direction.INPUT
        with pytest.raises(DeviceError, match="not open in this direction"):
            lines.write([1, 1])
    assert chip.values == {2: [1]}


def test_lines_that_another_program_has_are_named(devices):
    devices(Gpio).request_lines({3: gpiod.LineSettings()}, "pbonet x")
    open_device("x", 0, mode=Mode.READ).close()
    with pytest.raises(DeviceError, match=r"got Device or resource busy.*gpioinfo"):
        open_device("x", 1, mode=Mode.READ)


@pytest.mark.parametrize(
    ("wait", "there", "asked", "got"),
    [
        (Wait.NONE, 0, 2, 0),
        (Wait.NONE, 3, 2, 2),
        (Wait.NOALL, 1, 2, 0),
        (Wait.NOALL, 2, 2, 2),
        (Wait.ONE, 1, 2, 1),
        (Wait.ALL, 3, 2, 2),
    ],
)
def test_edges_are_awaited_as_the_device_was_opened(devices, wait, there, asked, got):
    chip = devices(GpioEdges, edges="rising", debounce_us=500)
    with open_device("x", 0, 5, mode=Mode.READ, wait=wait) as edges:
        (request,) = chip.requests
        one = request.config[3]
        assert one.edge_detection == gpiod.line.Edge.RISING
        assert one.debounce_period.microseconds == 500
        assert one.event_clock == gpiod.line.Clock.REALTIME
        for k in range(there):
            request.edge(2 + k, k % 2 == 0, 100 + k)
        all_of_them = [Edge(k, k % 2 == 0, 100 + k) for k in range(4)]
        assert edges.read(asked) == all_of_them[:got]
        for k in range(there, 4):
            request.edge(2 + k, k % 2 == 0, 100 + k)
        assert edges.read(4 - got) == all_of_them[got:]


def test_a_reader_waits_for_an_edge(devices):
    chip, found = devices(GpioEdges), []
    with open_device("x", mode=Mode.READ, wait=Wait.ALL) as edges:
        reads = threading.Thread(target=lambda: found.extend(edges.read(2)))
        reads.start()
        for stamp in (1, 2):
            chip.requests[0].edge(2, True, stamp)
        reads.join()
    assert [one.stamp_ns for one in found] == [1, 2]


def test_edges_that_the_kernel_dropped_are_counted(devices):
    chip = devices(GpioEdges, buffer=4)
    with open_device("x", mode=Mode.READ, wait=Wait.NONE) as edges:
        for k in range(10):
            chip.requests[0].edge(2, k % 2 == 0, k)
        assert [one.stamp_ns for one in edges.read(9)] == [6, 7, 8, 9]
        assert edges.status("DROPPED") == 6
