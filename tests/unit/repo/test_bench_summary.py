"""All benchmarks as one command: which there are, and what is said at the end."""

from __future__ import annotations

import importlib.util
import re
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[3]


@pytest.fixture
def bench(monkeypatch):
    """The program, whose benchmarks end at once with these statuses."""
    monkeypatch.syspath_prepend(str(ROOT))
    module = importlib.import_module("benchmarks.run")
    ended: dict[str, int] = {}
    monkeypatch.setattr(module, "run", lambda name, *, quick: ended.get(name, 0))  # noqa: ARG005
    module.ended = ended
    return module


def source(program: str) -> Path:
    """The file that runs a benchmark, which is a module or a package."""
    folder = ROOT / "benchmarks" / program
    return folder / "__main__.py" if folder.is_dir() else folder.with_suffix(".py")


def ends(bench, monkeypatch, capsys, *words):
    monkeypatch.setattr(sys, "argv", ["run", *words])
    status = bench.main()
    return status, capsys.readouterr().out.splitlines()


def test_every_benchmark_is_a_program(bench) -> None:
    for line in bench.RUNS.values():
        name = f"benchmarks.{line.split()[0]}"
        assert importlib.util.find_spec(name) is not None, name
    assert set(bench.QUICK) <= set(bench.RUNS)
    programs = {line.split()[0] for line in bench.RUNS.values()}
    for path in (ROOT / "benchmarks").rglob("*.py"):
        name = path.parent.name if path.stem == "__main__" else path.stem
        if '__name__ == "__main__"' in path.read_text() and name != "run":
            assert name in programs, f"`make bench` does not run {path}"


def test_those_without_a_goal_are_named(bench, monkeypatch, capsys) -> None:
    for program in {line.split()[0] for line in bench.RUNS.values()}:
        text = source(program).read_text()
        judges = re.search(r"judge\(|sys\.exit\(3\)|else 3|MISSED", text) is not None
        assert judges != (program in bench.NO_GOAL), program
    _, out = ends(bench, monkeypatch, capsys, "svar", "ports")
    assert out[-3].endswith(" good")
    assert out[-2].endswith("shown, it has no goal")


def test_all_good(bench, monkeypatch, capsys) -> None:
    status, out = ends(bench, monkeypatch, capsys)
    assert status == 0
    count = len(bench.RUNS)
    assert (
        out[-1]
        == f"{count} benchmarks: {count} good, 0 missed a goal, 0 failed or not run"
    )


def test_goals_that_were_missed_are_told(bench, monkeypatch, capsys) -> None:
    bench.ended |= {"svar": 3}
    status, out = ends(bench, monkeypatch, capsys, "svar", "ipc")
    assert status == 3
    assert [line.split(None, 3)[3] for line in out[-3:-1]] == ["goal missed", "good"]
    status, out = ends(bench, monkeypatch, capsys, "--quick", "svar", "ipc")
    assert status == 0
    assert out[-3].endswith("goal missed, which says nothing here")


def test_one_that_failed_counts_more(bench, monkeypatch, capsys) -> None:
    bench.ended |= {"svar": 3, "ipc": -9}
    status, out = ends(bench, monkeypatch, capsys, "svar", "ipc")
    assert status == 1
    assert out[-2].endswith("FAILED with status -9")
    assert ends(bench, monkeypatch, capsys, "nothing")[0] == 2


def test_an_interrupt_shows_what_there_is(bench, monkeypatch, capsys) -> None:
    def run(name, *, quick):
        if name == "ipc":
            raise KeyboardInterrupt
        return quick

    monkeypatch.setattr(bench, "run", run)
    status, out = ends(bench, monkeypatch, capsys, "svar", "ipc", "tbuf")
    assert status == 1
    assert [line.split()[-1] for line in out[-4:-1]] == ["good", "run", "run"]
