"""Single variables, by name and by index (section 5.5.1), and who is blamed."""

import os

import numpy as np
import pytest

from pbonet.config.model import Limit, Variable
from pbonet.errors import UnknownVariableError
from pbonet.svar import Flags, Table

ME = os.getpid()
VARIABLES = [
    Variable(name="A", type="double", nelem=3),
    Variable(name="B", type="double", nelem=2, min=(0,) * 2, max=(1,) * 2),
    Variable(name="C", type="double", nelem=3),
    Variable(
        name="D", type="int", nelem=2, min=(0,) * 2, max=(9,) * 2, limit=Limit.CLIP
    ),
    Variable(name="E", type="float", nelem=3),
    Variable(name="F", type="double", maxage=1.0),
    Variable(
        name="G", type="double", nelem=2, min=(0, 5), max=(1, 6), limit=Limit.ERROR
    ),
]


@pytest.fixture
def table(tmp_path, monkeypatch):
    monkeypatch.setenv("PBONET_SHM_DIR", str(tmp_path))
    with Table.create("arm", VARIABLES) as made:
        yield made


def everything(table):
    task = table.local("t", ME, outvar=table.names())
    task.array("G")[:] = 0.5, 5.5
    assert task.claim() == 0
    return task


def test_who_met_no_fault_blames_nothing(table):
    """Though the table's first variable is none of the task's."""
    task = table.local("t", ME, outvar=["C"])
    assert task.commit() == Flags.COMMIT_NOT_OWNER
    assert task.blamed == ("", 0, "", "")


@pytest.mark.parametrize("other", ["A", "C", "E", "G"])
def test_a_single_write_is_judged_alone(table, other):
    task = everything(table)
    task.array(other)[0] = np.nan if other != "G" else 7
    assert task.commit() in {Flags.COMMIT_NONFINITE, Flags.COMMIT_LIMIT}
    task.array("B")[:] = 1, 2
    assert task.write("B") == 0
    assert table.read("B").tolist() == [1, 2]
    assert np.isfinite(table.read(other)).all()
    assert task.write(other) != 0
    assert task.blamed[:2] == (other, 0)


def test_a_single_write_clips_nothing_but_itself(table):
    task = everything(table)
    task.array("D")[:] = 100
    task.array("C")[:] = 4
    assert task.write("C") == 0
    assert task.array("D").tolist() == [100, 100], "it was not sent"
    assert task.counters.clipped == 0
    assert task.write("D") == 0
    assert task.array("D").tolist() == table.read("D").tolist() == [9, 9]
    assert task.counters.clipped == 2


@pytest.mark.parametrize("name", ["A", "B", "C", "E", "F", "G"])
def test_a_single_write_is_judged_in_every_element(table, name):
    task = everything(table)
    before = table.read(name).tolist()
    good = task.array(name).copy()
    for element in range(len(good)):
        task.array(name)[:] = good
        task.array(name)[element] = np.nan if name != "G" else -1
        assert task.write(name) != 0
        assert task.blamed[:2] == (name, element)
        assert table.read(name).tolist() == before
    assert task.counters.refused == len(good)


@pytest.mark.parametrize("names", [("A", "C"), ("A", "B", "C"), ("C", "F"), ("B", "F")])
def test_the_blamed_variable_is_one_of_the_group(table, names):
    """Neighbours in a group need not be neighbours in the table."""
    task = table.local("t", ME, outvar=names)
    task.claim()
    for name in names:
        last = len(task.array(name)) - 1
        task.array(name)[last] = np.inf
        assert task.commit() == Flags.COMMIT_NONFINITE
        assert task.blamed[:2] == (name, last)
        task.array(name)[last] = 0


def test_a_stale_input_is_blamed_whatever_was_refused_before(table):
    task = table.local("t", ME, invar=["F"], outvar=["C"])
    task.claim()
    task.array("C")[2] = np.nan
    task.commit()
    assert task.blamed[:2] == ("C", 2)
    assert task.copy_in() == Flags.COPY_STALE
    assert task.blamed[:2] == ("F", 0)


def test_a_single_read_says_that_its_variable_is_stale(table):
    reader = table.local("r", ME, invar=["A", "F"])
    assert reader.read("A") == 0
    assert reader.read("F") == Flags.COPY_STALE
    assert reader.blamed[:2] == ("F", 0)
    table.write("F", [2])
    assert reader.read("F") == 0
    assert reader.array("F").tolist() == [2]
    assert reader.counters.stale == 1


def test_every_single_access_takes_an_index_as_well(table):
    writer = table.local("w", ME, outvar=["C", "E"])
    reader = table.local("r", ME, invar=["A", "C", "E"])
    writer.claim()
    for value, name in enumerate(("C", "E"), 1):
        index = table.index(name)
        assert writer.array(index) is writer.array(name)
        writer.array(index)[:] = value
        assert writer.write(index) == 0
        assert reader.read(index) == 0
        assert reader.array(index).tolist() == [value] * 3
        assert table.read(index).tolist() == [value] * 3
    assert reader.names() == ["A", "C", "E"]
    with pytest.raises(UnknownVariableError, match="r has no variable of index 1"):
        reader.read(1)
    with pytest.raises(UnknownVariableError, match="does not write variable of index"):
        writer.write(0)


def test_a_constant_that_stands_elsewhere_is_not_written(table):
    one = table.local("one", ME, outconst=["A"])
    two = table.local("two", ME, outconst=["A", "C"])
    one.copy_out_consts()
    two.array("C")[:] = 2
    assert two.copy_out_consts() == 0
    two.array("A")[:] = 3
    assert two.write("A") == Flags.COMMIT_NOT_OWNER, "it stands in one's register"
    assert table.read("A").tolist() == [0] * 3
    two.array("C")[:] = 4
    assert two.write("C") == 0
    assert table.read("C").tolist() == [4] * 3


def test_sharing_a_constant_takes_no_fresh_register_each_time(table):
    one = table.local("one", ME, outconst=["A"])
    two = table.local("two", ME, outconst=["A", "C"])
    one.copy_out_consts()
    two.copy_out_consts()
    before = table.info("C").register
    for value in range(5):
        two.array("C")[:] = value
        assert two.copy_out_consts() == 0
        assert table.read("C").tolist() == [value] * 3
    assert table.info("C").register == before
