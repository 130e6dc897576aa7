"""LOCAL lines: whatever they say, there is a value within its bounds or one error."""

import math
from typing import Annotated as A, Literal

from hypothesis import given, strategies as st

from pbonet import Params, param
from pbonet.config.model import LocalLine, Place
from pbonet.errors import ParameterError
from pbonet.pbo import change_param, decode_params, local_text


class All(Params):
    f: A[float, param("none", "a float", ge=-5, lt=1e6)] = 0.0
    i: A[int, param("none", "an int", gt=-3, le=300)] = 0
    b: A[bool, param("none", "a bool")] = False
    s: A[str, param("none", "a word")] = "x"
    m: A[Literal["linear", "cubic"], param("none", "a choice")] = "linear"
    v: A[tuple[float, ...], param("m", "some")] = (0.0,)
    t: A[tuple[int, int, int], param("m", "three", ge=0)] = (0, 0, 0)


WORDS = st.one_of(
    st.sampled_from([
        "1",
        "-2",
        "0x1F",
        "1e3",
        ".5",
        "5.",
        "yes",
        "OFF",
        "cubic",
        "nan",
        "9" * 5000,
        "\u0663",
    ]),
    st.integers().map(str),
    st.floats().map(str),
    st.text(st.characters(blacklist_categories=["Z", "C"]), min_size=1, max_size=5),
)
LINES = st.dictionaries(
    st.one_of(st.sampled_from("fibsmvtFIBSMVT"), st.text(max_size=3)),
    st.lists(WORDS, max_size=4).map(
        lambda words: LocalLine(tuple(words), Place("x.rmod", 7, 3))
    ),
    max_size=4,
)


@given(LINES)
def test_any_lines_give_good_values_or_one_error_with_its_place(lines):
    place = ""
    try:
        found = decode_params(All, lines)
    except ParameterError as error:
        place = error.where
    if place:
        assert place == "x.rmod:7:3"
        return
    assert -5 <= found.f < 1e6
    assert -3 < found.i <= 300
    assert all(math.isfinite(value) for value in found.v)
    assert len(found.t) == 3
    assert min(found.t) >= 0
    assert found.m in {"linear", "cubic"}
    assert [type(value) for value in (found.f, found.i, found.b)] == [float, int, bool]


FLOATS = st.floats(-1e9, 1e9)
WHOLE = st.builds(
    All,
    f=st.floats(-5, 1e6, exclude_max=True),
    i=st.integers(-2, 300),
    b=st.booleans(),
    s=st.text("abc/_-.0", min_size=1),
    m=st.sampled_from(["linear", "cubic"]),
    v=st.lists(FLOATS, min_size=1, max_size=5).map(tuple),
    t=st.tuples(*[st.integers(0)] * 3),
)


@given(WHOLE)
def test_what_is_written_is_read_back_as_the_same(params):
    lines = {
        name: LocalLine(tuple(local_text(getattr(params, name)).split()))
        for name in All.__declared__
    }
    assert decode_params(All, lines) == params


@given(WHOLE, WHOLE, st.sampled_from("fibsmvt"))
def test_one_change_changes_one_value(params, other, name):
    words = tuple(local_text(getattr(other, name)).split())
    changed = change_param(params, name, words)
    for each in All.__declared__:
        source = other if each == name else params
        assert getattr(changed, each) == getattr(source, each)
