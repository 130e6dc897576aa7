"""The autonomous program of the example in virtual time: all of it, every number."""

from __future__ import annotations

import importlib.util
import re
import sys
from pathlib import Path
from types import ModuleType

import numpy as np
import pytest

from pbonet.errors import ConditionError, MethodError
from pbonet.master.configuration.check_files import check_file
from pbonet.master.subsystem import Phase, Sequencer, Subsystem
from pbonet.testing import Bench

EXAMPLE = Path(__file__).parents[3] / "examples" / "pick_and_place"
JOBS = ["approach", "descend", "grasp", "lift", "move", "place", "release", "retreat"]
CHANGE = ["long_fingers for short_fingers", "tip is back"]


def load(name: str) -> ModuleType:
    spec = importlib.util.spec_from_file_location(
        f"pick_and_place_{name}", EXAMPLE / f"{name}.py"
    )
    assert spec is not None
    assert spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    sys.modules[spec.name] = module
    spec.loader.exec_module(module)
    return module


@pytest.fixture(scope="module")
def demo() -> ModuleType:
    return load("demo")


@pytest.mark.slow
def test_two_parts_are_carried_with_two_tools(demo: ModuleType) -> None:
    said: list[str] = []
    with demo.open_cell(sim=True) as cell:
        program = demo.Program(cell, said.append)
        assert program.run()
        recording = cell.simulation.recording
        (part,) = cell.display("PART")
    assert [line.what for line in program.timeline] == [*JOBS, *CHANGE, *JOBS]
    assert program.refused == []
    assert part.values == pytest.approx([0.5, 0.2, -0.42], abs=0.006)
    first, second = program.timeline[:8], program.timeline[10:]
    for line, again in zip(first, second, strict=True):
        assert again.tip == pytest.approx(line.tip, abs=0.006), line.what
        lifted = np.subtract(again.hand, line.hand)
        assert lifted == pytest.approx([0.0, 0.0, 0.06], abs=0.006), line.what
        assert line.force == (40.0 if line.what in JOBS[2:6] else 0.0)
    times = [line.at for line in program.timeline]
    assert times == sorted(times)
    asked = [text for text in said if re.match(r" +(PRE|POST) of ", text)]
    assert len(asked) == 2 * 16
    steps = np.abs(np.diff(recording.series("Q_MEZ")[1], axis=0)).max()
    assert steps < 0.003, "no joint jumps at any of the changes"


@pytest.mark.slow
def test_jaws_that_do_not_close_are_noticed_before_the_lift(
    demo: ModuleType, capsys: pytest.CaptureFixture[str]
) -> None:
    demo.main(["--sim", "--stuck"])
    out = capsys.readouterr().out
    assert "lift.job:4:7: 2 conditions do not hold" in out
    assert "PRE of lift does not hold: HELD and FORCE > 20 [N] (seen: 0 > 20 N" in out
    assert "expected them to hold within 5 s" in out
    assert re.search(r"^ *\d+\.\d\d  retreat .* 80.0 +0$", out, re.MULTILINE)
    assert out.endswith("the second part lies where it lay\n")


@pytest.mark.slow
def test_the_sequence_does_what_the_program_does() -> None:
    with Subsystem(EXAMPLE / "carry.seq", virtual=True) as cell:
        state = Sequencer(cell).run()
        (part,) = cell.display("PART")
        tools = [one.task for one in cell.status() if "fingers" in one.task]
    assert (state.phase, state.text) == (Phase.DONE, "both parts are in their place")
    assert state.entered == (*JOBS, "back", *JOBS, "home")
    assert state.errors == ()
    assert part.values == pytest.approx([0.5, 0.2, -0.42], abs=0.006)
    assert tools == ["long_fingers"]


def test_the_sequence_is_legal() -> None:
    found = check_file(EXAMPLE / "carry.seq")
    assert found.errors == []
    assert found.notes == []
    assert len(found.warnings) == 7, "PRE of each job but the first and the last"
    assert all("does not ensure PRE" in text for text in found.warnings)


def test_no_job_is_entered_without_a_tool(demo: ModuleType) -> None:
    with demo.open_cell(sim=True) as cell:
        with pytest.raises(ConditionError, match=r"0 > 0.05 m does not hold"):
            cell.start("approach")
        assert cell.status() == []


def test_two_tools_at_once_are_refused(demo: ModuleType) -> None:
    with demo.open_cell(sim=True) as cell:
        cell.spawn("short_fingers")
        with pytest.raises(MethodError, match="TOOL_LENGTH") as caught:
            cell.spawn("long_fingers")
        assert "kill short_fingers first" in str(caught.value)
        cell.kill("short_fingers")
        cell.spawn("long_fingers")


@pytest.mark.parametrize("path", sorted(EXAMPLE.glob("*.*")), ids=lambda p: p.name)
def test_files_are_legal(path: Path) -> None:
    if path.suffix in {".job", ".rmod", ".sbs", ".svar"}:
        assert check_file(path, [EXAMPLE]).errors == []


def test_jaws_hold_what_is_between_them() -> None:
    jaws = load("jaws")
    with Bench(jaws.Jaws, params=jaws.Drive()) as bench:
        bench["WIDTH"] = 0.08
        bench["X_TIP"] = [0.5, -0.25, -0.42]
        bench.on()
        bench["WIDTH_REF"] = 0.0
        bench.step(0.01, 100)
        assert (bench["HELD"], bench["WIDTH"], bench["FORCE"]) == (True, 0.03, 40.0)
        bench["X_TIP"] = [0.5, -0.25, -0.3]
        bench.step(0.01)
        assert list(bench["PART"]) == [0.5, -0.25, -0.3], "it goes with the jaws"
        bench["WIDTH_REF"] = 0.08
        bench.step(0.01)
        bench["X_TIP"] = [0.5, -0.25, 0.0]
        bench.step(0.01)
        assert not bench["HELD"]
        assert list(bench["PART"]) == [0.5, -0.25, -0.3], "it stays where it was let go"


@pytest.mark.slow
def test_after_a_stop_with_a_part_the_program_can_begin_again(demo: ModuleType) -> None:
    with demo.open_cell(sim=True) as cell:
        program = demo.Program(cell, str)
        cell.spawn("short_fingers", "arm1")
        for job, signal in demo.STEPS[:3]:
            program.enter(job)
            cell.sigwait([signal], timeout=30.0)
        program.enter("lift")
        assert cell.display("HELD")[0].values == [1.0]
        cell.stop()
        assert cell.display("HELD")[0].values == [0.0]
        cell.spawn("short_fingers", "arm1")
        cell.start("approach")
