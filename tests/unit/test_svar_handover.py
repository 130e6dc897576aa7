"""Variables that go from one live task to another as one event."""

import os

import pytest

from pbonet.config.model import Variable
from pbonet.errors import SvarOwnerError
from pbonet.svar import Flags, Table

ME = os.getpid()
DOUBLES = [Variable(name=f"V{i}", type="double", nelem=3) for i in range(4)]


@pytest.fixture
def table(tmp_path, monkeypatch):
    monkeypatch.setenv("PBONET_SHM_DIR", str(tmp_path))
    with Table.create("arm", DOUBLES) as made:
        yield made


@pytest.fixture
def old(table):
    """A task that owns V0 and V1."""
    local = table.local("old", ME, outvar=["V0", "V1"])
    local.array("V0")[:] = 5.0
    local.claim()
    return local


def owners(table):
    return [table.info(f"V{i}").owner for i in range(4)]


def test_an_heir_takes_over_while_the_old_one_lives(table, old):
    new = table.local("new", ME, outvar=["V0", "V1", "V2"])
    with pytest.raises(SvarOwnerError, match="old"):
        new.check_claim()
    new.heir_of(["someone", "old"])
    new.check_claim()
    old.cede()
    assert owners(table) == ["old", "old", None, None]  # nobody in between
    assert old.commit() == Flags.COMMIT_NOT_OWNER
    new.copy_in_on()
    assert new.array("V0").tolist() == [5.0] * 3
    generation = table.generation
    assert new.claim() == 0
    assert table.generation == generation + 1
    assert owners(table) == ["new", "new", "new", None]
    old.release()  # what nobody took; here nothing is left
    assert owners(table) == ["new", "new", "new", None]
    assert table.read("V0").tolist() == [5.0] * 3


def test_what_the_heir_does_not_take_is_left_until_it_is_released(table, old):
    new = table.local("new", ME, outvar=["V1"])
    new.heir_of(["old"])
    old.cede()
    new.claim()
    assert owners(table) == ["old", "new", None, None]
    old.release()
    assert owners(table) == [None, "new", None, None]


@pytest.mark.usefixtures("old")
def test_the_permission_ends(table):
    new = table.local("new", ME, outvar=["V0"])
    new.heir_of(["old"])
    new.heir_of([])
    with pytest.raises(SvarOwnerError):
        new.claim()
    assert owners(table)[0] == "old"


def test_the_old_one_comes_back_as_if_nothing_had_been(table, old):
    old.cede()
    assert old.claim() == 0
    assert old.commit() == 0
    new = table.local("new", ME, outvar=["V0"])
    new.heir_of(["old"])
    old.cede()
    new.claim()
    with pytest.raises(SvarOwnerError, match="new"):
        old.claim()
    new.release()
    old.claim()
    assert owners(table)[:2] == ["old", "old"]
