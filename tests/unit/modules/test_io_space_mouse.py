"""The SpaceMouse, on a socket that hands over its reports one by one, as the kernel.

The reports are those of real devices: of a SpaceNavigator (three numbers each), and of
a SpaceMouse Wireless (six numbers).
"""

from __future__ import annotations

import errno
import itertools
import os
import socket

import numpy as np
import pytest

from pbonet import State
from pbonet.errors import MethodError
from pbonet.io import no_devices, space_mouse
from pbonet.io.space_mouse import SpaceMouse
from pbonet.modules.teleoperation.deadman import Deadman
from pbonet.modules.teleoperation.spacemouse import Spacemouse
from pbonet.outside import Player, Tape, use
from pbonet.testing import Bench

PUSHED = bytes.fromhex("01 5e01 a2fe 2300")  # 350, -350, 35
TURNED = bytes.fromhex("02 0000 afff 5e01")  # 0, -81, 350
ALL_SIX = bytes.fromhex("01 af00 0000 0000 0000 0000 51ff")  # 175 ... -175
LEFT, BOTH, NONE = bytes.fromhex("0301"), bytes.fromhex("03030000"), b"\3\0\0"
REST = [bytes.fromhex("01 0000 0000 0000"), bytes.fromhex("02 0000 0000 0000")]
BATTERY = bytes.fromhex("17 64")


class Cap:
    """A device file, and its entry in the kernel's list."""

    def __init__(self, folder) -> None:
        self.folder, self.path = folder, ""
        self.plug()

    def plug(self, number: int = 0, ident: str = "0003:0000046D:0000C626") -> None:
        self.path = f"/dev/hidraw{number}"
        self.near, self.far = socket.socketpair(socket.AF_UNIX, socket.SOCK_SEQPACKET)
        self.near.setblocking(False)
        self.about = self.folder / f"hidraw{number}" / "device" / "uevent"
        self.about.parent.mkdir(parents=True)
        self.about.write_text(f"DRIVER=hid-generic\nHID_ID={ident}\nHID_NAME=x\n")

    def unplug(self) -> None:
        self.near.close()
        self.far.close()
        self.about.unlink()
        self.path = ""

    def open(self, path: str, flags: int) -> int:
        assert flags & os.O_NONBLOCK
        if path != self.path:
            raise FileNotFoundError(errno.ENOENT, os.strerror(errno.ENOENT))
        return os.dup(self.near.fileno())

    def send(self, *reports: bytes) -> None:
        for one in reports:
            self.far.send(one)


@pytest.fixture
def cap(tmp_path, monkeypatch):
    made = Cap(tmp_path)
    monkeypatch.setattr(space_mouse, "_SYSTEM", tmp_path)
    monkeypatch.setattr(space_mouse, "_open", made.open)
    yield made
    if made.path:
        made.unplug()


def mouse(cap) -> SpaceMouse:
    found = SpaceMouse(cap.path)
    assert found.poll(0).axes == (0.0,) * 6
    return found


def test_reports_of_three_numbers_are_taken_together(cap) -> None:
    found = mouse(cap)
    cap.send(PUSHED, TURNED, LEFT)
    assert found.poll(1) == ((1.0, -1.0, 0.1, 0.0, -81 / 350, 1.0), 1)
    cap.send(BOTH, bytes.fromhex("01 0000 0000 e803"))
    assert found.poll(2) == ((0.0, 0.0, 1.0, 0.0, -81 / 350, 1.0), 3), "1000 is full"
    cap.send(*REST, NONE)
    assert found.poll(3) == ((0.0,) * 6, 0)
    found.close()


def test_reports_of_six_numbers_and_others_are_told_apart(cap) -> None:
    found = mouse(cap)
    cap.send(ALL_SIX, BATTERY, b"\1\2", b"\3")
    assert found.poll(1) == ((0.5, 0.0, 0.0, 0.0, 0.0, -0.5), 0)
    found.close()


REST_AXES, SECOND = (0.0,) * 6, 10**9


def test_a_pushed_one_that_is_silent_is_out_of_reach(cap) -> None:
    """What was let go meanwhile is not heard: a push alone holds no button again."""
    found = mouse(cap)
    cap.send(PUSHED, LEFT)
    assert found.poll(SECOND).axes[0] == 1.0
    assert found.poll(SECOND + 250_000_000).axes[0] == 1.0
    assert found.poll(SECOND + 250_000_001) == (REST_AXES, 0)
    cap.send(PUSHED)
    again = found.poll(2 * SECOND)
    assert (again.axes[0], again.buttons) == (1.0, 0)
    cap.send(PUSHED, LEFT)
    assert found.poll(2 * SECOND + 1).buttons == 1
    found.close()


def test_one_at_rest_holds_its_button_for_a_while(cap) -> None:
    found = mouse(cap)
    cap.send(PUSHED, LEFT, *REST)
    assert found.poll(SECOND) == (REST_AXES, 1)
    assert found.poll(3 * SECOND) == (REST_AXES, 1), "the person waits"
    cap.send(PUSHED, *REST)
    assert found.poll(3 * SECOND) == (REST_AXES, 1), "and goes on"
    assert found.poll(5 * SECOND) == (REST_AXES, 1)
    assert found.poll(5 * SECOND + 1) == (REST_AXES, 0), "too long"
    cap.send(PUSHED)
    assert found.poll(5 * SECOND + 2).buttons == 0, "pressed anew, it counts"
    cap.send(LEFT)
    assert found.poll(5 * SECOND + 3).buttons == 1
    found.close()


