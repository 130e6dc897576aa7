"""PRE and POST: what is a condition, what it must fit, whether it holds."""

from __future__ import annotations

import math

import numpy as np
import pytest
from hypothesis import given, strategies as st

from pbonet.analysis import legality
from pbonet.config import parse_job
from pbonet.config.conditions import parse
from pbonet.config.model import Condition, Place, Variable
from pbonet.errors import ConfigError

TABLE = (
    Variable(name="Q", type="double", units="rad", nelem=6),
    Variable(name="Q^", type="double", units="rad/s", nelem=6),
    Variable(name="GRIP", type="double", units="m"),
    Variable(name="HELD", type="bool"),
    Variable(name="N", type="int"),
    Variable(name="RAW", type="struct[8]"),
    Variable(name="COUNT", type="int", units="counts per turn"),
    Variable(name="OLD", type="double", units="m", nelem=3, maxage=0.1),
    Variable(name="FREE", type="double", units="none", finite=False),
)
VALUES = {
    "Q": [0.1, -0.2, 0.3, 0.0, 0.0, 0.5],
    "Q^": [0.0, 0.0, -2.0, 0.0, 0.0, 0.0],
    "GRIP": [0.02],
    "HELD": [True],
    "N": [3],
    "COUNT": [7],
    "OLD": [3.0, 4.0, 0.0],
    "FREE": [math.nan],
}


def outcome(text, stale=()):
    assert legality.check_conditions([Condition(text)], TABLE) == []
    return legality.evaluate(Condition(text), TABLE, VALUES, stale)


@pytest.mark.parametrize(
    ("text", "holds"),
    [
        ("max(abs(Q)) < 0.51", True),
        ("max(abs(Q)) < 0.5", False),
        ("max(Q) == 0.5 and min(Q) == -0.2", True),
        ("norm(OLD) == 5", True),
        ("norm(OLD[0:2] - OLD[1:3]) < 4.2", True),
        ("norm(OLD[1:]) == 4 and norm(OLD[:1]) == 3", True),
        ("Q[5] > 28 [deg] and Q[5] < 29 [deg]", True),
        ("28 [deg] < Q[5] < 29 [deg]", True),
        ("28 [deg] < Q[5] < 28.5 [deg]", False),
        ("GRIP < 30 [mm] and GRIP > 10 [mm]", True),
        ("GRIP*GRIP < 5 [cm**2]", True),
        ("Q[2]/Q^[2] > -0.16 [s]", True),
        ("-GRIP - 0.01 < -0.02", True),
        ("2*(GRIP + 0.01) == 0.06", True),
        ("HELD", True),
        ("not HELD or N == 3", True),
        ("HELD and not N >= 4", True),
        ("HELD == 1", True),
        ("COUNT*2 == 14", True),
        ("min(GRIP, 0.5, 15 [mm]) == 0.015", True),
        ("min(max(Q, 0.4)) == 0.4", True),
        ("max(max(0.1, OLD, 3.5)) == 4 and min(max(0.1, OLD, 3.5)) == 3.5", True),
        ("max(1, 2000 [mm], GRIP) == 2 [m]", True),
        ("500 [mm] + max(1, 1500 [mm]) == 2 [m]", True),
        ("N != 0x3", False),
        ("1/(N - 3) > 0", False),
        ("FREE < 1 or FREE >= 1", False),
        ("not FREE < 1", False),
        ("FREE != FREE", False),
    ],
)
def test_it_holds_or_not(text, holds):
    assert outcome(text).holds is holds


def test_what_was_seen_has_both_sides_and_all_variables():
    found = outcome("max(abs(Q)) < 5 [deg] or GRIP > 0.1")
    assert found.seen == (
        "0.5 < 0.0872665 rad does not hold; 0.02 > 0.1 m does not hold; "
        "Q = 0.1 -0.2 0.3 0 0 0.5 rad; GRIP = 0.02 m"
    )


def test_what_is_older_than_its_maxage_answers_nothing():
    assert outcome("OLD[0] > 0").holds
    found = outcome("OLD[0] > 0", stale=["OLD"])
    assert not found.holds
    assert found.seen.endswith("OLD is older than its MAXAGE, 0.1 s")
    assert outcome("N == 3", stale=["OLD"]).holds


