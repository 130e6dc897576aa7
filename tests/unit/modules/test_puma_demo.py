"""The example's summary and plot, made from a recording of the simulator."""

from __future__ import annotations

import importlib.util
from pathlib import Path
from types import ModuleType

import numpy as np
import pytest

from pbonet.log import Log
from pbonet.master.configuration.environment import Place
from pbonet.master.console.run_job import run

EXAMPLE = Path(__file__).parents[3] / "examples" / "puma"


@pytest.fixture(scope="module")
def demo() -> ModuleType:
    spec = importlib.util.spec_from_file_location("puma_demo", EXAMPLE / "demo.py")
    assert spec is not None
    assert spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


@pytest.fixture(scope="module")
def file(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return recorded(tmp_path_factory.mktemp("puma"), 3.0)


def recorded(folder: Path, seconds: float) -> Path:
    """Return the log of a simulated run."""
    job, place = EXAMPLE / "puma.job", Place()
    return Path(run(job, place, seconds=seconds, sim=True, runs=folder, quiet=True).log)


def test_error_is_that_of_the_newest_reference(demo: ModuleType, file: Path) -> None:
    time, reference, measured, error = demo.tracking(Log(file))
    assert len(time) == len(reference) == len(measured) == len(error)
    assert len(time) > 3.0 * 500 - 12, "every cycle but those before the first Q_REF"
    assert np.array_equal(error, measured - reference)
    steps = np.flatnonzero(np.diff(reference[:, 0]))
    assert np.diff(steps).min() == 10, "a staircase of 50 Hz in steps of 500 Hz"


def test_missed_cycles_are_those_that_were_counted(
    demo: ModuleType, file: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    release = np.array([0, 2, 4, 10, 12, 16], dtype=np.int64) * 1_000_000
    assert demo.without_cycle(release, 2e6) == 3
    assert demo.without_cycle(release[:3], 2e6) == 0
    monkeypatch.setattr(Log, "missed", lambda _: {"qrdiff": 17})
    words = [line.split() for line in demo.task_table(Log(file))[1:]]
    assert {w[0]: w[3] for w in words if w[3] != "0"} == {"qrdiff": "17"}


def test_tables_say_what_ran(demo: ModuleType, file: Path) -> None:
    recording = Log(file)
    words = [line.split() for line in demo.task_table(recording)[1:]]
    assert {w[0]: w[1:5] for w in words} == {
        "puma_pidg": ["1500", "500", "0", "2"],  # until T_GRAV is of a measured posture
        "grav_comp": ["750", "250", "0", "0"],
        "qrdiff": ["300", "100", "0", "0"],
        "jttrace": ["150", "50", "0", "0"],
    }
    assert len(demo.joint_table(recording)) == 7


def test_plot_and_summary_are_made_of_a_recording(
    demo: ModuleType, file: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    model = tmp_path / "new" / "puma.png"
    demo.main(["--from", str(file), "--plot", str(model)])
    assert model.read_bytes()[:8] == b"\x89PNG\r\n\x1a\n"
    assert model.stat().st_size > 50_000
    out = capsys.readouterr().out
    assert "puma_pidg     1500" in out
    assert str(model) in out


def test_recording_that_shows_nothing_is_told(demo: ModuleType, tmp_path: Path) -> None:
    empty = recorded(tmp_path, 0.0)
    with pytest.raises(SystemExit, match="let it run longer"):
        demo.main(["--from", str(empty), "--plot", str(tmp_path / "a.png")])
    empty = tmp_path / "empty.mcap"
    empty.write_bytes(b"")
    with pytest.raises(SystemExit, match="the log is empty"):
        demo.main(["--from", str(empty), "--plot", str(tmp_path / "a.png")])
    assert not (tmp_path / "a.png").exists()


def test_a_failed_run_ends_the_demo(
    demo: ModuleType, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(demo, "HERE", tmp_path)  # there is no job
    with pytest.raises(SystemExit) as caught:
        demo.main(["--seconds", "1", "--sim", "--runs", str(tmp_path)])
    assert caught.value.code not in {0, None}
