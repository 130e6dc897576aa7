"""The visual servoing example in virtual time: what a live swap is good for."""

from __future__ import annotations

import importlib.util
import re
import sys
from pathlib import Path
from types import ModuleType
from typing import Any

import numpy as np
import pytest

EXAMPLE = Path(__file__).parents[3] / "examples" / "servoing"
STAYING = {"puma_pidg", "grav_comp", "forward_kin", "target", "qrdiff"}


def load(name: str) -> ModuleType:
    spec = importlib.util.spec_from_file_location(
        f"servoing_{name}", EXAMPLE / f"{name}.py"
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


@pytest.fixture(scope="module")
def runs(demo: ModuleType) -> list[Any]:
    steering = load("steering")
    return [
        demo.run(steering.Steering(demo.JOB, sim=True), swap=swap)
        for swap in (False, True)
    ]


def fastest(run: Any, name: str) -> float:
    return float(np.abs(run.recording.series(name)[1]).max())


@pytest.mark.slow
def test_the_swap_keeps_the_joints_slow_past_the_singularity(
    demo: ModuleType, runs: list[Any]
) -> None:
    plain, swapped = runs
    for run in runs:
        assert run.recording.series("SIGMA")[1].min() < 0.05, "it passes close by"
    assert fastest(plain, "Q^_REF") > 8.0
    assert fastest(plain, "Q^_MEZ") > 2.2, "as fast as the arm's interface lets it"
    assert fastest(swapped, "Q^_REF") < 1.0
    assert fastest(swapped, "Q^_MEZ") < 1.0
    (_, _, turned), (_, far, turned_less) = (
        demo.tracking(run.recording) for run in runs
    )
    assert turned.max() > 10.0
    assert turned_less.max() < 5.0
    assert far.max() < 10.0
    assert max(far[-1], turned_less[-1]) < 0.5, "and it arrives"


@pytest.mark.slow
def test_tasks_that_stay_miss_nothing(demo: ModuleType, runs: list[Any]) -> None:
    for run in runs:
        assert demo.missed(run) == dict.fromkeys(STAYING, (0, 0))
    plain, swapped = runs
    assert plain.swaps == []
    assert 2.0 < swapped.swaps[0] < swapped.swaps[1] < 5.0


@pytest.mark.slow
def test_the_reference_goes_on_without_a_step(runs: list[Any]) -> None:
    recording = runs[1].recording
    cycles = [
        (int(release), *value)
        for task in ("puma_inv_kin", "qrint")
        for release, value in zip(
            recording.arrays(task)["release_ns"],
            recording.arrays(task)["Q_REF"],
            strict=True,
        )
    ]
    references = np.array(sorted(cycles))
    assert set(np.diff(references[:, 0])) == {1e7}, "one writer in each 10 ms"
    steps = np.abs(np.diff(references[:, 1:], axis=0)).max(axis=1)
    assert steps.max() < 0.03, "what a picture's age of 40 ms makes of 0.7 rad/s"


@pytest.mark.slow
def test_demo_prints_both_runs_and_plots_them(
    demo: ModuleType, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    model = tmp_path / "new" / "servoing.png"
    demo.main(["--sim", "--plot", str(model)])
    assert model.read_bytes()[:8] == b"\x89PNG\r\n\x1a\n"
    out = capsys.readouterr().out
    number = r" +\d+\.\d+"
    for title in ("without a swap", "with the swap"):
        assert re.search(rf"^{title}{4 * number} +0 of \d+$", out, re.MULTILINE)
    assert out.count("  swapped at ") == 2


def test_missed_cycles_are_counted_and_those_at_a_swap_apart(demo: ModuleType) -> None:
    class Fake:
        begin_ns = 0
        tasks = ("damped_ls", "servo", "once")

        def __init__(self, **counted: int) -> None:
            self.counted = counted

        def missed(self) -> dict[str, int]:
            return self.counted

        def arrays(self, task: str) -> dict[str, np.ndarray]:
            release = {"damped_ls": [500, 900], "servo": [0, 10, 20, 50, 60, 70, 480,
                       490, 520, 530], "once": [0]}[task]  # fmt: skip
            return {"release_ns": np.array(release) * 1_000_000}

    assert demo.missed(demo.Result("", Fake())) == {"servo": (2 + 40 + 2, 42)}
    assert demo.missed(demo.Result("", Fake(servo=50))) == {"servo": (50, 42)}
