"""The PUMA's modules on a bench: robot interface, gravity compensation, ball."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest
from newton_euler import newton_euler

import pbonet.modules
from pbonet import Params, State
from pbonet.config import read_rmod, read_svar
from pbonet.config.library import Library
from pbonet.errors import MethodError
from pbonet.io import SimulatedArm
from pbonet.io.puma560 import PUMA560
from pbonet.modules._values import within
from pbonet.modules.controllers.grav_comp import GravComp
from pbonet.modules.robot_interfaces.puma_pidg import PumaPidg
from pbonet.modules.teleoperation.jtball import JtBall
from pbonet.pbo import decode_params
from pbonet.testing import Bench

LIBRARY = Path(pbonet.modules.__file__).parent
START = np.array([0.0, np.pi / 4, -np.pi, 0.0, np.pi / 4, 0.0])


def configured(name: str) -> Params:
    """Return the parameters that an RMOD of the library gives its module."""
    rmod = read_rmod(Library().find_rmod(name))
    return decode_params(Library().load(rmod.module).cls, rmod.local)


# -------------------------------------------------------------------------- grav_comp


def grav_comp(**params: object) -> Bench[GravComp]:
    given = configured("grav_comp")
    for name, value in params.items():
        given = type(given)(**{
            **{f: getattr(given, f) for f in given.__struct_fields__},
            name: value,
        })
    return Bench(GravComp, params=given, ndof=6, dh=PUMA560.dh, freq=250)


def test_masses_in_the_rmod_are_the_published_ones() -> None:
    links = configured("grav_comp")
    assert links.mass == tuple(PUMA560.mass)  # type: ignore[attr-defined]
    assert links.com == tuple(PUMA560.com.ravel())  # type: ignore[attr-defined]


@pytest.mark.slow
def test_gravity_compensation_agrees_with_a_newton_euler_written_by_hand() -> None:
    bench = grav_comp()
    bench.on()
    rng = np.random.default_rng(6)
    zero = np.zeros(6)
    for _ in range(1000):
        q = rng.uniform(PUMA560.lower, PUMA560.upper)
        bench.inputs.q = q
        bench.step()
        expected = newton_euler(PUMA560, q, zero, zero)
        assert np.abs(bench.outputs.t_grav - expected).max() < 1e-9


def test_gravity_is_there_as_soon_as_it_is_on() -> None:
    bench = grav_comp()
    bench.inputs.q = START
    bench.on()
    assert bench.outputs.t_grav == pytest.approx(
        [0, 31.6399, 6.0351, 0, 0.0283, 0], abs=5e-5
    )


def test_payload_weighs_at_the_last_frame() -> None:
    """Stretched out level, each kilogram adds its weight times its lever."""
    bench, loaded = grav_comp(), grav_comp(payload=2.0)
    stretched = [0.0, 0.0, -np.pi / 2, 0.0, 0.0, 0.0]
    for one in (bench, loaded):
        one.inputs.q = stretched
        one.on()
    extra = loaded.outputs.t_grav - bench.outputs.t_grav
    assert extra[1] == pytest.approx(2.0 * 9.81 * (0.4318 + 0.4318))
    bench.set("payload", 2.0)
    bench.step()
    assert bench.outputs.t_grav == pytest.approx(loaded.outputs.t_grav)


def test_another_arm_only_needs_other_constants() -> None:
    """A pendulum of two links, its table and masses given like any arm's."""
    bench = Bench(
        GravComp,
        params={"mass": (2.0, 1.0), "com": (-0.5, 0, 0, -0.25, 0, 0)},
        ndof=2,
        dh=[[0.0, 0.0, 1.0, np.pi / 2], [0.0, 0.0, 0.5, 0.0]],
    )
    bench.inputs.q = [0.3, 0.4]
    bench.on()
    # the first axis is vertical, the second level: only the second link is lifted
    assert bench.outputs.t_grav == pytest.approx([0.0, 9.81 * 0.25 * np.cos(0.4)])
    longer = np.array([[0.0, 0.0, 1.0, np.pi / 2], [0.0, 0.0, 0.8, 0.0]])
    bench.reinit(dh=longer)
    bench.step()
    assert bench.outputs.t_grav[1] == pytest.approx(9.81 * 0.55 * np.cos(0.4))


