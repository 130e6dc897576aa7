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
    new.take_over_from(["someone", "old"])
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
    new.take_over_from(["old"])
    old.cede()
    new.claim()
    assert owners(table) == ["old", "new", None, None]
    old.release()
    assert owners(table) == [None, "new", None, None]


@pytest.mark.usefixtures("old")
def test_the_permission_ends(table):
    new = table.local("new", ME, outvar=["V0"])
    new.take_over_from(["old"])
    new.take_over_from([])
    with pytest.raises(SvarOwnerError):
        new.claim()
    assert owners(table)[0] == "old"


def test_the_old_one_comes_back_as_if_nothing_had_been(table, old):
    old.cede()
    assert old.claim() == 0
    assert old.commit() == 0
    new = table.local("new", ME, outvar=["V0"])
    new.take_over_from(["old"])
    old.cede()
    new.claim()
    with pytest.raises(SvarOwnerError, match="new"):
        old.claim()
    new.release()
    old.claim()
    assert owners(table)[:2] == ["old", "old"]


@pytest.fixture
def heir(table, old):
    """A task that the old one hands over to; it has not claimed yet."""
    new = table.local("new", ME, outvar=["V0", "V1"])
    new.take_over_from(["old", "third"])
    old.cede()
    new.have_ended()
    return new


def test_who_has_ended_hands_over_as_it_was_told(table, heir):
    heir.check_claim()
    assert heir.claim() == 0
    assert owners(table) == ["new", "new", None, None]


def test_who_was_turned_on_again_keeps_its_variables(table, old, heir):
    """The heir's `on` was slow, and somebody has decided otherwise meanwhile."""
    assert old.claim() == 0
    with pytest.raises(SvarOwnerError, match="new cannot write V0"):
        heir.check_claim()
    with pytest.raises(SvarOwnerError, match="owner old"):
        heir.claim()
    assert owners(table) == ["old", "old", None, None]
    assert old.commit() == 0
    old.cede()
    heir.take_over_from(["old"])  # another exchange
    heir.have_ended()
    assert heir.claim() == 0
    assert owners(table) == ["new", "new", None, None]


def test_who_owned_nothing_when_those_ended_hands_over_nothing(table, old, heir):
    """As one on another machine, which had given its variables up, or one before."""
    third = table.local("third", ME, outvar=["V0"])
    old.release()
    third.claim()
    with pytest.raises(SvarOwnerError, match="owner third"):
        heir.claim()
    third.release()
    assert heir.claim() == 0
    assert owners(table) == ["new", "new", None, None]


def test_two_heirs_of_one_that_has_ended(table, old):
    """The claim of the first is no commit of the one that they follow."""
    old.cede()
    for name in ("V0", "V1"):
        new = table.local(f"of {name}", ME, outvar=[name])
        new.take_over_from(["old"])
        new.have_ended()
        assert new.claim() == 0
    assert owners(table) == ["of V0", "of V1", None, None]
