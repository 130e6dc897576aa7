"""How much memory a machine needs: an agent, and a job that runs on it.

The share of all memory (PSS) of every process is printed: pages that several processes
have in common are divided among them. First a job of four small tasks of numpy, then
the PUMA's. A task is compared with a bare interpreter which imports its module at the
same time. Page faults of a task are counted in its first 3 seconds, and in the next 3:
what it shares with the fork server is copied when a cycle first writes it.
Status 3: a goal was missed.

Other programs of Python that use the same files make all figures smaller.

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
LATER = 0
"""Goal: page faults of a task after that."""
MOST_TASK, MOST_MACHINE = 15.0, 150.0
"""Goals in MB: a task above what its module imports; a machine with four tasks."""


class Row(NamedTuple):
    """A process."""

    name: str
    mb: float
    imports: float | None = None
    """PSS of an interpreter that imports the module, in MB; for tasks only."""
    faults: tuple[int, int] = (0, 0)
    """Page faults at the start, and later; of tasks only."""


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


def rows(
    run: Path, modules: dict[str, str], folder: Path, subsystem: Subsystem
) -> list[Row]:
    """Let a job run; return the processes of a runtime folder."""
    first = faults(subsystem)
    later = {name: n - first[name] for name, n in faults(subsystem).items()}
    found: list[Row] = []
    for pid, role in sorted(processes(run).items()):
        name = Path(f"/proc/{pid}/comm").read_text().strip()
        imports = None
        if name in modules:
            bare = importer(modules[name], folder)
            imports = memory(bare.pid)[1] / 1024
            bare.communicate("")
        mb = memory(pid)[1] / 1024
        if imports:
            found.append(Row(name, mb, imports, (first[name], later[name])))
        else:
            found.append(Row(role, mb))
    return found


def faults(subsystem: Subsystem) -> dict[str, int]:
    """Let a job run; return how many page faults each task has had since its `on`."""
    subsystem.wait(SETTLED)
    return {one.task: one.faults for one in subsystem.status()}


def small(run: Path, folder: Path) -> list[Row]:
    """Run four small tasks on one RTPU."""
    sbs = write_files(folder, SMALL, 1e-5)
    with Embedded("default", libraries=[str(folder)]) as agents:
        agents.start([RTPU])
        with Subsystem(sbs, warned=lambda _text: None) as subsystem:
            for task in SMALL:
                subsystem.spawn(task, RTPU)
            subsystem.reconfig([(task, "on") for task in SMALL])
            return rows(run, dict.fromkeys(SMALL, "computes"), folder, subsystem)


def puma(run: Path, folder: Path) -> list[Row]:
    """Run the PUMA's job on two RTPUs."""
    with Embedded("default") as agents:
        agents.start(["arm0", "arm1"])
        with Subsystem(PUMA / "puma.job", warned=lambda _text: None) as subsystem:
            subsystem.start()
            return rows(run, PUMA_MODULES, folder, subsystem)


def show(title: str, found: Sequence[Row]) -> None:
    """Print a table."""
    heads = f"{'PSS MB':>8} {'its imports':>12} {'above':>8} {'faults':>8} {'later':>6}"
    print(f"\n{title}\n{'process':20} {heads}")
    for one in found:
        more = ""
        if one.imports:
            more = f"{one.imports:12.1f} {one.mb - one.imports:8.1f}"
            more += f" {one.faults[0]:8} {one.faults[1]:6}"
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
        rtbench.verdict(
            "page faults of a task after 3 s",
            max(one.faults[1] for one in (*first, *second)),
            LATER,
        ),
    ])


if __name__ == "__main__":
    main()
