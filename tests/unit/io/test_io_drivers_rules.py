"""What holds for each driver: refusals, loss, replay, and the name of its library."""

from __future__ import annotations

import os
import random
import socket
import sys
from contextlib import suppress

import can
import msgspec
import pytest
from device_rigs import RIGS
from watching import wait_for

from pbonet.errors import DeviceError
from pbonet.io import no_devices
from pbonet.io.drivers import (
    Mode,
    database,
    guard,
    guard_process,
    listed,
    open_device,
    port_claims,
)
from pbonet.outside import Player, Tape, open_devices, using as recording


@pytest.fixture(params=RIGS)
def rig(request, monkeypatch, tmp_path):
    monkeypatch.setenv("PBONET_RUN_DIR", str(tmp_path / "run"))
    one = RIGS[request.param](monkeypatch, tmp_path)
    with database.using({"x": one.entry(), "none": one.missing()}, "arm0/reads"):
        yield one
    one.close()


def opened(rig, *ports, name="x"):
    how = {"safe": None} if Mode.WRITE in rig.mode else {}
    return open_device(name, *ports, mode=rig.mode, **how)


def test_it_gives_what_is_there_and_its_ports_have_one_user(rig):
    last = rig.ports - 1
    with opened(rig, last):
        with pytest.raises(DeviceError, match=f"port {last}: arm0/reads"):
            opened(rig, last)
        if rig.ports > 1:
            opened(rig, 0).close()
    with opened(rig, min(1, last)) as one:
        rig.prepare()
        assert rig.use(one)
        assert one.status("PORTNUM") == rig.ports
        assert listed({"x": rig.entry()})[0].kind == one.kind


def test_what_it_has_not_is_refused_at_open(rig):
    with pytest.raises(DeviceError, match=r"no such ports|one of 0 to 0"):
        opened(rig, rig.ports)
    if rig.wrong is not None:
        with pytest.raises(DeviceError, match="cannot be opened in this direction"):
            open_device("x", mode=rig.wrong, safe=None)
    with pytest.raises(DeviceError) as caught:
        opened(rig, name="none")
    assert caught.value.remedy
    opened(rig).close()  # what was refused left nothing behind


def test_it_is_lost_and_its_ports_are_free(rig):
    one = opened(rig)
    rig.lose()
    with pytest.raises(DeviceError, match=rf"the device is gone \(got .*{rig.lost}"):
        [rig.use(one) for _ in range(9)]
    with pytest.raises(DeviceError, match="the device is not open"):
        rig.use(one)
    assert listed({"x": rig.entry()})[0].users == []
    before = open_devices.current()
    open_devices.use(open_devices.Openings())  # those of another task
    other = port_claims.claim(one.entry, one.opening)
    open_devices.use(before)
    assert other.is_wanted(one.entry, one.opening), "it comes back to the first task"
    other.release()


@pytest.mark.parametrize("rig", ["iio_buffer", "joystick"], indirect=True)
def test_garbage_ends_in_values_or_an_error(rig):
    """A hundred thousand bytes, as fast as the pipe takes them, and part of a piece."""
    device = opened(rig)
    many, errors = random.Random(1).randbytes(100_001), []
    os.set_blocking(rig.fd, False)
    while not errors:
        with suppress(BlockingIOError):
            many = many[os.write(rig.fd, many) :]
        try:
            assert rig.use(device)
        except DeviceError as error:
            errors.append(str(error))
    assert rig.lost in errors[0]


@pytest.mark.parametrize("rig", ["canopen", "canopen_pdo"], indirect=True)
def test_garbage_on_the_bus_ends_in_values_or_an_error(rig):
    """A hundred thousand bytes, many of them in frames that look like the node's."""
    chance, identities = random.Random(1), (0x585, 0x185, 0x7FF)
    bus = can.Bus("bus of a test", interface="virtual")
    with bus, opened(rig) as device:
        for k in range(12_500):
            data = chance.randbytes(chance.choice((8, 8, 8, 2)))
            identity = chance.choice(identities)
            frame = can.Message(
                arbitration_id=identity, data=data, is_extended_id=False
            )
            with suppress(can.CanError):  # what has no room is dropped
                bus.send(frame, timeout=0)
            if k % 100:
                continue
            with suppress(DeviceError):
                assert rig.use(device)
        wait_for(lambda: sound(rig, device), "values of the node")


