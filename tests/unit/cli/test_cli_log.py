"""``pbonet log`` as it is typed: what it prints, what it writes, what it answers."""

from __future__ import annotations

import json

import numpy as np
import pytest
from made_logs import PLAIN, about, cycles, record, run
from pyarrow import parquet

from pbonet.log import Log, LogWriter, is_complete

EVENTS = [
    (20, "SPAWNED", "pid", "it is there"),
    (30, "WARNING", "pid", "odd"),
    (30, "WARNING", "other", "odd too"),
    (40, "TASK_DIED", "other", "gone"),
    (10, "OUTPUT", "pid", "a line"),
]


def make(path, seed=1, count=30, since=0):
    """Write a log with two tasks, the events, and a warning without one."""
    path.parent.mkdir(exist_ok=True)
    writer = LogWriter(path, run())
    for task in ("pid", "other"):
        number = writer.add_task(about(task, PLAIN))
        writer.add(number, cycles(count, seed=seed, since=since))
        writer.flush()
    for n, (severity, code, task, text) in enumerate(EVENTS, 1):
        known = {"n": n, "time": n, "wall": float(n), "rtpu": "arm0", "task": task}
        writer.add_event({**known, "severity": severity, "code": code, "text": text})
    writer.close()
    return path


@pytest.fixture
def path(tmp_path):
    return make(tmp_path / "r" / "run.mcap")


@pytest.mark.parametrize(
    ("words", "wanted"),
    [
        ((), "1 2 3 4 5"),
        (("--task", "pid"), "1 2 5"),
        (("--code", "WARNING"), "2 3"),
        (("--severity", "warning"), "2 3 4"),
        (("--severity", "error"), "4"),
        (("--task", "other", "--code", "WARNING"), "3"),
        (("--task", "nobody"), ""),
    ],
)
def test_events_are_chosen(call, path, words, wanted) -> None:
    status, out, _ = call("log", "events", path, *words, "--json")
    assert status == 0
    assert " ".join(str(one["n"]) for one in json.loads(out)["events"]) == wanted
    lines = call("log", "events", path, *words)[1].splitlines()
    assert len(lines) == len(wanted.split())
    for line in lines:
        assert "arm0/" in line


def test_a_code_that_no_event_has_is_told_beside_what_was_found(call, path) -> None:
    status, out, err = call("log", "events", path, "--code", "WARNIGN")
    assert (status, out) == (0, "")
    assert err == "WARNING> no event has the code WARNIGN; did you mean WARNING?\n"
    assert call("log", "events", path, "--code", "RING_FULL")[1:] == ("", "")


def test_no_such_severity(call, path) -> None:
    status, _, err = call("log", "events", path, "--severity", "warnign")
    assert status == 1
    assert "there is no severity warnign" in err
    assert "did you mean warning?" in err


def test_values_go_to_numpy_and_parquet(call, path, tmp_path) -> None:
    npz, table = tmp_path / "a.npz", tmp_path / "a.parquet"
    words = ("log", "cat", path, "pid", "Y", "cpu_ns")
    assert call(*words, "-o", npz)[:2] == (0, f"{npz}\n")
    status, out, _ = call(*words, "--out", table, "--json")
    assert (status, json.loads(out)["file"]) == (0, str(table))
    wanted = Log(path).arrays("pid")["Y"]
    with np.load(npz) as arrays:
        assert list(arrays)[:3] == ["time", "cycle", "Y[0]"]
        got = np.stack([arrays[f"Y[{i}]"] for i in range(6)], axis=1)
    assert got.tobytes() == wanted.tobytes()
    read = parquet.read_table(table)
    assert read["Y[3]"].to_numpy().tobytes() == wanted[:, 3].tobytes()
    assert read.schema.field("Y[3]").metadata[b"units"] == b"m"
    status, _, err = call(*words, "-o", tmp_path / "no" / "a.npz")
    assert status == 1
    assert "the file cannot be written" in err
    status, _, err = call("log", "cat", path, "pit")
    assert status == 1
    assert "did you mean pid?" in err


def test_values_go_to_text_files_as_they_are_shown(call, path, tmp_path) -> None:
    words = ("log", "cat", path, "pid", "Y")
    for name, more in (("a.csv", ()), ("a.JSON", ("--json",))):
        shown = call(*words, *more)[1]
        out = tmp_path / name
        assert call(*words, "-o", out)[:2] == (0, f"{out}\n")
        assert out.read_bytes() == shown.encode()
    status, out, err = call(*words, "-o", tmp_path / "no" / "a.csv")
    assert (status, out) == (1, "")
    assert "no/a.csv: the file cannot be written (got No such file" in err


@pytest.mark.parametrize(
    ("name", "got", "remedy"),
    [
        ("a.parqet", ".parqet", "did you mean .parquet?"),
        ("values", "no ending", "use values.csv"),
    ],
)
def test_a_file_is_written_as_its_name_ends(call, path, name, got, remedy) -> None:
    status, _, err = call("log", "cat", path, "pid", "-o", name)
    assert status == 1
    wanted = "a name that ends in .csv, .json, .npz or .parquet"
    assert f"cannot be written (expected {wanted}, got {got}); {remedy}" in err


def test_a_log_without_commands_says_why(call, path, tmp_path) -> None:
    status, out, err = call("log", "commands", path)
    assert (status, out) == (0, "")
    assert err.startswith("the log has no commands; ")
    LogWriter(tmp_path / "s.mcap", run(seconds=2.0)).close()
    assert json.loads(call("log", "commands", tmp_path / "s.mcap", "--json")[1]) == {
        "commands": []
    }
    err = call("log", "commands", tmp_path / "s.mcap")[2]
    assert err.startswith("no commands were sent: this run was simulated, ")


