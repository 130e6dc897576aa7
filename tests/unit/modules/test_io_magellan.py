"""The ball's protocol, byte by byte, and the ball on a line that is only played."""

from __future__ import annotations

import pytest

from pbonet.errors import DeviceError
from pbonet.io.magellan import (
    AT_REST,
    NIBBLES,
    SET_UP,
    Ball,
    Decoder,
    Keys,
    Motion,
    Reply,
)

MS = 1_000_000
REST = b"d" + b"H000" * 6 + b"\r"
"""32768 is 8000 in sixteens, and eight is spelled H."""


def packets(data: bytes, decoder: Decoder | None = None) -> list[object]:
    return list((decoder or Decoder()).feed(data))


def test_alphabet_carries_its_value_in_the_low_half_and_has_even_parity() -> None:
    assert len(set(NIBBLES)) == 16
    assert [code & 0xF for code in NIBBLES] == list(range(16))
    assert all(code.bit_count() % 2 == 0 for code in NIBBLES)


@pytest.mark.parametrize(
    ("line", "axes"),
    [
        (REST, (0, 0, 0, 0, 0, 0)),
        # 0x8001, 0x7fff, 0x8190, 0x7e70, 0xffff, 0x0000
        (
            b"dH00AG???HA90GNG0????0000\r",
            (1, -1, 0x190, -0x190, 32767, -32768),
        ),
        # every character of the alphabet once: 0123 4567 89ab cdef, then 0x8000 twice
        (
            b"d0AB3D56GH9:K<MN?H000H000\r",
            (0x0123 - 0x8000, 0x4567 - 0x8000, 0x89AB - 0x8000, 0xCDEF - 0x8000, 0, 0),
        ),
    ],
)
def test_motion_packet(line: bytes, axes: tuple[int, ...]) -> None:
    assert packets(line) == [Motion(axes)]  # type: ignore[arg-type]


@pytest.mark.parametrize(
    ("line", "mask"),
    [
        (b"k000\r", 0),
        (b"kA00\r", 0b1),
        (b"kH00\r", 0b1000),
        (b"k0A0\r", 0b1_0000),
        (b"k0H0\r", 0b1000_0000),
        (b"k00A\r", 0b1_0000_0000),
        (b"k3D0\r", 0b0100_0011),
    ],
)
def test_button_packet(line: bytes, mask: int) -> None:
    assert packets(line) == [Keys(mask)]


def test_replies_are_told_by_their_letter() -> None:
    text = b"vMAGELLAN  Version 5.49\r\rm3\rz\r"
    assert packets(text) == [
        Reply("v", "MAGELLAN  Version 5.49"),
        Reply("m", "3"),
        Reply("z", ""),
    ]


def test_bytes_may_come_one_by_one() -> None:
    decoder = Decoder()
    got = [p for byte in REST + b"k00A\r" for p in decoder.feed(bytes([byte]))]
    assert got == [AT_REST, Keys(0x100)]
    assert decoder.damaged == 0


@pytest.mark.parametrize(
    "damage",
    [
        b"dH00\r",  # cut short
        b"dH000H000H000H000H000H0000\r",  # one too many
        b"dH000H000H000H000H000H001\r",  # 1 has an odd number of ones
        b"k00\r",
        b"k00z\r",
        b"\xff\x00\xf8\r",
        b"d" * 500 + b"\r",
    ],
)
def test_damage_costs_that_packet_only(damage: bytes) -> None:
    decoder = Decoder()
    assert packets(damage + REST, decoder) == [AT_REST]
    assert decoder.damaged == 1


def test_endless_garbage_is_bounded_and_one_stretch() -> None:
    decoder = Decoder()
    for _ in range(1000):
        assert packets(b"\xf0" * 100, decoder) == []
        assert len(decoder._rest) <= 64
    assert decoder.damaged == 1
    # the first CR only ends the stretch; what follows counts again
    assert packets(b"rest of it\r" + REST, decoder) == [AT_REST]
    assert decoder.damaged == 1


def test_every_single_bit_error_in_a_motion_packet_is_noticed() -> None:
    good = b"dH00AG???HA90GNG0????0000"
    for k in range(1, len(good)):
        for bit in range(8):
            bad = bytearray(good)
            bad[k] ^= 1 << bit
            assert Motion not in {type(p) for p in packets(bytes(bad) + b"\r")}, bad


