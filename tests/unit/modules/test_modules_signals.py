"""The generic modules, each stepped on a bench."""

from __future__ import annotations

import math

import numpy as np
import pytest

from pbonet import State
from pbonet.errors import MethodError
from pbonet.modules.controllers.joint_pid import JointPID
from pbonet.modules.signals.diff import Diff
from pbonet.modules.signals.gain import Gain
from pbonet.modules.teleoperation.constant import Constant
from pbonet.modules.trajectories.sine import Sine
from pbonet.testing import Bench

# ------------------------------------------------------------------------------- diff


def test_diff_of_a_ramp_is_its_slope() -> None:
    bench = Bench(Diff, ndof=2, z=[1.0, 2.0], freq=100)
    bench.on()
    for k in range(1, 5):
        bench.inputs.z = [1.0 + 0.01 * k, 2.0 - 0.03 * k]
        bench.step()
        assert bench.outputs.z_dot == pytest.approx([1.0, -3.0])


def test_diff_does_not_see_the_step_from_zero_when_it_is_turned_on() -> None:
    bench = Bench(Diff, ndof=1, z=[100.0], freq=100)
    bench.on()
    bench.step()
    assert bench.outputs.z_dot == pytest.approx([0.0])


def test_diff_uses_the_time_that_passed_when_a_cycle_was_missed() -> None:
    bench = Bench(Diff, ndof=1, z=[0.0], freq=100)
    bench.on()
    bench.inputs.z = [0.06]
    bench.step(0.03)
    assert bench.outputs.z_dot == pytest.approx([2.0])


def test_diff_goes_on_from_what_the_former_writer_said() -> None:
    bench = Bench(Diff, params={"tau": 0.5}, ndof=1, z=[3.0], z_dot=[0.7], freq=100)
    bench.on()
    assert bench.outputs.z_dot == pytest.approx([0.7])
    bench.inputs.z = [3.007]
    bench.step()
    assert bench.outputs.z_dot == pytest.approx([0.7])