def test_a_log_that_was_cut_is_recovered(call, path, tmp_path) -> None:
    cut, out = tmp_path / "cut.mcap", tmp_path / "whole.mcap"
    cut.write_bytes(path.read_bytes()[: -path.stat().st_size // 3])
    assert "not finished: see `log recover`" in call("log", "info", cut)[1]
    status, told, _ = call("log", "recover", cut, "-o", out, "--json")
    assert status == 0
    assert is_complete(out)
    count = Log(out).parts[0].count
    assert json.loads(told)["messages"] == count == Log(cut).parts[0].count > 0
    assert "complete" in call("log", "info", out)[1]
    status, _, err = call("log", "recover", cut, "-o", out)
    assert status == 1
    assert "the log cannot be written" in err
    cut.write_bytes(path.read_bytes()[:5])
    status, _, err = call("log", "recover", cut, "-o", tmp_path / "b.mcap")
    assert status == 1
    assert f"{cut}: the log is empty: it was truncated before its first" in err
    assert not (tmp_path / "b.mcap").exists()


def test_runs_that_differ_are_told_with_a_status(call, path, tmp_path) -> None:
    same = make(tmp_path / "same" / "run.mcap")
    assert call("log", "diff", path, same)[0] == 0
    writer = LogWriter(tmp_path / "other.mcap", run())
    number = writer.add_task(about("pid", PLAIN))
    writer.add(number, cycles(12) + record(bytes(48), cycle=13) * 18)
    writer.close()
    status, out, _ = call("log", "diff", path, tmp_path / "other.mcap", "--json")
    assert status == 1
    (row,) = json.loads(out)
    assert (row["task"], row["variable"], row["first"]) == ("pid", "Y", 13)
    status, out, _ = call("log", "diff", path, same, "--task", "other")
    assert status == 0
    assert [line.split()[0] for line in out.splitlines()] == ["task", "other"]
    status, _, err = call("log", "diff", path, same, "--task", "othre")
    assert status == 1
    assert "did you mean other?" in err


def test_a_variable_is_no_task(call, path) -> None:
    status, _, err = call("log", "cat", path, "Y")
    assert status == 1
    assert "the log has no task Y (" in err
    assert err.rstrip().endswith("; Y is a variable of pid and other")


def test_a_task_without_a_cycle_is_no_different(call, tmp_path) -> None:
    for name in ("one", "two"):
        writer = LogWriter(tmp_path / f"{name}.mcap", run())
        writer.add_task(about("standby", PLAIN))
        writer.close()
    logs = (tmp_path / "one.mcap", tmp_path / "two.mcap")
    status, out, err = call("log", "diff", *logs, "--json")
    assert status == 0, err
    rows = [(row["variable"], row["cycles"], row["first"]) for row in json.loads(out)]
    assert rows == [("Y", [0, 0], None)]


def test_a_picture_is_drawn(call, tmp_path) -> None:
    path, model = tmp_path / "run.mcap", tmp_path / "a.svg"
    writer = LogWriter(path, run())
    number = writer.add_task(about("pid", PLAIN))
    for n in range(9):
        writer.add(number, record(np.full(6, 0.5 * n).tobytes(), release_ns=n))
    writer.close()
    status, out, _ = call("log", "plot", path, "Y", "-o", model)
    assert (status, out.strip()) == (0, str(model))
    assert "<svg" in model.read_text()
    assert "<!-- spare -->" not in model.read_text(), "one writer needs no name"
    status, _, err = call("log", "plot", path, "Z", "-o", model)
    assert status == 1
    assert "no task of the run wrote Z" in err


def test_a_picture_names_all_writers_of_a_variable(call, tmp_path) -> None:
    path, model = tmp_path / "run.mcap", tmp_path / "a.svg"
    writer = LogWriter(path, run())
    for task, first in (("pid", 0), ("spare", 50)):
        number = writer.add_task(about(task, PLAIN))
        for n in range(first, first + 9):
            writer.add(number, record(np.full(6, 0.5 * n).tobytes(), release_ns=n))
    writer.close()
    assert call("log", "plot", path, "Y", "-o", model)[0] == 0
    drawn = model.read_text()  # each text's words stand in a comment before its path
    assert "<!-- pid -->" in drawn
    assert "<!-- spare -->" in drawn


def test_the_newest_run_is_taken_where_none_is_named(call, runs) -> None:
    runs.mkdir()
    make(runs / "2026-05-04T10-00-00.000-j" / "run.mcap", count=3)
    make(runs / "2026-05-05T10-00-00.000-j" / "run.mcap", count=7)
    assert json.loads(call("log", "info", "--json")[1])["tasks"]["pid"]["cycles"] == 7


@pytest.mark.parametrize(
    "words",
    [("log", "info"), ("log", "events"), ("replay",), ("replay", "--verify")],
    ids=" ".join,
)
def test_what_cannot_be_read_is_told_by_every_verb(call, tmp_path, words) -> None:
    verb, *more = words
    for name, run_, wanted in (
        (
            "newer",
            run(format=99, pbonet="9.1"),
            "the log was written by a newer pbonet",
        ),
        ("two", run("tuesday"), "the folder holds logs of several runs"),
    ):
        folder = tmp_path / name
        folder.mkdir()
        LogWriter(folder / "run.mcap", run_).close()
        if name == "two":
            LogWriter(folder / "run-2.mcap", run("monday")).close()
        place = (*more, folder) if verb == "log" else (folder, *more)
        status, out, err = call(verb, *place)
        assert (status, out) == (1, "")
        assert wanted in err
        assert "Traceback" not in err