@pytest.mark.parametrize(
    ("text", "code", "message"),
    [
        (
            "GRP < 1",
            "unknown-variable",
            "lift.job:5:6: a condition names GRP, which the table does not have "
            "(expected a variable of the .svar file, got GRP); did you mean GRIP?",
        ),
        (
            "HELD and done",
            "unknown-variable",
            "lift.job:5:15: a condition names done, which the table does not have "
            "(expected a variable of the .svar file, got done); correct the name; put "
            "comments after # or into DESC",
        ),
        (
            "abs(Q) < 1",
            "shape",
            "lift.job:5:6: several numbers cannot be compared at once (expected one "
            "number, got abs(Q), which has 6); write max(abs(abs(Q))), norm(abs(Q)), "
            "or an element of it",
        ),
        (
            "norm(OLD - Q) < 1",
            "shape",
            "lift.job:5:17: these have different numbers of elements (expected 3, or "
            "1, got Q, which has 6); take the elements that belong together, such as "
            "X[0:3]",
        ),
        (
            "min(max(1, OLD*0, Q*0)) < 1",
            "shape",
            "lift.job:5:24: these have different numbers of elements (expected 3, or "
            "1, got Q*0, which has 6); take the elements that belong together, such as "
            "X[0:3]",
        ),
        (
            "max(1, GRIP, Q[0]) < 1",
            "unit",
            "lift.job:5:19: different units cannot be compared or added (expected m, "
            "got Q[0] in rad); correct UNITS in the .svar file, or the condition",
        ),
        (
            "Q[6] < 1",
            "shape",
            "lift.job:5:6: there is no such element (expected elements 0 to 5, got "
            "Q[6]); count from 0; X[0:3] is the first three",
        ),
        (
            "norm(Q[2:2]) < 1",
            "shape",
            "lift.job:5:11: there is no such element (expected elements 0 to 5, got "
            "Q[2:2]); count from 0; X[0:3] is the first three",
        ),
        (
            "Q[0] < GRIP",
            "unit",
            "lift.job:5:13: different units cannot be compared or added (expected rad, "
            "got GRIP in m); correct UNITS in the .svar file, or the condition",
        ),
        (
            "GRIP + 3 [kg] > 0",
            "unit",
            "lift.job:5:13: different units cannot be compared or added (expected m, "
            "got 3 in kg); correct UNITS in the .svar file, or the condition",
        ),
        (
            "GRIP + OLD[0]*1 [1/m] > 0",
            "unit",
            "lift.job:5:13: different units cannot be compared or added (expected m, "
            "got OLD[0]*1 in (m)*(1/m)); correct UNITS in the .svar file, or the "
            "condition",
        ),
        (
            "GRIP",
            "condition",
            "lift.job:5:6: a number is not a condition (expected a comparison, or a "
            "variable of TYPE bool, got GRIP); write such as GRIP > 0",
        ),
        (
            "(HELD or HELD) + 1 > 1",
            "condition",
            "lift.job:5:7: a yes-or-no value is used where a number is expected "
            "(expected a "
            "number, got HELD or HELD); join comparisons with and, or, not",
        ),
        (
            "RAW > 0",
            "condition",
            "lift.job:5:6: a condition cannot read RAW (expected a variable of "
            "numbers, got TYPE struct[8]); let its writer put the relevant value "
            "into another variable",
        ),
    ],
)
def test_what_the_table_cannot_answer_is_refused_with_its_column(text, code, message):
    condition = Condition(text, Place("lift.job", 5, 6))
    (problem,) = legality.check_conditions([condition], TABLE)
    assert problem.code == code
    assert legality.as_text(problem) == message


