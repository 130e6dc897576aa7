"""The PUMA's mathematics against a recursive Newton-Euler written by hand."""

from __future__ import annotations

import dataclasses
import itertools
import subprocess
import sys

import numpy as np
import pytest
from newton_euler import G, newton_euler

from pbonet.io._friction import FrictionStep, add_damping, solve_with_friction
from pbonet.io.arm import SimulatedArm
from pbonet.io.chain import Chain
from pbonet.io.puma560 import PUMA560

NOMINAL = np.array([0.0, np.pi / 4, -np.pi, 0.0, np.pi / 4, 0.0])


@pytest.fixture(scope="module")
def chain():
    return Chain(PUMA560.dh, PUMA560.mass, PUMA560.com, PUMA560.inertia, PUMA560.rotor)


@pytest.fixture(scope="module")
def postures():
    rng = np.random.default_rng(560)
    return rng.uniform(PUMA560.lower, PUMA560.upper, (1000, 6))


def test_the_oracle_itself_on_a_pendulum():
    """One link, its centre of mass l along x of its own frame, axis horizontal."""
    swing = dataclasses.replace(
        PUMA560,
        dh=np.array([[0.0, 0.0, 0.0, np.pi / 2], [0.0, 0.0, 0.7, 0.0]]),
        mass=np.array([0.0, 3.0]),
        com=np.array([[0.0, 0.0, 0.0], [-0.2, 0.0, 0.0]]),
        inertia=np.array([[0.0, 0.0, 0.0], [0.0, 0.05, 0.05]]),
    )
    length, angle = 0.5, 0.3
    torque = newton_euler(swing, [0.0, angle], [0.0, 1.7], [0.0, 2.0])
    expected = 3.0 * G * length * np.cos(angle) + (3.0 * length**2 + 0.05) * 2.0
    assert torque[1] == pytest.approx(expected, abs=1e-12)
    # about the vertical axis there is only the Coriolis torque, which needs its motion
    spun = newton_euler(swing, [0.0, angle], [0.9, 1.7], [0.0, 0.0])
    coriolis = -2 * (3.0 * length**2 + 0.05) * np.sin(angle) * np.cos(angle) * 0.9 * 1.7
    assert spun[0] == pytest.approx(coriolis, abs=1e-12)


@pytest.mark.slow
def test_gravity_agrees_at_a_thousand_postures(chain, postures):
    zero = np.zeros(6)
    for q in postures:
        expected = newton_euler(PUMA560, q, zero, zero)
        assert np.abs(chain.gravity(q) - expected).max() < 1e-9


def test_velocity_torques_agree(chain, postures):
    rng = np.random.default_rng(1)
    for q in postures[:200]:
        qd = rng.uniform(-3, 3, 6)
        expected = newton_euler(PUMA560, q, qd, np.zeros(6))
        assert np.abs(chain.bias(q, qd) - expected).max() < 1e-9


@pytest.mark.slow
def test_mass_matrix_agrees_is_symmetric_and_positive_definite(chain, postures):
    motors = np.diag(PUMA560.rotor)
    smallest = np.inf
    for q in postures[:60]:
        mass = chain.mass_matrix(q)
        columns = [newton_euler(PUMA560, q, np.zeros(6), e, g=0.0) for e in np.eye(6)]
        assert np.abs(mass - np.array(columns).T - motors).max() < 1e-9
        assert np.array_equal(mass, mass.T)
        smallest = min(smallest, np.linalg.eigvalsh(mass)[0])
        np.linalg.cholesky(mass)
    # no joint can weigh less than its own motor does through its gear
    assert smallest > 0.9 * PUMA560.rotor.min()


def test_published_figures_of_the_nominal_posture(chain):
    """As the robotics community tabulates them for [CA]'s numbers at its posture qn."""
    gravity = chain.gravity(NOMINAL)
    assert gravity == pytest.approx([0, 31.6399, 6.0351, 0, 0.0283, 0], abs=5e-5)
    mass = np.diag(chain.mass_matrix(NOMINAL))
    assert mass == pytest.approx(
        [3.6594, 4.4137, 0.9378, 0.1925, 0.1713, 0.1941], abs=5e-5
    )


