"""The join connectors (Stewart 1994, Figure 3.6), each stepped on a bench."""

from __future__ import annotations

import math

import numpy as np
import pytest

from pbonet import State
from pbonet.config import parse_rmod
from pbonet.errors import MethodError, ParameterError
from pbonet.modules.connectors.join_average import JoinAverage
from pbonet.modules.connectors.join_first import JoinFirst
from pbonet.modules.connectors.join_max import JoinMax
from pbonet.modules.connectors.join_min import JoinMin
from pbonet.pbo import decode_params
from pbonet.testing import Bench

RMOD = """MODULE join_average
DESC join
INCONST NDOF
OUTCONST none
INVAR Z1 Z2
OUTVAR Z
TASKTYPE periodic
FREQ 100
LOCAL
WEIGHTS {}
EOF
"""


def test_average_weighs_its_inputs() -> None:
    bench = Bench(JoinAverage, params={"weights": (0.75, 0.25)}, ndof=2)
    bench.on()
    bench.inputs.z1, bench.inputs.z2 = [1.0, 0.0], [0.0, 4.0]
    bench.step()
    assert bench.outputs.z == pytest.approx([0.75, 1.0])
    bench.set("weights", (0.0, 1.0))
    bench.step()
    assert bench.outputs.z == pytest.approx([0.0, 4.0])


@pytest.mark.parametrize("words", ["0.7 0.2", "1 1", "0 0"])
def test_weights_that_do_not_sum_to_one_are_refused_with_their_place(words) -> None:
    rmod = parse_rmod(RMOD.format(words), "lib/mix.rmod")
    a, b = words.split()
    with pytest.raises(ParameterError) as caught:
        decode_params(JoinAverage, rmod.local, where=rmod.file)
    assert str(caught.value) == (
        "lib/mix.rmod:10:1: the values of parameter weights do not sum to 1 (expected "
        f"2 float, >= 0 and sum 1, got {a} + {b} = {float(a) + float(b):g}); "
        "give values that do"
    )


def test_weights_stay_what_they_were_when_new_ones_are_refused() -> None:
    bench = Bench(JoinAverage, params={"weights": (0.1, 0.9)}, ndof=1)
    with pytest.raises(ParameterError, match="do not sum to 1"):
        bench.set("weights", (0.1, 0.8))
    with pytest.raises(ParameterError, match="out of bounds"):
        bench.set("weights", (-1.0, 2.0))
    assert bench.get("weights") == (0.1, 0.9)


def test_weights_may_be_rounded() -> None:
    text = RMOD.format("0.3333333333 0.6666666667")
    params = decode_params(JoinAverage, parse_rmod(text, "m.rmod").local)
    assert sum(params.weights) == pytest.approx(1.0, abs=1e-9)
    with pytest.raises(ParameterError, match="do not sum to 1"):
        decode_params(JoinAverage, parse_rmod(RMOD.format("0.333 0.666"), "m").local)


@pytest.mark.parametrize(
    ("module", "wanted"), [(JoinMin, [-1.0, 2.0]), (JoinMax, [1.0, 5.0])]
)
def test_minimum_and_maximum_are_of_each_element(module, wanted) -> None:
    bench = Bench(module, ndof=2)
    bench.on()
    bench.inputs.z1, bench.inputs.z2 = [1.0, 2.0], [-1.0, 5.0]
    bench.step()
    assert bench.outputs.z.tolist() == wanted


@pytest.fixture
def first():
    bench = Bench(JoinFirst, ndof=2)
    bench.on()
    bench.inputs.z1, bench.inputs.z2 = [1.0, 1.0], [2.0, 2.0]
    return bench


def test_first_takes_the_better_one_while_it_is_valid(first) -> None:
    first.step()
    assert first.outputs.z.tolist() == [1.0, 1.0]
    assert first.notices() == []


@pytest.mark.parametrize("how", ["stale", "nan", "inf"])
def test_first_falls_back_and_comes_back_and_says_so(first, how) -> None:
    if how == "stale":
        first.stale.add("z1")
    else:
        first.inputs.z1[1] = math.nan if how == "nan" else math.inf
    first.step(n=3)
    assert first.outputs.z.tolist() == [2.0, 2.0]
    assert [notice.text for notice in first.notices()] == ["Z2 is taken, not Z1"]
    first.stale.clear()
    first.inputs.z1 = [7.0, 7.0]
    first.step()
    assert first.outputs.z.tolist() == [7.0, 7.0]
    assert [notice.text for notice in first.notices()] == ["Z1 is taken, not Z2"]


def test_first_fails_when_nothing_is_valid(first) -> None:
    first.step()
    first.inputs.z1 = np.full(2, math.nan)
    first.stale.add("z2")
    with pytest.raises(MethodError, match="neither Z1 nor Z2 is finite"):
        first.step()
    assert first.state is State.ERROR
    assert first.outputs.z.tolist() == [1.0, 1.0], "its output stands"


def test_a_port_that_is_no_in_var_has_no_age(first) -> None:
    with pytest.raises(MethodError, match=r"no in-var z3 \(expected z1 or z2\)"):
        first.task.stale("z3")
