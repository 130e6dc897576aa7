"""Visual servoing of a PUMA 560 past a singularity, with and without a live swap.

    python examples/servoing/demo.py [--sim]

Runs the job `inverse.job` (Stewart 1994, Figure 3.15) twice. The target takes the hand
close to the arm's wrist singularity. In the second run this program watches the
variable SIGMA; where it shrinks, it turns inverse kinematics off and damped least
squares with its integrator on (Figure 3.16), and where it has grown again, back. The
other tasks go on. The plot shows what velocity the joints were asked for and had.
"""

from __future__ import annotations

import argparse
import importlib
import sys
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from pbonet.errors import PbonetError

if TYPE_CHECKING:
    from collections.abc import Callable, Sequence

    from pbonet.log import Cycles

Floats = NDArray[np.float64]

HERE = Path(__file__).parent
JOB = HERE / "inverse.job"
BUILD = HERE.parents[1] / "build"
SECONDS = 7.0
"""How long a run lasts; the target rests from 5.08 s on."""
NEAR, AWAY = 0.2, 0.3
"""SIGMA at which damped least squares takes over, and gives back."""
SPARE = [("damped_ls", "arm1"), ("qrint", "arm1")]
INVERSE, DAMPED = ["puma_inv_kin"], ["damped_ls", "qrint"]
"""The two controllers, each in the order of its data flow."""
AROUND = 0.1
"""Seconds before and after a swap in which missed cycles are counted apart."""
LOOK = 0.02
"""Seconds between two looks at SIGMA."""


class Result(NamedTuple):
    """What became of one run."""

    title: str
    recording: Cycles

    @property
    def swaps(self) -> list[float]:
        """When the controllers were swapped, s after the first cycle of any."""
        if "damped_ls" not in self.recording.tasks:
            return []
        cycles = self.recording.arrays("damped_ls")["release_ns"]
        ends = (*cycles[:1], *cycles[-1:])
        return [(int(one) - self.recording.begin_ns) * 1e-9 for one in ends]


def run(steering: Any, *, swap: bool) -> Result:  # noqa: ANN401 - see steering.py
    """Run the job, with or without swaps."""
    steering.begin(SPARE)
    arm = steering.subsystem
    try:
        if swap:
            if _watch(steering, lambda sigma: sigma < NEAR):
                arm.swap(INVERSE, DAMPED)
            if _watch(steering, lambda sigma: sigma > AWAY):
                arm.swap(DAMPED, INVERSE)
        arm.wait(max(0.0, SECONDS - steering.now()))
    finally:
        recording = steering.end()
    title = "with the swap" if swap else "without a swap"
    return Result(title, recording)


def _watch(steering: Any, passed: Callable[[float], bool]) -> bool:  # noqa: ANN401
    """Wait until SIGMA is as wanted; False when the run is over before."""
    while steering.now() < SECONDS:
        if passed(steering.value("SIGMA")):
            return True
        steering.subsystem.wait(LOOK)
    return False


def tracking(recording: Cycles) -> tuple[Floats, Floats, Floats]:
    """Return time (s), and how far the hand was from the target in mm and degrees.

    The target is where the vision subsystem said last that it is.
    """
    time, measured = recording.series("X_MEZ")
    told, desired = recording.series("X_DES")
    newest = np.searchsorted(told, time, side="right") - 1
    both = newest >= 0
    wanted = desired[newest[both]].reshape(-1, 3, 4)
    there = measured[both].reshape(-1, 3, 4)
    far = np.linalg.norm(wanted[:, :, 3] - there[:, :, 3], axis=1)
    trace = np.einsum("kij,kij->k", wanted[:, :, :3], there[:, :, :3])
    angle = np.arccos(np.clip(0.5 * (trace - 1.0), -1.0, 1.0))
    return time[both], 1e3 * far, np.degrees(angle)


