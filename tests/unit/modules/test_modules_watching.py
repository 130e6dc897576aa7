"""`select_by`, `watchdog` and `deadman`, each stepped on a bench."""

from __future__ import annotations

import math

import numpy as np
import pytest

from pbonet import State
from pbonet.errors import MethodError
from pbonet.modules.connectors.select_by import SelectBy
from pbonet.modules.connectors.watchdog import Watchdog
from pbonet.modules.teleoperation.deadman import Deadman
from pbonet.testing import Bench


def said(bench: Bench) -> list[str]:
    return [notice.text for notice in bench.notices()]


# -------------------------------------------------------------------------- select_by


def select_by(n: int = 2, z=None, **params) -> Bench[SelectBy]:
    values = {"z1": np.full(n, 1.0), "z2": np.full(n, 2.0)}
    table = {} if z is None else {"z": np.full(n, z)}
    bench = Bench(SelectBy, params=params, ndof=n, freq=100, **values, **table)
    bench.on()
    return bench


@pytest.mark.parametrize("n", [1, 2, 7, 30])
def test_select_by_takes_what_the_number_says(n: int) -> None:
    bench = select_by(n, choice=3)
    for number, value in ((0, 1.0), (3, 2.0), (1, 1.0), (-7, 1.0), (3, 2.0)):
        bench.inputs.select = number
        bench.step()
        assert bench.outputs.z.tolist() == [value] * n


@pytest.mark.parametrize("n", [1, 30])
def test_select_by_blends_after_a_change_and_from_what_it_takes_over(n: int) -> None:
    bench = select_by(n, z=5.0, blend=0.5)
    assert bench.outputs.z.tolist() == [5.0] * n, "bumpless"
    for k in range(1, 101):
        bench.inputs.z1 = np.full(n, 1.0 + 0.1 * k)
        bench.step()
        x = min(0.02 * k, 1.0)
        away = (1.0 - 3.0 * x**2 + 2.0 * x**3) * (5.0 - 1.1)
        assert np.abs(bench.outputs.z - (1.0 + 0.1 * k + away)).max() < 1e-9
    before, bench.inputs.select = bench.outputs.z[0], 1
    seen = []
    for _ in range(60):
        bench.step()
        seen.append(bench.outputs.z[0])
    assert abs(seen[0] - before) < 0.02 * abs(before - 2.0)
    assert np.abs(np.diff(seen)).max() < 0.031 * abs(before - 2.0)
    assert seen[-1] == 2.0


def test_select_by_has_the_age_of_the_selected_input() -> None:
    bench = select_by()
    bench.ages.update(z1=0.3, z2=0.7)
    bench.step()
    assert bench.output_age == pytest.approx(0.3)
    bench.inputs.select = 1
    bench.step()
    assert bench.output_age == pytest.approx(0.7)


@pytest.mark.parametrize("blend", [0.0, 0.5])
def test_select_by_does_not_see_the_other_input(blend: float) -> None:
    bench = select_by(blend=blend)
    bench.inputs.z2 = [math.nan, 0.0]
    bench.step(n=60)
    assert bench.outputs.z.tolist() == [1.0, 1.0]
    bench.inputs.select = 1
    with pytest.raises(MethodError, match=r"not a finite number: Z\[0\]"):
        bench.step()
    bench.clear()
    bench.inputs.z2 = [2.0, 2.0]
    bench.on()
    bench.step(n=60)
    assert bench.outputs.z.tolist() == [2.0, 2.0]


# --------------------------------------------------------------------------- watchdog


def watchdog(n: int = 2, **params) -> Bench[Watchdog]:
    given = {"safe": (-9.0,), "lower": (-1.0,), "upper": (1.0,), **params}
    bench = Bench(Watchdog, params=given, ndof=n, freq=100, z=np.full(n, 0.5))
    bench.on()
    return bench


FAULTS = {
    1: "Z is 0.3 s old, which is too old",
    2: "Z[1] is not finite",
    3: "Z[1] is 1.5, not within -1 to 1",
}


def spoil(bench: Bench[Watchdog], fault: int) -> None:
    bench.ages["z"] = 0.3 if fault == 1 else 0.0
    bench.inputs.z = [0.5, {2: math.nan, 3: 1.5}.get(fault, 0.5)]


@pytest.mark.parametrize("fault", FAULTS)
def test_watchdog_gives_the_safe_value_and_says_why(fault: int) -> None:
    bench = watchdog(maxage=0.2)
    for again in (False, True):
        bench.step(n=3)
        assert bench.outputs.flag == 0
        assert bench.outputs.y.tolist() == [0.5, 0.5]
        spoil(bench, fault)
        bench.step(n=3)
        assert bench.outputs.flag == fault
        assert bench.outputs.y.tolist() == [-9.0, -9.0]
        assert bench.output_age == 0.0, "the safe value is new"
        assert said(bench) == [FAULTS[fault]], again
        spoil(bench, 0)


@pytest.mark.parametrize("n", [1, 7, 30])
def test_watchdog_has_limits_for_each_element(n: int) -> None:
    upper = np.linspace(0.6, 1.0, n)
    bench = watchdog(n, upper=upper, safe=np.arange(float(n)))
    bench.inputs.z = upper
    bench.step()
    assert bench.outputs.flag == 0
    assert np.array_equal(bench.outputs.y, upper)
    bench.inputs.z = upper + 1e-9 * (np.arange(n) == n - 1)
    bench.step()
    assert bench.outputs.flag == 3
    assert np.array_equal(bench.outputs.y, np.arange(n))


