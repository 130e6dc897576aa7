"""Process data of CANopen, with a node that carries out its own dictionary."""

from __future__ import annotations

from contextlib import suppress

import can
import pytest
from device_rigs import DRIVE_OBJECTS as OBJECTS, GOAL, WORD, CanopenPdo
from watching import wait_for

from pbonet.errors import DeviceError
from pbonet.io import no_devices
from pbonet.io.drivers import Mode, Wait, database, open_device
from pbonet.outside import Player, Tape, using as recording

INPUTS, OUTPUTS = (0, 3), (4, 5)


@pytest.fixture
def drive(monkeypatch, tmp_path):
    monkeypatch.setenv("PBONET_RUN_DIR", str(tmp_path / "run"))
    rig = CanopenPdo(monkeypatch, tmp_path)
    made = rig.entry(objects=OBJECTS)
    short = rig.entry(objects=OBJECTS, timeout=0.05)
    with database.using({"drive": made, "short": short}, "arm0/moves"):
        yield rig.node
    rig.close()


def inputs(name="drive", **how):
    return open_device(name, *INPUTS, mode=Mode.READ, signed=True, **how)


def test_objects_are_mapped_sent_and_taken(drive):
    drive.put(status=0x237, place=-100_000, speed=77, mode=8)
    with (
        inputs(wait=Wait.NONE) as seen,
        open_device("drive", *OUTPUTS, mode=Mode.WRITE, safe=[2, 0]) as told,
    ):
        wait_for(lambda: len(drive.commands) == 4, "both openings' commands")
        assert [one[:1] for one in drive.commands] == [b"\x80", b"\1"] * 2
        assert seen.read() == []
        drive.tell()
        assert wait_for(seen.read, "the values") == [0x237, -100_000, 77, 8]
        assert seen.read() == [], "nothing new"
        assert [seen.status("PORTSIZE", k) for k in range(4)] == [16, 32, 32, 8]
        told.write([15, 2**32 - 5])
        drive.take()
        assert drive.objects[WORD] == b"\x0f\0"
        assert drive.objects[GOAL] == b"\xfb\xff\xff\xff"
    drive.take()
    assert (drive.number_at(*WORD), drive.number_at(*GOAL)) == (2, 0), "safe values"
    assert drive.number_at(0x1800, 5) == 10, "ms"
    assert [len(places) for _, places in drive.pdos(0x1800)] == [2, 2]
    assert [hex(one) for one, _ in drive.pdos(0x1400)] == ["0x205"]


def test_a_read_that_waits_returns_what_comes_afterwards(drive, monkeypatch):
    with inputs(wait=Wait.ALL) as seen:
        drive.put(place=1)
        drive.tell()
        drive.put(place=2)
        ready = type(seen)._take

        def take(self):
            ready(self)
            drive.tell()

        monkeypatch.setattr(type(seen), "_take", take)
        assert seen.read()[1] == 2


@pytest.mark.parametrize("wait", [Wait.ALL, Wait.NONE])
def test_a_node_that_sends_nothing_is_named_and_may_go_on(drive, wait):
    with inputs("short", wait=wait) as seen:
        with pytest.raises(DeviceError, match=r"no process data.*185h 285h within"):
            wait_for(seen.read, "an error")
        if wait is Wait.NONE:

            def values():
                with suppress(DeviceError):  # where this takes longer
                    drive.tell()
                    return seen.read()

            assert wait_for(values, "values")


def test_what_is_not_as_it_was_mapped_is_refused(drive):
    with inputs(wait=Wait.NONE) as seen:
        drive.send(can.Message(arbitration_id=0x185, data=b"x", is_extended_id=False))
        with pytest.raises(DeviceError, match=r"6 bytes with identity 185h.*got 78"):
            wait_for(seen.read, "an error")


def test_a_node_that_refuses_a_mapping_is_not_opened(drive):
    drive.aborts[0x1A00, 2] = 0x06040041
    with pytest.raises(DeviceError, match=r"object 1A00:02: .*code 06040041h"):
        inputs()
    drive.aborts.clear()
    inputs().close()


@pytest.mark.parametrize(
    ("settings", "how", "told"),
    [
        ({}, {"mode": Mode.RW, "safe": None}, "read or written, and not both"),
        (
            {"pdo": 4},
            {"mode": Mode.READ},
            "at most 4 PDOs of 8 bytes, got objects that",
        ),
        ({"pdo": 5}, {"mode": Mode.READ}, "a setting of the device is wrong"),
        ({"period": 0}, {"mode": Mode.READ}, "a setting of the device is wrong"),
    ],
)
def test_what_cannot_be_is_refused(drive, settings, how, told):
    del drive
    entry = database.entry("drive")
    made = type(entry)(
        driver="canopen_pdo",
        address=entry.address,
        settings={**entry.settings, **settings},
    )
    with database.using({"x": made}), pytest.raises(DeviceError, match=told):
        open_device("x", *INPUTS, **how)


def test_what_was_read_replays_without_a_node(drive):
    def run():
        with inputs(wait=Wait.NONE) as seen:
            found = [seen.read()]
            drive.put(place=3)
            drive.tell()
            while not found[-1]:
                found.append(seen.read())
            return found

    tape = Tape()
    with recording(tape):
        found = run()
    player = Player()
    player.feed(tape.take())
    with recording(player), no_devices("this is a replay"):
        assert run() == found


def test_a_bus_that_is_off_is_lost_and_its_ports_are_free(drive):
    with inputs(wait=Wait.NONE) as seen:
        with pytest.raises(DeviceError, match="a port of the device is taken"):
            inputs()
        drive.send(can.Message(arbitration_id=0x40, is_error_frame=True))
        with pytest.raises(DeviceError, match=r"the device is gone.*bus-off"):
            wait_for(seen.read, "an error")
    inputs().close()
