"""Operator traces: the one that comes with pbonet, and damaged ones."""

from __future__ import annotations

import importlib.util
import itertools
from pathlib import Path

import pytest

from pbonet.errors import DeviceError
from pbonet.io import recorded
from pbonet.io.magellan import AT_REST, Keys, Motion
from pbonet.io.recorded import RecordedBall, find_trace, parse_trace, traces

MS = 1_000_000
ROOT = Path(__file__).parents[3]

SHORT = """
# a push along x with button 1, then rest
0.000 dH000H000H000H000H000H000
0.040 dHA90H000H000H000H000H000   # 400 counts
0.040 kA00
0.080 dH000H000H000H000H000H000
0.100 end
"""
PUSHED = Motion((400, 0, 0, 0, 0, 0))


@pytest.fixture
def short(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> str:
    (tmp_path / "short.trace").write_text(SHORT)
    monkeypatch.setattr(recorded, "_FOLDER", tmp_path)
    return "short"


def test_trace_is_played_in_time(short: str) -> None:
    ball = RecordedBall(short)
    begin = 987_654_321
    got = [ball.poll(begin + k * 20 * MS) for k in range(8)]
    assert got == [AT_REST, AT_REST, PUSHED, PUSHED, *[AT_REST] * 4]
    assert ball.keys == Keys(1)
    assert ball.seconds == pytest.approx(0.1)
    assert ball.fault is None


def test_trace_repeats_without_losing_its_beat(short: str) -> None:
    ball = RecordedBall(short, repeat=True)
    pushed = [ball.poll(k * 20 * MS) == PUSHED for k in range(500)]
    assert pushed == [k % 5 in {2, 3} for k in range(500)]
    # polls may be missing, for longer than the trace is
    assert ball.poll(500 * 20 * MS + 7 * 100 * MS + 50 * MS) == PUSHED


def test_trace_begins_anew_after_a_restart(short: str) -> None:
    ball = RecordedBall(short)
    ball.poll(0)
    assert ball.poll(50 * MS) == PUSHED
    ball.restart()
    assert ball.motion == AT_REST
    assert ball.keys == Keys(0)
    assert ball.poll(70 * MS) == AT_REST
    assert ball.poll(110 * MS) == PUSHED


def test_packets_that_came_between_two_polls_are_all_taken(short: str) -> None:
    ball = RecordedBall(short)
    ball.poll(0)
    assert ball.poll(90 * MS) == AT_REST
    assert ball.keys == Keys(1)


@pytest.mark.parametrize(
    ("text", "line"),
    [
        ("0.0 dH000\n1.0 end\n", 1),
        ("0.0\n1.0 end\n", 1),
        ("soon dH000H000H000H000H000H000\n1.0 end\n", 1),
        ("0.5 k000\n0.4 k000\n1.0 end\n", 2),
        ("0.5 k000\n1.0 end\n1.1 k000\n", 3),
        ("-1.0 k000\n1.0 end\n", 1),
        ("inf k000\n1.0 end\n", 1),
        ("nan k000\n1.0 end\n", 1),
        ("0.5 k000 k000\n1.0 end\n", 1),
    ],
)
def test_damaged_trace_names_its_line(text: str, line: int) -> None:
    with pytest.raises(DeviceError, match="the operator trace is damaged") as caught:
        parse_trace(text, "bad")
    assert caught.value.where == f"bad.trace:{line}"
    assert "seconds packet" in caught.value.expected


@pytest.mark.parametrize("text", ["", "# nothing\n", "0.1 k000\n"])
def test_trace_without_end_is_cut_short(text: str) -> None:
    with pytest.raises(DeviceError, match="the operator trace is cut short"):
        parse_trace(text, "bad")


def test_unknown_trace_offers_the_nearest() -> None:
    with pytest.raises(DeviceError) as caught:
        find_trace("pumas")
    assert caught.value.remedy == "did you mean puma?"
    with pytest.raises(DeviceError, match="no such operator trace"):
        find_trace("../../../etc/passwd")


def test_every_trace_that_comes_with_pbonet_can_be_played() -> None:
    assert "puma" in traces()
    for name in traces():
        ball = RecordedBall(name)
        axes = [ball.poll(k * 20 * MS).axes for k in range(int(ball.seconds * 50) + 2)]
        assert axes[0] == axes[-1] == (0,) * 6, "it begins and ends at rest"
        used = [axis for axis in range(6) if any(abs(a[axis]) > 100 for a in axes)]
        assert len(used) >= 3, "it exercises several joints"
        steps = [
            abs(b - a)
            for one, two in itertools.pairwise(axes)
            for a, b in zip(one, two, strict=True)
        ]
        assert max(steps) < 60, "it is smooth"
        for axis in range(6):
            assert abs(sum(a[axis] for a in axes)) < 600, "pushes are answered"


def test_the_script_writes_the_trace_that_is_there() -> None:
    path = ROOT / "examples" / "puma" / "make_trace.py"
    spec = importlib.util.spec_from_file_location("make_trace", path)
    assert spec is not None
    assert spec.loader is not None
    script = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(script)
    assert "\n".join(script.lines()) + "\n" == find_trace("puma")
