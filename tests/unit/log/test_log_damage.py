"""Logs with damaged bytes: what is read is what was written, and the rest is named."""

from __future__ import annotations

import contextlib
import io
import random
from pathlib import Path

import numpy as np
import pytest
from made_logs import PLAIN, about, cycles, flipped, run, written

from pbonet.errors import LogError
from pbonet.log import Log, LogWriter, Rows, recover, text
from pbonet.log.cycle_columns import ReadSchema
from pbonet.log.export import write_csv
from pbonet.log.part import Part

FLIPS = 1000


def content(log: Log) -> dict[str, object]:
    """Return everything that a log says, in parts that can be compared one by one."""
    found: dict[str, object] = {"about": log.about}
    for task in log.tasks:
        found[f"{task} about"] = log.task_about(task)
        arrays = log.arrays(task)
        for row, cycle in enumerate(arrays["cycle"].tolist()):
            values = {name: column[row].tobytes() for name, column in arrays.items()}
            found[f"{task} {cycle}"] = values
    for name, one in log.attached.items():
        found[f"attached {name}"] = one.data
    for kind in ("events", "commands"):
        for one in getattr(log, kind)():
            found[f"{kind} {one}"] = one
    return found


@pytest.fixture(scope="module")
def whole(tmp_path_factory):
    path = tmp_path_factory.mktemp("whole") / "run.mcap"
    return written(path, ["a", "b"], count=200, flush=True)


def test_a_flipped_bit_changes_no_value_and_is_reported(whole, tmp_path) -> None:
    before, path = content(Log(whole)), tmp_path / "run.mcap"
    unread = damaged = 0
    for n, bit in enumerate(flipped(whole, path, FLIPS, 13)):
        try:
            log = Log(path)
            after, lost = content(log), log.check()
            text.info_text(text.info(log))
        except LogError:
            unread += 1
            continue
        assert after.items() <= before.items(), f"bit {bit}"
        if len(after) < len(before):
            assert lost, f"bit {bit}: something is missing, and not reported"
            damaged += 1
        if n % 20 == 0:
            saved = Path(tmp_path, f"saved{n}.mcap")
            recover(path, saved)
            rescued = content(Log(saved))
            cycles_of = {key for key in after if key[:2] in {"a ", "b "}}
            assert cycles_of <= rescued.keys()
            assert all(rescued[key] == after[key] for key in cycles_of)
            write_csv(text.columns(Log(saved), "a"), io.StringIO())
    assert unread < FLIPS // 100, "a log could not be read for one bit"
    assert damaged > FLIPS // 2


def test_a_flipped_bit_in_a_log_without_its_end(whole, tmp_path) -> None:
    data, cut, path = whole.read_bytes(), tmp_path / "cut.mcap", tmp_path / "run.mcap"
    cut.write_bytes(data[: 9 * len(data) // 10])
    before = content(Log(cut))
    unread = 0
    for bit in flipped(cut, path, FLIPS // 4, 14):
        try:
            log = Log(path)
            after = content(log)
        except LogError:
            unread += 1
            continue
        assert after.items() <= before.items(), f"bit {bit}"
        assert len(after) == len(before) or log.check(), f"bit {bit}"
    assert unread < FLIPS // 40, "a log could not be read for one bit"


def test_a_record_that_is_too_short_for_its_channel_is_refused(tmp_path) -> None:
    writer = LogWriter(tmp_path / "run.mcap", run())
    writer.add(writer.add_task(about("a", PLAIN)), cycles(3))
    writer._writer.add_message(1, 5, b"\0" * 9, 5)
    writer.close()
    with pytest.raises(LogError, match="shorter than its channel's schema"):
        Log(tmp_path / "run.mcap").arrays("a")


def test_a_damaged_chunk_is_missing_from_its_first_cycle_on(tmp_path) -> None:
    """Its first message has cycles of before its own time."""
    writer = LogWriter(path := tmp_path / "run.mcap", run())
    number = writer.add_task(about("a", PLAIN))
    for first in (0, 4000, 8000):
        writer.add(number, cycles(4000, since=first))  # of 40 ms
        writer.flush()
    writer.close()
    chunk = Part(path)._chunks[1]
    data = bytearray(path.read_bytes())
    data[chunk.at + chunk.size - 9] ^= 1
    path.write_bytes(data)
    log = Log(path)
    numbers = log.arrays("a")["cycle"].tolist()
    missing = sorted(set(range(1, 12_001)) - set(numbers))
    assert numbers
    assert missing
    first = Part(path).span_ns
    assert first is not None
    (lost,) = log.check()
    assert lost.begin is not None
    assert lost.begin * 1e9 + first[0] <= 10_000 * (missing[0] - 1) or not lost.begin


def test_messages_that_end_anywhere_are_no_cycles() -> None:
    schema = ReadSchema(about("a", PLAIN))
    ((_, count, _, _, message),) = schema.encode(cycles(40))
    assert count == 40
    size, older = len(message), 0
    whole = schema.cycles(rows_of(message))
    assert len(whole) == 40
    for end in range(size):
        with contextlib.suppress(LogError):
            (row,) = schema.cycles(rows_of(message[:end]))
            assert row == whole[39], "as in logs with a message for each cycle"
            older += 1
    assert older < 10
    pick = random.Random(3)
    for _ in range(3000):
        broken = bytearray(message)
        for _ in range(pick.randrange(1, 4)):
            broken[pick.randrange(size)] = pick.randrange(256)
        with contextlib.suppress(LogError):
            schema.cycles(rows_of(bytes(broken)))


def rows_of(message: bytes) -> Rows:
    sizes, none = np.array([len(message)]), np.zeros(1, np.int64)
    return Rows(message, sizes, none, none)