def test_published_numbers_are_consistent_with_each_other():
    # motor inertia through the gear, against what AKB identified by oscillation (table
    # of "effective motor inertia"; kg*m^2). Two laboratories, two arms: within a half.
    identified = np.array([1.14, 4.71, 0.83, 0.200, 0.179, 0.193])
    ratio = PUMA560.rotor / identified
    assert np.all((ratio > 0.45) & (ratio < 1.1)), ratio
    # the drives can carry the arm with something to spare, in any posture
    assert np.all(PUMA560.coulomb_up < 0.4 * PUMA560.torque)
    assert np.all(PUMA560.coulomb_down < 0.4 * PUMA560.torque)
    # rigid bodies: no moment exceeds the sum of the others; link 3 does, as noted
    excess = 2 * PUMA560.inertia.max(axis=1) - PUMA560.inertia.sum(axis=1)
    assert np.flatnonzero(excess > 1e-12).tolist() == [0, 2]
    assert excess[2] == pytest.approx(0.0075)


def test_drives_hold_the_arm_in_every_posture(chain, postures):
    for q in postures:
        assert np.all(np.abs(chain.gravity(q)) < 0.5 * PUMA560.torque)


def test_where_the_wrist_stands(chain):
    # stretched along x: upper arm, forearm, and the small elbow offset upwards
    stretched = np.array([0.0, 0.0, -np.pi / 2, 0.0, 0.0, 0.0])
    assert chain.position(stretched) == pytest.approx([
        0.4318 + 0.4318,
        -0.15005,
        -0.0203,
    ])


# ------------------------------------------------------------------ the simulated arm


def frictionless():
    zero = np.zeros(6)
    return dataclasses.replace(
        PUMA560,
        motor_viscous=zero,
        motor_coulomb_up=zero,
        motor_coulomb_down=zero,
        lower=np.full(6, -1e3),
        upper=np.full(6, 1e3),
    )


def released(data, q, *, qd=0.0, substep=0.5e-3):
    arm = SimulatedArm(data, substep=substep, watchdog=1e9)
    arm.place(q, np.full(6, qd))
    arm.release_brakes()
    return arm


def energy_error(substep):
    """Let the arm fall for two seconds and return the largest error, J."""
    arm = released(frictionless(), NOMINAL, qd=0.5, substep=substep)
    start = arm.chain.energy(arm.q, arm.qd)
    worst = 0.0
    for _ in range(1000):
        arm.advance(2e-3)
        worst = max(worst, abs(arm.chain.energy(arm.q, arm.qd) - start))
    return worst


def test_energy_is_kept_without_friction_and_better_with_smaller_steps():
    coarse, fine = energy_error(1e-3), energy_error(0.5e-3)
    assert fine < 0.1  # joules, while some 30 J move between height and speed
    assert coarse / fine == pytest.approx(2.0, rel=0.05)  # first order, as it should


def swung(**settings):
    """Return the joint angles of an arm that follows swings of 0.6 rad for 2 s."""
    arm = SimulatedArm(PUMA560, **settings)
    arm.place(start := np.array([0.0, -0.8, 0.3, 0.1, 0.5, 0.0]), np.zeros(6))
    arm.release_brakes()
    stiff = np.array([500.0, 750.0, 375.0, 37.0, 37.0, 25.0])
    seen = []
    for cycle in range(1000):
        wish = start + 0.6 * np.sin(np.pi * 2e-3 * cycle * np.linspace(0.8, 1.2, 6))
        torque = stiff * (wish - arm.q) - stiff / 8 * arm.qd
        arm.advance(2e-3)
        arm.command(torque + arm.chain.gravity(arm.q))
        seen.append(arm.q.copy())
    return np.array(seen)


def test_the_step_that_is_taken_is_small_enough():
    """Its error is far below that of the servo, which is some milliradians."""
    assert np.abs(swung() - swung(substep=1 / 16e3)).max() < 1e-3


def test_friction_only_takes_energy_away():
    arm = released(dataclasses.replace(PUMA560), NOMINAL, qd=1.0)
    before = arm.chain.energy(arm.q, arm.qd)
    for _ in range(500):
        arm.advance(2e-3)
        after = arm.chain.energy(arm.q, arm.qd)
        assert after < before + 1e-3
        before = after


