"""Replays of logs with damaged bytes: a module is not blamed for what is missing."""

from __future__ import annotations

import contextlib

import pytest
from log_of_python_tasks import Shop, drive
from made_logs import flipped

from pbonet.cli import main
from pbonet.errors import PbonetError
from pbonet.log import Log, recover
from pbonet.log.part import Part
from pbonet.testing import rerun, verify

SLICES = 12


@pytest.fixture(scope="module")
def whole(tmp_path_factory):
    shop = Shop(tmp_path_factory.mktemp("whole"))
    try:
        drive(shop)
        yield shop.log(slices=SLICES)
    finally:
        shop.close()


def status(*words) -> int:
    """Run a verb; return its exit status."""
    with pytest.raises(SystemExit) as caught:
        main([*map(str, words)])
    return caught.value.code


def damaged(path, chunk):
    """Damage one chunk of a log."""
    one = Part(path)._chunks[chunk]
    data = bytearray(path.read_bytes())
    data[one.at + one.size - 5] ^= 4
    path.write_bytes(data)


@pytest.fixture
def copy(whole, tmp_path):
    path = tmp_path / "run.mcap"
    path.write_bytes(whole.read_bytes())
    return path


def test_the_whole_log_is_verified(whole) -> None:
    assert all(one.good for one in verify(whole))
    assert status("replay", whole, "--verify", "--strict") == 0


@pytest.mark.parametrize("chunk", range(SLICES))
def test_cycles_after_a_damaged_chunk_are_verified_again(copy, chunk, capsys) -> None:
    recorded = [one.recorded for one in verify(copy)]
    damaged(copy, chunk)
    verdicts = verify(copy)
    assert [one.divergence for one in verdicts] == [None, None]
    assert not any(one.good for one in verdicts)
    assert sum(one.recorded for one in verdicts) <= sum(recorded)
    if 0 < chunk < SLICES - 1:
        most = max(one.cycles / one.recorded for one in verdicts)
        assert most > 0.5, "what follows the gap is compared, too"
    assert status("replay", copy, "--verify") == 3
    told = capsys.readouterr().err
    assert "damaged chunk" in told
    assert "s of the run is missing" in told
    assert not rerun(copy).good
    assert not any(one.divergence for one in rerun(copy).tasks)


def test_a_task_whose_inputs_are_damaged_is_verified_where_they_are_not(tmp_path):
    """Its own records are all there; b reads what a wrote."""
    with contextlib.closing(Shop(tmp_path)) as shop:
        drive(shop)
        path = shop.log(slices=SLICES, apart=True)
    damaged(path, 2 * 4)
    a, b = verify(path)
    assert (a.divergence, b.divergence) == (None, None)
    assert "is not recorded" in b.gaps[0]
    assert not b.good
    assert b.recorded == 21
    assert b.cycles > 15, "those before and after the damage"


def test_a_recovered_log_does_not_hide_its_gap(copy, tmp_path) -> None:
    damaged(copy, SLICES // 2)
    out = tmp_path / "out.mcap"
    recover(copy, out)
    assert not Log(out).check()
    verdicts = verify(out)
    assert [one.divergence for one in verdicts] == [None, None]
    assert not all(one.good for one in verdicts)


def test_a_flipped_bit_is_never_the_modules_fault(whole, tmp_path) -> None:
    cycles = {one.task: one.cycles for one in verify(whole)}
    path = tmp_path / "run.mcap"
    for bit in flipped(whole, path, 150, 7):
        try:
            verdicts = verify(path)
        except PbonetError:
            continue
        for one in verdicts:
            assert one.divergence is None, f"bit {bit}: {one}"
            assert one.cycles == cycles[one.task] or not one.good, f"bit {bit}: {one}"


def test_a_log_that_was_cut_is_incomplete(copy, capsys) -> None:
    data = copy.read_bytes()
    copy.write_bytes(data[: Part(copy)._chunks[-1].at])
    for more, wanted in (((), 0), (("--strict",), 3)):
        assert status("replay", copy, "--verify", *more) == wanted
        assert "was not finished" in capsys.readouterr().err


def test_a_log_with_a_damaged_index_is_verified_without_it(copy, capsys) -> None:
    data = bytearray(copy.read_bytes())
    data[-60] ^= 1
    copy.write_bytes(data)
    assert Log(copy).complete
    assert status("replay", copy, "--verify", "--strict") == 0
    assert "damaged index" in capsys.readouterr().err
