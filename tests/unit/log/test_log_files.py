"""Logs on disk: what is written is read, whatever is cut off, merged or of others."""

from __future__ import annotations

import csv
import io
import json
import random

import numpy as np
import pytest
from made_logs import (
    PLAIN,
    VARIABLES,
    about,
    cycles,
    group,
    record,
    run,
    written,
)
from mcap.reader import make_reader
from pyarrow import parquet

from pbonet.config.model import Variable
from pbonet.errors import LogError, UnknownTaskError, UnknownVariableError
from pbonet.log import (
    Log,
    LogWriter,
    Part,
    Step,
    export,
    files_of,
    is_complete,
    last_run,
    scan,
    text,
)
from pbonet.log.rewrite import merge, recover


def chunks_of(path) -> list[scan.Found]:
    with path.open("rb") as file:
        found = scan.scan(file, str(path))
    return [one for one in found.records if one.opcode == scan.CHUNK]


def test_values_of_every_type_come_back(tmp_path) -> None:
    pick = random.Random(7)
    writer = LogWriter(tmp_path / "run.mcap", run())
    number = writer.add_task(about())
    rows = []
    for n in range(50):
        data, values = group(VARIABLES, pick)
        rows.append(values)
        head = {"cycle": n + 1, "release_ns": n, "cpu_ns": 3 * n, "flags": n % 3}
        pairs, inputs = (7, n, 8, n) if n % 2 else (), b"in" * (n % 5)
        heard = b"heard" * (n % 3)
        assert writer.add(number, record(data, pairs, inputs, heard, **head)) == 1
    step = record(b'{"what":"on"}', kind=Step.DID, release_ns=9)
    assert writer.add(number, step + record(b"abc", kind=Step.ON_IN)) == 2
    writer.close()
    log = Log(tmp_path)
    arrays = log.arrays("pid")
    for name in ("FLAG", "Q^", "COUNT", "RAW", "W"):
        wanted = np.array([row[name] for row in rows])
        assert arrays[name].dtype == wanted.dtype
        assert arrays[name].tobytes() == wanted.tobytes()
    assert arrays["cpu_ns"].tolist() == [3 * n for n in range(50)]
    (life,) = log.lives("pid")
    assert len(life.records) == 52
    assert [life.schema.group(one) for one in life.commits] == [
        b"".join(
            row[v.name].tobytes() + bytes(-row[v.name].nbytes % 8) for v in VARIABLES
        )
        for row in rows
    ]
    assert life.groups == [life.schema.group(one) for one in life.commits]
    assert life.schema.rest(life.commits[3]) == (
        np.array([7, 3, 8, 3], np.uint64).tobytes(),
        b"ininin",
        b"",
    )
    assert life.schema.rest(life.commits[2])[1:] == (b"inin", b"heard" * 2)
    assert life.schema.rest(life.commits[3])[1:] == (b"ininin", b"")
    assert life.schema.rest(life.commits[4])[1:] == (b"inininin", b"heard")


def test_a_task_without_outputs_has_cycles_of_nothing(tmp_path) -> None:
    writer = LogWriter(tmp_path / "run.mcap", run())
    one = record(cycle=1, number=1, end_ns=5)
    writer.add(writer.add_task(about(outvar=[])), one + record(cycle=2, number=2))
    writer.close()
    (life,) = Log(tmp_path).lives("pid")
    assert life.groups == [b"", b""]


def test_channels_say_units_and_descriptions(tmp_path) -> None:
    writer = LogWriter(tmp_path / "run.mcap", run())
    writer.add(writer.add_task(about()), record(group(VARIABLES, random.Random(1))[0]))
    writer.close()
    with (tmp_path / "run.mcap").open("rb") as file:
        summary = make_reader(file).get_summary()
    assert summary is not None
    channel = next(c for c in summary.channels.values() if c.topic == "arm/pid")
    assert json.loads(channel.metadata["fields"])["q_x5e"] == {
        "variable": "Q^",
        "units": "rad/s",
        "description": "speed",
        "type": "double",
    }
    schema = summary.schemas[channel.schema_id].data.decode()
    lines = [line.split("  #")[0] for line in schema.splitlines()]
    cycle = [
        *("bool[3] flag", "float64[2] q_x5e", "int16 count", "uint8[5] raw"),
        *("float32[3] w", "uint8[] consumed", "uint8[] inputs", "uint8[] heard"),
    ]
    assert lines[11:] == [
        *cycle,
        *("pbonet/ArmPidBefore[] cycles_before", "=" * 80, "MSG: pbonet/ArmPidBefore"),
        *("int64 release_ns", "int32 start_ns", "int32 end_ns", "uint32 cpu_ns"),
        *cycle,
    ]


