"""Modules of the library in jobs, in virtual time, each with its own .rmod."""

from __future__ import annotations

import re
import subprocess
import sys
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
import pytest
from urdf_chains import write_balls, write_chain

import pbonet.modules
from pbonet import Subsystem
from pbonet.config import Library
from pbonet.master.configuration import Place
from pbonet.master.console import run
from pbonet.pbo import describe
from pbonet.testing import rerun, verify

if TYPE_CHECKING:
    from pbonet.pbo import ModuleInfo

FOLDER = Path(pbonet.modules.__file__).parent
POSE = "1 0 0 0.1  0 1 0 0.2  0 0 1 0.3"
INIT = {"X_DES": POSE, "X_REF": POSE, "X_MEZ": POSE, "ACC": "0 0 9.80665"}
"""First values of variables, by the port's name; 0 otherwise."""
SIZES = {"ndof": 3, "nraw": 4, "nz": 4, "naxes": 3, "nx": 2, "nu": 1, "nfeet": 4}
SIZES |= {"n": 2, "m": 1, "ngrip": 2}
OTHER_SIZES = {
    "kalman": {"nz": 1},
    "impedance": {"ndof": 7},
    "pd_grav": {"ndof": 7},
    "jtball": {"ndof": 6},
}
CSV = "0 1 2 3\n1 2 3 4\n2 0 0 0\n"
PANDA, QUADRUPED = "test_panda_demo.py", "test_quadruped_demo.py"
ELSEWHERE = {
    **dict.fromkeys(("computed_torque", "fk_jac", "ik_placo", "mujoco_arm"), PANDA),
    **dict.fromkeys(("whole_body", "whole_body_dyn", "mujoco_quad"), QUADRUPED),
    "contact": QUADRUPED,
    **dict.fromkeys(("forward_kin", "puma_inv_kin"), "test_servoing_demo.py"),
    "grav_comp": "test_servoing_demo.py",
    "visual_ball": "test_camera_servoing_demo.py",
    "mujoco_base": "test_modules_in_jobs.py",
    "gravity": "test_modules_in_jobs.py",
}
"""Modules that run in virtual time in another test, with what they control."""
SYSTEM = {".job", ".rmod"}
"""Files that say which modules an example has."""
REAL = {"mppi_arm": "../../agents/modules/test_mppi.py"}
"""One whose plans come from another process, in real time."""
TWINS = {
    **{f"can_{what}": f"axes_{what}_sim" for what in ("position", "speed", "torque")},
    "dynamixel": "axes_position_sim",
    **{
        name: f"{name}_sim"
        for name in ("encoder", "ft300", "linear_actuator", "linear_sensor", "mpu6050")
    },
}
"""Modules over a device, which no simulation opens, and those that simulate them."""
LINKS = "mav_", "tbuf_"
"""Beginnings of the names of those over a link, which no simulation opens."""
RMODS = sorted(
    path.stem
    for path in FOLDER.glob("*/*.py")
    if not path.stem.startswith(("_", *LINKS))
    and path.stem not in {*ELSEWHERE, *REAL, *TWINS}
)
ROBOTS = {"com_zmp": write_chain, "self_collision": write_balls}
"""What writes the URDF file that a module needs."""


