"""The autonomous program of the example, over real agents and tasks."""

from __future__ import annotations

import importlib.util
import sys
from pathlib import Path

import pytest

EXAMPLE = Path(__file__).parents[3] / "examples" / "pick_and_place"
PATIENT, BRIEF = 60.0, 1.0
"""Seconds for conditions that come true on a machine with other work, and for those
that do not."""
JOBS = ["approach", "descend", "grasp", "lift", "move", "place", "release", "retreat"]


def load(name):
    spec = importlib.util.spec_from_file_location(
        f"pick_and_place_{name}", EXAMPLE / f"{name}.py"
    )
    module = importlib.util.module_from_spec(spec)
    sys.modules[spec.name] = module
    spec.loader.exec_module(module)
    return module


@pytest.fixture
def demo(nodes, monkeypatch):
    """The program, where two agents run already."""
    nodes.agent_processes("arm0", "arm1", libraries=[str(EXAMPLE)])
    found = load("demo")
    monkeypatch.setattr(found, "WAIT", PATIENT)
    monkeypatch.setattr(found, "LONGEST", 2 * PATIENT)
    return found


@pytest.mark.timeout(600)
def test_a_part_is_carried_the_tool_is_changed_and_a_stuck_gripper_refused(demo, nodes):
    change = ["long_fingers for short_fingers", "tip is back"]
    before = [*JOBS, *change, *JOBS[:3]]

    def say(_):
        """What comes behind these is refused, however long it is waited for."""
        refused = [line.what for line in program.timeline] == before
        demo.WAIT = BRIEF if refused else PATIENT

    with demo.open_cell(nodes.domain) as cell:
        program = demo.Program(cell, say)
        assert not program.run(stuck=True)
        states = {status.task: status.state for status in cell.status()}
    done = [line.what for line in program.timeline]
    assert done == [*before, "lift refused", "retreat"]
    lines = {line.what: line for line in program.timeline[:10]}
    assert lines["lift"].force == 40.0
    assert lines["place"].tip == pytest.approx((0.5, 0.2, -0.42), abs=0.01)
    retreat, back = lines["retreat"], lines["tip is back"]
    assert back.tip == pytest.approx(retreat.tip, abs=0.01)
    assert back.hand[2] - retreat.hand[2] == pytest.approx(0.06, abs=0.01)
    (refused,) = program.refused
    assert "lift.job:4:7: 2 conditions do not hold" in refused
    assert (
        "PRE of lift does not hold: HELD and FORCE > 20 [N] (seen: 0 > 20 N" in refused
    )
    assert "WIDTH = 0.08 m" in refused
    assert states["go_home"] == "ON"
    assert states["long_fingers"] == "OFF", "a constant's giver need not be ON"
    assert "close_jaws" not in states