def test_a_log_cut_anywhere_opens_up_to_its_last_whole_chunk(tmp_path) -> None:
    whole = written(tmp_path / "run.mcap", count=3000, flush=True)
    data = whole.read_bytes()
    chunks = chunks_of(whole)
    ends = [one.at + one.size for one in chunks]
    first = chunks[0].at
    pick, cut = random.Random(200), tmp_path / "cut.mcap"
    counts = set()
    for _ in range(200):
        at = pick.randrange(first, len(data))
        cut.write_bytes(data[:at])
        log = Log(cut)
        (part,) = log.parts
        assert not part.complete
        assert not log.check()
        whole_ones = sum(end <= at for end in ends)
        assert part.chunks == whole_ones
        if whole_ones:
            kept = log.arrays("pid")
            expected = min(3000, 100 * whole_ones)
            assert kept["cycle"].tolist() == list(range(1, expected + 1))
        counts.add(whole_ones)
    assert len(counts) > 20, "the places were all alike"


def test_a_log_cut_before_its_first_chunk_says_so_or_has_no_cycles(tmp_path) -> None:
    data = written(tmp_path / "run.mcap", flush=True).read_bytes()
    cut, told = tmp_path / "cut.mcap", set()
    first = chunks_of(tmp_path / "run.mcap")[0].at
    for at in range(first):
        cut.write_bytes(data[:at])
        assert not is_complete(cut)
        if not Part(cut).metadata:
            told.add(at)
            with pytest.raises(LogError, match=": the log is empty") as caught:
                Log(cut)
            assert caught.value.got == f"{at} bytes"
            continue
        log = Log(cut)
        assert log.tasks == []
        assert log.about["run"] == "r1"
        found = text.info(log)
        assert (found["seconds"], found["tasks"]) == (0.0, {})
        assert "not finished" in text.info_text(found)
        with pytest.raises(UnknownTaskError, match="expected a log with tasks"):
            log.arrays("pid")
    assert told == set(range(len(told))), "up to the record that says which run it is"
    assert 8 < len(told) < first


def test_a_file_that_was_hardly_begun_keeps_nobody_from_the_others(tmp_path) -> None:
    written(tmp_path / "run.mcap", count=200)
    for size in (0, 5, 8, 30):
        data = (tmp_path / "run.mcap").read_bytes()[:size]
        (tmp_path / "run-2.mcap").write_bytes(data)
        log = Log(tmp_path)
        assert len(log.arrays("pid")["cycle"]) == 200
        files = text.info(log)["files"]
        assert sorted(file["complete"] for file in files) == [False, True]
        assert merge([tmp_path], tmp_path / f"{size}.out").messages == 3


