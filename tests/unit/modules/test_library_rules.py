"""Rules that hold for every module of the library, each on a bench as it is used.

What is no number: the module is in ERROR and names the variable, or goes on with
numbers; no output jumps, and nothing of it stays. Turned on: outputs go on from where
they stand, velocities only from those of a predecessor. Robot interfaces: no cycle on
old data. Robots from files: a wrong file or frame is refused by name. A new module is
under all of these rules by itself; what does not fit a rule stands in a list here, with
the reason.
"""

from __future__ import annotations

import re
from pathlib import Path

import numpy as np
import pytest

import pbonet.modules
from benchmarks.library_benches import bench, surroundings
from pbonet import State
from pbonet.config import Library
from pbonet.errors import PbonetError
from pbonet.ports import Kind

FOLDER = Path(pbonet.modules.__file__).parent
LIBRARY = Library()
MODULES = {
    path.stem: LIBRARY.load(path.stem)
    for path in sorted(FOLDER.glob("*/*.py"))
    if not path.name.startswith("_")
}
pytestmark = pytest.mark.usefixtures("packages")
CYCLES = 40
OFFSET = 0.1
"""What the value that is taken over is away from what the law says, in its unit."""
LINKED = {"mav_", "tbuf_", "ros_"}
"""Without a vehicle, a station or another subsystem they do nothing."""
PROCESSORS = {"mppi_arm", "visual_ball"}
"""What they give is computed by another process; it comes some time later."""
UNMOVED = {
    ("deadman", "Z"): "its button is not held",
    ("select_by", "Z2"): "the other input is selected",
    ("join_first", "Z2"): "the first input is right",
    ("kalman", "Z_MEZ"): "no number is no measurement: it predicts",
    ("ekf_odom", "GYR"): "then the wheels say how it turns",
    ("ekf_odom", "X_FIX"): "a wrong fix is left out",
    ("wrench_comp", "X_MEZ"): "its tool weighs nothing, so no pose is needed",
}
"""Inputs that may be no numbers without a word, and why."""
FUNCTIONS = {
    "gravity": "a torque for the present posture, which no controller commands alone",
    "grav_comp": "the same",
    "damped_ls": "a velocity for the present pose; an integrator makes it positions",
    "diff_drive": "wheels have the speed of the command",
    "mecanum": "the same",
    "ackermann": "the same",
    "tricycle": "the same",
    "com_zmp": "a measurement",
    "self_collision": "a measurement",
    "fk_jac": "a measurement",
    "forward_kin": "a measurement",
    "gain": "a scale",
    "diff": "a slope of its input",
    "select_by": "a choice among inputs",
    "join_average": "a choice among inputs",
    "join_first": "a choice among inputs",
    "join_max": "a choice among inputs",
    "join_min": "a choice among inputs",
    "watchdog": "its input, or the safe value",
    "deadman": "its input, or the safe value",
    "visual_target": "where the target is",
    "joystick": "where the stick is",
    "joystick_sim": "where the stick would be",
    "spacemouse": "how far the cap is pushed",
    "constant": "what an operator says, by SLEW if it is given",
}
"""Modules whose outputs follow from their inputs alone: nothing is taken over."""
TAKES_OVER = {"controller", "trajectory", "kinematics", "signal", "connector"}
TAKES_OVER |= {"teleoperation"}
"""Classes whose outputs are commands; those of the others are measurements."""
FAR, LATER = 1.0, 0.15
"""How far a robot is from its reference, in its unit, and seconds after `on`."""
AT_ONCE = {
    "pid": "of any unit, so that no speed fits all: `rate_limit` makes Z_REF",
    "lqr": "the same",
    "mpc_linear": "the same",
    "impedance": "a spring, whose FORCE and MOMENT say how hard it pulls",
    "whole_body_dyn": "who moves X_BODY_DES says how fast the body moves",
    "damped_ls": "LINEAR, ANGULAR and JOINT_ACCEL bound what it commands",
}
"""Modules that go to a reference as their law says, and why."""
FOLLOWS = re.compile(r"\^|COV|AGE|CONTACT")
"""Variables that follow from those that are taken over."""


def cases(*kinds: str) -> list[str]:
    return [
        name
        for name, one in MODULES.items()
        if one.info.module_class in kinds
        and name not in PROCESSORS
        and not name.startswith(tuple(LINKED))
    ]


EVERY = cases(*{one.info.module_class for one in MODULES.values()})


@pytest.fixture
def packages():
    for name in ("placo", "mujoco"):
        pytest.importorskip(name, reason=f"pip install 'pbonet[{name}]'")


@pytest.fixture
def folder():
    with surroundings() as found:
        yield found


def ports(made, kind):
    return [
        port
        for port in made.module.__interface__.ports
        if port.kind is kind and port.type.startswith("float")
    ]


def values(made, kind):
    """Return the values of ports by attribute."""
    return {
        one.attr: np.array(made[one.name], dtype=float) for one in ports(made, kind)
    }


