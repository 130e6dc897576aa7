"""The ball's module against a Magellan that is only software, over a pseudo-terminal.

`Magellan` speaks the device's side of the protocol byte by byte; the module opens the
terminal like any serial line. Time is the bench's, so nothing here sleeps: the test
waits until the kernel has moved the bytes, and for nothing else.
"""

from __future__ import annotations

import fcntl
import os
import random
import termios
import time
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest
from magellan import VERSION, Magellan

from pbonet.modules.teleoperation.jtball import JtBall
from pbonet.testing import Bench

SPEED = (0.5, 0.6, 0.7, 0.8, 0.9, 1.0)
FULL, DEAD = 400, 15


@pytest.fixture
def device(tmp_path: Path) -> Iterator[Magellan]:
    magellan = Magellan(tmp_path / "ttyBALL")
    magellan.plug_in()
    yield magellan
    if magellan.master >= 0:
        os.close(magellan.master)


@pytest.fixture
def bench(device: Magellan) -> Iterator[Bench[JtBall]]:
    params = {
        "device": str(device.link),
        "speed": SPEED,
        "lower": (-1.0,),
        "upper": (1.0,),
        "full": float(FULL),
        "dead": float(DEAD),
    }
    with Bench(JtBall, params=params, ndof=6, freq=50) as bench:
        device.answer()
        bench.on()
        device.said = 0  # on forgets what came before
        yield bench


def deliver(bench: Bench[JtBall], device: Magellan, cycles: int = 1) -> None:
    """Cycle once everything that was said has come through the terminal."""
    wait_for_bytes(bench, device)
    bench.step(n=cycles)


def wait_for_bytes(bench: Bench[JtBall], device: Magellan) -> None:
    """Wait until the module's end holds all that was said since the last call."""
    port = bench.module._ball._line._port  # type: ignore[union-attr]
    give_up = time.monotonic() + 60.0
    count = bytearray(4)
    while int.from_bytes(count, "little") < device.said:
        assert time.monotonic() < give_up, "the terminal swallowed bytes"
        fcntl.ioctl(port.fileno(), termios.FIONREAD, count)
    device.said = 0


def rate(*axes: int) -> np.ndarray:
    """The joints' speeds that a deflection means, by the module's promise."""
    push = np.array(axes, dtype=float)
    size = np.clip(np.abs(push) - DEAD, 0, FULL - DEAD) / (FULL - DEAD)
    return np.sign(push) * size * np.array(SPEED)


def test_it_sets_the_device_up_and_learns_its_version(
    bench: Bench[JtBall], device: Magellan
) -> None:
    assert device.commands == [b"m3", b"vQ"]
    assert device.mode == 3
    bench.step()
    device.answer()
    assert device.commands == [b"m3", b"vQ"] * 2, "and again when it is turned on"
    deliver(bench, device)
    assert bench.module._ball.version == VERSION


def test_every_axis_moves_its_joint_at_the_right_speed(
    bench: Bench[JtBall], device: Magellan
) -> None:
    pushes = [
        (400, 0, 0, 0, 0, 0),
        (0, -200, 0, 0, 0, 0),
        (0, 0, 100, -100, 0, 0),
        (0, 0, 0, 0, 30, -1000),
        (1, -2, 3, -15, 15, 16),
        (-32768, 32767, 0, 0, 0, 0),
    ]
    expected = np.zeros(6)
    for push in pushes:
        device.push(*push)
        deliver(bench, device)
        expected += rate(*push) * 0.02
        assert bench.outputs.q_ref == pytest.approx(expected, abs=1e-12)


def test_a_held_push_goes_on_until_the_ball_is_let_go(
    bench: Bench[JtBall], device: Magellan
) -> None:
    device.push(400, 0, 0, 0, 0, 0)
    deliver(bench, device, cycles=3)
    assert bench.outputs.q_ref[0] == pytest.approx(3 * 0.01)
    device.push(0, 0, 0, 0, 0, 0)
    deliver(bench, device, cycles=50)
    assert bench.outputs.q_ref[0] == pytest.approx(3 * 0.01)


def test_a_ball_that_falls_silent_while_pushed_is_let_go(
    bench: Bench[JtBall], device: Magellan
) -> None:
    device.push(400, 0, 0, 0, 0, 0)
    deliver(bench, device, cycles=100)
    assert bench.outputs.q_ref[0] == pytest.approx(0.01 * 13), "for 0.25 s, no longer"
    assert bench.notices() == []


