"""The vehicle example over real agents: a square over a MAVLink link, and its logs."""

from __future__ import annotations

import importlib.util
import sys
from contextlib import ExitStack
from pathlib import Path

EXAMPLE = Path(__file__).parents[3] / "examples" / "vehicle"
spec = importlib.util.spec_from_file_location("vehicle_demo", EXAMPLE / "demo.py")
assert spec is not None
assert spec.loader is not None
demo = importlib.util.module_from_spec(spec)
sys.modules[spec.name] = demo
spec.loader.exec_module(demo)


def test_it_takes_off_flies_a_square_and_lands_and_its_logs_replay() -> None:
    pilot, logs = demo.fly()
    result = demo.judge(pilot, logs)
    assert result.differs == []
    assert result.top > 2.9
    assert result.home < demo.HOME
    assert not result.armed
    _, measured, _ = demo.way(pilot)
    for corner in ((4, 0), (4, 4), (0, 4)):
        assert abs(measured[:, :2] - corner).max(axis=1).min() < demo.NEAR, corner


def test_another_vehicle_is_called_at_its_address() -> None:
    with ExitStack() as stack:
        folder = demo._with_address("udpin:localhost:14550", stack)
        text = (folder / "vehicle.rmod").read_text()
        assert "ADDRESS   udpin:localhost:14550\n" in text
        assert "14561" not in text
        assert (folder / "pilot.job").is_file()