def test_what_was_cut_is_recovered_for_everybody(tmp_path) -> None:
    whole = written(tmp_path / "run.mcap", count=2000, flush=True)
    cut, out = tmp_path / "cut.mcap", tmp_path / "out.mcap"
    cut.write_bytes(whole.read_bytes()[: whole.stat().st_size // 2])
    assert not is_complete(cut)
    count = recover(cut, out).messages
    assert is_complete(out)
    before, after = Log(cut), Log(out)
    assert count == before.parts[0].count > 0
    assert after.about == before.about
    assert after.attached == before.attached
    assert np.array_equal(after.arrays("pid")["Y"], before.arrays("pid")["Y"])
    with out.open("rb") as file:
        assert sum(1 for _ in make_reader(file).iter_messages()) == count
    with pytest.raises(LogError, match="the log cannot be written") as caught:
        recover(cut, out)
    assert caught.value.got == "File exists"


def test_a_damaged_chunk_is_left_out_and_counted(tmp_path) -> None:
    path = written(tmp_path / "run.mcap", count=500, flush=True)
    chunk = chunks_of(path)[2]
    data = bytearray(path.read_bytes())
    data[chunk.at + chunk.size - 9] ^= 0xFF
    path.write_bytes(data)
    log = Log(path)
    assert len(log.check()) == 1
    numbers = log.arrays("pid")["cycle"].tolist()
    assert numbers == [*range(1, 201), *range(301, 501)]
    assert text.info(log)["files"][0]["damaged"] == 1


def test_logs_of_one_run_are_read_as_one_and_merged_by_time(tmp_path) -> None:
    (tmp_path / "r").mkdir()
    written(tmp_path / "r" / "a0.mcap", ["a"])
    written(tmp_path / "r" / "a1.mcap", ["b", "c"])
    both = Log(tmp_path / "r")
    assert both.tasks == ["a", "b", "c"]
    count = merge([tmp_path / "r"], tmp_path / "one.mcap").messages
    one = Log(tmp_path / "one.mcap")
    assert count == one.parts[0].count == 3 * 5 + 2, "a message for 100 cycles"
    assert len(one.events()) == 2
    for task in both.tasks:
        assert np.array_equal(one.arrays(task)["Y"], both.arrays(task)["Y"])
    with (tmp_path / "one.mcap").open("rb") as file:
        times = [m.log_time for _, _, m in make_reader(file).iter_messages()]
    assert times == sorted(times)


def test_two_runs_in_one_folder_are_told(tmp_path) -> None:
    written(tmp_path / "run.mcap", name="monday")
    written(tmp_path / "run-2.mcap", name="tuesday")
    with pytest.raises(LogError, match="several runs") as caught:
        Log(tmp_path)
    assert caught.value.got == "monday, tuesday"
    assert Log(tmp_path / "run-2.mcap").about["run"] == "tuesday"


def test_a_newer_log_says_which_pbonet_is_needed(tmp_path) -> None:
    path = written(tmp_path / "run.mcap", format=99, pbonet="9.1")
    with pytest.raises(LogError, match="written by a newer pbonet") as caught:
        Log(path)
    assert caught.value.got == "format 99, pbonet 9.1"
    with path.open("rb") as file:
        assert make_reader(file).get_summary() is not None


def test_what_is_no_log(tmp_path) -> None:
    (tmp_path / "a.mcap").write_bytes(b"something else")
    (tmp_path / "b.mcap").touch()
    for path, got in (
        (tmp_path / "a.mcap", "14 bytes of something else"),
        (tmp_path / "b.mcap", "0 bytes"),
        (tmp_path / "none.mcap", "No such file or directory"),
    ):
        with pytest.raises(LogError) as caught:
            Log(path)
        assert caught.value.got == got
    (tmp_path / "empty").mkdir()
    with pytest.raises(LogError, match="the folder has no log"):
        files_of(tmp_path / "empty")
    with pytest.raises(LogError, match="no run was recorded here"):
        last_run(tmp_path / "empty")


def test_a_task_that_is_not_there_offers_the_nearest(tmp_path) -> None:
    log = Log(written(tmp_path / "run.mcap"))
    with pytest.raises(UnknownTaskError, match="the log has no task pit") as caught:
        log.arrays("pit")
    assert caught.value.remedy == "did you mean pid?"


@pytest.mark.parametrize(("last", "lost"), [(0.0, 7), (1.0, 4)])
def test_what_fits_no_ring_is_counted(tmp_path, last, lost) -> None:
    """Unless it came before the last seconds, which alone were to be recorded."""
    writer = LogWriter(tmp_path / "run.mcap", run(last=last))
    number = writer.add_task(about("pid", PLAIN))
    for cycle, before in ((4, 3), (12, 7)):
        writer.add(number, record(bytes(48), cycle=cycle, lost=before))
    writer.close()
    assert Log(tmp_path).lost() == {"pid": lost}


def test_a_hidden_variable_is_not_in_the_file(tmp_path) -> None:
    secret = bytes(range(200, 216))
    variables = [Variable(name="A", type="double", nelem=2), *PLAIN]
    writer = LogWriter(tmp_path / "run.mcap", run())
    number = writer.add_task(about("pid", variables, hidden=["A"]))
    writer.add(number, record(secret + np.arange(6.0).tobytes(), cycle=1))
    writer.close()
    log = Log(tmp_path)
    assert log.variables("pid") == ["Y"]
    assert log.arrays("pid")["Y"].tolist() == [[0, 1, 2, 3, 4, 5]]
    assert secret not in log.lives("pid")[0].commits[0]


def test_values_go_out_as_csv_and_arrays(tmp_path) -> None:
    log = Log(written(tmp_path / "run.mcap", count=20))
    table = text.columns(log, "pid", ["Y", "cpu_ns"])
    out = io.StringIO()
    export.write_csv(table, out)
    rows = list(csv.reader(io.StringIO(out.getvalue())))
    assert rows[0] == ["time", "cycle", *(f"Y[{i}]" for i in range(6)), "cpu_ns"]
    back = np.array([row[2:8] for row in rows[1:]], float)
    assert np.array_equal(back, log.arrays("pid")["Y"], equal_nan=True)
    export.write_npz(table, tmp_path / "out.npz")
    with np.load(tmp_path / "out.npz") as archive:
        assert archive["cycle"].tolist() == list(range(1, 21))
    export.write_parquet(table, tmp_path / "out.parquet", log, "pid")
    read = parquet.read_table(tmp_path / "out.parquet")
    assert read.column_names == rows[0]
    stack = np.stack([read[f"Y[{i}]"].to_numpy() for i in range(6)], axis=1)
    assert np.array_equal(stack, log.arrays("pid")["Y"], equal_nan=True)
    units = [read.schema.field(name).metadata[b"units"] for name in ("time", "Y[2]")]
    assert units == [b"s", b"m"]
    with pytest.raises(LogError, match="the file cannot be written"):
        export.write_parquet(table, tmp_path / "no" / "out.parquet", log, "pid")
    with pytest.raises(LogError, match="pid has no Z on record"):
        text.columns(log, "pid", ["Z"])


def test_runs_are_compared_by_variable(tmp_path) -> None:
    one = Log(written(tmp_path / "a.mcap", count=30))
    same = Log(written(tmp_path / "b.mcap", count=30, name="r2"))
    assert [row["first"] for row in text.diff(one, same)] == [None]
    writer = LogWriter(tmp_path / "c.mcap", run("r3"))
    number = writer.add_task(about("pid", PLAIN))
    writer.add(number, cycles(12, seed=0) + cycles(18, seed=5, since=12))
    writer.close()
    (row,) = text.diff(one, Log(tmp_path / "c.mcap"))
    assert (row["task"], row["variable"], row["first"]) == ("pid", "Y", 13)
    assert "13" in text.diff_text([row])


def test_a_variable_s_series_has_the_values_of_all_its_writers(tmp_path) -> None:
    """As after a swap, a swap back, and a fallback: a, b, a, c, and b spawned again."""
    writer = LogWriter(tmp_path / "run.mcap", run())
    numbers = {task: writer.add_task(about(task, PLAIN)) for task in "abc"}
    order = [("a", 0, 40), ("b", 40, 30), ("a", 70, 20), ("c", 90, 10)]
    for task, since, count in order:
        writer.add(numbers[task], cycles(count, since=since))
    again = writer.add_task(about("c", [*PLAIN, VARIABLES[2]]))
    writer.add(again, cycles(15, [*PLAIN, VARIABLES[2]], since=100))
    writer.close()
    log = Log(tmp_path / "run.mcap")
    time, values = log.series("Y")
    assert len(time) == len(values) == 115
    assert np.all(np.diff(time) > 0)
    begins, tasks = zip(*log.writers("Y"), strict=True)
    assert tasks == ("a", "b", "a", "c")
    assert begins == pytest.approx([since * 1e-5 for _, since, _ in order])
    with pytest.raises(UnknownVariableError, match="no task of the run wrote Z"):
        log.series("Z")
