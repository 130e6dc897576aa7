"""The fit of an error over periods, and the periods with its least within a load."""

from itertools import product

import pytest

from pbonet.analysis.allocation import (
    Fit,
    best_periods,
    fitted,
    harmonic,
    in_step_rates,
    rounded_down,
)

pytest.importorskip("scipy")


def test_a_fit_finds_what_the_errors_were_made_of():
    periods = [{"a": a, "b": b} for a in (1.0, 2.0, 4.0) for b in (1.0, 3.0)]
    errors = [0.5 + 2.0 * one["a"] + 0.25 * one["b"] for one in periods]
    fit = fitted(periods, errors)
    assert fit.constant == pytest.approx(0.5)
    assert fit.slopes == pytest.approx({"a": 2.0, "b": 0.25})
    assert fit.quality == pytest.approx(1.0)
    assert fit.error({"a": 2.0, "b": 2.0}) == pytest.approx(5.0)
    falling = fitted(periods, [10.0 - one["a"] for one in periods])
    assert falling.slopes["a"] == 0.0, "a longer period makes no error smaller"
    assert fitted(periods, [1.0] * 6).quality == 1.0


@pytest.mark.parametrize("load", [0.2, 0.5, 0.9, 2.0])
def test_no_periods_of_a_grid_are_better(load):
    fit = Fit(constant=1.0, slopes={"a": 9.0, "b": 1.0, "c": 0.0}, quality=1.0)
    costs = {"a": 0.002, "b": 0.008, "c": 0.001}
    present = {"a": 0.05, "b": 0.05, "c": 0.1}
    found = best_periods(fit, costs, present, load, 4.0)
    assert sum(costs[n] / t for n, t in found.items()) <= load * (1 + 1e-9)
    assert found["c"] == present["c"]
    steps = [4.0 ** (k / 20) for k in range(-20, 21)]
    grid = ({"a": 0.05 * x, "b": 0.05 * y, "c": 0.1} for x, y in product(steps, steps))
    fits = [one for one in grid if sum(costs[n] / t for n, t in one.items()) <= load]
    assert fit.error(found) <= min(map(fit.error, fits)) + 1e-9


def test_tasks_without_influence_give_way_when_there_is_no_room():
    fit = Fit(constant=0.0, slopes={"a": 1.0, "c": 0.0}, quality=1.0)
    costs, present = {"a": 0.01, "c": 0.01}, {"a": 0.02, "c": 0.02}
    found = best_periods(fit, costs, present, 0.6, 2.0)
    assert found["c"] == pytest.approx(0.04)
    assert sum(costs[n] / t for n, t in found.items()) <= 0.6 * (1 + 1e-9)


def test_harmonic_periods_are_powers_of_two_of_the_shortest():
    assert harmonic({"a": 0.01, "b": 0.019, "c": 0.05}) == pytest.approx({
        "a": 0.01,
        "b": 0.02,
        "c": 0.04,
    })
    assert harmonic({}) == {}


@pytest.mark.parametrize(
    ("hz", "shown"), [(178.6, 178.0), (20.0, 20.0), (0.12345, 0.123), (0.0, 0.0)]
)
def test_rates_are_rounded_down(hz, shown):
    assert rounded_down(hz) == shown


@pytest.mark.parametrize("fastest", [178.6, 28.57, 999.9, 33.4, 7.0])
@pytest.mark.parametrize("times", [(1, 2), (1, 2, 4, 16)])
def test_rates_in_step_have_periods_that_are_multiples(fastest, times):
    rates = in_step_rates({str(n): n / fastest for n in times})
    periods = {int(name): round(1e9 / hz) for name, hz in rates.items()}
    assert all(period == n * periods[1] for n, period in periods.items())
    assert 0.8 * fastest < rates["1"] <= fastest
