"""Each module of the library on a bench, as it is used: for benchmark and tests.

`surroundings` gives devices, processors and a folder with files, as modules with their
own `.rmod` need them; within it `bench` puts any module on a bench.
"""

from __future__ import annotations

import os
import struct
import tempfile
from contextlib import ExitStack, contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Any
from unittest import mock

import numpy as np

from benchmarks.library_devices import entries
from pbonet.config import SppEntry, read_svar
from pbonet.io.drivers import Entry, database, joystick_driver as joystick
from pbonet.io.spp import processors
from pbonet.modules import __file__ as built_in
from pbonet.testing import Bench

if TYPE_CHECKING:
    from collections.abc import Callable, Generator, Mapping

    from pbonet.config.library import LoadedModule

SIZE = 6
AXIS = struct.pack("@6i", 0, -100, 100, 0, 0, 0)
"""What the kernel says of an axis of a joystick."""
SEES = """
from pbonet.io.spp import Library

library = Library()
library.variable("q", 6)
library.variable("ball", 3)
library.variable("seen", 6)


@library.routine("numpy")
def look(m, number):
    m.seen[:] = number, 160.0 + number % 7, 120.0, 2000.0, 1.0, 1.0
"""
"""A library for a camera that always sees a ball, and needs no time."""
PANDA = Path(__file__).parents[1] / "examples" / "panda"
QUADRUPED = PANDA.parent / "quadruped"
FOLDERS = PANDA, QUADRUPED, Path(__file__).parent
"""Folders in which files that parameters name are looked for."""
HOME = (0.0, -0.4, 0.0, -2.2, 0.0, 1.8, 0.785)
"""A posture of its arm that is not singular, rad."""


def puma(_: Path) -> Mapping[str, Any]:
    """Return the geometry of the PUMA, in a posture that is not singular."""
    from pbonet.io import PUMA560

    return {"ndof": SIZE, "dh": PUMA560.dh}


def answer(_fd: int, request: int, room: bytes) -> bytes:
    """Answer for the kernel of a joystick: three axes at rest, and no button."""
    return bytes(len(room)) if request == joystick.GET_KEYS else AXIS


def _fifo(folder: Path, stack: ExitStack) -> None:
    """Make a device file on which nothing arrives, as in most cycles of a person."""
    path = folder / "device"
    os.mkfifo(path)
    stack.callback(os.close, os.open(path, os.O_RDWR))


@contextmanager
def surroundings() -> Generator[Path]:
    """Give what modules find around them in a block: devices, processors, files.

    Yields:
        The folder of the files.
    """
    with ExitStack() as stack:
        folder = Path(stack.enter_context(tempfile.TemporaryDirectory()))
        _fifo(folder, stack)
        (folder / "camera.py").write_text(SEES, encoding="utf-8")
        pad = Entry(
            driver="joystick",
            address=str(folder / "device"),
            settings={"axes": [0, 1, 2]},
        )
        devices = {**entries(folder, SIZE, stack), "pad": pad}
        stack.enter_context(database.using(devices, "benchmarks.library"))
        stack.enter_context(mock.patch.object(joystick, "ioctl", answer))
        on_cpu = SppEntry(driver="numpy")
        stack.enter_context(processors.using({"gpu0": on_cpu, "camera": on_cpu}))
        yield folder


def before_a_ball(_: Path) -> Mapping[str, Any]:
    """Return a hand before a ball, which an executive of this program sees at once."""
    turn = np.array([[0.0, 0.0, 1.0], [-1.0, 0.0, 0.0], [0.0, -1.0, 0.0]])
    return {"ndof": SIZE, "x": np.column_stack((turn, [0.55, -0.1, -0.1]))}


def limbs(folder: Path) -> Mapping[str, Any]:
    """Return what `self_collision` needs: a robot of cylinders."""
    shape = '<cylinder radius="0.05" length="0.2"/>'
    inertia = '<inertia ixx="1" iyy="1" izz="1" ixy="0" ixz="0" iyz="0"/>'
    body = (
        f'<inertial><mass value="1"/>{inertia}</inertial><collision>'
        f'<origin xyz="0 0 0.2"/><geometry>{shape}</geometry></collision>'
    )
    parts = [f'<link name="l0">{body}</link>']
    for k in range(SIZE):
        axis = "0 1 0" if k % 2 else "1 0 0"
        parts.append(
            f'<link name="l{k + 1}">{body}</link><joint name="j{k}" type="revolute">'
            f'<parent link="l{k}"/><child link="l{k + 1}"/><origin xyz="0 0 0.4"/>'
            f'<axis xyz="{axis}"/><limit lower="-2" upper="2" effort="9" velocity="9"/>'
            "</joint>"
        )
    robot = f'<robot name="limbs">{"".join(parts)}</robot>'
    path = folder / "limbs.urdf"
    path.write_text(robot, encoding="utf-8")
    return {"params": {"urdf": path.name}, "q": [0.3] * SIZE}