def sound(rig, device):
    """Return what is read, if the device raises no error."""
    with suppress(DeviceError):
        return rig.use(device)
    return None


@pytest.mark.parametrize(
    "rig", [name for name, one in RIGS.items() if one.library], indirect=True
)
def test_its_library_is_named_with_its_command(rig):
    rig.patch.setitem(sys.modules, rig.library, None)
    with pytest.raises(DeviceError, match=rf"pip install 'pbonet\[{rig.extra}\]'"):
        opened(rig)


def test_it_replays_without_a_device(rig):
    def run():
        with opened(rig, min(1, rig.ports - 1)) as one:
            if not one.outside.plays:
                rig.prepare()
            found = [rig.use(one), one.status("PORTNUM"), one.status("PORTSIZE")]
            if not one.outside.plays:
                rig.lose()
            with pytest.raises(DeviceError) as caught:
                [rig.use(one) for _ in range(9)]
        return [*found, str(caught.value)]

    tape = Tape()
    with recording(tape):
        first = run()
    if rig.library:
        rig.patch.setitem(sys.modules, rig.library, None)
    player = Player()
    player.feed(tape.take())
    with database.using({}), no_devices("this is a replay"), recording(player):
        assert run() == first


def test_modes_are_kept(rig):
    with open_device("x", mode=Mode.NONE) as one:
        with pytest.raises(DeviceError, match="not open in this direction"):
            rig.use(one)
        assert one.status("PORTNUM") == rig.ports


WRITTEN = [name for name, one in RIGS.items() if one.safe is not None]
written = pytest.mark.parametrize("rig", WRITTEN, indirect=True)


def used(rig, device):
    """Write what is not safe, and see it there."""
    device.write(rig.unsafe)
    if hasattr(device, "exchange"):
        device.exchange()
    wait_for(lambda: rig.outputs() != rig.safe, "other values")


@written
def test_what_it_cannot_be_left_with_is_refused_at_open(rig):
    for values, told in [*rig.never_safe, (object(), "wrong type")]:
        with pytest.raises(DeviceError) as caught:
            open_device("x", mode=Mode.WRITE, safe=values)
        assert told in str(caught.value)
    assert listed({"x": rig.entry()})[0].users == []


@written
def test_it_has_its_safe_values_when_the_task_is_not_on_and_when_it_is_closed(rig):
    device = open_device("x", mode=Mode.WRITE, safe=rig.safe)
    used(rig, device)
    device.write_safe(wait=False)
    wait_for(lambda: rig.outputs() == rig.safe, "safe values")
    used(rig, device)
    device.close()
    wait_for(lambda: rig.outputs() == rig.safe, "safe values")


@written
def test_its_guard_leaves_it_with_its_safe_values(rig):
    """The guard's own code in this process, which alone has what the rig replaces."""
    device = open_device("x", mode=Mode.WRITE, safe=rig.safe)
    used(rig, device)
    device.disconnect()  # the kernel does that for a process that is killed
    rig.patch.setattr(device, "disconnect", lambda: None)
    told = guard.Watch(
        number=1,
        entry=device.entry,
        opening=guard.flat(device.opening),
        safe=device.safe,
        modules=[],
        owner="arm0/reads",
    )
    near, far = socket.socketpair()
    with near, far:
        guards = guard_process.GuardProcess(far, -1)
        claim = os.dup(device._claim.fd)
        assert not guards._done(msgspec.msgpack.encode(told), [claim])
        assert rig.outputs() != rig.safe
        guards.secure()
    wait_for(lambda: rig.outputs() == rig.safe, "safe values")
    device.shut()
    opened(rig).close()