def run(made, cycles=CYCLES):
    """Run with inputs that move; return the largest step of each output."""
    rest = {
        one.attr: np.array(made[one.name], dtype=float)
        for one in ports(made, Kind.INVAR)
        if one.unit != "mixed"
    }
    steps = dict.fromkeys(values(made, Kind.OUTVAR), 0.0)
    for n in range(cycles):
        for attr, value in rest.items():
            setattr(made.inputs, attr, value + 1e-3 * np.sin(0.1 * n))
        before = values(made, Kind.OUTVAR)
        made.step()
        for attr, now in values(made, Kind.OUTVAR).items():
            step = np.abs(now - before[attr]).max(initial=0.0)
            steps[attr] = max(steps[attr], float(step))
    return steps


def inputs_of(name):
    return [
        port.name
        for port in MODULES[name].info.ports
        if port.kind is Kind.INVAR and port.type.startswith("float")
    ]


@pytest.mark.parametrize(
    ("name", "variable"), [(name, one) for name in EVERY for one in inputs_of(name)]
)
def test_what_is_no_number_is_named_and_nothing_jumps(folder, name, variable) -> None:
    made = bench(MODULES[name], folder)
    usual = run(made)
    (port,) = [one for one in ports(made, Kind.INVAR) if one.name == variable]
    good = np.array(made[variable], dtype=float)
    bad = good.copy()
    bad.reshape(-1)[0] = np.nan
    before = values(made, Kind.OUTVAR)
    setattr(made.inputs, port.attr, bad if bad.ndim else float("nan"))
    made.step(n=3, check=False)
    after = values(made, Kind.OUTVAR)
    told = " ".join([*(one.text for one in made.notices()), str(made.executor.failure)])
    assert variable in told or (made.state is State.ON and (name, variable) in UNMOVED)
    for attr, value in after.items():
        assert np.isfinite(value).all(), attr
        stops = attr.startswith(("qd", "v", "w")) or name == "watchdog"
        most = max(9.0 * usual[attr], 1e-9, np.abs(before[attr]).max() if stops else 0)
        assert np.abs(value - before[attr]).max(initial=0.0) <= most, attr
    setattr(made.inputs, port.attr, good if good.ndim else float(good))
    if made.state is State.ERROR:
        made.clear()
        made.on()
    made.step(n=5)
    assert made.state is State.ON
    assert all(np.isfinite(one).all() for one in values(made, Kind.OUTVAR).values())
    made.kill()


@pytest.mark.parametrize("name", cases(*TAKES_OVER))
def test_turned_on_its_outputs_go_on_from_where_they_stand(folder, name) -> None:
    """Whatever another task wrote there; so a swap within a class is no jump either."""
    made = bench(MODULES[name], folder)
    usual = run(made)
    there = {**values(made, Kind.INVAR), **values(made, Kind.OUTVAR)}
    taken = [one for one in ports(made, Kind.OUTVAR) if not FOLLOWS.search(one.name)]
    made.kill()
    for port in taken:
        if there[port.attr].shape != (3, 4):
            there[port.attr] = there[port.attr] + OFFSET
    made = bench(MODULES[name], folder, first=there, handover=True)
    made.step()
    steps = [
        float(np.abs(np.array(made[one.name]) - there[one.attr]).max(initial=0.0))
        for one in taken
    ]
    made.kill()
    if name in FUNCTIONS:
        assert not steps or max(steps) > 0.2 * OFFSET, "it takes over, now"
        return
    exact = MODULES[name].info.module_class == "controller" and name != "joint_pid"
    for port, step in zip(taken, steps, strict=True):
        most = 1e-9 if exact else max(3.0 * usual[port.attr], 0.2 * OFFSET)
        assert step <= most, port.name


@pytest.mark.parametrize("name", cases(*TAKES_OVER))
def test_rates_that_a_dead_writer_left_have_no_effect(folder, name) -> None:
    """Nothing moves by them any more, however old they are."""
    rates = [
        port.attr
        for port in MODULES[name].info.ports
        if port.kind is Kind.OUTVAR and "^" in port.name
    ]
    found = []
    for left in (0.0, 0.3):
        made = bench(MODULES[name], folder)
        first = {attr: values(made, Kind.OUTVAR)[attr] * 0 + left for attr in rates}
        made.kill()
        made = bench(MODULES[name], folder, first=first)
        made.step()
        found.append(values(made, Kind.OUTVAR))
        made.kill()
    without, left_there = found
    for attr, value in without.items():
        assert np.array_equal(value, left_there[attr]), attr


def pairs(name):
    """Return references of places and what is measured of the same, by attribute."""
    known = {one.name: one for one in MODULES[name].info.ports}
    found = [re.fullmatch("([^FV].*)_(REF|DES)", one) for one in inputs_of(name)]
    both = [(known[one[0]], known.get(f"{one[1]}_MEZ")) for one in found if one]
    return [
        (reference.attr, measured.attr)
        for reference, measured in both
        if measured and reference.unit in {"rad", "m", "any", "mixed"}
    ]