@pytest.mark.parametrize(
    ("text", "column", "got"),
    [
        ("the arm stands", 5, "'arm stands'"),
        ("X ** 2 < 3", 1, "'X ** 2'"),
        ("X.real() < 3", 1, "'X.real()'"),
        ("exec(X) < 3", 1, "'exec(X)'"),
        ("__import__('os') == 1", 12, "''os') == 1'"),
        ("(lambda: 1)() == 1", 8, "': 1)() == 1'"),
        ("[1, 2] < X", 1, "'[1, 2]'"),
        ("X if Y else Z", 3, "'if Y else Z'"),
        ("X[Y] < 1", 1, "'X[Y]'"),
        ("X[0.5] < 1", 1, "'X[0.5]'"),
        ("X[0:4:2] < 1", 1, "'X[0:4:2]'"),
        ("max(X)[0] < 1", 1, "'max(X)[0]'"),
        ("norm() < 1", 1, "0 arguments"),
        ("norm(X, Y) < 1", 1, "2 arguments"),
        ("max(*X) < 1", 5, "'*X'"),
        ("1j < X", 2, "'j < X'"),
        ("X < 1e999", 5, "'1e999'"),
        ("X <", 1, "'X <'"),
        ("X < (", 5, "'('"),
        ("X & Y", 1, "'X & Y'"),
        ("X = 1", 3, "'= 1'"),
        ("ö < 1", 1, "the character 'ö'"),
        ("X < 1; Y", 6, "'; Y'"),
        ("-" * 400 + "X < 1", 1, "more than 50 nested parts"),
        ("(" * 240 + "X" + ")" * 240, 201, "'" + "(" * 37 + "...'"),
    ],
)
def test_what_is_no_condition_is_refused_with_its_column(text, column, got):
    with pytest.raises(ConfigError) as caught:
        parse(text, Place("a.job", 7, 6))
    where = caught.value.where
    assert where.startswith("a.job:7:")
    assert (
        int(where.rsplit(":", 1)[1]) - 5,
        caught.value.got.rsplit(" in '", 1)[0],
    ) == (
        column,
        got,
    )


def test_names_of_variables_may_look_like_operators_and_words():
    found = parse("Q^_MEZ < X'.a and in + is > 2 [m/s^2] or min > abs(max)")
    assert found.variables == ["Q^_MEZ", "X'.a", "in", "is", "min", "max"]
    assert list(found.units.values()) == ["m/s^2"]


def test_constants_of_the_job_stand_for_numbers():
    job = parse_job(
        "DEFINE NEAR 0.25\nJOB a\nDESC\nSBS a.sbs\nPRE GRIP <  NEAR # close\n"
        "POST -NEAR < GRIP\nTASK t\nEOF\n"
    )
    assert [one.text for one in (*job.pre, *job.post)] == [
        "GRIP <  0.25",
        "-0.25 < GRIP",
    ]


# -- an oracle: Python itself, on expressions that both understand -------------------

numbers = st.floats(-4, 4).map(lambda x: repr(round(x, 3))) | st.sampled_from([
    "A",
    "B[0]",
    "B[1]",
    "max(B)",
    "min(A, B[1])",
    "norm(B)",
    "abs(A)",
])
sums = st.recursive(
    numbers,
    lambda inner: st.builds("({} {} {})".format, inner, st.sampled_from("+-*"), inner),
    max_leaves=5,
)
questions = st.recursive(
    st.builds(
        "{} {} {}".format, sums, st.sampled_from(["<", "<=", ">", ">=", "=="]), sums
    ),
    lambda inner: (
        st.builds("({} and {})".format, inner, inner)
        | st.builds("({} or {})".format, inner, inner)
        | st.builds("(not {})".format, inner)
    ),
    max_leaves=4,
)
ORACLE = (
    Variable(name="A", type="double"),
    Variable(name="B", type="double", nelem=2),
)


@given(questions, st.floats(-4, 4), st.tuples(st.floats(-4, 4), st.floats(-4, 4)))
def test_python_answers_the_same(text, a, b):
    names = {"A": a, "B": b, "norm": lambda v: float(np.linalg.norm(v))}
    names |= {"abs": abs, "max": max, "min": min}
    expected = bool(eval(text, names))  # noqa: S307 - the oracle
    assert legality.check_conditions([Condition(text)], ORACLE) == []
    found = legality.evaluate(Condition(text), ORACLE, {"A": [a], "B": list(b)})
    assert found.holds is expected


