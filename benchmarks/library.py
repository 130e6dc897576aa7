"""The library's modules: how long a cycle takes, beside the bare call of its library.

Each module runs on a bench as its ``.rmod`` configures it, with six joints or elements,
and inputs that move in every cycle. Shown is the CPU time of its `cycle`, as MAXC is
one; copying to and from the table is not in it (`benchmarks/svar.py`). Where a module's
law is one call of a library, such as pinocchio's, that call is timed in the same cycle,
after it. A module that cannot run here is shown with the reason, such as a package that
is not installed. The goals: p99 is at most a fifth of the period, so 200 us at 1 kHz;
p50 is at most 5 us above that of the library's call.

    python -m benchmarks.library [--cycles N] [NAME ...]
"""

from __future__ import annotations

import argparse
import platform
from pathlib import Path
from time import thread_time_ns
from typing import TYPE_CHECKING, Any

import numpy as np

from pbonet.config import Library, read_svar
from pbonet.errors import PbonetError
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
MISSED = 3
SIZE = 6
PANDA = Path(__file__).parents[1] / "examples" / "panda"
QUADRUPED = PANDA.parent / "quadruped"
FOLDERS = PANDA, QUADRUPED, Path(__file__).parent
"""Folders in which files of robots are looked for."""
HOME = (0.0, -0.4, 0.0, -2.2, 0.0, 1.8, 0.785)
"""A posture of its arm that is not singular, rad."""


def puma() -> Mapping[str, Any]:
    """Return the geometry of the PUMA, in a posture that is not singular."""
    from pbonet.io import PUMA560

    return {"ndof": SIZE, "dh": PUMA560.dh}


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
    "tbuf_send": lambda: {"params": {"link": "x"}},
    "tbuf_receive": lambda: {"params": {"link": "arm:x"}},
    "gait": lambda: {"nfeet": 4},
    "kalman": lambda: {"nx": 2, "nz": 1, "nu": 1},
    "lqr": lambda: {"n": 2, "m": 1},
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
    "damped_ls": lambda: {"x_des": pose(0.4, 0.1, 0.3), "x": pose(0.4, 0.0, 0.3)},
}
"""Values that a module needs beside sizes, and ``params`` that its RMOD lacks."""
RMODS = {
    "fk_jac": PANDA / "hand.rmod",
    "computed_torque": PANDA / "torque.rmod",
    "ik_placo": PANDA / "ik_placo.rmod",
    "mujoco_arm": PANDA / "arm.rmod",
    "mujoco_quad": QUADRUPED / "robot.rmod",
    "whole_body": QUADRUPED / "posture.rmod",
    "whole_body_dyn": QUADRUPED / "torque.rmod",
    "contact": QUADRUPED / "touch.rmod",
}
"""Modules that are measured as an example configures them."""
BARE: dict[str, Callable[[Any], Callable[[], object]]] = {
    "grav_comp": lambda module: lambda: module._chain.gravity(module.q),
    "gravity": lambda module: lambda: module._model.gravity(module.q),
    "computed_torque": lambda module: (
        lambda: module._model.torque(module.q, module.qd, module.qdd_ref)
    ),
    "ik_placo": lambda module: (
        lambda: module._motion.solver.solve(False)  # noqa: FBT003
    ),
    "whole_body": lambda module: (
        lambda: module._motion.solver.solve(False)  # noqa: FBT003
    ),
    "whole_body_dyn": lambda module: (
        lambda: module._solver.solve(False)  # noqa: FBT003
    ),
    "mujoco_quad": lambda module: lambda: module._robot.advance(0.002),
    "otg": lambda module: (
        lambda: module._motion._solver.update(
            module._motion._state, module._motion._next
        )
    ),
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
    return made


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


def row(module: LoadedModule, cycles: int) -> tuple[list[str], bool]:
    """Return the row of a module, and whether it is as fast as it must be."""
    name = module.info.name
    try:
        made = bench(module)
        bare = BARE[name](made.module) if name in BARE else None
        whole, alone = measure(made, bare, cycles)
        made.kill()  # a link has a file
    except (PbonetError, ImportError) as error:
        return [name, f"not here: {str(error).splitlines()[0][:70]}", *4 * ["-"]], True
    cells, met = [name, module.info.module_class], True
    p50, p99 = np.percentile(whole, [50, 99]) / 1e3
    met = p99 <= SHARE * 1e6 / made.task.freq
    cells += [f"{p50:.1f}", f"{p99:.1f}"]
    if not alone:
        return [*cells, "-", "-"], met
    least, most = np.percentile(alone, [50, 99]) / 1e3
    return [*cells, f"{least:.1f}", f"{most:.1f}"], met and p50 - least <= OVER


def own(path: Path) -> bool:
    """Return whether a file is one of pbonet's own modules."""
    return str(path).startswith(built_in.removesuffix("__init__.py"))


def main() -> int:
    """Measure and print a Markdown table; 3 when a module is too slow."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--cycles", type=int, default=5000)
    parser.add_argument("names", nargs="*", metavar="NAME")
    given = parser.parse_args()
    library = Library()
    names = [name for name, path in library.files().items() if own(path)]
    if unknown := sorted(set(given.names) - set(names)):
        parser.error(f"the library has no module {', '.join(unknown)}")
    print(f"{platform.processor() or platform.machine()}, {platform.python_version()}")
    print(f"{given.cycles} cycles; microseconds; {SIZE} joints or elements\n")
    print("| module | class | p50 | p99 | library's call, p50 | p99 |")
    print("|---|---|---|---|---|---|")
    slow: list[str] = []
    for name in given.names or names:
        cells, met = row(library.load(name), given.cycles)
        print(f"| {' | '.join(cells)} |", flush=True)
        slow += [] if met else [name]
    if slow:
        print(f"\ngoal missed by {', '.join(slow)}")
    return MISSED if slow else 0


if __name__ == "__main__":
    raise SystemExit(main())