def test_watchdog_obeys_the_limit_of_the_variable_too() -> None:
    bench = watchdog()
    bench.stale.add("z")
    bench.step()
    assert bench.outputs.flag == 1


def test_watchdog_passes_on_the_age_of_a_right_value() -> None:
    bench = watchdog(maxage=0.2)
    bench.ages["z"] = 0.1
    bench.step()
    assert bench.output_age == pytest.approx(0.1)


def test_watchdog_waits_until_the_value_has_been_right_for_long_enough() -> None:
    bench = watchdog(settle=0.05)
    spoil(bench, 3)
    bench.step()
    spoil(bench, 0)
    bench.step(n=3)
    spoil(bench, 2)
    bench.step()
    spoil(bench, 0)
    bench.step(n=4)
    assert (bench.outputs.flag, bench.outputs.y[0]) == (2, -9.0)
    bench.step(n=2)
    assert (bench.outputs.flag, bench.outputs.y[0]) == (0, 0.5)
    assert said(bench) == [FAULTS[3], FAULTS[2]]


def test_watchdog_raises_the_illegal_flag_as_long_as_the_fault_lasts() -> None:
    bench = watchdog(action="illegal")
    spoil(bench, 3)
    bench.step(n=2)
    assert bench.illegal
    bench.set("action", "flag")
    spoil(bench, 0)
    bench.step()
    assert not bench.illegal


def test_watchdog_may_end_in_error_and_keeps_its_value() -> None:
    bench = watchdog(action="error")
    bench.step()
    spoil(bench, 3)
    with pytest.raises(MethodError, match=r"Z\[1\] is 1\.5, not within -1 to 1"):
        bench.step()
    assert bench.state is State.ERROR
    assert bench.outputs.y.tolist() == [0.5, 0.5]
    spoil(bench, 0)
    bench.clear()
    bench.on()
    assert bench.step() is State.ON


def test_watchdog_refuses_limits_without_room() -> None:
    with pytest.raises(MethodError, match="no value of Z is right"):
        watchdog(lower=(2.0,))


# ---------------------------------------------------------------------------- deadman


def deadman(n: int = 2, **params) -> Bench[Deadman]:
    start = {"z": np.full(n, 4.0), "y": np.full(n, 7.0)}
    bench = Bench(Deadman, params={"button": 2, **params}, ndof=n, freq=50, **start)
    bench.on()
    return bench


def press(bench: Bench[Deadman], mask: int) -> float:
    bench.inputs.buttons = mask
    bench.step()
    return bench.outputs.y[0]


@pytest.mark.parametrize("n", [1, 7, 30])
def test_deadman_passes_a_command_on_while_the_button_is_held(n: int) -> None:
    bench = deadman(n, released=np.full(n, -1.0))
    assert bench.outputs.y.tolist() == [7.0] * n
    seen = [press(bench, mask) for mask in (0, 1, 2, 3, 2, 1, 0, 6)]
    assert seen == [-1, -1, 4, 4, 4, -1, -1, 4]
    assert bench.outputs.y.tolist() == [4.0] * n


def test_deadman_may_keep_the_last_command() -> None:
    bench = deadman(release="hold")
    assert press(bench, 0) == 7.0, "bumpless"
    assert press(bench, 2) == 4.0
    bench.inputs.z = [9.0, 9.0]
    assert press(bench, 0) == 4.0
    bench.off()
    assert bench.outputs.y.tolist() == [4.0, 4.0]


def test_deadman_wants_the_button_let_go_first() -> None:
    bench = deadman()
    assert [press(bench, mask) for mask in (2, 2, 0, 2)] == [0, 0, 0, 4]


@pytest.mark.parametrize("how", ["age", "stale", "nan"])
def test_deadman_releases_when_the_button_or_the_command_fails(how: str) -> None:
    bench = deadman()
    press(bench, 0)
    assert press(bench, 2) == 4.0
    if how == "age":
        bench.ages["buttons"] = 0.3
    elif how == "stale":
        bench.stale.add("buttons")
    else:
        bench.inputs.z = [4.0, math.nan]
    assert press(bench, 2) == 0.0
    bench.step(n=3)
    why = "Z[1] is not finite" if how == "nan" else "BUTTONS is"
    (text,) = said(bench)
    assert text.startswith(f"the button counts as released: {why}")
    bench.ages.clear()
    bench.stale.clear()
    bench.inputs.z = [4.0, 4.0]
    assert [press(bench, mask) for mask in (2, 2, 0, 2)] == [0, 0, 0, 4]


def test_deadman_is_new_without_the_button_and_as_old_as_the_command_with_it() -> None:
    bench = deadman()
    bench.ages["z"] = 0.1
    press(bench, 0)
    assert bench.output_age == 0.0
    press(bench, 2)
    assert bench.output_age == pytest.approx(0.1)


def test_deadman_releases_when_it_is_turned_off_but_not_for_a_successor() -> None:
    for handover, value in ((False, 0.0), (True, 4.0)):
        bench = deadman()
        press(bench, 0)
        press(bench, 2)
        bench.off(handover=handover)
        assert bench.outputs.y.tolist() == [value, value]