def test_ranges_in_the_example_s_table_are_the_arm_s() -> None:
    file = LIBRARY.parents[1] / "examples" / "puma" / "puma.svar"
    table = {variable.name: variable for variable in read_svar(file).variables}
    for name, low, high in (
        ("Q_REF", PUMA560.lower, PUMA560.upper),
        ("Q_MEZ", PUMA560.lower, PUMA560.upper),
        ("T_GRAV", -PUMA560.torque, PUMA560.torque),
    ):
        assert table[name].min == pytest.approx(tuple(low), abs=1e-6)
        assert table[name].max == pytest.approx(tuple(high), abs=1e-6)
    speed = configured("puma_pidg").speed  # type: ignore[attr-defined]
    assert table["Q^_REF"].max == speed
    steering = configured("jttrace")
    assert all(steering.lower > PUMA560.lower)  # type: ignore[attr-defined]
    assert all(steering.upper < PUMA560.upper)  # type: ignore[attr-defined]
    assert configured("jtball").lower == steering.lower  # type: ignore[attr-defined]
    assert configured("jtball").upper == steering.upper  # type: ignore[attr-defined]


# -------------------------------------------------------------------------- puma_pidg


ODD = [np.nan, -np.nan, np.inf, -np.inf, 0.0, -0.0, 5e-324, -5e-324, 1.5, -1.5, 1e308]


def test_limits_are_those_of_clip_to_the_bit() -> None:
    rng = np.random.default_rng(20)
    for _ in range(2000):
        high = np.abs(rng.choice(ODD, 6))
        values = rng.choice([rng.choice(ODD, 6), 2 * rng.normal(size=6)])
        expected, out = values.clip(-high, high), np.empty(6)
        within(values, -high, high, out)
        within(values, -high, high, values)  # in place, as the servo's integral
        assert out.tobytes() == values.tobytes() == expected.tobytes()


def test_an_arm_s_torques_are_limited_to_the_bit() -> None:
    most, rng = PUMA560.torque, np.random.default_rng(20)
    arm = SimulatedArm(PUMA560)
    for _ in range(500):
        torque = rng.choice([*ODD, *most, *-most], 6)
        arm.command(torque)
        assert arm._torque.tobytes() == torque.clip(-most, most).tobytes()


class Arm:
    """The robot interface with gravity compensation beside it, as in Figure 6.10."""

    def __init__(self, **changes: Any) -> None:
        self.bench = Bench(
            PumaPidg,
            params=configured("puma_pidg"),
            q=START,
            q_ref=START,
            freq=500,
            critical=True,
        )
        for name, value in changes.items():
            self.bench.set(name, value)
        self.gravity = grav_comp()
        self.gravity.inputs.q = START
        self.gravity.on()
        self.bench.inputs.t_grav = self.gravity.outputs.t_grav
        self.bench.on()

    @property
    def q(self) -> np.ndarray:
        return self.bench.outputs.q.copy()

    @property
    def qd(self) -> np.ndarray:
        return self.bench.outputs.qd.copy()

    def run(self, seconds: float, *, dt: float = 0.002) -> np.ndarray:
        """Go on; return the joint angles of every cycle."""
        seen = []
        for k in range(round(seconds / dt)):
            self.bench.step(dt)
            if k % 2 == 0:
                self.gravity.inputs.q = self.bench.outputs.q
                self.gravity.step()
                self.bench.inputs.t_grav = self.gravity.outputs.t_grav
            seen.append(self.q)
        return np.array(seen)


@pytest.fixture
def arm() -> Arm:
    return Arm()


def test_it_tells_others_what_arm_it_is(arm: Arm) -> None:
    assert arm.bench.outputs.ndof == 6
    assert np.array_equal(arm.bench.outputs.dh, PUMA560.dh)


