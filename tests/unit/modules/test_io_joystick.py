"""The joystick, on a pipe that carries the kernel's events."""

from __future__ import annotations

import errno
import os

import pytest

from pbonet import State
from pbonet.errors import MethodError
from pbonet.io import joystick, no_devices
from pbonet.io.joystick import ABS, EVENT, KEY, SYN, Joystick
from pbonet.modules.teleoperation.joystick import Joystick as Module
from pbonet.outside import Player, Tape, use
from pbonet.testing import Bench

X, Y, SOUTH, EAST = 0, 1, 304, 305


class Pad:
    """A device file: a pipe for the events, and the answers of the kernel."""

    def __init__(self, path) -> None:
        self.path = path
        self.axes = {X: (128, 0, 255), Y: (0, -100, 100)}
        self.keys: set[int] = set()
        self.lost: int | None = None
        self.plug()

    def plug(self) -> None:
        os.mkfifo(self.path)
        self.fd = os.open(self.path, os.O_RDWR | os.O_NONBLOCK)

    def unplug(self) -> None:
        os.close(self.fd)
        self.path.unlink()

    def ioctl(self, _fd: int, request: int, room: bytes) -> bytes:
        if request == joystick.GET_KEYS:
            table = bytearray(room)
            for code in self.keys:
                table[code // 8] |= 1 << code % 8
            return bytes(table)
        code = (request & 0xFF) - 0x40
        assert request == joystick.get_axis(code)
        return joystick._ABSINFO.pack(*self.axes.get(code, (0, 0, 0)), 0, 0, 0)

    def send(self, *events: tuple[int, int, int]) -> None:
        os.write(self.fd, b"".join(EVENT.pack(0, 0, *event) for event in events))


@pytest.fixture
def pad(tmp_path, monkeypatch):
    made = Pad(tmp_path / "event7")
    monkeypatch.setattr(joystick, "ioctl", made.ioctl)
    yield made
    if made.path.exists():
        made.unplug()


def test_requests_are_those_of_the_kernel() -> None:
    """From linux/input.h, as the C compiler computes them."""
    assert joystick.get_axis(0) == 0x80184540
    assert joystick.GET_KEYS == 0x80604518
    assert EVENT.size == 24


def test_it_has_the_state_of_the_device_when_it_is_opened(pad) -> None:
    pad.axes[Y], pad.keys = (50, -100, 100), {EAST}
    stick = Joystick(str(pad.path), (X, Y), (SOUTH, EAST))
    axes, buttons = stick.poll(0)
    assert axes == pytest.approx((1 / 255, 0.5))
    assert buttons == 0b10
    stick.close()


def test_it_follows_the_events(pad) -> None:
    stick = Joystick(str(pad.path), (Y, X), (SOUTH, EAST))
    stick.poll(0)
    pad.send((ABS, X, 255), (ABS, Y, -100), (KEY, SOUTH, 1), (SYN, 0, 0))
    assert stick.poll(1) == ((-1.0, 1.0), 0b01)
    pad.send((KEY, EAST, 1), (KEY, SOUTH, 0), (ABS, 40, 9), (KEY, 44, 1), (ABS, X, 999))
    assert stick.poll(2) == ((-1.0, 1.0), 0b10)
    assert stick.poll(3) == ((-1.0, 1.0), 0b10)
    stick.close()


def test_it_asks_again_after_events_were_lost(pad) -> None:
    stick = Joystick(str(pad.path), (Y,), (SOUTH,))
    stick.poll(0)
    pad.axes[Y], pad.keys = (-50, -100, 100), {SOUTH}
    pad.send((ABS, Y, 100), (SYN, joystick.DROPPED, 0))
    assert stick.poll(1) == ((-0.5,), 1)
    stick.close()


def test_an_axis_that_the_device_has_not_stays_at_rest(pad) -> None:
    stick = Joystick(str(pad.path), (17,), ())
    assert stick.poll(0) == ((0.0,), 0)
    pad.send((ABS, 17, 5))
    assert stick.poll(1) == ((0.0,), 0)
    stick.close()


def test_a_device_that_is_no_input_device_is_refused_with_a_remedy(tmp_path) -> None:
    file = tmp_path / "file"
    file.write_text("")
    stick = Joystick(str(file), (X,), ())
    assert stick.poll(0) == ((0.0,), 0)
    assert "give the file of an input device" in str(stick.fault)


def module(pad, **params) -> Bench[Module]:
    given = {"device": str(pad.path), "axes": (X, -1, Y), "buttons": (SOUTH, EAST)}
    return Bench(Module, params={**given, **params}, naxes=3, freq=50)


def test_the_module_scales_what_is_beyond_the_dead_zone(pad) -> None:
    bench = module(pad, gain=(2.0, 1.0, -4.0), dead=0.2)
    bench.on()
    pad.send((ABS, Y, 60), (ABS, X, 140), (KEY, EAST, 1))
    bench.step()
    assert bench.outputs.y == pytest.approx([0.0, 0.0, -4.0 * 0.4 / 0.8], abs=1e-9)
    assert bench.outputs.buttons == 2
    bench.off()
    assert not bench.outputs.y.any()
    assert bench.outputs.buttons == 0
    bench.kill()


def test_a_lost_joystick_rests_is_reported_once_and_found_again(pad) -> None:
    bench = module(pad)
    bench.on()
    pad.send((ABS, Y, 100), (KEY, SOUTH, 1))
    bench.step()
    assert bench.outputs.y[2] == 1.0
    read, os.read = os.read, gone
    try:
        bench.step()
    finally:
        os.read = read
    pad.unplug()
    bench.step(n=100)
    assert not bench.outputs.y.any()
    assert bench.outputs.buttons == 0
    (text,) = [notice.text for notice in bench.notices()]
    assert text.startswith("the joystick rests: ")
    assert "got No such device); check the cable" in text
    pad.plug()
    pad.axes[Y] = (100, -100, 100)
    bench.step(n=60)
    assert bench.outputs.y[2] == 1.0
    assert bench.step() is State.ON
    bench.kill()


def gone(fd: int, size: int) -> bytes:
    del fd, size
    raise OSError(errno.ENODEV, "gone")


def test_a_missing_joystick_is_reported_at_once(tmp_path) -> None:
    bench = Bench(Module, params={"device": str(tmp_path / "no")}, naxes=2)
    (notice,) = bench.notices()
    assert "ls /dev/input/by-id" in notice.text


def test_in_a_simulation_no_device_is_opened(pad) -> None:
    with no_devices("this is a simulation"):
        bench = module(pad)
        bench.on()
        pad.send((ABS, Y, 100))
        bench.step()
        assert not bench.outputs.y.any()


@pytest.mark.parametrize(
    ("params", "text"),
    [
        ({"axes": (0, 1)}, "expected 3, as AXES has elements, got 2 values"),
        ({"buttons": tuple(range(32))}, "room for 31 buttons"),
    ],
)
def test_the_module_refuses_a_wrong_layout(pad, params, text) -> None:
    with pytest.raises(MethodError, match=text):
        module(pad, **params)


def test_a_recorded_joystick_is_replayed_without_the_device(pad) -> None:
    tape = Tape()
    former = use(tape)
    try:
        stick = Joystick(str(pad.path), (X, Y), (SOUTH,))
        pad.send((ABS, Y, 70))
        seen = [stick.poll(0)]
        pad.send((KEY, SOUTH, 1), (SYN, joystick.DROPPED, 0))
        pad.keys = {SOUTH}
        seen.append(stick.poll(1))
        stick.close()
        pad.unplug()
        player = Player()
        player.feed(tape.take())
        use(player)
        again = Joystick(str(pad.path), (X, Y), (SOUTH,))
        assert [again.poll(0), again.poll(1)] == seen
    finally:
        use(former)
