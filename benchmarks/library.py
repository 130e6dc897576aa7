"""The library's modules: how long a cycle takes, beside the bare call of its library.

Each module runs on a bench as its ``.rmod`` configures it, with six joints or elements,
and inputs that move in every cycle. Shown is the CPU time of its `cycle`, as MAXC is
one; copying to and from the table is not in it (`benchmarks/svar.py`). Where a module's
law is computed by a library, such as pinocchio, what it must ask that library for is
timed in the same cycle, after it. A module that cannot run here is shown with the
reason, such as a package that is not installed. The goals: p99 is at most a fifth of
the period, so 200 us at 1 kHz; p50 is at most 5 us above that of the library's call.

``--grow`` runs that many more cycles with the garbage collector off, as in a task, and
counts the memory blocks of Python and the KiB of the process that are not given back.
The goal: none that grow with the cycles.

``--save`` writes the figures, with the machine, to ``docs/benchmarks/library.json``,
from which ``docs/library_pages.py`` makes the table and the line on each module's page.
Modules that are not named keep theirs.

    python -m benchmarks.library [--cycles N] [--grow N] [--save] [NAME ...]
"""

from __future__ import annotations

import argparse
import gc
import json
import os
import platform
import resource
import struct
import sys
import tempfile
from pathlib import Path
from time import thread_time_ns
from typing import TYPE_CHECKING, Any
from unittest import mock

import numpy as np

from benchmarks.library_devices import entries
from pbonet.config import Library, SppEntry, read_svar
from pbonet.errors import PbonetError
from pbonet.io.drivers import Entry, database, joystick_driver as joystick
from pbonet.io.spp import processors
from pbonet.modules import __file__ as built_in
from pbonet.ports import Kind
from pbonet.testing import Bench

if TYPE_CHECKING:
    from collections.abc import Callable, Mapping

    from pbonet.config.library import LoadedModule

SHARE = 0.2
"""Of its period, what p99 of a module's cycle may take."""
OVER = 5.0
"""Microseconds of p50 that a module may take beside its library's call."""
BLOCKS, KIB = 300, 256
"""What may be kept once for all: caches, warnings, and pages of the allocator."""
MISSED = 3
SIZE = 6
FOLDER = tempfile.TemporaryDirectory(prefix="pbonet-")
"""Where files that modules need are."""
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
FILE = Path(__file__).parents[1] / "docs" / "benchmarks" / "library.json"
PANDA = Path(__file__).parents[1] / "examples" / "panda"
QUADRUPED = PANDA.parent / "quadruped"
FOLDERS = PANDA, QUADRUPED, Path(__file__).parent, Path(FOLDER.name)
"""Folders in which files that parameters name are looked for."""
HOME = (0.0, -0.4, 0.0, -2.2, 0.0, 1.8, 0.785)
"""A posture of its arm that is not singular, rad."""


def puma() -> Mapping[str, Any]:
    """Return the geometry of the PUMA, in a posture that is not singular."""
    from pbonet.io import PUMA560

    return {"ndof": SIZE, "dh": PUMA560.dh}


def answer(_fd: int, request: int, room: bytes) -> bytes:
    """Answer for the kernel of a joystick: three axes at rest, and no button."""
    return bytes(len(room)) if request == joystick.GET_KEYS else AXIS


def device() -> str:
    """Return a device file on which nothing arrives, as in most cycles of a person."""
    path = str(Path(FOLDER.name) / "device")
    if not Path(path).exists():
        os.mkfifo(path)
        os.open(path, os.O_RDWR)  # open until this program ends
    return path


def pad() -> str:
    """Return the name of a joystick with three axes, on that file."""
    mock.patch.object(joystick, "ioctl", answer).start()
    settings = {"axes": [0, 1, 2]}
    pad = Entry(driver="joystick", address=device(), settings=settings)
    database.use({"pad": pad}, "benchmark")
    return "pad"


def camera() -> Mapping[str, Any]:
    """Return a hand before a ball, and begin an executive that sees this at once."""
    (Path(FOLDER.name) / "camera.py").write_text(SEES, encoding="utf-8")
    processors.use({"camera": SppEntry(driver="numpy")}, "")
    turn = np.array([[0.0, 0.0, 1.0], [-1.0, 0.0, 0.0], [0.0, -1.0, 0.0]])
    return {"ndof": SIZE, "x": np.column_stack((turn, [0.55, -0.1, -0.1]))}