def moved_by_hand(name, folder, away, then=0.0):
    """Turn a module on with references away from what is measured.

    Args:
        away: How far they are.
        then: By how much they jump when it is on.

    Returns:
        Its outputs `LATER`, and the speed that its parameters give.
    """
    made = bench(MODULES[name], folder)
    first = {ref: getattr(made.module, mez) + away for ref, mez in pairs(name)}
    made.kill()
    made = bench(MODULES[name], folder, first=first)
    for attr, value in first.items():
        setattr(made.inputs, attr, value + then)
    made.step(n=round(LATER / made.module.task.period))
    after = values(made, Kind.OUTVAR)
    speed = float(np.max(made.module.params.speed))
    made.kill()
    return after, speed


@pytest.mark.parametrize(
    "name", [one for one in EVERY if pairs(one) and one not in AT_ONCE]
)
def test_turned_on_away_from_its_reference_a_robot_is_moved_slowly(folder, name):
    """A person may have moved it while no task did, and Q_REF stays what it was."""
    here, speed = moved_by_hand(name, folder, 0.0)
    far, _ = moved_by_hand(name, folder, FAR)
    near = 1.01 * speed * LATER
    assert near < 0.5 * FAR, "else it tells nothing"
    jumped, _ = moved_by_hand(name, folder, 0.0, near)
    moves = far.keys() & {mez for _, mez in pairs(name)}
    for attr in moves or far:
        most = near if moves else np.abs(jumped[attr] - here[attr]) + 1e-9
        assert (np.abs(far[attr] - here[attr]) <= most).all(), attr


ROBOTS = cases("robot interface")


@pytest.mark.parametrize("name", ROBOTS)
def test_a_robot_interface_runs_no_cycle_on_old_data(folder, name) -> None:
    info = MODULES[name].info
    made = bench(MODULES[name], folder, critical=True)
    made.step(n=3)
    module, ran = made.module, []
    for method in ("cycle", "stable"):
        if own := getattr(module, method, None):
            note = lambda dt, own=own, method=method: (ran.append(method), own(dt))[1]  # noqa: E731
            object.__setattr__(module, method, note)
    for port in ports(made, Kind.INVAR):
        made.stale = {port.attr}
        made.step(n=2, check=False)
        assert "cycle" not in ran, f"on an old {port.name}"
        assert made.state is State.ON, "it holds the robot"
        if values(made, Kind.OUTVAR) and "stable" in ran:
            assert made.output_age == 0.0, "what `stable` measures is new"
        made.stale = set()
        made.step(n=5)
        assert ran.pop() == "cycle", "and goes on when the data are new"
        ran.clear()
    assert info.critical_ok
    rmod = LIBRARY.read_rmod(MODULES[name].path.with_suffix(".rmod"))
    assert rmod.critical or not inputs_of(name)
    made.kill()


FILES = {
    (name, param.name)
    for name in EVERY
    for param in MODULES[name].info.params
    if param.name in {"urdf", "model"}
}
FRAMES = {
    (name, param.name)
    for name, _ in FILES
    for param in MODULES[name].info.params
    if param.name in {"frame", "body", "feet", "wheels"}
}


def configured(name, folder, **change):
    """Return the error of a module whose parameters have been changed."""
    made = bench(MODULES[name], folder)
    params = {
        key: getattr(made.module.params, key)
        for key in dir(made.module.params)
        if not key.startswith("_")
    }
    made.kill()
    with pytest.raises(PbonetError) as caught:
        bench(MODULES[name], folder, first={"params": {**params, **change}})
    return str(caught.value)


@pytest.mark.parametrize(("name", "param"), sorted(FILES))
def test_a_robot_s_file_that_is_none_is_refused_by_name(folder, name, param) -> None:
    told = configured(name, folder, **{param: "nowhere.urdf"})
    assert 'there is no file "nowhere.urdf"' in told
    (folder / "broken.urdf").write_text("<robot name='r'><link/></rob>")
    assert "broken.urdf" in configured(name, folder, **{param: "broken.urdf"})


@pytest.mark.parametrize(("name", "param"), sorted(FRAMES))
def test_a_frame_that_the_robot_lacks_is_refused_by_name(folder, name, param) -> None:
    one = "nobody" if param in {"frame", "body"} else ("nobody",) * 4
    told = configured(name, folder, **{param: one})
    assert "nobody" in told


@pytest.mark.parametrize("name", sorted(MODULES))
def test_every_module_says_what_it_is(name) -> None:
    """Its class in the library, and of each port and parameter the unit and meaning."""
    info = MODULES[name].info
    assert info.module_class
    assert info.doc
    for one in (*info.ports, *info.params):
        assert one.unit, one.name
        assert one.doc, one.name


@pytest.mark.parametrize("name", sorted(MODULES))
def test_its_rmod_is_complete_and_of_this_module(name) -> None:
    rmod = LIBRARY.read_rmod(MODULES[name].path.with_suffix(".rmod"))
    assert name in rmod.module.split("+")
    assert rmod.desc


def test_lists_of_exceptions_name_what_is_there() -> None:
    known = {(name, one) for name in MODULES for one in inputs_of(name)}
    assert set(UNMOVED) <= known
    assert set(FUNCTIONS) <= set(cases(*TAKES_OVER))
    assert set(MODULES) >= PROCESSORS
    assert all(pairs(name) for name in AT_ONCE)