@pytest.mark.parametrize(("reports", "most"), [((PUSHED,), 0.3), (REST, 1.1)])
def test_out_of_reach_with_its_button_held_it_opens_the_dead_man_s_switch(
    cap, reports, most
) -> None:
    bench = module(cap, held=1.0)
    grip = Bench(Deadman, ndof=6, z=[1.0] * 6, freq=50)
    bench.on()
    grip.on()
    grip.step()
    cap.send(LEFT, *reports)

    def held() -> bool:
        bench.step()
        grip.inputs.buttons = bench.outputs.buttons
        grip.step()
        return bool(grip.outputs.y.any())

    assert held()
    count = sum(itertools.takewhile(bool, (held() for _ in range(200))))
    assert most - 0.1 <= count / 50 <= most
    assert not any(held() for _ in range(100))
    cap.send(NONE)
    assert not held()
    cap.send(LEFT)
    assert held()
    bench.kill()


@pytest.mark.parametrize(
    ("ident", "there"),
    [
        ("0003:0000256F:0000C635", True),
        ("0003:0000046D:0000C62B", True),
        ("0003:0000046D:0000C52B", False),
        ("0003:00001234:0000C635", False),
        ("nonsense", False),
    ],
)
def test_it_is_found_by_its_maker(cap, ident, there) -> None:
    cap.unplug()
    cap.plug(4, ident)
    if there:
        assert space_mouse.find_space_mouse() == "/dev/hidraw4"
    else:
        with pytest.raises(FileNotFoundError):
            space_mouse.find_space_mouse()


def module(cap, **params) -> Bench[Spacemouse]:
    return Bench(Spacemouse, params={"device": cap.path, **params}, freq=50)


def test_the_module_moves_the_hand_as_the_person_pushes(cap) -> None:
    """Away from the person, with a turn about the vertical: the base's x, and z."""
    bench = module(cap, linear=0.2, angular=1.0, dead=0.0)
    bench.on()
    cap.send(PUSHED, TURNED, LEFT)
    bench.step()
    wanted = [0.2, -0.2, -0.02, 81 / 350, 0.0, -1.0]
    assert bench.outputs.v == pytest.approx(wanted, abs=1e-12)
    assert bench.outputs.buttons == 1
    bench.off()
    assert not bench.outputs.v.any()
    assert bench.outputs.buttons == 0
    bench.kill()


def test_the_module_s_dead_zone_and_axes(cap) -> None:
    bench = module(cap, axes=(1, 0, 0, 0, 0, 5), linear=0.5, angular=2.0, dead=0.1)
    bench.on()
    cap.send(PUSHED, TURNED)
    bench.step()
    turn = -2.0 * (81 / 350 - 0.1) / 0.9
    assert bench.outputs.v == pytest.approx([0.5, 0, 0, 0, 0, turn], abs=1e-12)
    with pytest.raises(MethodError, match="an axis of the cap makes two motions"):
        bench.set("axes", "1 1 0 0 0 0")
    bench.kill()


def test_a_lost_one_rests_is_reported_once_and_found_elsewhere(cap) -> None:
    bench = module(cap, device="")
    bench.on()
    cap.send(PUSHED, LEFT)
    bench.step()
    assert bench.outputs.v[0] > 0.0
    read, os.read = os.read, gone
    try:
        bench.step()
    finally:
        os.read = read
    cap.unplug()
    bench.step(n=100)
    assert not bench.outputs.v.any()
    assert bench.outputs.buttons == 0
    (text,) = [notice.text for notice in bench.notices()]
    assert text.startswith("the SpaceMouse rests: ")
    assert "No such device" in text
    cap.plug(3)
    bench.step(n=60)
    cap.send(PUSHED)
    bench.step()
    assert bench.outputs.v[0] > 0.0
    assert bench.state is State.ON
    bench.kill()


def gone(fd: int, size: int) -> bytes:
    del fd, size
    raise OSError(errno.ENODEV, "No such device")


def test_a_missing_one_is_reported_at_once(cap) -> None:
    cap.unplug()
    bench = Bench(Spacemouse)
    (notice,) = bench.notices()
    assert "ls /sys/class/hidraw" in notice.text


def test_in_a_simulation_it_is_not_opened(cap) -> None:
    with no_devices("this is a simulation"):
        bench = module(cap)
        bench.on()
        cap.send(PUSHED)
        bench.step()
        assert not bench.outputs.v.any()


def test_a_recorded_one_is_replayed_without_the_device(cap) -> None:
    tape = Tape()
    former = use(tape)
    try:
        path = cap.path
        found = SpaceMouse(path)
        cap.send(PUSHED, LEFT)
        seen = [found.poll(0)]
        cap.send(ALL_SIX)
        seen.append(found.poll(1))
        found.close()
        cap.unplug()
        player = Player()
        player.feed(tape.take())
        use(player)
        again = SpaceMouse(path)
        assert [again.poll(0), again.poll(1)] == seen
        assert np.any(seen[1].axes)
    finally:
        use(former)
