"""The joystick, on a pipe that carries the kernel's events."""

from __future__ import annotations

import os
import sys

import pytest
from device_rigs import Joystick as Pad

from pbonet import State
from pbonet.errors import DeviceError, MethodError
from pbonet.io import no_devices
from pbonet.io.drivers import Mode, database, joystick_driver, open_device
from pbonet.io.drivers.joystick_driver import ABS, EVENT, KEY, SYN
from pbonet.modules.teleoperation.joystick import Joystick as Module
from pbonet.modules.teleoperation.joystick_sim import JoystickSim
from pbonet.testing import Bench

X, Y, SOUTH, EAST = 0, 1, 304, 305


@pytest.fixture
def pad(tmp_path, monkeypatch):
    monkeypatch.setenv("PBONET_RUN_DIR", str(tmp_path / "run"))
    made = Pad(monkeypatch, tmp_path)
    with database.using({"pad": made.entry(), "no": made.missing()}):
        yield made
    made.close()


def opened(last=3):
    return open_device("pad", 0, last, mode=Mode.READ, signed=True)


def test_requests_are_those_of_the_kernel() -> None:
    """From linux/input.h, as the C compiler computes them."""
    assert joystick_driver.get_axis(0) == 0x80184540
    assert joystick_driver.GET_KEYS == 0x80604518
    assert EVENT.size == 24


def test_it_has_the_state_of_the_device_when_it_is_opened(pad) -> None:
    pad.axes[Y], pad.keys = (50, -100, 100), {EAST}
    with open_device("pad", 0, 3, mode=Mode.READ) as stick:
        assert stick.read() == [128, 50, 0, 1]
        assert [stick.status("RANGE", k) for k in (1, 3)] == [(-100, 100), (0, 1)]
        assert [stick.status("PORTSIZE", k) for k in (1, 3)] == [32, 1]


def test_it_follows_the_events(pad) -> None:
    with opened(2) as stick:
        pad.send((ABS, X, 255), (ABS, Y, -100), (KEY, SOUTH, 1), (SYN, 0, 0))
        assert stick.read() == [255, -100, 1], "a button has no sign"
        pad.send((KEY, EAST, 1), (KEY, SOUTH, 0), (ABS, 40, 9), (KEY, 44, 1))
        assert stick.read() == stick.read() == [255, -100, 0]


PRESSED = """
    e2 3b 58 66 00 00 00 00  9a 4c 0b 00 00 00 00 00  04 00 04 00 01 00 09 00
    e2 3b 58 66 00 00 00 00  9a 4c 0b 00 00 00 00 00  01 00 30 01 01 00 00 00
    e2 3b 58 66 00 00 00 00  9a 4c 0b 00 00 00 00 00  03 00 01 00 c4 ff ff ff
    e2 3b 58 66 00 00 00 00  9a 4c 0b 00 00 00 00 00  00 00 00 00 00 00 00 00
"""
"""What a 64-bit kernel sends for a button pushed and a stick pulled, as `od` shows it:
four events of 24 bytes, the first with the button's number on the device (MSC_SCAN)."""


@pytest.mark.skipif(sys.byteorder != "little" or EVENT.size != 24, reason="other bytes")
def test_it_reads_the_bytes_of_a_kernel(pad) -> None:
    with open_device("pad", 0, 3, mode=Mode.READ) as stick:
        os.write(pad.fd, bytes.fromhex(PRESSED))
        assert stick.read() == [128, 2**32 - 60, 1, 0]


def test_it_asks_again_after_events_were_lost(pad) -> None:
    with open_device("pad", 1, 2, mode=Mode.READ, signed=True) as stick:
        pad.axes[Y], pad.keys = (-50, -100, 100), {SOUTH}
        pad.send((ABS, Y, 100), (SYN, joystick_driver.DROPPED, 0))
        assert stick.read()[0] == -50
        pad.send((KEY, SOUTH, 2))
        assert stick.read()[1] != 0


def test_an_axis_that_the_device_has_not_is_refused(pad) -> None:
    some = pad.entry(axes=[0, 17])
    with database.using({"pad": some}), pytest.raises(DeviceError, match="code 17"):
        opened()
    with database.using({"pad": pad.entry(buttons=[768])}), pytest.raises(DeviceError):
        opened()


def test_a_device_that_is_no_input_device_is_refused_with_a_remedy(pad) -> None:
    pad.patch.undo()  # the kernel's own answer
    with pytest.raises(DeviceError, match="give the file of an input device"):
        opened()


