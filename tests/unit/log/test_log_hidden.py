"""Variables that are not recorded: their values are nowhere, and that is said."""

from __future__ import annotations

import struct

import pytest
from log_of_python_tasks import Shop, drive

from pbonet.log import Log
from pbonet.testing import rerun, verify

SECRET = 0.123456789


@pytest.fixture
def shop(tmp_path):
    shop = Shop(tmp_path)
    yield shop
    shop.close()


def everything(path):
    """Return all messages of a log, unpacked."""
    log = Log(path)
    rows = [
        part.rows(key).all()
        for part in log.parts
        for key in part.channels
        if part.count
    ]
    return b"".join(b"".join(map(bytes, one)) for one in rows)


@pytest.mark.parametrize("hidden", [[], ["X"]])
def test_no_value_of_it_is_anywhere(shop, hidden) -> None:
    shop.cycles(2)
    shop.table.write("X", [SECRET, SECRET])
    shop.cycles(2)
    shop.a.signal("off")
    shop.a.signal("on")
    shop.cycles(2)
    found = everything(shop.log(hidden=hidden)).count(struct.pack("<d", SECRET))
    assert found == 0 if hidden else found >= 4, "in inputs of cycles and of `on`"


def test_a_constant_too(shop) -> None:
    shop.cycles(2)
    data = everything(shop.log(hidden=["N"]))
    assert data, "the rest is there"
    a, b = verify(shop.folder / "run.mcap")
    for one in (a, b):
        assert one.divergence is None
        assert one.gaps == ["spawn after cycle 0: N is not recorded"]


def test_who_reads_it_is_not_verified_and_no_zero_is_taken_for_it(shop) -> None:
    drive(shop)
    a, b = verify(shop.log(hidden=["X"]))
    assert a.cycles == 0
    assert a.divergence is None
    assert a.gaps == ["on after cycle 0: X is not recorded"]
    assert b.good


def test_run_together_a_task_gives_it_anew(shop) -> None:
    drive(shop)
    path = shop.log(hidden=["Y0"])
    assert verify(path, ["b"])[0].gaps[0].endswith("Y0 is not recorded")
    out = shop.folder / "now.mcap"
    found = rerun(path, out=out)
    assert found.good, str(found)
    assert [one.cycles for one in found.tasks] == [20, 21]
    assert "Y0" in Log(out).arrays("a"), "it was made"


def test_what_nobody_made_is_not_written_as_zeros(shop) -> None:
    drive(shop)
    out = shop.folder / "now.mcap"
    found = rerun(shop.log(hidden=["Y0"]), ["b"], out=out)
    assert found.tasks[0].divergence is None
    assert found.tasks[0].gaps[0].endswith("Y0 is not recorded")
    arrays = Log(out).arrays("a")
    assert "Y0" not in arrays
    assert len(arrays["cycle"]) == 20
    assert "Y1" in Log(out).arrays("b")