def test_it_holds_the_arm_where_it_stands(arm: Arm) -> None:
    seen = arm.run(0.5)
    assert np.abs(seen - START).max() < 1e-9


def test_it_follows_a_step_smoothly_and_arrives(arm: Arm) -> None:
    goal = START + np.array([0.2, -0.1, 0.2, -0.3, 0.2, 0.3])
    arm.bench.inputs.q_ref = goal
    seen = arm.run(4.0)
    assert seen[-1] == pytest.approx(goal, abs=3e-3)
    overshoot = np.abs(seen - START).max(axis=0) - np.abs(goal - START)
    assert np.all(overshoot < 0.01)


def test_a_far_reference_makes_no_jump(arm: Arm) -> None:
    arm.bench.inputs.q_ref = START + 2.0
    seen = arm.run(0.6)
    speed = np.abs(np.diff(seen, axis=0)).max(axis=0) / 0.002
    allowed = np.array(configured("puma_pidg").speed)  # type: ignore[attr-defined]
    assert np.all(speed < 1.25 * allowed)


def test_it_never_asks_beyond_the_joint_limits(arm: Arm) -> None:
    arm.bench.inputs.q_ref = np.full(6, 100.0)
    seen = arm.run(4.0)
    assert np.all(seen <= PUMA560.upper)
    reference = arm.bench.module._r
    assert np.array_equal(reference, PUMA560.upper)
    assert np.array_equal(arm.bench.module._v, np.zeros(6)), "nor for a velocity there"


def test_integral_torque_is_bounded() -> None:
    """By itself it moves joint 1 if, and only if, it may exceed the dry friction."""
    for wind, moves in ((0.9, False), (1.1, True)):
        arm = Arm(kp=0.0, kd=0.0, ki=1000.0, wind=wind * PUMA560.coulomb_up[0])
        arm.bench.inputs.q_ref = START + np.array([0.1, 0, 0, 0, 0, 0])
        seen = arm.run(1.0)
        assert bool(np.abs(seen - START).max() > 0.0) is moves


def test_it_follows_a_moving_reference_better_when_told_its_velocity() -> None:
    worst = {}
    for told in (False, True):
        arm = Arm()
        errors = []
        for k in range(750):
            time = 0.002 * (k + 1)
            arm.bench.inputs.q_ref = START + 0.2 * np.sin(2 * time) ** 2
            if told:
                arm.bench.inputs.qd_ref = np.full(6, 0.4 * np.sin(4 * time))
            arm.run(0.002)
            errors.append(arm.q - arm.bench.inputs.q_ref)
        worst[told] = np.abs(errors).max()
    assert worst[True] < 0.02
    assert worst[True] < 0.6 * worst[False]


def test_gains_change_while_it_runs(arm: Arm) -> None:
    arm.run(0.1)
    arm.bench.set("kp", 100.0)
    arm.bench.inputs.q_ref = START + 0.01
    weak = arm.run(0.3)[-1] - START
    assert weak[0] < 1e-3, "100 N*m/rad do not overcome the friction of joint 1"
    arm.bench.set("kp", (2400.0, 3000.0, 700.0, 130.0, 120.0, 130.0))
    assert (arm.run(1.5)[-1] - START)[0] > 5e-3


def test_illegal_flag_stops_it_softly_and_without_inputs(arm: Arm) -> None:
    arm.bench.inputs.q_ref = START + np.array([0.5, 0, 0, 0, 0, 0])
    arm.run(0.2)
    assert arm.qd[0] > 0.5
    bench = arm.bench
    bench.illegal = True
    bench.inputs.q_ref = np.full(6, np.nan)
    bench.inputs.qd_ref = np.full(6, np.nan)
    bench.inputs.t_grav = np.full(6, np.nan)
    fastest = abs(arm.qd[0])
    speeds = []
    for _ in range(1000):
        bench.step(0.002)
        speeds.append(arm.qd.copy())
    assert bench.state is State.ON
    assert np.abs(speeds).max() < fastest + 0.05
    assert np.abs(speeds[-1]).max() < 0.01
    stood = arm.q
    bench.step(0.002, n=500)
    assert arm.q == pytest.approx(stood, abs=5e-3)


