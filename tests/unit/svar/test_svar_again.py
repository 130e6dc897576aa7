"""A task that owns its variables reads everything anew (section 6.3: an abort)."""

import os

import pytest

from pbonet.config.model import Variable
from pbonet.svar import Table

ME = os.getpid()
DOUBLES = [Variable(name=f"V{i}", type="double", nelem=3) for i in range(2)]


@pytest.fixture
def table(tmp_path, monkeypatch):
    monkeypatch.setenv("PBONET_SHM_DIR", str(tmp_path))
    with Table.create("arm", DOUBLES) as made:
        yield made


def test_an_owner_reads_back_what_it_wrote_last_and_goes_on_owning(table):
    other = table.local("o", ME, outvar=["V0"])
    other.claim()
    task = table.local("w", ME, invar=["V0"], outvar=["V1"])
    task.array("V1")[:] = 1.5
    task.claim()
    task.commit()
    before = table.info("V1")
    task.array("V1")[:] = 99.0
    other.array("V0")[:] = 7.0
    other.commit()
    assert task.copy_in_on() == 0
    assert task.array("V1").tolist() == [1.5] * 3
    assert task.array("V0").tolist() == [7.0] * 3
    assert (table.info("V1").owner, table.info("V1").seq) == ("w", before.seq)
    task.array("V1")[:] = 2.5
    assert task.commit() == 0
    assert table.info("V1").seq == before.seq + 1
