"""What a commit is judged by: FINITE, LIMIT clip, LIMIT error, for every type."""

import os

import numpy as np
import pytest

from pbonet.config.model import Limit, Variable
from pbonet.errors import SvarError
from pbonet.svar import Flags, Table

ME = os.getpid()
NARROW = [
    "char",
    "short",
    "int",
    "int64",
    "byte",
    "word",
    "unsigned",
    "uint64",
    "float",
    "double",
]


@pytest.fixture(autouse=True)
def _folder(tmp_path, monkeypatch):
    monkeypatch.setenv("PBONET_SHM_DIR", str(tmp_path))


@pytest.fixture
def table():
    variables = [Variable(name="V0", type="double", nelem=3)]
    with Table.create("arm", variables) as made:
        yield made


def fill(local, **values):
    for name, value in values.items():
        local.array(name)[:] = value


@pytest.mark.parametrize("kind", ["float", "double"])
@pytest.mark.parametrize("bad", [np.nan, np.inf, -np.inf])
@pytest.mark.parametrize("nelem", [1, 2, 7, 64])
def test_non_finite_is_refused_wherever_it_stands(kind, bad, nelem):
    variables = [Variable(name=f"X{i}", type=kind, nelem=nelem) for i in range(3)]
    names = [v.name for v in variables]
    with Table.create("guard", variables) as table:
        task = table.local("t", ME, outvar=names)
        fill(task, X0=1, X1=2, X2=3)
        task.claim()
        largest = np.finfo(variables[0].dtype).max
        for name in names:
            for element in {0, nelem // 2, nelem - 1}:
                task.array(name)[element] = bad
                assert task.commit() == Flags.COMMIT_NONFINITE
                assert task.blamed[:2] == (name, element)
                assert np.isfinite(table.read(name)).all()
                task.array(name)[element] = largest
                assert task.commit() == 0
                task.array(name)[element] = -largest
                assert task.commit() == 0
                task.array(name)[element] = 0.0
        assert task.counters.refused == 3 * len({0, nelem // 2, nelem - 1})


@pytest.mark.parametrize("kind", ["float", "double"])
@pytest.mark.parametrize("nelem", [1, 3, 5, 11, 16, 33, 256])
def test_values_that_are_checked_while_they_are_copied_arrive_whole(kind, nelem):
    """And after a refused commit readers still have what was there before."""
    random = np.random.default_rng(nelem)
    variables = [Variable(name=f"X{i}", type=kind, nelem=nelem) for i in range(3)]
    names = [v.name for v in variables]
    with Table.create("whole", variables) as table:
        task = table.local("t", ME, outvar=names)
        task.claim()
        for turn in range(6):
            for name in names:
                task.array(name)[:] = random.normal(size=nelem)
            good = {name: task.array(name).copy() for name in names}
            assert task.commit(7, turn) == 0
            spoilt = names[turn % 3], int(random.integers(nelem))
            task.array(spoilt[0])[spoilt[1]] = np.nan
            assert task.commit(8, turn) == Flags.COMMIT_NONFINITE
            assert task.blamed[:2] == spoilt
            for name in names:
                np.testing.assert_array_equal(table.read(name), good[name])
                assert table.info(name).time_ns == 7


def test_claim_of_a_non_finite_value_claims_nothing(table):
    task = table.local("t", ME, outvar=["V0"])
    fill(task, V0=np.nan)
    assert task.claim() == Flags.COMMIT_NONFINITE
    assert not task.claimed
    assert table.info("V0").owner is None


def test_finite_no_lets_nan_pass():
    variables = [Variable(name="X", type="double", nelem=2, finite=False)]
    with Table.create("nan", variables) as table:
        task = table.local("t", ME, outvar=["X"])
        fill(task, X=np.nan)
        assert task.claim() == 0
        assert np.isnan(table.read("X")).all()


@pytest.mark.parametrize("kind", NARROW)
def test_clip_brings_values_inside(kind):
    low = 0 if kind in {"byte", "word", "unsigned", "uint64"} else -5
    variable = Variable(
        name="X", type=kind, nelem=3, min=(low,) * 3, max=(5, 5, 5), limit=Limit.CLIP
    )
    with Table.create("clip", [variable]) as table:
        task = table.local("t", ME, outvar=["X"])
        top = 100
        fill(task, X=[low, top, 3])
        assert task.claim() == 0
        assert table.read("X").tolist() == [low, 5, 3]
        assert task.array("X").tolist() == [low, 5, 3]
        assert task.counters.clipped == 1
        if low:
            fill(task, X=-100)
            assert task.commit() == 0
            assert table.read("X").tolist() == [low] * 3


@pytest.mark.parametrize("kind", NARROW)
def test_limit_error_refuses(kind):
    variable = Variable(
        name="X", type=kind, nelem=2, min=(1, 1), max=(5, 5), limit=Limit.ERROR,
        units="N",
    )  # fmt: skip
    with Table.create("limit", [variable]) as table:
        task = table.local("t", ME, outvar=["X"])
        fill(task, X=[1, 5])
        assert task.claim() == 0
        fill(task, X=[1, 6])
        assert task.commit() == Flags.COMMIT_LIMIT
        dot = ".0" if task.array("X").dtype.kind == "f" else ""
        assert task.blamed == ("X", 1, f"6{dot}", f"1{dot} to 5{dot} N")
        fill(task, X=[0, 5])
        assert task.commit() == Flags.COMMIT_LIMIT
        assert task.blamed[:2] == ("X", 0)
        assert table.read("X").tolist() == [1, 5]


def test_min_and_max_alone_are_for_information():
    variable = Variable(name="X", type="double", min=(0.0,), max=(1.0,))
    with Table.create("info", [variable]) as table:
        task = table.local("t", ME, outvar=["X"])
        fill(task, X=9)
        assert task.claim() == 0
        assert table.read("X").tolist() == [9]


def test_infinity_is_an_error_even_where_a_limit_would_clip_it():
    variable = Variable(
        name="X", type="double", min=(0.0,), max=(1.0,), limit=Limit.CLIP
    )
    with Table.create("both", [variable]) as table:
        task = table.local("t", ME, outvar=["X"])
        fill(task, X=np.inf)
        assert task.claim() == Flags.COMMIT_NONFINITE


def test_nan_passes_limits_where_finite_no_admits_it():
    variable = Variable(
        name="X", type="double", min=(0.0,), max=(1.0,), limit=Limit.ERROR, finite=False
    )
    with Table.create("both", [variable]) as table:
        task = table.local("t", ME, outvar=["X"])
        fill(task, X=np.nan)
        assert task.claim() == 0
        fill(task, X=np.inf)
        assert task.commit() == Flags.COMMIT_LIMIT


def test_structs_and_booleans_are_not_judged():
    variables = [
        Variable(name="S", type="struct[8]", nelem=2),
        Variable(name="B", type="bool", nelem=3),
    ]
    with Table.create("raw", variables) as table:
        task = table.local("t", ME, outvar=["S", "B"])
        task.array("S").view(np.float64)[:] = np.nan
        fill(task, B=[True, False, True])
        assert task.claim() == 0
        assert table.read("B").tolist() == [True, False, True]


def keep_safe(limit, value):
    one = Variable(
        name="X", type="double", nelem=2, min=(0, 0), max=(1, 1), limit=limit
    )
    with Table.create("arm", [one]) as table:
        return table.local("t", ME, outvar=["X"]).keep_safe({"X": value})


@pytest.mark.parametrize(("limit", "value"), [(Limit.NONE, 2.0), (Limit.ERROR, 0.5)])
def test_safe_values_are_kept_as_they_are_committed(limit, value):
    assert keep_safe(limit, value) == np.full(2, value).tobytes()


@pytest.mark.parametrize("value", [2.0, np.nan, np.inf])
@pytest.mark.parametrize("limit", [Limit.ERROR, Limit.CLIP])
def test_safe_values_that_are_no_values_of_the_variable_are_refused(limit, value):
    """The dispatcher commits them unseen."""
    with pytest.raises(SvarError, match="safe values of arm/t"):
        keep_safe(limit, value)
