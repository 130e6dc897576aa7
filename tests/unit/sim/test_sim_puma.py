"""The PUMA example in virtual time: the whole job, without processes or devices."""

from __future__ import annotations

import hashlib
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from virtual_job import VirtualJob, simulate

from pbonet.log import STABLE
from pbonet.master.sim.sim_recording import Recording

ROOT = Path(__file__).parents[3]
JOB = ROOT / "examples" / "puma" / "puma.job"
SETTLING = 30
"""Its cycles until each input has come twice more: Q_REF has 50 Hz, the robot 500."""
FIRST = 2
"""Cycles of the robot until T_GRAV is computed from a measured posture."""


def tracking(recording: Recording) -> np.ndarray:
    """Return measured minus reference angle of every servo cycle."""
    time, measured = recording.series("Q_MEZ")
    when, reference = recording.series("Q_REF")
    newest = np.searchsorted(when, time, side="right") - 1
    return measured[newest >= 0] - reference[newest[newest >= 0]]


def digest(recording: Recording) -> str:
    """Return a hash of every bit of every cycle."""
    total = hashlib.sha256()
    for task in recording.tasks:
        for name, values in recording.arrays(task).items():
            total.update(f"{task}/{name} {values.dtype}".encode())
            total.update(values.tobytes())
    return total.hexdigest()


@pytest.fixture(scope="module")
def recording() -> Recording:
    return simulate(JOB, 15.0)


def test_every_cycle_is_there(recording: Recording) -> None:
    rates = {"puma_pidg": 500, "grav_comp": 250, "qrdiff": 100, "jttrace": 50}
    assert {t: len(recording.arrays(t)["cycle"]) for t in recording.tasks} == {
        task: 15 * rate for task, rate in rates.items()
    }
    for task, rate in rates.items():
        arrays = recording.arrays(task)
        assert np.array_equal(arrays["cycle"], np.arange(1, 15 * rate + 1))
        assert set(np.diff(arrays["release_ns"])) == {round(1e9 / rate)}


def test_the_arm_follows_the_operator(recording: Recording) -> None:
    error = tracking(recording)
    assert np.sqrt((error**2).mean(axis=0)).max() < 0.01
    assert np.abs(error).max() < 0.03
    _, measured = recording.series("Q_MEZ")
    assert np.all(np.ptp(measured, axis=0) > 0.3), "every joint moves"
    assert measured[-1] == pytest.approx(measured[0], abs=0.02), "and comes back"


def test_nothing_was_wrong(recording: Recording) -> None:
    assert recording.about["events"] == []
    for task in recording.tasks:
        flags = recording.arrays(task)["flags"]
        assert not flags[FIRST * (task == "puma_pidg") :].any()


def test_gravity_is_that_of_the_posture(recording: Recording) -> None:
    from pbonet.io.chain import Chain
    from pbonet.io.puma560 import PUMA560

    chain = Chain(PUMA560.dh, PUMA560.mass, PUMA560.com)
    _, measured = recording.series("Q_MEZ")
    _, torque = recording.series("T_GRAV")
    for k in range(1, len(torque), 250):
        near = [
            chain.gravity(measured[j]).copy() for j in (2 * k - 1, 2 * k, 2 * k + 1)
        ]
        low, high = np.min(near, axis=0) - 1e-9, np.max(near, axis=0) + 1e-9
        assert np.all((torque[k] >= low) & (torque[k] <= high))


def test_two_runs_are_equal_bit_for_bit_even_in_two_processes(
    recording: Recording,
) -> None:
    script = (
        f"import sys; sys.path[:0] = {sys.path}\n"
        "from test_sim_puma import JOB, digest, simulate\n"
        "print(digest(simulate(JOB, 2.0)))\n"
    )
    other = subprocess.run(
        [sys.executable, "-c", script],
        capture_output=True,
        text=True,
        check=True,
        env={"PYTHONHASHSEED": "5", "PATH": ""},
        cwd=ROOT,
    )
    assert digest(simulate(JOB, 2.0)) == other.stdout.strip()
    # and a longer run begins like a shorter one
    assert (
        recording.arrays("puma_pidg")["Q_MEZ"][:1000].tobytes()
        == simulate(JOB, 2.0).arrays("puma_pidg")["Q_MEZ"].tobytes()
    )


def test_robot_interface_holds_the_arm_when_gravity_compensation_fails() -> None:
    simulation = VirtualJob(JOB)
    simulation.start()
    simulation.wait(3.0)
    assert not simulation.table.illegal
    simulation.control("grav_comp", "off")
    causes = [one.cause for one in simulation.table.illegal]
    assert causes == ["equation 2: no task writes T_GRAV for puma_pidg"]
    simulation.wait(2.0)
    stood = simulation.table.read("Q_MEZ")
    simulation.wait(2.0)
    assert simulation.table.read("Q_MEZ") == pytest.approx(stood, abs=5e-3)
    simulation.control("grav_comp", "on")
    simulation.wait(3.0)
    assert not simulation.table.illegal
    simulation.stop()
    assert simulation.states() == {}

    arrays = simulation.recording.arrays("puma_pidg")
    stable = arrays["flags"] == STABLE
    assert stable[1500:3500].all()
    assert not stable[FIRST:1500].any()
    assert not stable[3500 + SETTLING :].any()
    speed = np.abs(np.diff(arrays["Q_MEZ"], axis=0)).max(axis=0) / 0.002
    asked = np.array([1.2, 1.0, 1.4, 2.4, 2.0, 2.4])  # SPEED in puma_pidg.rmod
    assert np.all(speed < 1.2 * asked), "no jump anywhere"
    assert np.abs(tracking(simulation.recording)[-500:]).max() < 0.03


def test_gains_can_be_set_while_it_runs() -> None:
    simulation = VirtualJob(JOB)
    simulation.start()
    simulation.wait(0.5)
    (kp,) = simulation.set("puma_pidg", "kp", 2000)
    assert kp.value == [2000.0]
    simulation.wait(0.5)
    simulation.stop()
    assert simulation.events == []


def test_status_says_how_far_it_is() -> None:
    simulation = VirtualJob(JOB)
    simulation.start()
    simulation.wait(1.0)
    status = {t.task: t for rtpu in simulation.rtpu_status() for t in rtpu.tasks}
    assert {name: t.cycle for name, t in status.items()} == {
        "puma_pidg": 500,
        "grav_comp": 250,
        "qrdiff": 100,
        "jttrace": 50,
    }
    assert {t.state for t in status.values()} == {"ON"}
    assert status["puma_pidg"].rtpu == "arm0"
    assert status["puma_pidg"].mez_f == pytest.approx(500.0)
    assert {rtpu.backend for rtpu in simulation.rtpu_status()} == {"inline"}
    simulation.stop()


def test_a_ball_on_a_serial_line_is_not_opened(tmp_path: Path) -> None:
    for name in ("puma.svar", "puma.sbs"):
        (tmp_path / name).write_text((JOB.parent / name).read_text())
    job = JOB.read_text().replace("jttrace ", "jtball ").replace("OFF   jttrace", "OFF")
    (tmp_path / "puma.job").write_text(job)
    recording = simulate(tmp_path / "puma.job", 1.0)
    (event,) = recording.about["events"]
    assert "jtball" in event
    assert "this is a simulation" in event
    reference = recording.arrays("jtball")["Q_REF"]
    assert np.all(reference == reference[0])
