"""Joint teleoperation of a PUMA 560 on two RTPUs, from start to a plot (Figure 6.10).

    python examples/puma/demo.py [--seconds 15] [--sim]

Runs the job `puma.job` with live status, then sums up what happened: how well the arm
followed, how many cycles ran and how many were missed, what they cost, and how late
they began. The plot shows the reference and the measured angle of every joint, drawn
from every cycle. Both are made from the recording alone, so `--from FILE` shows an old
one.
"""

from __future__ import annotations

import argparse
import subprocess
import sys
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from pbonet.errors import PbonetError
from pbonet.log import STABLE, Cycles, Log, last_run

Floats = NDArray[np.float64]

HERE = Path(__file__).parent
BUILD = HERE.parents[1] / "build"
JOINTS = ("waist", "shoulder", "elbow", "wrist turn", "wrist bend", "flange")


def run(seconds: float, runs: Path, *, sim: bool) -> Path:
    """Run the job; return its log, or exit with its status when it fails."""
    command = [sys.executable, "-m", "pbonet.cli", "run", str(HERE / "puma.job")]
    command += ["--seconds", f"{seconds:g}", "--runs", str(runs)]
    if sim:
        command.append("--sim")
    status = subprocess.run(command, check=False).returncode
    if status:
        sys.exit(status)
    return last_run(runs)


def tracking(recording: Cycles) -> tuple[Floats, Floats, Floats, Floats]:
    """Return time (s), reference, measured angle (rad) and their difference.

    There is one row for each servo cycle; the reference is the newest that had been
    written when the cycle was released.
    """
    time, measured = recording.series("Q_MEZ")
    written, references = recording.series("Q_REF")
    newest = np.searchsorted(written, time, side="right") - 1
    both = newest >= 0
    reference = references[newest[both]]
    return time[both], reference, measured[both], measured[both] - reference


def without_cycle(release_ns: NDArray[np.int64], period_ns: float) -> int:
    """Return how many releases have no cycle, where nobody counted: in a simulation."""
    return int(np.sum(np.round(np.diff(release_ns) / period_ns) - 1))


def task_table(recording: Cycles) -> list[str]:
    """Return one line for each task: cycles, misses, CPU time, delay of the start."""
    lines = [
        "task        cycles    Hz  missed  stable | CPU us/cycle    p99    max"
        " | start us p50    p99    max"
    ]
    counted = recording.missed()
    for task in recording.tasks:
        cycles = recording.arrays(task)
        release = cycles["release_ns"]
        if not np.any(np.diff(release)):  # a task without two cycles has no period
            continue
        period = float(np.median(np.diff(release)))
        cpu = cycles["cpu_ns"] / 1e3
        late = (cycles["start_ns"] - release) / 1e3
        stable = int(np.sum(cycles["flags"] & STABLE != 0))
        missed = counted.get(task, without_cycle(release, period))
        lines.append(
            f"{task:10s} {len(release):7d} {1e9 / period:5.0f} "
            f"{missed:7d} {stable:7d} | "
            f"{cpu.mean():12.1f} {np.percentile(cpu, 99):6.0f} {cpu.max():6.0f} | "
            f"{np.percentile(late, 50):12.1f} {np.percentile(late, 99):6.0f} "
            f"{late.max():6.0f}"
        )
    return lines


def joint_table(recording: Cycles) -> list[str]:
    """Return one line for each joint: how far it moved and how well it followed."""
    _, reference, _, error = tracking(recording)
    lines = ["joint        moved deg | error mrad rms    max"]
    for k, name in enumerate(JOINTS):
        moved = np.degrees(np.ptp(reference[:, k]))
        rms, worst = np.sqrt(np.mean(error[:, k] ** 2)), np.abs(error[:, k]).max()
        lines.append(f"{name:12s} {moved:9.1f} | {1e3 * rms:14.2f} {1e3 * worst:6.1f}")
    return lines


def plot(recording: Cycles, file: Path) -> None:
    """Draw reference, measured angle and their difference for every joint."""
    import matplotlib as mpl

    mpl.use("Agg")
    import matplotlib.pyplot as plt

    time, reference, measured, error = tracking(recording)
    drawn: Any = plt.subplots(  # matplotlib's own types are incomplete
        len(JOINTS), 2, figsize=(13, 13), sharex=True, width_ratios=(2, 1)
    )
    figure, axes = drawn
    for k, name in enumerate(JOINTS):
        left, right = axes[k]
        left.step(
            time,
            np.degrees(reference[:, k]),
            where="post",
            color="0.65",
            linewidth=3.0,
            label="reference (Q_REF)",
        )
        left.plot(
            time,
            np.degrees(measured[:, k]),
            color="tab:blue",
            linewidth=1.0,
            label="measured (Q_MEZ)",
        )
        left.set_ylabel(f"{k + 1} {name}, deg")
        right.plot(time, 1e3 * error[:, k], color="tab:red", linewidth=0.7)
        right.set_ylabel("error, mrad")
        for axis in (left, right):
            axis.grid(visible=True, alpha=0.3)
            axis.margins(x=0.0)
    axes[0, 0].legend(loc="best")
    for axis in axes[-1]:
        axis.set_xlabel("time, s")
    rms = 1e3 * np.sqrt(np.mean(error**2))
    figure.suptitle(
        f"PUMA 560, joint teleoperation: {len(time)} servo cycles, "
        f"error {rms:.1f} mrad rms over all joints"
    )
    figure.tight_layout()
    file.parent.mkdir(parents=True, exist_ok=True)
    figure.savefig(file, dpi=100)
    plt.close(figure)


def main(argv: list[str] | None = None) -> None:
    """Run, sum up, plot."""
    words = argparse.ArgumentParser(description=(__doc__ or "").split("\n\n")[0])
    words.add_argument("--seconds", type=float, default=15.0, help="how long")
    words.add_argument("--sim", action="store_true", help="in virtual time")
    words.add_argument("--from", dest="old", type=Path, help="show this log")
    words.add_argument("--runs", type=Path, default=BUILD / "runs", help="of logs")
    words.add_argument("--plot", type=Path, default=BUILD / "puma.png")
    told = words.parse_args(argv)
    file = told.old or run(told.seconds, told.runs, sim=told.sim)
    try:
        recording = Log(file)
        if not len(tracking(recording)[0]):
            sys.exit(f"demo: no reference was written in {file}; let it run longer")
    except PbonetError as error:
        sys.exit(f"demo: {error}")
    plot(recording, told.plot)
    tasks = [*task_table(recording), ""] if told.old else []  # a run has said it
    lines = ["", *tasks, *joint_table(recording), ""]
    lines += [f"every cycle: {file}", f"plot:        {told.plot}", ""]
    sys.stdout.write("\n".join(lines))


if __name__ == "__main__":
    main()
