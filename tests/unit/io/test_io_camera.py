"""A camera at the edge of the kernel; a file has the memory of its buffers."""

from __future__ import annotations

import errno

import pytest
from device_rigs import Camera
from msgspec.structs import replace

from pbonet.errors import DeviceError
from pbonet.io.drivers import Mode, Wait, camera_driver, database, open_device
from pbonet.outside import Player, Tape, using as recording


@pytest.fixture
def rig(monkeypatch, tmp_path):
    monkeypatch.setenv("PBONET_RUN_DIR", str(tmp_path / "run"))
    one = Camera(monkeypatch, tmp_path)
    with database.using({"x": one.entry()}, "arm0/sees"):
        yield one


def opened(wait=Wait.NONE, mode=Mode.READ):
    return open_device("x", mode=mode, wait=wait)


def test_requests_are_those_of_the_kernel():
    """From linux/videodev2.h, as the C compiler computes them."""
    d = camera_driver
    assert [one.size for one in (d.FORMAT, d.BUFFERS, d.BUFFER)] == [208, 20, 88]
    assert [d.S_FMT >> 16 & 0x3FFF, d.REQBUFS >> 16 & 0x3FFF] == [208, 20]
    assert {one >> 16 & 0x3FFF for one in (d.QUERYBUF, d.QBUF, d.DQBUF)} == {88}
    packed = d.BUFFER.pack(0, 1, 0, 0, 0, 2, 3, 4, 5, 6, 7)
    places = {24: 2, 32: 3, 56: 4, 60: 5, 64: 6, 72: 7}
    assert {at: packed[at] for at in places} == places


def test_frames_are_in_shared_memory_by_their_number(rig):
    with opened() as camera:
        assert camera.status("FORMAT") == (32, 16, 64, 1024)
        assert camera.status("FRAME") == -1
        view = camera.mmap()
        assert len(view) == 4 * 1024
        rig.shot(6, 66, stamp=(5, 6))
        assert camera.status("FRAME") == 6
        assert camera.status("STAMP") == 5_000_006_000
        assert camera.status("FRAME") == 6, "none is newer"
        assert bytes(view[2 * 1024 : 3 * 1024]) == b"B" * 1024
        assert camera.read(4, 1020) == b"BBBB"
        shared = rig.folder / "shm" / "cam"
        assert shared.read_bytes()[2 * 1024 :][:4] == b"BBBB", "of other tasks, too"
        assert shared.stat().st_mode & 0o777 == 0o600
        view.release()
    assert not shared.exists()
    assert not rig.streams


def test_the_newest_frame_is_taken_and_the_buffers_go_round(rig):
    with opened() as camera:
        for number in range(42):
            rig.shot(number, number)
            if number % 7 == 6:
                newest = camera.status("FRAME")
                assert camera.read(1) == bytes((newest,))
                assert sorted(rig.given) == [0, 1, 2, 3]
        for number in range(50, 60):
            rig.shot(number, number)
        assert camera.status("FRAME") == 53, "the camera lost those without a buffer"


def test_a_frame_that_is_damaged_is_none(rig):
    with opened() as camera:
        rig.shot(1, 1)
        rig.shot(2, 2, flags=camera_driver.DAMAGED)
        assert camera.status("FRAME") == 1
        rig.shot(3, 3, used=4000)  # more than it said
        assert camera.status("FRAME") == 3
        assert camera.read(1024) == b"\3" * 1024
        rig.shot(4, 4, used=10)
        assert camera.status("FRAME") == 4
        with pytest.raises(DeviceError, match=r"no such bytes.*expected up to 10"):
            camera.read(11)
        assert sorted(rig.given) == [0, 1, 2, 3]


def test_a_task_may_wait_for_a_frame(rig):
    with opened(Wait.ALL) as camera:
        assert camera.status("FRAME") == 7
        rig.coming = lambda: None
        camera_driver_timeout = database.using({"x": rig.entry(timeout=0.01)})
    with camera_driver_timeout, opened(Wait.ALL) as camera:
        with pytest.raises(DeviceError, match=r"gives no frame.*exposure"):
            camera.status("FRAME")
        rig.shot(9, 9)
        assert camera.status("FRAME") == 9, "it is open"


def test_what_the_camera_has_not_is_refused(rig):
    rig.offers = (640, 480)
    with pytest.raises(DeviceError, match=r"got it offers 640 x 480 YUYV"):
        opened()
    rig.offers, rig.error = None, errno.EBUSY
    with pytest.raises(DeviceError, match=r"got Device or resource busy.*other prog"):
        opened()
    for wrong in ({"format": "YUY"}, {"slots": 1}, {"memory": "../x"}, {"width": 0}):
        with (
            database.using({"x": rig.entry(**wrong)}),
            pytest.raises(DeviceError, match="a setting of the device is wrong"),
        ):
            opened()
    assert list((rig.folder / "shm").iterdir()) == []


def test_two_cameras_have_memories_of_their_own(rig):
    other = rig.folder / "video1"
    other.write_bytes(rig.path.read_bytes())
    entries = {"x": rig.entry(), "y": replace(rig.entry(), address=str(other))}
    with database.using(entries), opened() as camera:
        with pytest.raises(DeviceError, match="another camera has the memory cam"):
            open_device("y", mode=Mode.READ)
        assert (rig.folder / "shm" / "cam").exists()
        rig.shot(1, 1)
        assert camera.status("FRAME") == 1


def test_frames_that_were_read_replay_and_mapped_ones_do_not(rig):
    tape = Tape()

    def run(shot):
        with opened() as camera:
            shot(2, 2)
            return camera.status("FRAME"), camera.read(9), camera.status("FORMAT")

    with recording(tape):
        first = run(rig.shot)
    assert first == (2, b"\2" * 9, (32, 16, 64, 1024))
    player = Player()
    player.feed(tape.take())
    with database.using({}), recording(player):
        assert run(lambda *_: None) == first
    player, tape = Player(), Tape()
    with recording(tape):
        opened().close()
    player.feed(tape.take())
    told = pytest.raises(DeviceError, match="are in no log")
    with recording(player), opened() as camera, told:
        camera.mmap()
