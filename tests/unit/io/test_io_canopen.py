"""Objects of a CANopen node, which answers at the other end of a virtual bus."""

from __future__ import annotations

import contextlib

import can
import pytest
from device_rigs import Canopen
from watching import wait_for

from pbonet.errors import DeviceError
from pbonet.io.drivers import Mode, Wait, database, open_device

OBJECTS = ["6040:00/16", "6064:00/32", "60FF:02/8"]


@pytest.fixture
def rig(monkeypatch, tmp_path):
    monkeypatch.setenv("PBONET_RUN_DIR", str(tmp_path / "run"))
    one = Canopen(monkeypatch, tmp_path)
    values = (6).to_bytes(2, "little"), (-7).to_bytes(4, "little", signed=True), b"\x80"
    places = (0x6040, 0), (0x6064, 0), (0x60FF, 2)
    one.node.objects |= dict(zip(places, values, strict=True))
    with database.using({"x": one.entry(objects=OBJECTS)}, "arm0/reads"):
        yield one
    one.close()


def opened(start=0, end=2, mode=Mode.RW, **how):
    if Mode.WRITE in mode:
        how = {"safe": None, **how}
    return open_device("x", start, end, mode=mode, **how)


@pytest.mark.parametrize("wait", [Wait.ALL, Wait.NONE])
def test_objects_are_read_and_written(rig, wait):
    with opened(wait=wait, signed=True) as node:
        assert wait_for(node.read, "the values") == [6, -7, -128]
        assert [node.status("PORTSIZE", k) for k in range(3)] == [16, 32, 8]
        node.write([15, -100_000, 5])
        now = [15, -100_000, 5]
        wait_for(lambda: node.read() == now, "what was written")
    assert rig.node.objects[0x6040, 0] == b"\x0f\0"
    assert rig.node.objects[0x60FF, 2] == b"\x05"
    assert rig.node.asked[0] == (0x40, 0x1000, 0), "its type, at open"


def test_a_node_is_set_to_a_state(rig):
    with opened() as node:
        node.control("NMT", "operational")
        node.control("NMT", "reset")
        with pytest.raises(DeviceError, match="expected operational, stopped, preop"):
            node.control("NMT", "on")
        with pytest.raises(DeviceError, match="no command RESET"):
            node.control("RESET", 1)
        node.read()
    assert rig.node.commands == [b"\x01\x05", b"\x81\x05"]
    refused = pytest.raises(DeviceError, match="not open in this direction")
    with opened(mode=Mode.READ) as node, refused:
        node.control("NMT", "reset")


@pytest.mark.parametrize("wait", [Wait.ALL, Wait.NONE])
def test_what_a_node_refuses_is_raised_and_it_works_on(rig, wait):
    with opened(1, 2, wait=wait) as node:
        rig.node.aborts[0x60FF, 2] = 0x06010002
        told = r"object 60FF:02: .*can only be read \(code 06010002h\)"
        with pytest.raises(DeviceError, match=told):
            wait_for(lambda: node.write([1, 1]), "an error")
        rig.node.aborts.clear()

        def values():
            with contextlib.suppress(DeviceError):  # of the write before
                return node.read()

        assert wait_for(values, "values")


def test_safe_values_wait_for_the_node_behind_what_did_not(rig):
    node = opened(wait=Wait.NONE, safe=[6, 7, 8])
    node.write([15, 1, 2])
    node.write([15, 3, 4])
    node.close()
    values = [int.from_bytes(one, "little") for one in rig.node.objects.values()]
    assert values[-3:] == [6, 7, 8]


def test_a_safe_value_that_is_refused_keeps_no_other_from_the_node(rig):
    node = opened(safe=[6, 7, 8])
    node.write([15, 1, 2])
    rig.node.aborts[0x6040, 0] = 0x08000022
    with pytest.raises(DeviceError, match=r"object 6040:00: .*in this state"):
        node.close()
    assert rig.node.objects[0x6040, 0] == b"\x0f\0"
    assert rig.node.objects[0x60FF, 2] == b"\x08"


@pytest.mark.parametrize("value", [b"\1", b"123456789"])
def test_an_object_of_another_size_is_refused(rig, value):
    rig.node.objects[0x6064, 0] = value
    with opened(1, 1) as node:
        told = r"does not fit.*object of 4 bytes.*the object's bits"
        with pytest.raises(DeviceError, match=told):
            node.read()


@pytest.mark.parametrize("wait", [Wait.ALL, Wait.NONE])
def test_a_silent_node_is_named_whatever_else_is_on_the_bus(rig, wait):
    """A hundred thousand bytes of frames that are no answers, and one that is late."""
    with opened(1, 1, wait=wait) as node:
        rig.node.number = 9
        node._line.timeout = 0.05
        with can.Bus("bus of a test", interface="virtual") as other:
            for k in range(12_500):
                if k % 500 == 0:
                    with contextlib.suppress(DeviceError):
                        assert node.read() == []
                identity = 0x585 if k % 2 else 0x185
                other.send(can.Message(arbitration_id=identity, data=bytes(8)))
        with pytest.raises(DeviceError, match="the device does not answer"):
            wait_for(node.read, "an error")
        rig.node.number = 5
        node._line.timeout = 30.0

        def values():
            with contextlib.suppress(DeviceError):
                return node.read()

        assert wait_for(values, "values")


@pytest.mark.parametrize(
    ("settings", "told"),
    [
        ({"objects": []}, "objects"),
        ({"objects": ["6064:0/32"]}, "objects"),
        ({"objects": ["6064:00/12"]}, "objects"),
        ({"unit": 0}, "unit"),
        ({"unit": 128}, "unit"),
        ({"interface": "socketcan", "bitrate": 5}, "ip link set can0 type can"),
        ({"filters": ["181/7FF"]}, "filters"),
    ],
)
def test_wrong_settings_are_refused(rig, settings, told):
    with database.using({"x": rig.entry(**settings)}), pytest.raises(DeviceError) as e:
        opened(0, 0)
    assert told in str(e.value)


def test_nodes_of_one_bus_are_claimed_apart(rig):
    entries = {"x": rig.entry(), "y": rig.entry(unit=7)}
    with database.using(entries), opened(0, 0):
        open_device("y", mode=Mode.NONE).close()
        with pytest.raises(DeviceError, match="a port of the device is taken"):
            open_device("x", mode=Mode.NONE)