def test_it_goes_on_smoothly_when_the_flag_is_down_again(arm: Arm) -> None:
    bench = arm.bench
    goal = START + np.array([0.5, 0, 0, 0, 0, 0])
    bench.inputs.q_ref = goal
    arm.run(0.4)
    bench.illegal = True
    arm.run(0.5)
    bench.illegal = False
    seen = arm.run(3.0)
    assert np.abs(np.diff(seen, axis=0)).max() / 0.002 < 1.5
    assert seen[-1] == pytest.approx(goal, abs=3e-3)


def test_it_brakes_when_it_is_turned_off(arm: Arm) -> None:
    arm.bench.inputs.q_ref = START + 0.5
    arm.run(0.3)
    assert np.abs(arm.qd).max() > 0.2
    arm.bench.off()
    assert np.array_equal(arm.qd, np.zeros(6))
    stood = arm.q
    arm.bench.on()
    arm.bench.inputs.q_ref = stood
    assert np.abs(arm.run(0.2) - stood).max() < 5e-3


def test_at_a_handover_it_keeps_moving(arm: Arm) -> None:
    """The successor finds the velocity in the table, and goes on with it."""
    arm.bench.inputs.q_ref = START + 0.5
    arm.run(0.3)
    q, qd = arm.q, arm.qd
    arm.bench.off(handover=True)
    assert np.array_equal(arm.qd, qd)
    successor = Bench(
        PumaPidg, params=configured("puma_pidg"), q=q, qd=qd, q_ref=START + 0.5
    )
    successor.on()
    successor.step(0.002)
    assert successor.outputs.qd == pytest.approx(qd, abs=0.1)


def test_a_handover_while_the_flag_is_up_slows_down_softly(arm: Arm) -> None:
    arm.bench.inputs.q_ref = START + 0.5
    arm.run(0.3)
    q, qd = arm.q, arm.qd
    arm.bench.off(handover=True)
    successor = Bench(
        PumaPidg, params=configured("puma_pidg"), q=q, qd=qd, freq=500, critical=True
    )
    successor.on()
    successor.illegal = True
    for k in range(10):
        successor.step(0.002)
        slower = np.abs(qd) - np.abs(successor.outputs.qd)
        assert np.all(slower < 4.0 * 0.002 * (k + 1) + 0.1)


def test_cycles_that_come_too_late_brake_the_arm_and_are_told(arm: Arm) -> None:
    arm.bench.inputs.q_ref = START + 0.5
    arm.run(0.3)
    arm.bench.notices()
    arm.bench.step(0.2)
    (notice,) = arm.bench.notices()
    assert "no torque command came in time" in notice.text
    assert np.array_equal(arm.qd, np.zeros(6))
    arm.run(2.0)
    assert arm.bench.notices() == []
    assert arm.q == pytest.approx(START + 0.5, abs=5e-3)


def test_a_missed_cycle_is_only_a_longer_one(arm: Arm) -> None:
    arm.bench.inputs.q_ref = START + 0.3
    arm.run(0.1)
    arm.bench.step(0.006)
    arm.run(2.0)
    assert arm.q == pytest.approx(START + 0.3, abs=5e-3)


# ------------------------------------------------------------------------------ jtball


def ball(**params: object) -> Bench[JtBall]:
    given = {
        "trace": "puma",
        "speed": (0.5,),
        "lower": (-1.0,),
        "upper": (1.0,),
    } | params
    return Bench(JtBall, params=given, ndof=6, freq=50)