def test_joint_sticks_until_the_torque_exceeds_its_friction():
    hold = released(PUMA560, NOMINAL)
    gravity = hold.chain.gravity(NOMINAL).copy()
    for extra, moves in ((0.98, False), (1.02, True)):
        arm = released(PUMA560, NOMINAL)
        torque = gravity.copy()
        torque[0] += extra * PUMA560.coulomb_up[0]
        for _ in range(50):
            arm.command(torque)
            arm.advance(2e-3)
        assert bool(arm.q[0] > 0) is moves
        assert moves or np.array_equal(arm.q, NOMINAL)
    arm = released(PUMA560, NOMINAL)
    torque = gravity.copy()
    torque[1] -= 1.02 * PUMA560.coulomb_down[1]  # the weaker direction of joint 2
    for _ in range(50):
        arm.command(torque)
        arm.advance(2e-3)
    assert arm.q[1] < NOMINAL[1]


def test_viscous_friction_is_added_to_the_torque_of_each_joint():
    torque, damping, qd = np.random.default_rng(5).normal(size=(3, 30))
    wanted = torque + damping * qd
    add_damping(torque[::2], damping[::2], qd[::2])
    add_damping(torque[1::2], damping[1::2], qd[1::2])
    assert torque == pytest.approx(wanted, abs=1e-15)
    with pytest.raises(ValueError, match="same joints"):
        add_damping(torque, damping, qd[:3])


@pytest.mark.slow
def test_viscous_friction_sets_the_terminal_speed():
    torque = np.array([PUMA560.coulomb_up[0] + 2.0, 0, 0, 0, 0, 0])
    data = dataclasses.replace(
        PUMA560, mass=np.zeros(6), lower=np.full(6, -1e3), upper=np.full(6, 1e3)
    )
    arm = released(data, np.zeros(6))
    for _ in range(3000):
        arm.command(torque)
        arm.advance(2e-3)
    assert arm.qd[0] == pytest.approx(2.0 / PUMA560.viscous[0], rel=1e-3)


@pytest.mark.parametrize("way", [1.0, -1.0])
def test_end_stops_hold_whatever_pushes(way):
    stop = PUMA560.upper if way > 0 else PUMA560.lower
    arm = released(PUMA560, NOMINAL)
    for _ in range(1500):
        arm.command(way * PUMA560.torque)
        arm.advance(2e-3)
        assert np.all(way * arm.q <= way * stop)
    assert arm.q == pytest.approx(stop)
    assert np.array_equal(arm.qd, np.zeros(6))
    for _ in range(10):
        arm.command(-way * PUMA560.torque)
        arm.advance(2e-3)
    assert np.all(way * arm.q < way * stop), "a stop does not glue"


def test_drives_limit_the_torque():
    arms = [released(PUMA560, NOMINAL) for _ in range(2)]
    for factor, arm in zip((1.0, 50.0), arms, strict=True):
        arm.command(factor * PUMA560.torque)
        arm.advance(2e-3)
    assert np.array_equal(arms[0].qd, arms[1].qd)


def test_brakes_hold_from_the_start_and_after_the_watchdog():
    arm = SimulatedArm(PUMA560, watchdog=0.05)
    arm.place(NOMINAL, np.zeros(6))
    arm.advance(10.0)
    assert np.array_equal(arm.q, NOMINAL)
    arm.release_brakes()
    arm.advance(0.04)
    assert not arm.braked
    assert arm.qd[1] < 0, "it falls"
    arm.advance(1000.0)  # bounded work: the brakes are on after 10 ms of it
    assert arm.braked
    assert np.array_equal(arm.qd, np.zeros(6))
    fallen = arm.q.copy()
    arm.advance(1.0)
    assert np.array_equal(arm.q, fallen)


def test_missed_cycles_change_nothing_but_the_held_torque():
    """One advance by 6 ms equals three by 2 ms under the same torque."""
    a, b = released(PUMA560, NOMINAL), released(PUMA560, NOMINAL)
    a.advance(6e-3)
    for _ in range(3):
        b.advance(2e-3)
    assert a.q == pytest.approx(b.q, abs=1e-12)


def test_place_respects_the_joint_limits():
    arm = SimulatedArm(PUMA560)
    arm.place(np.full(6, 100.0), np.zeros(6))
    assert np.array_equal(arm.q, PUMA560.upper)


# ------------------------------------------------------------------- friction, exactly