def limbs() -> Mapping[str, Any]:
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
    path = Path(FOLDER.name) / "limbs.urdf"
    path.write_text(robot, encoding="utf-8")
    return {"params": {"urdf": path.name}, "q": [0.3] * SIZE}


def samples() -> str:
    """Return a file of samples of six joints over ten seconds."""
    path = Path(FOLDER.name) / "samples.csv"
    times = np.linspace(0.0, 10.0, 1001)
    rows = np.column_stack([times, *(np.sin(times + k) for k in range(SIZE))])
    np.savetxt(path, rows)
    return str(path)


def planner() -> Mapping[str, Any]:
    """Return what `mppi_arm` needs; an executive of this program makes small plans."""
    from pbonet.io.spp import SppEntry, processors

    processors.use({"gpu0": SppEntry(driver="numpy")}, "")
    params = {
        "urdf": "panda.urdf",
        "frame": "hand",
        "acceleration": (8.0,),
        "posture": HOME,
        "rollouts": 2,
    }
    goal = [0.5, 0.3, 0.4]
    return {"ndof": 7, "q": HOME, "q_ref": HOME, "goal": goal, "params": params}


USUAL: dict[str, Callable[[], Mapping[str, Any]]] = {
    "grav_comp": puma,
    "forward_kin": puma,
    "puma_inv_kin": lambda: {**puma(), "x": pose(0.45, -0.15, 0.3)},
    "imu_fusion": lambda: {"acc": [0.0, 0.0, 9.81]},
    "admittance": lambda: {"x_ref": pose(0.4, 0.1, 0.3), "x_cmd": pose(0.4, 0.1, 0.3)},
    "hybrid_force": lambda: {
        "x_ref": pose(0.4, 0.1, 0.3),
        "x_cmd": pose(0.4, 0.1, 0.3),
    },
    "otg_cart": lambda: {"x": pose(0.4, 0.0, 0.3), "x_des": pose(0.5, 0.1, 0.3)},
    "joystick": lambda: {
        "naxes": SIZE // 2,
        "params": {"device": pad(), "axes": (0, 1, 2), "buttons": (3, 4, 5, 6)},
    },
    "spacemouse": lambda: {"params": {"device": device()}},
    "traj_play": lambda: {"params": {"file": samples(), "repeat": True}},
    "dmp": lambda: {"params": {"file": samples()}},
    "tbuf_send": lambda: {"params": {"link": "x"}},
    "tbuf_receive": lambda: {"params": {"link": "arm:x"}},
    "mav_ground": lambda: {"nparam": 1},
    "mav_params": lambda: {"nparam": 1},
    "mav_mission": lambda: {"nparam": 1},
    "mav_rc": lambda: {"nrc": 8, "nact": 6, "npulse": 8},
    "mav_gimbal": lambda: {"nrc": 8, "nact": 6, "npulse": 8},
    "mav_actuator": lambda: {"nrc": 8, "nact": 6, "npulse": 8},
    "mav_hil": lambda: {"nact": 4, "att": [1.0, 0.0, 0.0, 0.0]},
    "gait": lambda: {"nfeet": 4},
    "kalman": lambda: {"nx": 2, "nz": 1, "nu": 1},
    "lqr": lambda: {"n": 2, "m": 1},
    "mpc_linear": lambda: {"n": 2, "m": 1},
    "pd_grav": lambda: {"ndof": 7},
    "impedance": lambda: {
        "ndof": 7,
        "x_des": pose(0.4, 0.1, 0.3),
        "x": pose(0.4, 0.1, 0.3),
    },
    "fk_jac": lambda: {"ndof": 7, "q": HOME},
    "gravity": lambda: {"ndof": 7, "q": HOME, "params": {"urdf": "panda.urdf"}},
    "computed_torque": lambda: {"ndof": 7, "q": HOME, "q_ref": HOME},
    "ik_placo": lambda: {"ndof": 7, "q_ref": HOME, "x_des": hand()},
    "mppi_arm": planner,
    "mujoco_arm": lambda: {"ndof": 7, "q": HOME},
    "mujoco_quad": lambda: standing(x="X_MEZ", q="Q_MEZ", tau="T_MEZ", t_ref="T_REF"),
    "mujoco_base": lambda: {
        "w_ref": [1.0, 1.0],
        "params": {"model": "cart.xml", "wheels": ("left", "right"), "gain": (1.5,)},
    },
    "whole_body": lambda: standing(
        x_body="X_BODY_DES", x_feet="X_FEET_DES", q_ref="Q_REF", ndof="NDOF"
    ),
    "whole_body_dyn": lambda: standing(
        x_des="X_BODY_DES",
        x="X_MEZ",
        contact="CONTACT_DES",
        q_ref="Q_REF",
        q="Q_MEZ",
        tau="T_REF",
        ndof="NDOF",
    ),
    "contact": lambda: standing(
        x="X_MEZ",
        q="Q_MEZ",
        tau="T_MEZ",
        contact="CONTACT",
        force="F_FEET",
        ndof="NDOF",
    ),
    "com_zmp": lambda: {
        **standing(x="X_MEZ", q="Q_MEZ", ndof="NDOF"),
        "params": {"urdf": "quadruped.urdf"},
    },
    "self_collision": limbs,
    "visual_ball": camera,
    "damped_ls": lambda: {"x_des": pose(0.4, 0.1, 0.3), "x": pose(0.4, 0.0, 0.3)},
    "can_position": lambda: {"ndof": 2},
    "can_speed": lambda: {"ndof": 2},
    "can_torque": lambda: {"ndof": 2},
    "dynamixel": lambda: {"ndof": 2},
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
BARE: dict[str, Callable[[Any], Callable[[], object]]] = {
    "grav_comp": lambda module: lambda: module._chain.gravity(module.q),
    "gravity": lambda module: lambda: module._model.gravity(module.q),
    "computed_torque": lambda module: (
        lambda: module._model.torque(module.q, module.qd, module.qdd_ref)
    ),
    "ik_placo": lambda module: lambda: placo_step(module),
    "mpc_linear": lambda module: lambda: daqp_plan(module),
    "mujoco_quad": lambda module: lambda: module._robot.advance(0.002),
    "otg": lambda module: new_goal(module._motion),
    "com_zmp": lambda module: module._model.centroidal,
    "self_collision": lambda module: lambda: coal_distance(module._model, module.q),
    "whole_body": lambda module: lambda: placo_posture(module),
    "whole_body_dyn": lambda module: lambda: placo_torques(module),
}
"""The bare call of a module's library, made from its instance."""


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


def placo_step(module: Any) -> None:  # noqa: ANN401 - its parts are its own
    """Do what placo must be asked for: of the state, for a goal, the step."""
    motion = module._motion
    motion.show()
    motion.robot.get_T_world_frame(module._frame)
    module._task.T_world_frame = module._goal
    motion.solver.dt = 0.002
    motion.solver.solve(False)  # noqa: FBT003


def placo_posture(module: Any) -> None:  # noqa: ANN401 - as above
    """Do what placo must be asked for: frames, for their goals, the step."""
    motion = module._motion
    for task, place in zip(module._feet_tasks, module._places, strict=True):
        task.target_world = place
    module._body_task.T_world_frame = module._goal
    motion.solver.dt = 0.002
    motion.solver.solve(False)  # noqa: FBT003
    motion.robot.update_kinematics()
    for frame in (module.params.body, *module.params.feet):
        motion.robot.get_T_world_frame(frame)


def placo_torques(module: Any) -> None:  # noqa: ANN401 - as above
    """Do what placo must be asked for: of the state, for goals, the torques."""
    robot, model = module._robot, module._model
    robot.state.q, robot.state.qd = model.q, model.v
    robot.update_kinematics()
    module._body.T_world_frame = module._pose
    for name, q in zip(model.joints.joints, module.q_ref.tolist(), strict=True):
        module._posture.set_joint(name, q, 0.0)
    for task, foot in zip(module._feet, module.params.feet, strict=True):
        task.target_world = robot.get_T_world_frame(foot)[:3, 3]
    module._solver.solve(False)  # noqa: FBT003


def coal_distance(model: Any, q: Any) -> None:  # noqa: ANN401 - as above
    """Do what pinocchio and coal must be asked for: places, then distances."""
    shapes, found = model._shapes, model._found
    model._pin.updateGeometryPlacements(model._model, model._data, shapes, found, q)
    model._pin.computeDistances(shapes, found)


def daqp_plan(module: Any) -> None:  # noqa: ANN401 - its parts are its own
    """Give daqp new limits and another pull, and have it solved."""
    program = module._program
    pull = module._pull @ (module.z - module.z_ref)
    program.update(f=pull, bupper=module._high, blower=module._low)
    program.solve()


def new_goal(motion: Any) -> Callable[[], object]:  # noqa: ANN401 - of a module
    """Return ruckig's call for a goal that is another one each time."""
    state, goals = motion._state, [[0.3] * SIZE, [0.31] * SIZE]

    def call() -> None:
        goals.reverse()
        state.target_position = goals[0]
        motion._solver.update(state, motion._next)

    return call


def hand() -> np.ndarray[Any, np.dtype[np.float64]]:
    """Return the pose of the arm's hand at `HOME`."""
    made = Bench.of(PANDA / "hand.rmod", {"ndof": 7, "q": HOME}, library=[PANDA])
    made.on()
    return np.array(made["X_MEZ"])


def pose(*place: float) -> np.ndarray[Any, np.dtype[np.float64]]:
    """Return a pose that looks down at a place."""
    return np.column_stack((np.diag([1.0, -1.0, -1.0]), place))


def bench(module: LoadedModule) -> Bench[Any]:
    """Return a module on a bench, ON.

    Raises:
        PbonetError: It cannot run here.
    """
    values = dict(USUAL.get(module.info.name, dict)())
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
    if params is None:
        made = Bench.of(rmod, values, library=FOLDERS)
    else:
        made = Bench(module.cls, values, params=params, library=FOLDERS)
    made.on()
    _leave_notes(made.module)
    return made


def _leave_notes(module: Any) -> None:  # noqa: ANN401 - of any class
    """Take away the bench's `cycle`, which notes each call, from a module's own."""
    module.__dict__.pop("cycle", None)


def _follows(dim: str, values: Mapping[str, Any], known: Mapping[str, Any]) -> bool:
    """Return whether a size follows from a value that is given."""
    return any(name in known and dim in known[name].shape for name in values)


def measure(
    made: Bench[Any], bare: Callable[[], object] | None, cycles: int
) -> tuple[list[int], list[int]]:
    """Return nanoseconds of CPU time of each cycle, and of each bare call."""
    moving = [
        (port.name, np.array(made[port.name], dtype=float))
        for port in made.module.__interface__.ports
        if port.kind is Kind.INVAR
        and port.unit != "mixed"
        and port.type.startswith("float")
    ]
    dt = 1.0 / made.task.freq
    whole: list[int] = []
    alone: list[int] = []
    for n in range(cycles):
        for name, rest in moving:
            made[name] = rest + 1e-3 * np.sin(0.1 * n)
        made.step()
        begun = thread_time_ns()
        made.module.cycle(dt)
        ended = thread_time_ns()
        whole.append(ended - begun)
        if bare is not None:
            begun = thread_time_ns()
            bare()
            alone.append(thread_time_ns() - begun)
    return whole, alone


def growth(made: Bench[Any], cycles: int) -> tuple[int, int]:
    """Return blocks of Python and KiB of the process that cycles do not give back."""
    module, dt = made.module, 1.0 / made.task.freq
    local = made.table.local
    moving = [
        (local[port.attr], local[port.attr].copy())
        for port in module.__interface__.ports
        if port.kind is Kind.INVAR
        and port.unit != "mixed"
        and port.type.startswith("float")
    ]

    def run(count: int) -> None:
        for n in range(count):
            for values, rest in moving:
                np.add(rest, 1e-3 * np.sin(0.1 * n), out=values)
            module.cycle(dt)

    gc.collect()
    gc.freeze()
    gc.disable()
    try:
        run(cycles)  # what is kept once for all is then there
        blocks, size = sys.getallocatedblocks(), _resident()
        run(cycles)
        return sys.getallocatedblocks() - blocks, _resident() - size
    finally:
        gc.enable()
        gc.unfreeze()


def _resident() -> int:
    """Return the KiB of memory of this process."""
    pages = int(Path("/proc/self/statm").read_text(encoding="ascii").split()[1])
    return pages * resource.getpagesize() // 1024


def figures(module: LoadedModule, cycles: int, grow: int) -> dict[str, Any]:
    """Return the figures of a module, or why there are none."""
    name = module.info.name
    try:
        made = bench(module)
        bare = BARE[name](made.module) if name in BARE else None
        whole, alone = measure(made, bare, cycles)
        grown = growth(made, grow) if grow else None
        made.kill()  # a link has a file
    except (PbonetError, ImportError) as error:
        return {"missing": str(error).splitlines()[0][:70]}
    p50, p99 = np.percentile(whole, [50, 99]) / 1e3
    found: dict[str, Any] = {"size": _size(made), "hz": made.task.freq}
    found |= {"cycles": cycles, "p50": round(p50, 1), "p99": round(p99, 1)}
    found["max"] = max(whole) // 1000
    if alone:
        found["bare"] = round(float(np.percentile(alone, 50)) / 1e3, 1)
    if grown:
        found["growth"] = {"cycles": grow, "blocks": grown[0], "kib": grown[1]}
    return found


def _size(made: Bench[Any]) -> str:
    """Return the sizes of a module's ports in words."""
    sizes: dict[str, int] = {}
    for port in made.module.__interface__.ports:
        shape = np.shape(getattr(made.module, port.attr))
        sizes |= {
            dim: count
            for dim, count in zip(port.shape, shape, strict=False)
            if isinstance(dim, str)
        }
    return ", ".join(f"{dim} {count}" for dim, count in sorted(sizes.items()))


def faults(found: Mapping[str, Any]) -> list[str]:
    """Return the goals that a module misses."""
    if "missing" in found:
        return []
    missed: list[str] = []
    if found["p99"] > SHARE * 1e6 / found["hz"]:
        missed.append("p99")
    if found["p50"] - found.get("bare", found["p50"]) > OVER:
        missed.append("overhead")
    grown = found.get("growth", {"blocks": 0, "kib": 0})
    if grown["blocks"] > BLOCKS or grown["kib"] > KIB:
        missed.append("memory")
    return missed


def cells(name: str, found: Mapping[str, Any]) -> list[str]:
    """Return the row of a module in the table."""
    if "missing" in found:
        return [name, f"not here: {found['missing']}", *4 * [""]]
    told = [f"{found['p50']:.1f}", f"{found['p99']:.1f}", str(found["max"])]
    told.append(f"{found['bare']:.1f}" if "bare" in found else "")
    grown = found.get("growth")
    told.append(f"{grown['blocks']}, {grown['kib']} KiB" if grown else "")
    return [name, found["size"], *told]


def machine() -> str:
    """Return what this machine is, in words, and how busy it is."""
    lines = Path("/proc/cpuinfo").read_text(encoding="utf-8").splitlines()
    model = next((one for one in lines if one.startswith("model name")), "")
    cpu = " ".join(model.partition(":")[2].split()) or platform.machine()
    cores, load = len(os.sched_getaffinity(0)), os.getloadavg()[0]
    version = platform.python_version()
    return f"{cores} cores of {cpu}, Python {version}, load average {load:.0f}"


def save(measured: Mapping[str, Mapping[str, Any]]) -> None:
    """Keep figures in the file, with their machine and the goals that they miss."""
    kept: dict[str, Any] = json.loads(FILE.read_text(encoding="utf-8"))
    told = machine()
    kept |= {name: {**found, "machine": told} for name, found in measured.items()}
    for found in kept.values():
        found["missed"] = faults(found)
    text = json.dumps(dict(sorted(kept.items())), indent=1)
    FILE.write_text(f"{text}\n", encoding="utf-8")


def own(path: Path) -> bool:
    """Return whether a file is one of pbonet's own modules."""
    return str(path).startswith(built_in.removesuffix("__init__.py"))


def main() -> int:
    """Measure and print a Markdown table; 3 when a module is too slow."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--cycles", type=int, default=5000)
    parser.add_argument("--grow", type=int, default=0)
    parser.add_argument("--save", action="store_true")
    parser.add_argument("names", nargs="*", metavar="NAME")
    given = parser.parse_args()
    library = Library()
    database.use(entries(Path(FOLDER.name), SIZE), "benchmarks.library")
    names = [name for name, path in library.files().items() if own(path)]
    if unknown := sorted(set(given.names) - set(names)):
        parser.error(f"the library has no module {', '.join(unknown)}")
    print(f"{machine()}\n{given.cycles} cycles; microseconds\n")
    print("| module | size | p50 | p99 | largest | library's call | growth |")
    print("|---|---|---|---|---|---|---|")
    measured: dict[str, dict[str, Any]] = {}
    missed: list[str] = []
    for name in given.names or names:
        found = measured[name] = figures(library.load(name), given.cycles, given.grow)
        print(f"| {' | '.join(cells(name, found))} |", flush=True)
        missed += [f"{name} ({goal})" for goal in faults(found)]
    if given.save:
        save(measured)
    if missed:
        print(f"\ngoals missed: {', '.join(missed)}")
    return MISSED if missed else 0


if __name__ == "__main__":
    raise SystemExit(main())
