"""Logs with damaged bytes: what is read is what was written, and the rest is named."""

from __future__ import annotations

import io
from pathlib import Path

import pytest
from made_logs import PLAIN, about, cycles, flipped, run, written

from pbonet.errors import LogError
from pbonet.log import Log, LogWriter, recover, text
from pbonet.log.export import write_csv

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