class Variables:
    """The variables that tasks need, and a task that writes those of nobody else."""

    def __init__(self, folder: Path) -> None:
        self.folder, self.text, self.ports = folder, [], []
        self.seen: dict[str, int] = {}  # the line of its unit

    def add(self, rmod, info: ModuleInfo, sizes: dict[str, int], written=()) -> None:
        for port in info.ports:
            name = rmod.svar_name(port.name)
            if name in self.seen:
                if port.unit != "any":
                    self.text[self.seen[name]] = f"UNITS {port.unit}"
                continue
            self.seen[name] = len(self.text) + 3
            shape = tuple(sizes.get(d, d) for d in port.shape)
            count = int(np.prod(shape, initial=1))
            kind = "int" if port.type == "int" else "double"
            unit = "none" if port.unit == "any" else port.unit
            value = INIT.get(port.name, f"{sizes['ndof'] if name == 'NDOF' else 0}")
            lines = [f"NAME {name}", f"TYPE {kind}", "DESC of a test", f"UNITS {unit}"]
            lines += [f"NELEM {count}"]
            if not port.kind.is_const:
                lines += [f"INIT {value}"]
            self.text += [*lines, ""]
            if port.kind.is_input and name not in written:
                self.ports.append((name, port, shape, unit, value))

    def write(self) -> None:
        """Write the table, and the module `source` with its RMOD."""
        (self.folder / "t.svar").write_text("\n".join([*self.text, "EOF\n"]))
        body, start, names = [], [], {"const": [], "var": []}
        for k, (name, port, shape, unit, value) in enumerate(self.ports):
            kind = "OutConst" if port.kind.is_const else "OutVar"
            names["const" if port.kind.is_const else "var"].append(name)
            size = ",".join(map(str, shape)) or "1"
            size = f"n{k}" if shape == (1,) else size
            hint = {(): port.type}.get(shape, f"NDArray[np.{port.type.strip('[]')}]")
            body.append(
                f'    p{k}: A[{hint}, {kind}("{name}", "{size}", "{unit}", "x")]'
            )
            if port.kind.is_const:
                start.append(f"        self.p{k} = {value}")
        text = [
            "from typing import Annotated as A",
            "import numpy as np",
            "from numpy.typing import NDArray",
            "from pbonet import OutConst, OutVar, PortBasedObject",
            "class Source(PortBasedObject):",
            '    """Writes what others read."""',
            *body,
            "    def init(self) -> None:",
            *(start or ["        pass"]),
            "    def cycle(self, dt: float) -> None:",
            "        pass\n",
        ]
        (self.folder / "source.py").write_text("\n".join(text))
        lists = {key: " ".join(found) or "none" for key, found in names.items()}
        rmod = (
            f"MODULE source\nDESC x\nINCONST none\nOUTCONST {lists['const']}\n"
            f"INVAR none\nOUTVAR {lists['var']}\nTASKTYPE periodic\nFREQ 100\nEOF\n"
        )
        (self.folder / "source.rmod").write_text(rmod)


def job(folder: Path, tasks: list[str], spares=(), sizes=None) -> Subsystem:
    """Open a job of these RMODs; `spares` are written for, and not in the job."""
    library, variables = Library([folder]), Variables(folder)
    found = []
    for name in [*tasks, *spares]:
        places = [folder / f"{name}.rmod", *FOLDER.glob(f"*/{name}.rmod")]
        rmod = library.read_rmod(next(place for place in places if place.is_file()))
        found.append((rmod, describe(library.load_rmod(rmod).cls)))
    written = {rmod.svar_name(one) for rmod, _ in found for one in rmod.outvar}
    for rmod, info in found:
        variables.add(rmod, info, {**SIZES, **(sizes or {})}, written)
    variables.write()
    (folder / "t.sbs").write_text("SUBSYSTEM t\nSVARFILE t.svar\nRTPU a\nEOF\n")
    all_tasks = ["source", *tasks] if variables.ports else tasks
    lines = "".join(f"TASK {name} a\n" for name in all_tasks)
    (folder / "t.job").write_text(f"JOB t\nDESC t\nSBS t.sbs\n{lines}EOF\n")
    return Subsystem(folder / "t.job", libraries=[folder], virtual=True)


