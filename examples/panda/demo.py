"""A seven-axis arm draws a circle, and its inverse kinematics is swapped meanwhile.

    python examples/panda/demo.py [--sim]

Runs `circle.job` for two rounds. In the middle of the first, damped least squares takes
the place of placo's quadratic program, and half a round later it gives it back; the
other tasks go on. What is printed is how far the hand was from the circle, the largest
step of the reference, and how many cycles of the reference were lost.
"""

from __future__ import annotations

import argparse
import os
import sys
from pathlib import Path
from typing import TYPE_CHECKING, NamedTuple

import numpy as np
from numpy.typing import NDArray

from pbonet import Subsystem
from pbonet.errors import PbonetError, StateError

if TYPE_CHECKING:
    from pbonet.log import Cycles

Floats = NDArray[np.float64]

JOB = Path(__file__).parent / "circle.job"
PLACO, DAMPED = "ik_placo", "ik_damped"
SECONDS = 11.0
"""How long a run lasts: the hand gains speed for 1 s, then a round takes 5 s."""
SWAPS = 3.5, 6.0
"""When the two are exchanged, and when they are exchanged back."""


class Result(NamedTuple):
    """What became of a run."""

    rms: float
    """How far the hand was from where it should be, mm, root of the mean square."""
    far: float
    """The most of it, mm."""
    step: float
    """The largest step of an element of Q_REF from one cycle to the next, rad."""
    gap_ms: float
    """The longest time between two cycles that wrote Q_REF."""
    lost: dict[str, int]
    """Cycles that tasks missed, as their RTPU counted."""


def run(*, sim: bool) -> Cycles:
    """Run the job with the two swaps; return every cycle."""
    arm = Subsystem(JOB, domain=f"panda{os.getpid()}", embed=not sim, virtual=sim)
    arm.open()
    try:
        arm.start()
        arm.spawn(DAMPED, "arm1")
        begin = arm.clock.now()
        arm.wait(SWAPS[0])
        arm.swap(PLACO, DAMPED)
        arm.wait(SWAPS[1] - SWAPS[0])
        arm.swap(DAMPED, PLACO)
        arm.wait(max(0.0, SECONDS - (arm.clock.now() - begin)))
    finally:
        arm.finish()
    if arm.simulation is not None:
        return arm.simulation.recording
    log = arm.recordings.log()
    if log is None:
        raise StateError("the job was never started", where=arm.name)
    return log


def hand(recording: Cycles) -> tuple[Floats, Floats, Floats]:
    """Return time (s), and where the hand was and should have been (m), [k, 3] each."""
    time, measured = recording.series("X_MEZ")
    told, desired = recording.series("X_DES")
    newest = np.searchsorted(told, time, side="right") - 1
    both = newest >= 0
    wanted = desired[newest[both]].reshape(-1, 3, 4)[:, :, 3]
    return time[both], measured[both].reshape(-1, 3, 4)[:, :, 3], wanted


def references(recording: Cycles) -> tuple[NDArray[np.int64], Floats]:
    """Return when Q_REF was written (ns), whichever task did, and what."""
    tasks = [task for task in (PLACO, DAMPED) if task in recording.tasks]
    time = np.concatenate([recording.arrays(task)["release_ns"] for task in tasks])
    value = np.concatenate([recording.arrays(task)["Q_REF"] for task in tasks])
    order = np.argsort(time, kind="stable")
    return time[order], value[order]


def judge(recording: Cycles) -> Result:
    """Return what became of a run."""
    _, there, wanted = hand(recording)
    far: Floats = 1e3 * np.sqrt(((there - wanted) ** 2).sum(axis=1))
    time, value = references(recording)
    return Result(
        rms=float(np.sqrt((far @ far) / len(far))),
        far=float(far.max()),
        step=float(np.abs(np.diff(value, axis=0)).max()),
        gap_ms=float(np.diff(time).max()) * 1e-6,
        lost=recording.missed(),
    )


def main(argv: list[str] | None = None) -> None:
    """Run, and say what became of it."""
    words = argparse.ArgumentParser(description=(__doc__ or "").split("\n\n")[0])
    words.add_argument("--sim", action="store_true", help="in virtual time")
    told = words.parse_args(argv)
    try:
        result = judge(run(sim=told.sim))
    except PbonetError as error:
        sys.exit(f"demo: {error}")
    lost = ", ".join(f"{task} {n}" for task, n in result.lost.items() if n) or "none"
    sys.stdout.write(
        f"hand from the circle    {result.rms:.3f} mm RMS, at most {result.far:.3f}\n"
        f"largest step of Q_REF   {result.step:.2e} rad\n"
        f"longest time without    {result.gap_ms:.1f} ms\n"
        f"cycles missed           {lost}\n"
    )


if __name__ == "__main__":
    main()