def test_garbage_on_the_line_costs_a_packet_at_most(
    bench: Bench[JtBall], device: Magellan
) -> None:
    noise = random.Random(560)
    expected = np.zeros(6)
    for _ in range(50):
        device.raw(bytes(noise.randrange(256) for _ in range(noise.randrange(90))))
        device.raw(b"\r")
        push = tuple(noise.randrange(-400, 401) for _ in range(6))
        device.push(*push)
        deliver(bench, device)
        expected += rate(*push) * 0.02
        assert bench.outputs.q_ref == pytest.approx(expected, abs=1e-12)
    assert bench.module._ball.damaged > 0  # type: ignore[union-attr]


def test_packets_cut_anywhere_are_put_together(
    bench: Bench[JtBall], device: Magellan
) -> None:
    packet = b"dHA90H000H000H000H000H000\r"
    for cut in range(1, len(packet)):
        before = bench.outputs.q_ref[0]
        bench.module._ball.restart()
        device.raw(packet[:cut])
        deliver(bench, device)
        assert bench.outputs.q_ref[0] == before
        device.raw(packet[cut:])
        deliver(bench, device)
        assert bench.outputs.q_ref[0] == pytest.approx(before + 0.01)


def test_enable_button_is_a_dead_man_s_switch(
    bench: Bench[JtBall], device: Magellan
) -> None:
    bench.set("enable", 9)
    device.push(400, 0, 0, 0, 0, 0)
    deliver(bench, device)
    assert bench.outputs.q_ref[0] == 0.0
    device.hold(1, 8, 9)
    deliver(bench, device)
    assert bench.outputs.q_ref[0] == pytest.approx(0.01)
    device.hold(1, 8)
    deliver(bench, device)
    assert bench.outputs.q_ref[0] == pytest.approx(0.01)


def test_what_the_ball_said_while_the_task_was_off_is_forgotten(
    bench: Bench[JtBall], device: Magellan
) -> None:
    bench.off()
    for _ in range(20):
        device.push(400, 0, 0, 0, 0, 0)
    wait_for_bytes(bench, device)
    bench.on()
    bench.step(n=10)
    assert np.array_equal(bench.outputs.q_ref, np.zeros(6))


def test_pulled_plug_is_told_once_and_a_new_one_works(
    bench: Bench[JtBall], device: Magellan
) -> None:
    device.push(400, 0, 0, 0, 0, 0)
    deliver(bench, device, cycles=2)
    stood = bench.outputs.q_ref.copy()
    assert stood[0] == pytest.approx(0.02)
    device.unplug()
    bench.step(n=120)
    assert np.array_equal(bench.outputs.q_ref, stood), "the reference stays"
    (notice,) = bench.notices()
    assert "the ball rests" in notice.text
    assert "the device on the serial line is gone" in notice.text

    device.commands.clear()
    device.plug_in()
    bench.step(n=51)  # it looks once a second
    device.answer()
    assert device.commands == [b"m3", b"vQ"]
    device.push(0, 400, 0, 0, 0, 0)
    deliver(bench, device)
    assert bench.outputs.q_ref[1] == pytest.approx(stood[1] + 0.012)
    assert bench.notices() == []
    device.unplug()
    bench.step()
    assert len(bench.notices()) == 1, "a second loss is told again"


def test_it_can_start_before_the_ball_is_there(
    tmp_path: Path,
) -> None:
    device = Magellan(tmp_path / "ttyBALL")
    params = {
        "device": str(device.link),
        "speed": SPEED,
        "lower": (-1.0,),
        "upper": (1.0,),
    }
    with Bench(JtBall, params=params, ndof=6, freq=50) as bench:
        assert len(bench.notices()) == 1
        bench.on()
        bench.step(n=10)
        device.plug_in()
        bench.step(n=60)
        device.answer()
        device.push(400, 0, 0, 0, 0, 0)
        deliver(bench, device)
        assert bench.outputs.q_ref[0] == pytest.approx(0.01)
    os.close(device.master)


def test_kill_gives_the_line_back(bench: Bench[JtBall], device: Magellan) -> None:
    line = bench.module._ball._line  # type: ignore[union-attr]
    assert line.is_open
    bench.off()
    bench.kill()
    assert not line.is_open
    assert device.link.exists()
