"""The library's modules: how long a cycle takes, beside the bare call of its library.

Each module runs on a bench as its ``.rmod`` configures it, with six joints or elements,
and inputs that move in every cycle. Shown is the CPU time of its `cycle`, as MAXC is
one; copying to and from the table is not in it (`benchmarks/svar.py`). Where a module's
law is computed by a library, such as pinocchio, what it must ask that library for is
timed in turns with it, on the same state. A module that cannot run here is shown with
the reason, such as a package that is not installed. The goals: p99 is at most a fifth
of the period, so 200 us at 1 kHz; p50 is at most 5 us above the library's call.

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
import sys
from pathlib import Path
from time import thread_time_ns
from typing import TYPE_CHECKING, Any

import numpy as np

from benchmarks.library_benches import SIZE, bench, surroundings
from pbonet.config import Library
from pbonet.errors import PbonetError
from pbonet.modules import __file__ as built_in
from pbonet.ports import Kind

if TYPE_CHECKING:
    from collections.abc import Callable, Mapping

    from pbonet.config.library import LoadedModule
    from pbonet.testing import Bench

SHARE = 0.2
"""Of its period, what p99 of a module's cycle may take."""
OVER = 5.0
"""Microseconds of p50 that a module may take beside its library's call."""
BLOCKS, KIB = 300, 256
"""What may be kept once for all: caches, warnings, and pages of the allocator."""
MISSED = 3
FILE = Path(__file__).parents[1] / "docs" / "benchmarks" / "library.json"
BARE: dict[str, Callable[[Any], Callable[[], object]]] = {
    "grav_comp": lambda module: lambda: module._chain.gravity(module.q),
    "gravity": lambda module: lambda: module._model.gravity(module.q),
    "computed_torque": lambda module: (
        lambda: module._model.torque(module.q, module.qd, module.qdd_ref)
    ),
    "ik_placo": lambda module: lambda: placo_step(module),
    "mpc_linear": lambda module: lambda: daqp_plan(module),
    "fk_jac": lambda module: lambda: pinocchio_jacobian(module),
    "mujoco_arm": lambda module: mujoco_motion(module._arm),
    "mujoco_base": lambda module: mujoco_motion(module._robot, 0.01),
    "mujoco_quad": lambda module: mujoco_motion(module._robot),
    "otg": lambda module: new_goal(module._motion),
    "com_zmp": lambda module: module._model.centroidal,
    "self_collision": lambda module: lambda: coal_distance(module._model, module.q),
    "whole_body": lambda module: lambda: placo_posture(module),
    "whole_body_dyn": lambda module: lambda: placo_torques(module),
}
"""The bare call of a module's library, made from its instance."""


def placo_step(module: Any) -> None:  # noqa: ANN401 - its parts are its own
    """Do what placo must be asked for: for a goal, the step, and where the hand is."""
    motion = module._motion
    module._task.T_world_frame = module._hand.goal
    motion.solver.dt = 0.002
    motion.solver.solve(False)  # noqa: FBT003
    motion.robot.update_kinematics()
    motion.robot.get_T_world_frame(module.params.frame)


def placo_posture(module: Any) -> None:  # noqa: ANN401 - as above
    """Do what placo must be asked for: frames, for their goals, the step."""
    motion = module._motion
    for task, place in module._feet_goals:
        task.target_world = place
    module._body_task.T_world_frame = module._body.goal
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
    module._body.T_world_frame = module._pose.goal
    module._body_place.dtarget_world = module._v_des[0]
    module._body_turn.omega_world = module._v_des[1]
    for name, q in zip(model.joints.joints, module.q_ref.tolist(), strict=True):
        module._posture.set_joint(name, q, 0.0)
    for task, foot in zip(module._feet, module.params.feet, strict=True):
        task.target_world = robot.get_T_world_frame(foot)[:3, 3]
    found = module._solver.solve(False)  # noqa: FBT003
    _ = found.success, found.tau


def pinocchio_jacobian(module: Any) -> None:  # noqa: ANN401 - as above
    """Do what pinocchio must be asked for, and LAPACK for the singular values."""
    model = module._model
    pin, robot, data = model._pin, model._model, model._data
    found = pin.computeFrameJacobian(
        robot, data, module.q, module._frame, pin.LOCAL_WORLD_ALIGNED
    )
    place = pin.updateFramePlacement(robot, data, module._frame)
    _ = place.rotation, place.translation
    np.linalg.svd(found, compute_uv=False)


def mujoco_motion(
    robot: Any,  # noqa: ANN401 - of a module
    period: float = 0.002,
) -> Callable[[], object]:
    """Return MuJoCo's calls for a period: its steps, and what then holds."""
    steps = round(period / robot._step)
    mujoco, model, data = robot._mujoco, robot._model, robot._data

    def call() -> None:
        mujoco.mj_step(model, data, steps)
        mujoco.mj_forward(model, data)

    return call


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


def moved(made: Bench[Any]) -> list[tuple[Any, Any]]:
    """Return the inputs that move: what the module reads, and around which values."""
    local = made.table.local
    return [
        (local[port.attr], local[port.attr].copy())
        for port in made.module.__interface__.ports
        if port.kind is Kind.INVAR
        and port.unit != "mixed"
        and port.type.startswith("float")
    ]


def measure(
    made: Bench[Any], bare: Callable[[], object] | None, cycles: int
) -> tuple[list[int], list[int]]:
    """Return nanoseconds of CPU time of each cycle, and of each bare call.

    The two run in turns: what ran just before would leave code and data of the library
    in the caches to the other.
    """
    dt, cycle = 1.0 / made.task.freq, made.module.cycle
    inputs = moved(made)
    whole: list[int] = []
    alone: list[int] = []
    for n in range(cycles if bare is None else 2 * cycles):
        made.step()
        for values, rest in inputs:
            np.add(rest, 1e-3 * np.sin(0.1 * n), out=values)
        if bare is None or n % 2:
            begun = thread_time_ns()
            cycle(dt)
            whole.append(thread_time_ns() - begun)
        else:
            begun = thread_time_ns()
            bare()
            alone.append(thread_time_ns() - begun)
    return whole, alone


def growth(made: Bench[Any], cycles: int) -> tuple[int, int]:
    """Return blocks of Python and KiB of the process that cycles do not give back."""
    module, dt = made.module, 1.0 / made.task.freq
    moving = moved(made)

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


def figures(
    module: LoadedModule, folder: Path, cycles: int, grow: int
) -> dict[str, Any]:
    """Return the figures of a module, or why there are none."""
    name = module.info.name
    try:
        made = bench(module, folder)
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
    names = [name for name, path in library.files().items() if own(path)]
    if unknown := sorted(set(given.names) - set(names)):
        parser.error(f"the library has no module {', '.join(unknown)}")
    print(f"{machine()}\n{given.cycles} cycles; microseconds\n")
    print("| module | size | p50 | p99 | largest | library's call | growth |")
    print("|---|---|---|---|---|---|---|")
    measured: dict[str, dict[str, Any]] = {}
    missed: list[str] = []
    with surroundings() as folder:
        for name in given.names or names:
            module = library.load(name)
            found = figures(module, folder, given.cycles, given.grow)
            measured[name] = found
            print(f"| {' | '.join(cells(name, found))} |", flush=True)
            missed += [f"{name} ({goal})" for goal in faults(found)]
    if given.save:
        save(measured)
    if missed:
        print(f"\ngoals missed: {', '.join(missed)}")
    return MISSED if missed else 0


if __name__ == "__main__":
    raise SystemExit(main())