@pytest.mark.parametrize("name", RMODS)
def test_a_module_runs_with_its_rmod(tmp_path, monkeypatch, name: str) -> None:
    monkeypatch.chdir(tmp_path)
    Path("trajectory.csv").write_text(CSV, encoding="ascii")
    if name in ROBOTS:
        ROBOTS[name](tmp_path, SIZES["ndof"])
    with job(tmp_path, [name], sizes=OTHER_SIZES.get(name)) as system:
        system.start()
        system.wait(0.2)
        assert {one.state for one in system.status_all()} == {"ON"}
        outputs = list(system.simulation.recording.arrays(name).values())
        assert len(outputs[0]) >= 5
        assert all(np.isfinite(rows).all() for rows in outputs)


def test_all_others_run_elsewhere_or_have_a_twin() -> None:
    files = {path.stem for path in FOLDER.glob("*/*.py")}
    assert files >= {*ELSEWHERE, *REAL, *TWINS}
    assert set(TWINS.values()) <= set(RMODS)
    here = Path(__file__).parent
    assert all((here / place).is_file() for place in {**ELSEWHERE, **REAL}.values())
    for name, place in ELSEWHERE.items():
        if place != Path(__file__).name:
            example = place.removeprefix("test_").removesuffix("_demo.py")
            files = (FOLDER.parents[1] / "examples" / example).glob("*.*")
            text = "\n".join(one.read_text() for one in files if one.suffix in SYSTEM)
            assert re.search(rf"^(TASK|MODULE) +{name}\b", text, re.MULTILINE), name


def test_a_replay_names_the_files_of_robots_and_trajectories_that_changed(tmp_path):
    """What a module read in `init`, whether it is run again alone or all together."""
    chain = write_chain(tmp_path, SIZES["ndof"])
    motion = tmp_path / "trajectory.csv"
    motion.write_text(CSV)
    with job(tmp_path, ["gravity", "traj_play"]):
        pass  # its files are there
    place = Place(libraries=(str(tmp_path),))
    path = tmp_path / "t.job"
    runs = tmp_path / "runs"
    log = run(path, place, seconds=0.3, sim=True, runs=runs, quiet=True).log
    assert all(one.good and not one.changed for one in verify(log))
    chain.path.write_text(chain.path.read_text() + "<!-- the same robot -->\n")
    motion.write_text(CSV.replace("1 2 3 4", "1 5 3 4"))
    verdicts = {one.task: one for one in verify(log)}
    assert verdicts["gravity"].good, "the robot is as it was, and the file is named"
    told = str(verdicts["gravity"])
    assert re.search(rf"{chain.path} has changed: \w{{12}} to \w{{12}}$", told)
    assert verdicts["traj_play"].differs
    assert f"{motion} has changed: " in str(verdicts["traj_play"])
    assert verdicts["source"].changed == []
    together = {one.task: one for one in rerun(log).tasks}
    assert f"{chain.path} has changed: " in str(together["gravity"])
    motion.unlink()
    verdicts = {one.task: one for one in verify(log)}
    assert f"{motion} is gone" in str(verdicts["traj_play"])


SPLINE = """MODULE spline
DESC the same joints, by points
SVARALIAS Y=Q_REF
SVARALIAS Y^=Q^_REF
SVARALIAS Y^^=Q^^_REF
INCONST NDOF
OUTCONST none
INVAR none
OUTVAR Y Y^ Y^^
TASKTYPE periodic
FREQ 500
LOCAL
TIME 1.0 2.0
POINTS 0.2 0.1 0.0  0.0 0.0 0.0
EOF
"""


def test_a_run_in_virtual_time_ends_without_words_of_a_library(tmp_path) -> None:
    """What modules have of one is freed before it counts what is left."""
    with job(tmp_path, ["otg"]):
        pass  # its files are there
    words = ["run", str(tmp_path / "t.job"), "--sim", "--seconds", "0.1"]
    words += ["--library", str(tmp_path)]
    ended = subprocess.run(
        [sys.executable, "-m", "pbonet.cli", *words],
        capture_output=True,
        text=True,
        cwd=tmp_path,
        check=True,
    )
    assert ended.stderr == ""