class PlayedLine:
    """A serial line whose other end is the test."""

    def __init__(self) -> None:
        self.there = True
        self.is_open = False
        self.opened = 0
        self.incoming = b""
        self.sent = b""
        self.room = 1000

    def open(self) -> None:
        self.opened += 1
        if not self.there:
            msg = "the serial line cannot be opened"
            raise DeviceError(msg, where="played")
        self.is_open = True

    def close(self) -> None:
        self.is_open = False

    def read_available(self, limit: int = 256) -> bytes:
        self._check()
        data, self.incoming = self.incoming[:limit], self.incoming[limit:]
        return data

    def discard_input(self) -> None:
        self._check()
        self.incoming = b""

    def write_nowait(self, data: bytes) -> int:
        self._check()
        taken = data[: self.room]
        self.sent += taken
        return len(taken)

    def _check(self) -> None:
        if not self.there:
            self.is_open = False
            msg = "the device on the serial line is gone"
            raise DeviceError(msg, where="played")


@pytest.fixture
def line() -> PlayedLine:
    return PlayedLine()


@pytest.fixture
def ball(line: PlayedLine) -> Ball:
    return Ball(line, retry=1.0, silence=0.25)  # type: ignore[arg-type]


PUSHED = b"dHA90H000H000H000H000GNG0\r"


def test_ball_sets_the_device_up_and_learns_its_version(
    ball: Ball, line: PlayedLine
) -> None:
    ball.poll(0)
    assert line.sent == SET_UP == b"\r\rm3\rvQ\r"
    line.incoming = b"m3\rvMAGELLAN  Version 5.49\r"
    ball.poll(20 * MS)
    assert ball.version == "MAGELLAN  Version 5.49"
    assert line.sent == SET_UP, "sent once"


def test_a_full_output_buffer_only_delays_the_set_up(
    ball: Ball, line: PlayedLine
) -> None:
    line.room = 3
    for k in range(5):
        ball.poll(k * 20 * MS)
    assert line.sent == SET_UP


def test_pushed_ball_rests_when_it_falls_silent(ball: Ball, line: PlayedLine) -> None:
    ball.poll(0)
    line.incoming = PUSHED
    pushed = Motion((0x190, 0, 0, 0, 0, -0x190))
    assert ball.poll(20 * MS) == pushed
    assert ball.poll(270 * MS) == pushed
    assert ball.poll(271 * MS) == AT_REST


def test_one_poll_does_bounded_work(ball: Ball, line: PlayedLine) -> None:
    ball.poll(0)
    line.incoming = PUSHED * 1000
    ball.poll(20 * MS)
    assert len(line.incoming) == 1000 * len(PUSHED) - 256


def test_lost_device_rests_and_is_tried_once_a_second(
    ball: Ball, line: PlayedLine
) -> None:
    ball.poll(0)
    line.incoming = PUSHED + b"kA00\r"
    ball.poll(20 * MS)
    assert ball.keys == Keys(1)
    line.there = False
    assert ball.poll(40 * MS) == AT_REST
    assert ball.keys == Keys(0)
    assert ball.fault is not None
    assert ball.fault.what == "the device on the serial line is gone"
    before = line.opened
    for k in range(3, 152):
        ball.poll(k * 20 * MS)  # until 3.02 s: 1.04, 2.04
    assert line.opened - before == 2


def test_device_that_comes_back_is_set_up_again(ball: Ball, line: PlayedLine) -> None:
    line.there = False
    ball.poll(0)
    assert ball.fault is not None
    line.there = True
    ball.poll(500 * MS)
    assert ball.fault is not None, "not tried before its time"
    line.incoming = b"0000\r" + PUSHED  # the tail of a packet, then a whole one
    assert ball.poll(1000 * MS) == Motion((0x190, 0, 0, 0, 0, -0x190))
    assert ball.fault is None
    assert line.sent == SET_UP


def test_closed_ball_rests_and_opens_at_the_next_poll(
    ball: Ball, line: PlayedLine
) -> None:
    ball.poll(0)
    line.incoming = PUSHED
    ball.poll(20 * MS)
    ball.close()
    assert not line.is_open
    assert ball.motion == AT_REST
    ball.poll(40 * MS)
    assert line.is_open


def test_restart_forgets_what_came_meanwhile(ball: Ball, line: PlayedLine) -> None:
    ball.poll(0)
    line.incoming = PUSHED * 10 + PUSHED[:9]
    ball.poll(20 * MS)
    ball.restart()
    assert ball.motion == AT_REST
    line.incoming += PUSHED[9:]  # the tail of a packet that nobody will miss
    assert ball.poll(40 * MS) == AT_REST
    line.incoming = PUSHED
    assert ball.poll(60 * MS) == Motion((0x190, 0, 0, 0, 0, -0x190))


def test_restart_of_a_lost_ball_is_no_error(ball: Ball, line: PlayedLine) -> None:
    ball.poll(0)
    line.there = False
    ball.restart()
    assert ball.fault is not None
    assert ball.poll(20 * MS) == AT_REST
    ball.restart()
