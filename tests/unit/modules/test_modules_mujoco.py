"""The robot interface of a simulated arm, on a bench."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from pbonet import State
from pbonet.errors import MethodError
from pbonet.io import RobotModel
from pbonet.modules.robot_interfaces.mujoco_arm import MujocoArm
from pbonet.outside import Player, Tape, files_read, use
from pbonet.testing import Bench

mujoco = pytest.importorskip("mujoco", reason="pip install 'pbonet[mujoco]'")

PANDA = Path(__file__).parents[3] / "examples" / "panda"
HOME = np.array([0.0, -0.5, 0.0, -2.2, 0.0, 1.8, 0.785])


def panda(**values: Any) -> Bench[MujocoArm]:
    params = {"model": "panda.urdf", **values.pop("params", {})}
    return Bench(
        MujocoArm,
        params=params,
        library=[PANDA],
        freq=500,
        critical=True,
        **{"q": HOME, "t_ref": np.zeros(7), **values},
    )


def test_it_says_how_many_joints_there_are_and_where_the_arm_stands() -> None:
    bench = panda(qd=[0.1] * 7)
    assert bench.outputs.ndof == 7
    bench.on()
    assert bench.outputs.q == pytest.approx(HOME, abs=1e-12)
    assert bench.outputs.qd == pytest.approx([0.1] * 7, abs=1e-12)


def test_a_torque_does_what_mujoco_s_own_loop_makes_of_it() -> None:
    torque = np.array([3.0, -9.0, 1.0, 19.0, 0.5, 1.5, 0.2])
    bench = panda(t_ref=torque)
    bench.on()
    held = RobotModel("panda.urdf", [PANDA]).gravity(HOME)
    model = mujoco.MjModel.from_xml_path(str(PANDA / "panda.urdf"))
    model.opt.timestep = 0.001
    data = mujoco.MjData(model)
    data.qpos[:] = HOME
    data.qfrc_applied[:] = held  # until the first torque is read
    for _ in range(100):
        mujoco.mj_step(model, data, 2)
        data.qfrc_applied[:] = torque
        bench.step()
        assert bench.outputs.q == pytest.approx(data.qpos, abs=1e-9)
        assert bench.outputs.qd == pytest.approx(data.qvel, abs=1e-9)


def test_the_time_that_passed_is_filled_with_equal_steps() -> None:
    bench = panda()
    bench.on()
    bench.step(0.0035)
    arm = bench.module._arm
    assert arm._model.opt.timestep == pytest.approx(0.000875)
    assert arm._data.time == pytest.approx(0.0035)


def test_a_torque_is_limited_to_what_the_file_allows() -> None:
    bench = panda(t_ref=[1000.0, -1000.0, 0.0, 0.0, 1000.0, 0.0, -1000.0])
    bench.on()
    bench.step()
    applied = bench.module._arm._data.qfrc_applied
    assert applied == pytest.approx([87.0, -87.0, 0.0, 0.0, 12.0, 0.0, -12.0])


def test_without_a_fresh_torque_the_arm_is_held() -> None:
    bench = panda()
    bench.ages["t_ref"] = 0.06
    bench.on()
    bench.step(n=500)
    assert bench.outputs.q == pytest.approx(HOME, abs=1e-9)
    assert bench.outputs.qd == pytest.approx(np.zeros(7), abs=1e-9)
    assert bench.output_age == 0.0, "what is measured is new, whatever was commanded"


def test_a_moving_arm_slows_down_and_stays_where_it_stops() -> None:
    bench = panda(qd=[0.4, 0.0, 0.0, -0.8, 0.0, 0.0, 0.0])
    bench.on()
    bench.illegal = True
    speeds = []
    for _ in range(250):
        bench.step()
        speeds.append(np.abs(bench.outputs.qd).max())
    assert np.diff(speeds).min() > -4.0 * 0.002 - 2e-3, "no harder than SLOW"
    stopped = bench.outputs.q.copy()
    expected = HOME + np.array([0.4**2, 0, 0, -(0.8**2), 0, 0, 0]) / 8.0
    assert stopped == pytest.approx(expected, abs=3e-3), "v^2 / 2a"
    bench.step(n=500)
    assert bench.outputs.q == pytest.approx(stopped, abs=1e-3)
    assert np.abs(bench.outputs.qd).max() < 1e-3


def test_an_arm_stops_from_where_torques_have_taken_it_each_time() -> None:
    bench = panda(t_ref=[2.0, -20.0, 0.0, 20.0, 0.0, 2.0, 0.0])
    bench.on()
    for _ in range(2):
        bench.illegal = False
        bench.step(n=50)
        q, qd = bench.outputs.q.copy(), bench.outputs.qd.copy()
        assert np.abs(q - HOME).max() > 0.02
        bench.illegal = True
        bench.step(n=700)
        assert np.abs(bench.outputs.qd).max() < 1e-2
        assert np.abs(bench.outputs.q - q - qd * np.abs(qd) / 8.0).max() < 0.02


def test_off_is_with_brakes_and_a_handover_is_not() -> None:
    bench = panda(qd=[0.5] * 7)
    bench.on()
    bench.step()
    bench.off(handover=True)
    assert np.abs(bench.outputs.qd).max() > 0.1
    bench.on()
    bench.step()
    where = bench.outputs.q.copy()
    bench.off()
    assert bench.outputs.qd == pytest.approx(np.zeros(7))
    bench.on()
    assert bench.outputs.q == pytest.approx(where, abs=1e-12)


def test_a_torque_that_is_no_number_is_an_error_that_names_the_joint() -> None:
    bench = panda()
    bench.on()
    bench.step()
    before = bench.outputs.q.copy()
    bench.inputs.t_ref = [0.0, 0.0, np.nan, 0.0, 0.0, 0.0, 0.0]
    with pytest.raises(MethodError, match="T_REF of joint joint3 is not finite"):
        bench.step()
    assert bench.state is State.ERROR
    assert bench.outputs.q == pytest.approx(before)


def test_an_arm_that_flies_apart_is_an_error_that_names_the_joint(
    tmp_path: Path,
) -> None:
    bodies = "".join(
        f"<body><joint name='{name}'/><geom size='0.1'/></body>" for name in ("a", "b")
    )
    text = f"<mujoco><worldbody>{bodies}</worldbody></mujoco>"
    (tmp_path / "arm.xml").write_text(text)
    params = {"model": "arm.xml"}
    bench = Bench(MujocoArm, params=params, library=[tmp_path], ndof=2, qd=[1.0, 2e4])
    bench.on()
    with pytest.raises(MethodError, match="flies apart at joint b"):
        bench.step()


def test_two_runs_are_the_same_to_the_bit() -> None:
    def run() -> bytes:
        bench = panda(t_ref=[1.0, -10.0, 0.0, 19.0, 0.0, 1.0, 0.0])
        bench.on()
        bench.step(n=200)
        return bench.outputs.q.tobytes()

    assert run() == run()


def said(tmp_path: Path, text: str, n: int = 1) -> str:
    (tmp_path / "arm.xml").write_text(text)
    with pytest.raises(MethodError) as caught:
        Bench(
            MujocoArm,
            params={"model": "arm.xml"},
            library=[tmp_path],
            ndof=n,
        )
    return str(caught.value)


BODY = "<mujoco><worldbody><body>{}<geom size='0.1'/></body></worldbody>{}</mujoco>"


def test_a_model_with_another_number_of_joints_is_refused(tmp_path: Path) -> None:
    text = said(tmp_path, BODY.format("<joint name='elbow'/>", ""), n=2)
    assert "expected 2 joints, got 1: elbow" in text


@pytest.mark.parametrize(
    ("text", "word"),
    [
        ("<mujoco", "MuJoCo cannot read the model"),
        (BODY.format("<freejoint name='loose'/>", ""), "joint loose is a ball or free"),
        (BODY.format("", ""), "the model has no joint"),
    ],
)
def test_a_model_that_is_no_arm_is_refused(
    text: str, word: str, tmp_path: Path
) -> None:
    assert word in said(tmp_path, text)


def files_noted(folder: Path) -> list[str]:
    """Return the files that a task's tape names for a model with one joint."""
    tape = Tape()
    former = use(tape)
    try:
        values = {"params": {"model": "arm.xml"}, "library": [folder], "ndof": 1}
        Bench(MujocoArm, **values)
        player = Player()
        player.feed(tape.take())
    finally:
        use(former)
    return [
        str(Path(one.path).relative_to(folder.absolute())) for one in files_read(player)
    ]