def missed(result: Result) -> dict[str, tuple[int, int]]:
    """Return how many cycles each task that stayed has missed, as its RTPU counted.

    The second number is of those within `AROUND` of a swap, by the distances of cycles;
    so is the first in a simulation, where nobody counts.
    """
    recording, lost = result.recording, dict[str, tuple[int, int]]()
    counted = recording.missed()
    for task in recording.tasks:
        release: NDArray[np.int64] = recording.arrays(task)["release_ns"]
        if task in {*INVERSE, *DAMPED} or len(release) < 2:  # noqa: PLR2004 - no interval
            continue
        gaps = np.diff(release)
        each = np.round(gaps / float(np.median(gaps))) - 1
        time = (release[1:] - recording.begin_ns) * 1e-9
        swaps = np.array(result.swaps)
        near = (np.abs(time[:, None] - swaps) <= AROUND).any(axis=1)
        total = counted.get(task, int(np.sum(each)))
        lost[task] = total, int(np.sum(each[near]))
    return lost


def table(results: Sequence[Result]) -> list[str]:
    """Return what is printed: velocities, errors, missed cycles."""
    lines = [
        "                 joint velocity, rad/s     tracking error    cycles missed by",
        "                 asked for    measured      mm      deg    tasks that stay",
    ]
    for result in results:
        title, recording = result
        asked, had = (
            np.abs(recording.series(name)[1]).max() for name in ("Q^_REF", "Q^_MEZ")
        )
        _, far, angle = tracking(recording)
        lost = missed(result)
        cycles = sum(len(recording.arrays(task)["cycle"]) for task in lost)
        lines.append(
            f"{title:15s} {asked:10.2f} {had:11.2f} {far.max():9.1f} {angle.max():8.1f}"
            f"    {sum(n for n, _ in lost.values())} of {cycles}"
        )
        lines += [f"  swapped at {when:.2f} s" for when in result.swaps]
        lines += [
            f"  {task} missed {n}, of them {k} within {AROUND:g} s of a swap"
            for task, (n, k) in lost.items()
            if n
        ]
    return lines


def plot(results: Sequence[Result], file: Path) -> None:
    """Draw joint velocities and tracking error of both runs beside each other."""
    import matplotlib as mpl

    mpl.use("Agg")
    import matplotlib.pyplot as plt

    drawn: Any = plt.subplots(  # matplotlib's own types are incomplete
        3, len(results), figsize=(12, 9), sharex=True, sharey="row", squeeze=False
    )
    figure, axes = drawn
    for column, result in enumerate(results):
        title, recording = result
        axes[0, column].set_title(title)
        for row, name in enumerate(("Q^_REF", "Q^_MEZ")):
            time, velocity = recording.series(name)
            for joint in range(velocity.shape[1]):
                axes[row, column].plot(
                    time, velocity[:, joint], linewidth=1.0, label=f"joint {joint + 1}"
                )
        time, far, angle = tracking(recording)
        axes[2, column].plot(time, far, label="position, mm")
        axes[2, column].plot(time, angle, label="orientation, deg")
        axes[2, column].set_xlabel("time, s")
        for axis in axes[:, column]:
            axis.grid(visible=True, alpha=0.3)
            for when in result.swaps:
                axis.axvline(when, color="0.4", linestyle="--", linewidth=1.0)
    for row, text in enumerate((
        "joint velocity asked for, rad/s",
        "joint velocity measured, rad/s",
        "tracking error",
    )):
        axes[row, 0].set_ylabel(text)
    axes[0, 0].legend(loc="upper left", fontsize=8)
    axes[2, 0].legend(loc="upper left", fontsize=8)
    figure.suptitle("PUMA 560, visual servoing past the wrist singularity")
    figure.tight_layout()
    file.parent.mkdir(parents=True, exist_ok=True)
    figure.savefig(file, dpi=100)
    plt.close(figure)


def main(argv: list[str] | None = None) -> None:
    """Run twice, sum up, plot."""
    words = argparse.ArgumentParser(description=(__doc__ or "").split("\n\n")[0])
    words.add_argument("--sim", action="store_true", help="in virtual time")
    words.add_argument("--plot", type=Path, default=BUILD / "servoing.png")
    told = words.parse_args(argv)
    sys.path.insert(0, str(HERE))
    steering = importlib.import_module("steering")
    make = steering.Steering
    try:
        results = [run(make(JOB, sim=told.sim), swap=swap) for swap in (False, True)]
    except PbonetError as error:
        sys.exit(f"demo: {error}")
    plot(results, told.plot)
    sys.stdout.write("\n".join([*table(results), f"plot: {told.plot}", ""]))


if __name__ == "__main__":
    main()