def by_enumeration(matrix, push, low, high):
    """Try every pattern of signs; exactly one is consistent."""
    n = len(push)
    found = []
    for signs in itertools.product((-1, 0, 1), repeat=n):
        friction = np.array([
            {-1: low[i], 0: 0.0, 1: high[i]}[s] for i, s in enumerate(signs)
        ])
        if not np.isfinite(friction).all():
            continue
        free = [i for i, s in enumerate(signs) if s]
        v = np.zeros(n)
        if free:
            v[free] = np.linalg.solve(
                matrix[np.ix_(free, free)], (push - friction)[free]
            )
        needed = push - matrix @ v
        if all(
            v[i] * s > 0 if s else low[i] <= needed[i] <= high[i]
            for i, s in enumerate(signs)
        ):
            found.append(v)
    assert len(found) == 1
    return found[0]


@pytest.mark.parametrize(
    ("seed", "all_at_once"), [*((seed, 10) for seed in range(150)), (7, -1), (11, -1)]
)
def test_friction_solver_finds_the_one_solution(seed, all_at_once):
    """With -1 every correction is a single one."""
    rng = np.random.default_rng(seed)
    n = int(rng.integers(1, 6))
    root = rng.normal(size=(n, n))
    matrix = root @ root.T + 10.0 ** rng.uniform(-3, 0) * np.eye(n)
    push = rng.normal(size=n)
    high, low = rng.exponential(0.7, n), -rng.exponential(0.7, n)
    high[rng.random(n) < 0.15] = np.inf
    low[rng.random(n) < 0.15] = -np.inf
    expected = by_enumeration(matrix, push, low, high)
    bounds = list(zip(low.tolist(), high.tolist(), strict=True))
    for guess in (np.zeros(n), rng.normal(size=n), -np.ones(n)):
        got = solve_with_friction(matrix, push, bounds, guess, all_at_once)
        assert got == pytest.approx(expected, abs=1e-9)


def test_friction_solver_ends_where_correcting_all_signs_goes_round():
    """Of this matrix every sign is corrected back and forth for ever."""
    matrix = np.array([[22.1, -14.0, 3.0], [-14.0, 24.1, 12.0], [3.0, 12.0, 14.1]])
    push = np.array([-8.0, -5.0, -8.0])
    low, high = np.array([-4.0, -4.0, -1.0]), np.array([5.0, 0.0, 5.0])
    bounds = list(zip(low.tolist(), high.tolist(), strict=True))
    got = solve_with_friction(matrix, push, bounds, np.zeros(3))
    expected = by_enumeration(matrix, push, low, high)
    assert got == pytest.approx(expected, abs=1e-9)


def test_friction_solver_says_how_many_joints_it_takes():
    none = np.zeros(33)
    with pytest.raises(ValueError, match="33 joints are not 1 to 32"):
        solve_with_friction(np.eye(33), none, [(0.0, 0.0)] * 33, none)


def test_numbers_of_another_arm_are_refused():
    """Native code reads no memory behind them."""
    each, few = np.zeros(6), np.zeros(5)
    fits = dict.fromkeys(("viscous", "down", "up", "lower", "upper"), each)
    for name in fits:
        with pytest.raises(ValueError, match="not those of 6 joints"):
            FrictionStep(each, each, each, **fits | {name: few})
    with pytest.raises(ValueError, match="not those of 6 joints"):
        FrictionStep(each, few, each, **fits)
    bounds = [(-1.0, 1.0)] * 6
    for matrix, friction, guess in (
        (np.eye(5), bounds, each),
        (np.eye(6), bounds[1:], each),
        (np.eye(6), bounds, few),
    ):
        with pytest.raises(ValueError, match="not those of 6 joints"):
            solve_with_friction(matrix, each, friction, guess)


def test_an_arm_that_begins_to_move_loads_nothing():
    program = (
        "import sys\n"
        "from pbonet.io.arm import SimulatedArm\n"
        "from pbonet.io.puma560 import PUMA560\n"
        "arm = SimulatedArm(PUMA560)\n"
        "arm.release_brakes()\n"
        "arm.command(PUMA560.torque)\n"
        "before = set(sys.modules)\n"
        "arm.advance(0.002)\n"
        "assert arm.qd.any()\n"
        "print(*set(sys.modules) - before)\n"
    )
    told = subprocess.run(
        [sys.executable, "-c", program], check=True, capture_output=True, text=True
    )
    assert told.stdout.split() == []