def test_trace_moves_the_reference_within_the_limits_and_back() -> None:
    bench = Bench(JtBall, params=configured("jttrace"), ndof=6, q_ref=START, freq=50)
    bench.on()
    seen = [bench.outputs.q_ref.copy()]
    for _ in range(751):
        bench.step()
        seen.append(bench.outputs.q_ref.copy())
    moved = np.ptp(seen, axis=0)
    assert np.all(moved > 0.3), "every joint is exercised"
    assert seen[-1] == pytest.approx(START, abs=0.03), "and comes back"
    given = configured("jttrace")
    assert np.all(np.abs(np.diff(seen, axis=0)) <= np.array(given.speed) * 0.0201)  # type: ignore[attr-defined]


def test_reference_goes_on_from_where_it_stands() -> None:
    bench = Bench(JtBall, params=configured("jttrace"), ndof=6, q_ref=START, freq=50)
    bench.on()
    assert np.array_equal(bench.outputs.q_ref, START)
    bench.step()
    assert np.array_equal(bench.outputs.q_ref, START), "the trace begins at rest"


def test_limits_stop_the_reference_but_never_pull_it() -> None:
    bench = ball(upper=(0.1,), lower=(-0.1,))
    bench.outputs.q_ref = [0.5, 0, 0, 0, 0, 0]  # beyond, left there by somebody else
    bench.on()
    seen = []
    for _ in range(750):
        bench.step()
        seen.append(bench.outputs.q_ref.copy())
    first = np.array(seen)[:, 0]
    assert first.max() == 0.5
    assert np.all(np.abs(np.diff(first)) < 0.011)
    assert first.min() >= -0.1
    others = np.array(seen)[:, 1:]
    assert np.abs(others).max() <= 0.1


def test_axes_choose_and_reverse() -> None:
    plain, turned = ball(), ball(axes=(-6, 5, 4, 3, 2, 1))
    for bench in (plain, turned):
        bench.on()
        bench.step(n=300)
    assert turned.outputs.q_ref[5] == plain.outputs.q_ref[0] != 0.0
    assert turned.outputs.q_ref[0] == -plain.outputs.q_ref[5] != 0.0


def test_enable_button_must_be_held() -> None:
    bench = ball(enable=1)  # nobody holds a button in the trace
    bench.on()
    bench.step(n=300)
    assert np.array_equal(bench.outputs.q_ref, np.zeros(6))


@pytest.mark.parametrize(
    ("params", "message"),
    [
        ({"trace": "", "device": ""}, "either a device or a trace"),
        ({"device": "/dev/ttyS0"}, "either a device or a trace"),
        ({"trace": "nobody"}, "no such operator trace"),
        ({"axes": (1, 2, 3)}, "axes cannot control the joints"),
        ({"axes": (1, 2, 3, 0, 5, 6)}, "axes cannot control the joints"),
        ({"dead": 500.0}, "axes cannot control the joints"),
        ({"speed": (1.0, 2.0)}, "speed has the wrong number of values"),
    ],
)
def test_wrong_steering_stops_the_task_from_being_created(
    params: dict[str, object], message: str
) -> None:
    with pytest.raises(MethodError, match=message):
        ball(**params)


def test_speed_can_be_changed_while_it_runs_but_not_the_ball() -> None:
    slow, fast = ball(), ball()
    for bench in (slow, fast):
        bench.on()
    fast.set("speed", 1.0)
    for bench in (slow, fast):
        bench.step(n=60)
    assert fast.outputs.q_ref == pytest.approx(2.0 * slow.outputs.q_ref)
    with pytest.raises(MethodError, match="read when the task is created"):
        fast.set("trace", "other")


def test_missing_device_is_a_warning_and_the_reference_stays() -> None:
    bench = ball(trace="", device="/dev/ttyNOWHERE")
    (notice,) = bench.notices()
    assert "the ball rests" in notice.text
    assert "/dev/ttyNOWHERE" in notice.text
    bench.outputs.q_ref = START
    bench.on()
    bench.step(n=200)
    assert np.array_equal(bench.outputs.q_ref, START)
    assert bench.notices() == [], "said once"
    assert bench.state is State.ON
    bench.off()
    assert bench.kill() is State.NOT_CREATED