def test_events_of_any_kind_change_no_more_than_its_ports(pad) -> None:
    """A hundred thousand bytes of them, none of which is about the position."""
    with opened() as stick:
        before = stick.read()
        for begin in range(0, 100_000, 24 * 60):
            noise = bytes((begin + k) * 7 & 0x7F | 0x40 for k in range(24 * 60))
            os.write(pad.fd, noise)
            assert stick.read() == before
        os.write(pad.fd, b"part")
        with pytest.raises(DeviceError, match="the device is gone"):
            stick.read()


def module(**params) -> Bench[Module]:
    given = {"device": "pad", "axes": (0, -1, 1), "buttons": (2, 3)}
    return Bench(Module, params={**given, **params}, naxes=3, freq=50)


def test_the_module_scales_what_is_beyond_the_dead_zone(pad) -> None:
    bench = module(gain=(2.0, 1.0, -4.0), dead=0.2)
    bench.on()
    pad.send((ABS, Y, 60), (ABS, X, 140), (KEY, EAST, 1))
    bench.step()
    assert bench.outputs.y == pytest.approx([0.0, 0.0, -4.0 * 0.4 / 0.8], abs=1e-9)
    assert bench.outputs.buttons == 2
    pad.send((ABS, Y, 999), (KEY, SOUTH, 1))
    bench.step()
    assert bench.outputs.y[2] == -4.0, "no more than the range"
    assert bench.outputs.buttons == 3
    bench.off()
    assert not bench.outputs.y.any()
    assert bench.outputs.buttons == 0
    bench.kill()
    opened().close()  # its ports are free


def test_a_lost_joystick_rests_is_reported_once_and_found_again(pad) -> None:
    bench = module()
    bench.on()
    pad.send((ABS, Y, 100), (KEY, SOUTH, 1))
    bench.step()
    assert bench.outputs.y[2] == 1.0
    pad.lose()
    bench.step(n=100)
    assert not bench.outputs.y.any()
    assert bench.outputs.buttons == 0
    (text,) = [notice.text for notice in bench.notices()]
    assert text.startswith("the joystick rests: ")
    assert "the device is gone" in text
    pad.plug()
    pad.axes[Y] = (100, -100, 100)
    bench.step(n=60)
    assert bench.outputs.y[2] == 1.0
    assert bench.step() is State.ON
    bench.kill()


def test_its_twin_is_pushed_as_it_is_told_and_rests_alike() -> None:
    params = {"gain": (4.0, 1.0), "dead": 0.2, "mean": (0.6, 0.0), "held": 2}
    bench = Bench(JoystickSim, params=params, naxes=2, freq=50)
    with no_devices("this is a simulation"):
        bench.on()
        bench.step()
    assert bench.outputs.y == pytest.approx([4.0 * 0.4 / 0.8, 0.0])
    assert bench.outputs.buttons == 2
    bench.set("amplitude", "0 1")
    bench.step(n=125)
    assert bench.outputs.y == pytest.approx([4.0 * 0.4 / 0.8, 1.0])
    bench.off()
    assert not bench.outputs.y.any()
    assert bench.outputs.buttons == 0


def test_a_joystick_goes_from_one_task_to_another(pad) -> None:
    with database.using({"pad": pad.entry()}, "arm0/x"):
        old, new = module(), module()
        for going, coming in ((old, new), (new, old)):
            if going.state is State.OFF:
                going.on()
            going.off(handover=True)
            pad.axes[Y] = (100, -100, 100)
            coming.on()
            coming.step()
            assert coming.outputs.y[2] == 1.0, "in its first cycle"
        for bench in (old, new):
            bench.kill()


@pytest.mark.usefixtures("pad")
def test_a_missing_joystick_is_reported_at_once() -> None:
    (notice,) = module(device="no").notices()
    assert "ls /dev/input/by-id" in notice.text


def test_in_a_simulation_no_device_is_opened(pad) -> None:
    with no_devices("this is a simulation"):
        bench = module()
        bench.on()
        pad.send((ABS, Y, 100))
        bench.step()
        assert not bench.outputs.y.any()


@pytest.mark.usefixtures("pad")
@pytest.mark.parametrize(
    ("params", "text"),
    [
        ({"axes": (0, 1)}, "expected 3, as AXES has elements, got 2 values"),
        ({"buttons": tuple(range(32))}, "room for 31 buttons"),
    ],
)
def test_the_module_refuses_a_wrong_layout(params, text) -> None:
    with pytest.raises(MethodError, match=text):
        module(**params)