def staircase(tau: float) -> list[float]:
    """Differentiate a ramp of slope 1 that is written every other cycle."""
    bench = Bench(Diff, params={"tau": tau}, ndof=1, z=[0.0], freq=100)
    bench.on()
    seen = []
    for k in range(1, 101):
        bench.inputs.z = [0.02 * (k // 2)]
        bench.step()
        seen.append(float(bench.outputs.z_dot[0]))
    return seen[-20:]


def test_diff_makes_a_slope_of_a_staircase() -> None:
    plain = staircase(0.0)
    assert sorted({round(value, 9) for value in plain}) == [0.0, 2.0]
    smooth = staircase(0.02)
    assert np.mean(smooth) == pytest.approx(1.0, abs=0.01)
    assert np.ptp(smooth) < 0.15


def test_diff_smooths_as_two_lags_do() -> None:
    """Against the differential equation, integrated finely."""
    tau, dt = 0.1, 0.01
    bench = Bench(Diff, params={"tau": tau}, ndof=1, z=[0.0], freq=100)
    bench.on()
    for k in range(1, 51):
        bench.inputs.z = [dt * k]
        bench.step()
    time = 50 * dt
    exact = 1.0 - (1.0 + time / tau) * math.exp(-time / tau)
    assert bench.outputs.z_dot == pytest.approx([exact], abs=0.02)


# ------------------------------------------------------------------------------- gain


def test_gain_is_a_straight_line_per_element() -> None:
    bench = Bench(Gain, params={"gain": (2.0, -1.0), "bias": (0.5,)}, ndof=2)
    bench.on()
    bench.inputs.z = [3.0, 4.0]
    bench.step()
    assert bench.outputs.y == pytest.approx([6.5, -3.5])


def test_gain_changes_between_two_cycles() -> None:
    bench = Bench(Gain, params={"gain": (2.0,)}, ndof=2, z=[1.0, 1.0])
    bench.on()
    bench.set("gain", (5.0, 7.0))
    bench.step()
    assert bench.outputs.y == pytest.approx([5.0, 7.0])
    with pytest.raises(MethodError, match="expected 2 values, or one for all"):
        bench.set("gain", (1.0, 2.0, 3.0))
    bench.step()
    assert bench.outputs.y == pytest.approx([5.0, 7.0]), (
        "a refused value changes nothing"
    )
    assert bench.get("gain") == (5.0, 7.0)


def test_wrong_number_of_values_stops_the_task_from_being_created() -> None:
    with pytest.raises(
        MethodError, match="parameter gain has the wrong number of values"
    ):
        Bench(Gain, params={"gain": (1.0, 2.0, 3.0)}, ndof=2)


# --------------------------------------------------------------------------- constant


def test_constant_jumps_without_slew() -> None:
    bench = Bench(Constant, params={"value": (1.0,)}, ndof=2)
    bench.on()
    bench.step()
    assert bench.outputs.y == pytest.approx([1.0, 1.0])


def test_constant_moves_by_at_most_its_slew_from_where_it_was() -> None:
    bench = Bench(
        Constant, params={"value": (1.0, -1.0), "slew": 2.0}, ndof=2, y=[0.9, 0.0]
    )
    bench.on()
    assert bench.outputs.y == pytest.approx([0.9, 0.0]), "on changes nothing"
    bench.step(0.1)
    assert bench.outputs.y == pytest.approx([1.0, -0.2])
    bench.step(0.1, n=10)
    assert bench.outputs.y == pytest.approx([1.0, -1.0])
    bench.set("value", 0.0)
    bench.step(0.1)
    assert bench.outputs.y == pytest.approx([0.8, -0.8])


# ------------------------------------------------------------------------------- sine


def test_sine_swings_about_where_the_output_stood() -> None:
    bench = Bench(
        Sine,
        params={"amplitude": (0.5, 1.0), "freq": (1.0, 0.5), "fade": 0.5},
        ndof=2,
        y=[10.0, -3.0],
        freq=1000,
    )
    bench.on()
    assert bench.outputs.y == pytest.approx([10.0, -3.0])
    bench.step(n=1250)
    assert bench.outputs.y == pytest.approx([10.5, -3.0 + math.sin(1.25 * math.pi)])
    assert bench.outputs.y_dot == pytest.approx(
        [0.0, math.pi * math.cos(1.25 * math.pi)], abs=1e-9
    )


def test_sine_begins_without_a_jump_and_its_derivative_is_one() -> None:
    bench = Bench(
        Sine,
        params={"amplitude": (0.3,), "freq": (0.7,), "phase": (1.1,), "fade": 2.0},
        ndof=1,
        y=[0.2],
        freq=1000,
    )
    bench.on()
    before, rates, slopes = 0.2, [], []
    for _ in range(3000):
        rates.append(float(bench.outputs.y_dot[0]))
        bench.step()
        slopes.append((float(bench.outputs.y[0]) - before) / 1e-3)
        before = float(bench.outputs.y[0])
    assert abs(slopes[0]) < 1e-3
    middle = (np.array(rates[:-1]) + np.array(rates[1:])) / 2
    assert np.array(slopes[1:-1]) == pytest.approx(middle[1:], abs=1e-5)


# -------------------------------------------------------------------------- joint_pid


def pid(**gains: float) -> Bench[JointPID]:
    params = {"kp": 10.0, "limit": 5.0} | gains
    bench = Bench(JointPID, params=params, ndof=2, freq=500)
    bench.on()
    return bench


def test_pid_is_proportional() -> None:
    bench = pid()
    bench.inputs.q_ref = [0.1, -0.2]
    bench.step()
    assert bench.outputs.tau == pytest.approx([1.0, -2.0])


def test_pid_damps() -> None:
    bench = pid(kd=2.0)
    bench.inputs.qd = [1.0, -0.5]
    bench.step()
    assert bench.outputs.tau == pytest.approx([-2.0, 1.0])


def test_pid_keeps_its_limit_and_winds_up_no_further() -> None:
    bench = pid(ki=100.0)
    bench.inputs.q_ref = [10.0, -10.0]
    bench.step(n=1000)
    assert bench.outputs.tau == pytest.approx([5.0, -5.0])
    bench.inputs.q_ref = [-0.1, 0.1]
    bench.step()
    # what the integral holds is bounded by the limit: 5 minus the first step back
    assert bench.outputs.tau == pytest.approx([5.0 - 0.02 - 1.0, -5.0 + 0.02 + 1.0])


def test_pid_with_an_integral_begins_at_the_torque_that_the_table_holds() -> None:
    bench = pid(kp=10.0, ki=100.0)
    bench.inputs.q_ref = [0.1, 0.1]
    bench.step(n=100)
    before = bench.outputs.tau.copy()
    assert np.all(before > 0.0)
    bench.off()
    bench.inputs.q_ref = [0.0, -0.1]
    bench.on(handover=True)
    assert bench.outputs.tau == pytest.approx(before)
    bench.step()
    step = np.array([0.0, -0.1 * 100.0 * 0.002])
    assert bench.outputs.tau == pytest.approx(before + step)


def test_pid_without_an_integral_holds_on_to_nothing() -> None:
    bench = pid(kp=10.0)
    bench.inputs.q_ref = [0.1, 0.1]
    bench.step()
    bench.off()
    bench.inputs.q_ref = [0.0, 0.0]
    bench.on()
    bench.step()
    assert bench.outputs.tau == pytest.approx([0.0, 0.0])


def test_pid_brings_a_mass_to_its_place() -> None:
    bench = pid(kp=40.0, kd=9.0, ki=20.0, limit=50.0)
    q, qd = np.zeros(2), np.zeros(2)
    bench.inputs.q_ref = [1.0, -2.0]
    for _ in range(5000):
        bench.inputs.q, bench.inputs.qd = q, qd
        bench.step()
        qd += (bench.outputs.tau - 0.5) * 0.002  # a load pulls at both
        q += qd * 0.002
    assert q == pytest.approx([1.0, -2.0], abs=5e-3)


def test_a_bad_input_never_reaches_the_table() -> None:
    bench = pid()
    bench.inputs.q_ref = [0.1, 0.1]
    bench.step()
    before = bench.outputs.tau.copy()
    bench.inputs.q = [math.nan, 0.0]
    assert bench.step(check=False) is State.ERROR
    assert bench.outputs.tau == pytest.approx(before)