@given(
    st.text(
        st.sampled_from("Q^GRIPHELD[]0123.:()<>=!+-*/ andornot'~,\\\""), max_size=40
    )
)
def test_any_text_is_a_condition_or_an_error_with_a_place(text):
    condition = Condition(text, Place("a.job", 1, 1))
    try:
        problems = legality.check_conditions([condition], TABLE)
    except ConfigError as error:
        where = error.where
    else:
        where = problems[0].where if problems else "a.job:1:1"
        if not problems:
            legality.evaluate(condition, TABLE, VALUES)
    assert where.startswith("a.job:1:")


@pytest.mark.parametrize(
    ("former", "later", "known", "outcome"),
    [
        (["GRIP > 7 [cm]"], ["GRIP < 4 [cm]"], [], "conflict"),
        (["GRIP > 7 [cm]"], ["0.06 >= GRIP"], [], "conflict"),
        (["GRIP <= 4 [cm]"], ["GRIP >= 40 [mm]"], [], "unsaid"),
        (["GRIP < 4 [cm]"], ["GRIP >= 40 [mm]"], [], "conflict"),
        (["GRIP > 7 [cm]"], ["GRIP > 0.05"], [], "follows"),
        (["GRIP > 7 [cm]"], ["GRIP > 0.08"], [], "unsaid"),
        (["GRIP > 7 [cm]"], ["GRIP >= 7 [cm]"], [], "follows"),
        (["GRIP >= 7 [cm]"], ["GRIP > 7 [cm]"], [], "unsaid"),
        (["GRIP > 7 [cm]"], ["GRIP > 7 [m]"], [], "unsaid"),
        (["HELD"], ["not HELD"], [], "conflict"),
        (["HELD and N > 2"], ["HELD"], [], "follows"),
        (["not HELD"], ["HELD and N > 1"], [], "conflict"),
        (["N == 3"], ["1 < N < 5"], [], "follows"),
        (["N == 3"], ["3 < N < 5"], [], "conflict"),
        (["N != 3"], ["N == 3"], [], "unsaid"),
        (["norm(OLD) < 5 [mm]"], ["norm( OLD ) < 6 [mm]"], [], "follows"),
        (["norm(OLD) < 5 [mm]"], ["0.01 < norm(OLD)"], [], "conflict"),
        (["Q[0] > 1"], ["Q[1] > 1"], [], "unsaid"),
        (["HELD or N > 2"], ["HELD  or N>2"], [], "follows"),
        (["HELD or N > 2"], ["HELD"], [], "unsaid"),
        ([], ["GRIP > 7 [cm]"], ["GRIP > 8 [cm]"], "follows"),
        ([], ["GRIP > 7 [cm]"], ["GRIP < 6 [cm]"], "unsaid"),
    ],
)
def test_how_a_pre_fits_the_post_before_it(former, later, known, outcome):
    conditions = [[Condition(one) for one in some] for some in (former, later, known)]
    found = legality.fit(*conditions[:2], TABLE, conditions[2])
    told = "conflict" if found.conflicts else "unsaid" if found.unsaid else "follows"
    assert told == outcome


@given(
    st.sampled_from(["<", "<=", ">", ">=", "=="]),
    st.integers(-3, 3),
    st.sampled_from(["<", "<=", ">", ">=", "=="]),
    st.integers(-3, 3),
)
def test_what_is_said_of_a_pre_is_true_of_every_number(one, first, two, second):
    post, pre = Condition(f"N {one} {first}"), Condition(f"N {two} {second}")
    found = legality.fit([post], [pre], TABLE)
    halves = [n / 2 for n in range(-8, 9)]

    def holds(condition, number):
        return legality.evaluate(condition, TABLE, {"N": [number]}).holds

    left = [n for n in halves if holds(post, n)]
    assert bool(found.conflicts) is not any(holds(pre, n) for n in left)
    if not found.conflicts:
        assert bool(found.unsaid) is not all(holds(pre, n) for n in left)