def test_a_swap_of_trajectories_in_motion_does_not_jump(tmp_path) -> None:
    """From `otg` to a spline and back, with position and velocity continuous."""
    (tmp_path / "goal.rmod").write_text(
        "MODULE constant\nDESC goal\nSVARALIAS Y=Q_DES\nINCONST NDOF\nOUTCONST none\n"
        "INVAR none\nOUTVAR Y\nTASKTYPE periodic\nFREQ 50\nLOCAL\nVALUE 2.0\nEOF\n"
    )
    (tmp_path / "points.rmod").write_text(SPLINE)
    with job(tmp_path, ["goal", "otg"], spares=["points"]) as system:
        system.start()
        system.wait(0.8)
        system.spawn("points", "a")
        system.swap("otg", "points")
        system.wait(0.5)
        system.swap("points", "otg")
        system.wait(4.0)
        recording = system.simulation.recording
        q, v = (recording.series(name)[1] for name in ("Q_REF", "Q^_REF"))
        assert not [one for one in system.events() if one.code == "ERROR"]
    assert np.abs(v[350:450]).max() > 0.8, "in motion"
    assert np.abs(np.diff(q, axis=0)).max() < 0.0021 * np.abs(v).max()
    assert np.abs(np.diff(v, axis=0)).max() < 0.002 * 20.0
    assert q[-1] == pytest.approx([2.0] * 3, abs=1e-9)


CART = Path(__file__).parents[3] / "benchmarks" / "cart.xml"


def test_a_simulated_base_drives_and_is_located(tmp_path, monkeypatch) -> None:
    """`diff_drive`, `mujoco_base` and `ekf_odom` together, as they are connected."""
    monkeypatch.setitem(INIT, "X_MEZ", "1 0 0 0  0 1 0 0  0 0 1 0.1")
    pytest.importorskip("mujoco", reason="pip install 'pbonet[mujoco]'")
    ends = "TASKTYPE periodic\nFREQ 500\n"
    files = {
        "go": "MODULE constant\nDESC x\nSVARALIAS Y=V_DES\nINCONST NDOF\n"
        f"OUTCONST none\nINVAR none\nOUTVAR Y\n{ends}LOCAL\nVALUE 0.4 0.0 0.3\nEOF\n",
        "wheels": "MODULE diff_drive\nDESC x\nSVARALIAS X_MEZ=X_ODO\nINCONST none\n"
        f"OUTCONST none\nINVAR V_DES W_MEZ\nOUTVAR W_REF X_MEZ V_MEZ\n{ends}"
        "LOCAL\nRADIUS 0.1\nTRACK 0.4\nEOF\n",
        "base": "MODULE mujoco_base\nDESC x\nINCONST none\nOUTCONST none\nINVAR W_REF\n"
        f"OUTVAR W_MEZ GYR X_FIX X^_FIX\n{ends}CRITICAL\nLOCAL\nMODEL {CART}\n"
        "WHEELS left right\nGAIN 1.5\nEOF\n",
        "located": "MODULE ekf_odom\nDESC x\nINCONST none\nOUTCONST none\n"
        f"INVAR V_MEZ GYR X_FIX\nOUTVAR X_MEZ X_COV\n{ends}EOF\n",
    }
    for name, text in files.items():
        (tmp_path / f"{name}.rmod").write_text(text)
    sizes = {"nwheels": 2}
    with job(tmp_path, ["go", "base", "wheels", "located"], sizes=sizes) as system:
        system.start()
        system.wait(1.0)
        recording = system.simulation.recording
        assert not [one for one in system.events() if one.code == "ERROR"]
        truth, found = (recording.series(name)[1] for name in ("X_FIX", "X_MEZ"))
        assert truth[-1][3] > 0.3, "it drives"
        assert found[-1] == pytest.approx(truth[-1], abs=0.03)
        system.off("wheels")
        system.wait(1.0)
        rates = recording.series("W_MEZ")[1]
        assert np.abs(rates[-1]).max() < 0.1, "and stands when nothing drives it"
