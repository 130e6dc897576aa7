"""How much memory a machine needs: an agent, and a job that runs on it.

The share of all memory (PSS) of every process is printed: pages that several processes
have in common are divided among them. First a job of four small tasks of numpy, then
the PUMA's. A task is compared with a bare interpreter which imports its module at the
same time. Status 3: a goal was missed.

    python -m benchmarks.memory [--json FILE]
"""

from __future__ import annotations

import argparse
import json
import os
import subprocess
import sys
import tempfile
from pathlib import Path
from typing import TYPE_CHECKING, NamedTuple

from benchmarks import rtbench
from benchmarks.equal_tasks import RTPU, write_files
from benchmarks.kills import processes
from benchmarks.soak import memory
from pbonet.master import Subsystem
from pbonet.master.subsystem.embedded_agents import Embedded

if TYPE_CHECKING:
    from collections.abc import Sequence

PUMA = Path(__file__).resolve().parents[1] / "examples" / "puma"
PUMA_MODULES = {
    "puma_pidg": "pbonet.modules.robot_interfaces.puma_pidg, pinocchio",
    "grav_comp": "pbonet.modules.controllers.grav_comp, pinocchio",
    "qrdiff": "pbonet.modules.signals.diff",
    "jttrace": "pbonet.modules.teleoperation.jtball",
}
"""What each task's module imports, some of it in `init`."""
SMALL = ("task1", "task2", "task3", "task4")
SETTLED = 3.0
"""Seconds for which a job runs before its memory is read."""
MOST_TASK, MOST_MACHINE = 15.0, 150.0
"""Goals in MB: a task above what its module imports; a machine with four tasks."""


class Row(NamedTuple):
    """A process."""

    name: str
    mb: float
    imports: float | None = None
    """PSS of an interpreter that imports the module, in MB; for tasks only."""


def importer(module: str, folder: Path) -> subprocess.Popen[str]:
    """Start an interpreter that imports a module, and waits."""
    code = f"import sys, {module}; print(flush=True); sys.stdin.read()"
    process = subprocess.Popen(
        [sys.executable, "-c", code],
        stdin=subprocess.PIPE,
        stdout=subprocess.PIPE,
        text=True,
        env={**os.environ, "PYTHONPATH": str(folder), "PBONET_RUN_DIR": "/"},
    )
    assert process.stdout is not None
    process.stdout.readline()
    return process


def rows(run: Path, modules: dict[str, str], folder: Path) -> list[Row]:
    """Return the processes of a runtime folder."""
    found: list[Row] = []
    for pid, role in sorted(processes(run).items()):
        name = Path(f"/proc/{pid}/comm").read_text().strip()
        imports = None
        if name in modules:
            bare = importer(modules[name], folder)
            imports = memory(bare.pid)[1] / 1024
            bare.communicate("")
        found.append(Row(name if imports else role, memory(pid)[1] / 1024, imports))
    return found


def small(run: Path, folder: Path) -> list[Row]:
    """Run four small tasks on one RTPU."""
    sbs = write_files(folder, SMALL, 1e-5)
    with Embedded("default", libraries=[str(folder)]) as agents:
        agents.start([RTPU])
        with Subsystem(sbs, warned=lambda _text: None) as subsystem:
            for task in SMALL:
                subsystem.spawn(task, RTPU)
            subsystem.reconfig([(task, "on") for task in SMALL])
            subsystem.wait(SETTLED)
            return rows(run, dict.fromkeys(SMALL, "computes"), folder)


def puma(run: Path, folder: Path) -> list[Row]:
    """Run the PUMA's job on two RTPUs."""
    with Embedded("default") as agents:
        agents.start(["arm0", "arm1"])
        with Subsystem(PUMA / "puma.job", warned=lambda _text: None) as subsystem:
            subsystem.start()
            subsystem.wait(SETTLED)
            return rows(run, PUMA_MODULES, folder)


def show(title: str, found: Sequence[Row]) -> None:
    """Print a table."""
    print(f"\n{title}\n{'process':20} {'PSS MB':>8} {'its imports':>12} {'above':>8}")
    for one in found:
        more = f"{one.imports:12.1f} {one.mb - one.imports:8.1f}" if one.imports else ""
        print(f"{one.name:20} {one.mb:8.1f} {more}".rstrip())
    print(f"{'together':20} {sum(one.mb for one in found):8.1f}")


def main() -> None:
    """Measure, print the tables, and judge."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--json", type=Path)
    asked = parser.parse_args()
    os.environ.pop("PYTHONDONTWRITEBYTECODE", None)  # as for a user's program
    with tempfile.TemporaryDirectory(prefix="pbonet-", dir="/tmp") as name:
        folder = Path(name)
        os.environ["PBONET_RUN_DIR"] = str(folder / "run")
        os.chdir(folder)  # for the logs
        first = small(folder / "run", folder)
        second = puma(folder / "run", folder)
    print(rtbench.machine())
    show("four small tasks", first)
    show("PUMA", second)
    if asked.json:
        result = [[one._asdict() for one in found] for found in (first, second)]
        asked.json.write_text(json.dumps(result, indent=1), encoding="utf-8")
    above = [one.mb - one.imports for one in (*first, *second) if one.imports]
    rtbench.judge([
        rtbench.verdict("MB of a task above its imports", max(above), MOST_TASK),
        rtbench.verdict(
            "MB of a machine with four small tasks",
            sum(one.mb for one in first),
            MOST_MACHINE,
        ),
    ])


if __name__ == "__main__":
    main()
