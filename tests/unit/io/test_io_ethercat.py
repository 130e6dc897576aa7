"""An EtherCAT bus at pysoem's edge."""

from __future__ import annotations

import pysoem
import pytest
from device_rigs import Ethercat

from pbonet.errors import DeviceError
from pbonet.io.drivers import Mode, database, open_device


@pytest.fixture
def bus(monkeypatch, tmp_path):
    monkeypatch.setenv("PBONET_RUN_DIR", str(tmp_path / "run"))
    return Ethercat(monkeypatch, tmp_path)


def opened(bus, mode=Mode.RW, safe=None, **settings):
    with database.using({"x": bus.entry(**settings)}):
        return open_device("x", mode=mode, safe=safe)


def test_slaves_go_into_operation_with_outputs_of_0_and_back(bus):
    bus.slaves[0].output = b"\7\7\7"
    with opened(bus) as image:
        assert bus.log[:3] == ["open", "map", [bytes(3), bytes(1)]]
        assert bus.log[3] == pysoem.OP_STATE
        assert image.status("IMAGE") == (3, 4)
    assert bus.log[-2:] == [pysoem.INIT_STATE, "closed"]


def test_slaves_begin_with_safe_values_and_have_them_before_they_leave(bus):
    with opened(bus, safe={2: b"\5\6"}, lost=3) as image:
        assert bus.log[2:4] == [[b"\0\0\5", b"\6"], pysoem.OP_STATE]
        image.write(b"abcd")
        image.exchange()
        counters = iter([0, 0, 6])
        bus.receive_processdata = lambda _: next(counters)
    assert bus.log[-5:] == [[b"ab\5", b"\6"]] * 3 + [pysoem.INIT_STATE, "closed"]


@pytest.mark.parametrize("lost", [1, 2])
def test_safe_values_that_no_slave_takes_are_told_and_the_bus_leaves(bus, lost):
    image = opened(bus, safe={0: b"\0"}, lost=lost)
    bus.counter = 0
    with pytest.raises(DeviceError, match="the device is gone"):
        image.close()
    assert bus.log[-2:] == [pysoem.INIT_STATE, "closed"]


def test_an_exchange_carries_outputs_and_brings_inputs(bus):
    with opened(bus) as image:
        image.write(b"abcd")
        image.write(b"X", at=1)
        bus.slaves[1].input = b"\x09"
        assert image.read(3) == b"\1\2\3", "of the exchange at open"
        image.exchange()
        assert bus.log[-1] == [b"aXc", b"d"]
        assert image.read(2, at=1) == b"\2\x09"


def test_a_slave_that_misses_an_exchange_is_told_and_then_the_bus_is_lost(bus):
    with opened(bus, lost=3) as image:
        bus.counter = 3
        for _ in range(2):
            with pytest.raises(DeviceError, match=r"not all slaves.*counter 6, got 3"):
                image.exchange()
        bus.counter = 6
        image.exchange()
        bus.counter = 0
        for told in ("not all slaves", "not all slaves", "the device is gone"):
            with pytest.raises(DeviceError, match=told):
                image.exchange()
    assert bus.log[-1] == "closed"


@pytest.mark.parametrize(
    ("settings", "change", "told"),
    [
        ({"slaves": 3}, {}, "expected an interface with 3 slaves.*got 2 slaves"),
        ({}, {"found": -1}, "got 0 slaves"),
        ({}, {"stuck": 1}, r"got slave 2 \(io\): "),
        ({"slaves": 0}, {}, "a setting of the device is wrong"),
        ({"timeout": 1.0}, {}, "a setting of the device is wrong"),
    ],
)
def test_a_bus_that_is_not_as_it_should_be_is_refused(bus, settings, change, told):
    for name, value in change.items():
        setattr(bus, name, value)
    with pytest.raises(DeviceError, match=told):
        opened(bus, **settings)
    assert bus.log[-1:] in (["closed"], [])


@pytest.mark.parametrize(
    ("mode", "call", "told"),
    [
        (Mode.RW, lambda x: x.read(4), "expected 0 to 2, got 0 to 3"),
        (Mode.RW, lambda x: x.write(b"abc", at=2), "expected 0 to 3, got 2 to 4"),
        (Mode.RW, lambda x: x.mmap(), "not mapped"),
        (Mode.READ, lambda x: x.write(b"a"), "not open in this direction"),
        (Mode.WRITE, lambda x: x.read(1), "not open in this direction"),
    ],
)
def test_what_the_image_has_not_is_refused(bus, mode, call, told):
    with opened(bus, mode) as image:
        with pytest.raises(DeviceError, match=told):
            call(image)
        image.exchange()
