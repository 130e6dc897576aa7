"""The serial line over a pseudo-terminal: real system calls, no waiting."""

from __future__ import annotations

import os
import select
import struct
import termios
import tty
from collections.abc import Iterator

import pytest

from pbonet.errors import DeviceError
from pbonet.io import SerialLine, devices_allowed, no_devices, serial_line


@pytest.fixture
def pty() -> Iterator[tuple[int, str]]:
    master, slave = os.openpty()
    tty.setraw(master)
    name = os.ttyname(slave)
    os.close(slave)
    yield master, name
    os.close(master)


def arrives(line: SerialLine, count: int) -> bytes:
    data = b""
    while len(data) < count:
        assert select.select([line._port.fileno()], [], [], 5.0)[0]
        data += line.read_available()
    return data


def test_bytes_pass_unchanged_both_ways(pty: tuple[int, str]) -> None:
    master, name = pty
    everything = bytes(range(256))
    with SerialLine(name) as line:
        os.write(master, everything)
        assert arrives(line, 256) == everything
        assert line.write_nowait(everything) == 256
        got = b""
        while len(got) < 256:
            got += os.read(master, 256)
        assert got == everything
    assert not line.is_open


@pytest.mark.parametrize("unsent", [0, 9])
def test_a_line_that_is_closed_sends_what_it_was_given_where_it_can(
    pty: tuple[int, str], monkeypatch: pytest.MonkeyPatch, unsent: int
) -> None:
    """And drops it where it cannot: closing never waits long."""
    dropped: list[bool] = []
    line = SerialLine(pty[1])
    line.open()
    port = line._port._port
    monkeypatch.setattr(port, "reset_output_buffer", lambda: dropped.append(True))
    monkeypatch.setattr(serial_line, "_LAST", 0.0)
    left = struct.pack("i", unsent)
    monkeypatch.setattr(serial_line.fcntl, "ioctl", lambda *_: left)
    line.close()
    assert dropped == [True] * bool(unsent)
    assert not line.is_open


def test_settings_reach_the_line(pty: tuple[int, str]) -> None:
    _, name = pty
    with SerialLine(name, 19200, bits=7, parity="E", stop=2, rtscts=True) as line:
        _, _, flags, _, ispeed, ospeed, _ = termios.tcgetattr(line._port.fileno())
        # a pseudo-terminal keeps eight bits without parity, whatever it is told
        assert (line._port._port.bytesize, line._port._port.parity) == (7, "E")  # type: ignore[attr-defined]
    assert ispeed == ospeed == termios.B19200
    assert flags & termios.CSTOPB
    assert flags & termios.CRTSCTS


def test_nothing_there_is_nothing_read(pty: tuple[int, str]) -> None:
    with SerialLine(pty[1]) as line:
        assert line.read_available() == b""
        assert line.is_open


def test_no_more_is_read_than_asked_for(pty: tuple[int, str]) -> None:
    master, name = pty
    with SerialLine(name) as line:
        os.write(master, b"abcdef")
        assert select.select([line._port.fileno()], [], [], 5.0)[0]  # type: ignore[union-attr]
        assert line.read_available(4) == b"abcd"
        assert line.read_available(4) == b"ef"


def test_a_full_line_takes_nothing_and_does_not_block(pty: tuple[int, str]) -> None:
    with SerialLine(pty[1]) as line:
        for _ in range(10_000):
            if line.write_nowait(b"x" * 4096) == 0:
                break
        else:
            pytest.fail("the line never filled up")
        assert line.is_open


def test_lost_device_closes_the_line_and_says_so() -> None:
    master, slave = os.openpty()
    name = os.ttyname(slave)
    line = SerialLine(name)
    line.open()
    os.close(slave)
    os.close(master)
    with pytest.raises(DeviceError) as caught:
        line.read_available()
    assert caught.value.what == "the device on the serial line is gone"
    assert caught.value.where == name
    assert "check the cable" in caught.value.remedy
    assert not line.is_open
    with pytest.raises(DeviceError, match="the serial line is not open"):
        line.write_nowait(b"x")
    line.close()


def test_lost_device_is_noticed_on_writing_too() -> None:
    master, slave = os.openpty()
    with SerialLine(os.ttyname(slave)) as line:
        os.close(slave)
        os.close(master)
        with pytest.raises(DeviceError, match="the device on the serial line is gone"):
            line.write_nowait(b"x")


@pytest.mark.parametrize(
    ("path", "got", "remedy"),
    [
        ("/dev/ttyNOWHERE", "No such file or directory", "check cable and name"),
        ("/dev/null", "", "give the device file of a serial line"),
    ],
)
def test_line_that_cannot_be_opened(path: str, got: str, remedy: str) -> None:
    line = SerialLine(path)
    with pytest.raises(DeviceError) as caught:
        line.open()
    assert caught.value.what == "the serial line cannot be opened"
    assert caught.value.where == path
    assert got in caught.value.got
    assert remedy in caught.value.remedy
    assert not line.is_open


def test_two_programs_do_not_share_a_line(pty: tuple[int, str]) -> None:
    with (
        SerialLine(pty[1]),
        pytest.raises(DeviceError, match="another program has it open"),
    ):
        SerialLine(pty[1]).open()


def test_wrong_settings_are_an_error_of_the_line(pty: tuple[int, str]) -> None:
    with pytest.raises(DeviceError, match=r"cannot be opened.*Not a valid byte size"):
        SerialLine(pty[1], bits=3).open()


def test_opening_twice_is_allowed(pty: tuple[int, str]) -> None:
    with SerialLine(pty[1]) as line:
        line.open()
        assert line.is_open


def test_no_device_is_opened_in_a_simulation(pty: tuple[int, str]) -> None:
    line = SerialLine(pty[1])
    with no_devices("this is a simulation"):
        assert not devices_allowed()
        with pytest.raises(DeviceError, match="this is a simulation"):
            line.open()
    assert devices_allowed()
    with line:
        assert line.is_open


def test_input_can_be_discarded(pty: tuple[int, str]) -> None:
    master, name = pty
    with SerialLine(name) as line:
        os.write(master, b"old")
        assert select.select([line._port.fileno()], [], [], 5.0)[0]  # type: ignore[union-attr]
        line.discard_input()
        assert line.read_available() == b""
        os.write(master, b"new")
        assert arrives(line, 3) == b"new"
    with pytest.raises(DeviceError, match="the serial line is not open"):
        line.discard_input()


def test_discarding_notices_a_lost_device() -> None:
    master, slave = os.openpty()
    with SerialLine(os.ttyname(slave)) as line:
        os.close(slave)
        os.close(master)
        with pytest.raises(DeviceError, match="the device on the serial line is gone"):
            line.discard_input()