def samples(folder: Path) -> str:
    """Return a file of samples of six joints over ten seconds."""
    path = folder / "samples.csv"
    times = np.linspace(0.0, 10.0, 1001)
    rows = np.column_stack([times, *(np.sin(times + k) for k in range(SIZE))])
    np.savetxt(path, rows)
    return str(path)


def planner(_: Path) -> Mapping[str, Any]:
    """Return what `mppi_arm` needs; an executive of this program makes small plans."""
    params = {
        "urdf": "panda.urdf",
        "frame": "hand",
        "acceleration": (8.0,),
        "posture": HOME,
        "rollouts": 2,
    }
    goal = [0.5, 0.3, 0.4]
    return {"ndof": 7, "q": HOME, "q_ref": HOME, "goal": goal, "params": params}


USUAL: dict[str, Callable[[Path], Mapping[str, Any]]] = {
    "grav_comp": puma,
    "forward_kin": puma,
    "puma_inv_kin": lambda folder: {**puma(folder), "x": pose(0.45, -0.15, 0.3)},
    "imu_fusion": lambda _: {"acc": [0.0, 0.0, 9.81]},
    "admittance": lambda _: {
        "x_ref": pose(0.4, 0.1, 0.3),
        "x_cmd": pose(0.4, 0.1, 0.3),
    },
    "hybrid_force": lambda _: {
        "x_ref": pose(0.4, 0.1, 0.3),
        "x_cmd": pose(0.4, 0.1, 0.3),
    },
    "otg_cart": lambda _: {"x": pose(0.4, 0.0, 0.3), "x_des": pose(0.5, 0.1, 0.3)},
    "joystick": lambda _: {
        "naxes": SIZE // 2,
        "params": {"device": "pad", "axes": (0, 1, 2), "buttons": (3, 4, 5, 6)},
    },
    "joystick_sim": lambda _: {"naxes": SIZE // 2},
    "spacemouse": lambda folder: {"params": {"device": str(folder / "device")}},
    "traj_play": lambda folder: {"params": {"file": samples(folder), "repeat": True}},
    "dmp": lambda folder: {"params": {"file": samples(folder)}},
    "tbuf_send": lambda _: {"params": {"link": "x"}},
    "tbuf_receive": lambda _: {"params": {"link": "arm:x"}},
    "mav_ground": lambda _: {"nparam": 1},
    "mav_params": lambda _: {"nparam": 1},
    "mav_mission": lambda _: {"nparam": 1},
    "mav_rc": lambda _: {"nrc": 8, "nact": 6, "npulse": 8},
    "mav_gimbal": lambda _: {"nrc": 8, "nact": 6, "npulse": 8},
    "mav_actuator": lambda _: {"nrc": 8, "nact": 6, "npulse": 8},
    "mav_hil": lambda _: {"nact": 4, "att": [1.0, 0.0, 0.0, 0.0]},
    "gait": lambda _: {"nfeet": 4},
    "kalman": lambda _: {"nx": 2, "nz": 1, "nu": 1},
    "lqr": lambda _: {"n": 2, "m": 1},
    "mpc_linear": lambda _: {"n": 2, "m": 1},
    "pd_grav": lambda _: {"ndof": 7},
    "impedance": lambda _: {
        "ndof": 7,
        "x_des": pose(0.4, 0.1, 0.3),
        "x": pose(0.4, 0.1, 0.3),
        "jacobian": np.eye(6, 7),
    },
    "fk_jac": lambda _: {"ndof": 7, "q": HOME},
    "gravity": lambda _: {"ndof": 7, "q": HOME, "params": {"urdf": "panda.urdf"}},
    "computed_torque": lambda _: {"ndof": 7, "q": HOME, "q_ref": HOME},
    "ik_placo": lambda _: {"ndof": 7, "q_ref": HOME, "x_des": hand()},
    "mppi_arm": planner,
    "mujoco_arm": lambda _: {"ndof": 7, "q": HOME},
    "mujoco_quad": lambda _: standing(x="X_MEZ", q="Q_MEZ", tau="T_MEZ", t_ref="T_REF"),
    "mujoco_base": lambda _: {
        "w_ref": [1.0, 1.0],
        "params": {"model": "cart.xml", "wheels": ("left", "right"), "gain": (1.5,)},
    },
    "whole_body": lambda _: standing(
        x_body="X_BODY_DES", x_feet="X_FEET_DES", q_ref="Q_REF", ndof="NDOF"
    ),
    "whole_body_dyn": lambda _: standing(
        x_des="X_BODY_DES",
        x="X_MEZ",
        contact="CONTACT_DES",
        q_ref="Q_REF",
        q="Q_MEZ",
        tau="T_REF",
        ndof="NDOF",
    ),
    "contact": lambda _: standing(
        x="X_MEZ",
        q="Q_MEZ",
        tau="T_MEZ",
        contact="CONTACT",
        force="F_FEET",
        ndof="NDOF",
    ),
    "com_zmp": lambda _: {
        **standing(x="X_MEZ", q="Q_MEZ", ndof="NDOF"),
        "params": {"urdf": "quadruped.urdf"},
    },
    "self_collision": limbs,
    "visual_ball": before_a_ball,
    "damped_ls": lambda _: {
        "x_des": pose(0.4, 0.1, 0.3),
        "x": pose(0.4, 0.0, 0.3),
        "jacobian": np.eye(6),
    },
    "can_position": lambda _: {"ndof": 2},
    "can_speed": lambda _: {"ndof": 2},
    "can_torque": lambda _: {"ndof": 2},
    "dynamixel": lambda _: {"ndof": 2},
}
"""Values that a module needs beside sizes, and ``params`` that its RMOD lacks."""
CRAFT = Path(built_in).parent / "robot_interfaces" / "mav_craft.rmod"
PAYLOAD = CRAFT.with_name("mav_payload.rmod")
RMODS = {
    "fk_jac": PANDA / "hand.rmod",
    "computed_torque": PANDA / "torque.rmod",
    "ik_placo": PANDA / "ik_placo.rmod",
    "mujoco_arm": PANDA / "arm.rmod",
    "mujoco_quad": QUADRUPED / "robot.rmod",
    "whole_body": QUADRUPED / "posture.rmod",
    "whole_body_dyn": QUADRUPED / "torque.rmod",
    "contact": QUADRUPED / "touch.rmod",
    "mav_params": CRAFT,  # a part without its task is nothing: that is measured
    "mav_mission": CRAFT,
    "mav_rc": PAYLOAD,
    "mav_gimbal": PAYLOAD,
    "mav_actuator": PAYLOAD,
}
"""Modules that are measured as an example configures them."""


def standing(**ports: str) -> Mapping[str, Any]:
    """Return values of ports as the quadruped stands, by their variables."""
    variables = read_svar(QUADRUPED / "quadruped.svar").variables
    init = {one.name: np.array(one.init) for one in variables}
    init["NDOF"] = np.array(12)
    shapes = {"X_FEET_DES": (4, 3), "F_FEET": (4, 3), "X_MEZ": (3, 4)}
    shapes["X_BODY_DES"] = (3, 4)
    return {
        attr: init[name].reshape(shapes.get(name, init[name].shape))
        for attr, name in ports.items()
    }


def hand() -> np.ndarray[Any, np.dtype[np.float64]]:
    """Return the pose of the arm's hand at `HOME`."""
    made = Bench.of(PANDA / "hand.rmod", {"ndof": 7, "q": HOME}, library=[PANDA])
    made.on()
    return np.array(made["X_MEZ"])


def pose(*place: float) -> np.ndarray[Any, np.dtype[np.float64]]:
    """Return a pose that looks down at a place."""
    return np.column_stack((np.diag([1.0, -1.0, -1.0]), place))


def bench(
    module: LoadedModule,
    folder: Path,
    *,
    first: Mapping[str, Any] | None = None,
    handover: bool = False,
    **more: Any,  # noqa: ANN401 - what a bench takes
) -> Bench[Any]:
    """Return a module on a bench, ON, as its `.rmod` or an example configures it.

    Args:
        module: It.
        folder: That of `surroundings`.
        first: First values of ports by attribute, in place of the usual ones.
        handover: Whether it goes on from a predecessor, as in a swap.
        more: What the bench is made with in place of what the RMOD says.

    Raises:
        PbonetError: It cannot run here.
    """
    usual = USUAL.get(module.info.name)
    values = {**(usual(folder) if usual else {}), **(first or {})}
    params = values.pop("params", None)
    ports = module.info.ports
    known = {port.attr: port for port in ports}
    for dim in {dim for port in ports for dim in port.shape if isinstance(dim, str)}:
        if dim not in values and not _follows(dim, values, known):
            values[dim] = SIZE
    rmod = module.path.with_suffix(".rmod")
    if module.info.name in RMODS:
        rmod = RMODS[module.info.name]
    made: Bench[Any]
    more = {"library": (*FOLDERS, folder), **more}
    if params is None:
        made = Bench.of(rmod, values, **more)
    else:
        made = Bench(module.cls, values, params=params, **more)
    made.on(handover=handover)
    _leave_notes(made.module)
    return made


def _leave_notes(module: Any) -> None:  # noqa: ANN401 - of any class
    """Take away the bench's `cycle`, which notes each call, from a module's own."""
    module.__dict__.pop("cycle", None)


def _follows(dim: str, values: Mapping[str, Any], known: Mapping[str, Any]) -> bool:
    """Return whether a size follows from a value that is given."""
    return any(name in known and dim in known[name].shape for name in values)