LOADS = """
import sys
sys.addaudithook(lambda event, args: event == "subprocess.Popen" and sys.exit(args[1]))
from pbonet.io import MujocoRobot
print(MujocoRobot(sys.argv[1]).n)
"""


def test_loading_mujoco_starts_no_program_which_a_replay_refuses() -> None:
    done = subprocess.run(
        [sys.executable, "-c", LOADS, str(PANDA / "panda.urdf")],
        env={name: os.environ[name] for name in os.environ if name != "MUJOCO_GL"},
        capture_output=True,
        text=True,
        check=False,
    )
    assert (done.stdout, done.stderr) == ("7\n", "")


def test_included_files_are_noted_and_those_that_they_include(tmp_path: Path) -> None:
    """MuJoCo looks beside the model first: the joint is in the file there."""
    (tmp_path / "parts").mkdir()
    joint, names = "<joint name='elbow'/>", ("parts/one.xml", "two.xml", "three.xml")
    one, two, three = (f"<include file='{name}'/>" for name in names)
    (tmp_path / "arm.xml").write_text(f"<mujoco>{one}</mujoco>")
    (tmp_path / "parts" / "one.xml").write_text(f"<mujoco>{two}{three}</mujoco>")
    (tmp_path / "two.xml").write_text(BODY.format(joint, ""))
    (tmp_path / "parts" / "two.xml").write_text("<mujoco")
    (tmp_path / "parts" / "three.xml").write_text("<mujoco><asset/></mujoco>")
    wanted = ["arm.xml", "parts/one.xml", "two.xml", "parts/three.xml"]
    assert files_noted(tmp_path) == wanted


@pytest.mark.parametrize(
    ("head", "encoding"),
    [
        ("<!-- <include file='gone.xml'/> -->", "utf-8"),
        ("<?xml version='1.0' encoding='ISO-8859-1'?><!-- Größe -->", "latin-1"),
        ("<!-- Größe -->", "latin-1"),
        ("<!-- no -- XML -->", "utf-8"),
    ],
)
def test_what_mujoco_reads_is_not_refused(head, encoding, tmp_path: Path) -> None:
    text = head + BODY.format("<joint name='elbow'/>", "")
    (tmp_path / "arm.xml").write_text(text, encoding=encoding)
    assert files_noted(tmp_path) == ["arm.xml"]


def test_actuators_of_the_file_do_nothing(tmp_path: Path) -> None:
    """As those of a model whose drives hold positions by themselves."""
    drive = "<actuator><position joint='elbow' kp='100' ctrlrange='-9 9'/></actuator>"
    (tmp_path / "arm.xml").write_text(BODY.format("<joint name='elbow'/>", drive))
    bench = Bench(
        MujocoArm, params={"model": "arm.xml"}, library=[tmp_path], ndof=1, q=[0.7]
    )
    bench.on()
    bench.step(n=50)
    assert bench.outputs.q == pytest.approx([0.7], abs=1e-9)
