"""Logs with damaged bytes: what is read is what was written, and the rest is named."""

from __future__ import annotations

import random

import pytest
from made_logs import written

from pbonet.errors import LogError
from pbonet.log import Log, text

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
    data = bytearray(whole.read_bytes())
    before = content(Log(whole))
    pick, path = random.Random(13), tmp_path / "run.mcap"
    unread = damaged = 0
    for bit in sorted(pick.sample(range(8 * len(data)), FLIPS)):
        data[bit // 8] ^= 1 << bit % 8
        path.write_bytes(data)
        data[bit // 8] ^= 1 << bit % 8
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
    assert unread < FLIPS // 100, "a log could not be read for one bit"
    assert damaged > FLIPS // 2


def test_a_flipped_bit_in_a_log_without_its_end(whole, tmp_path) -> None:
    data = bytearray(whole.read_bytes())
    del data[9 * len(data) // 10 :]
    path = tmp_path / "run.mcap"
    path.write_bytes(data)
    before = content(Log(path))
    pick = random.Random(14)
    for bit in sorted(pick.sample(range(8 * len(data)), FLIPS // 4)):
        data[bit // 8] ^= 1 << bit % 8
        path.write_bytes(data)
        data[bit // 8] ^= 1 << bit % 8
        try:
            log = Log(path)
            after = content(log)
        except LogError:
            continue
        assert after.items() <= before.items(), f"bit {bit}"
        assert len(after) == len(before) or log.check(), f"bit {bit}"
