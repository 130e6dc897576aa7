"""A quadruped stands, squats by 5 cm, and is pushed to the side.

    python examples/quadruped/demo.py [--sim]

Runs `squat.job`: whole-body control at 500 Hz. After the squat the robot is pushed by
20 N for 0.2 s. What is printed is how far the body was from where it should be, how
deep it went, what the push did, and whether the robot still stands; if not, the program
ends with 1.
"""

from __future__ import annotations

import argparse
import os
import sys
from math import acos, degrees
from pathlib import Path
from typing import TYPE_CHECKING, NamedTuple

import numpy as np
from numpy.typing import NDArray

from pbonet import Subsystem
from pbonet.errors import PbonetError, StateError

if TYPE_CHECKING:
    from pbonet.log import Cycles

Floats = NDArray[np.float64]

JOB = Path(__file__).parent / "squat.job"
PUSH = "0 -20 0"
"""N, to the robot's right."""
PUSHED, SECONDS = 3.5, 5.5
"""When the push begins, and how long a run lasts; the squat is over after 3 s."""
LOW, TILTED = 0.2, 30.0
"""m and degrees: a body that was lower, or more tilted, has fallen."""


class Result(NamedTuple):
    """What became of a run."""

    rms: float
    """How far the body was from where it should be before the push, mm."""
    depth: float
    """How deep the body went, mm."""
    away: float
    """How far the push moved the body, mm."""
    left: float
    """How far from where it should be the body was in the end, mm."""
    tilt: float
    """The largest tilt of the body, degrees."""
    feet: int
    """The fewest feet that touched the floor, as `contact` saw it from the torques."""
    lost: dict[str, int]
    """Cycles that tasks missed, as their RTPU counted."""
    stands: bool
    """Whether it stood all the time."""


def run(*, sim: bool) -> Cycles:
    """Run the job with the push; return every cycle."""
    robot = Subsystem(JOB, domain=f"quad{os.getpid()}", embed=not sim, virtual=sim)
    robot.open()
    try:
        robot.start()
        begin = robot.clock.now()
        robot.wait(PUSHED)
        robot.set("robot", "push", PUSH)
        robot.wait(max(0.0, SECONDS - (robot.clock.now() - begin)))
    finally:
        robot.finish()
    if robot.simulation is not None:
        return robot.simulation.recording
    log = robot.recordings.log()
    if log is None:
        raise StateError("the job was never started", where=robot.name)
    return log


def bodies(recording: Cycles) -> tuple[Floats, Floats, Floats]:
    """Return time (s), and where the body was and should have been, [k, 3, 4] each."""
    time, measured = recording.series("X_MEZ")
    told, desired = recording.series("X_BODY_DES")
    newest = np.searchsorted(told, time, side="right") - 1
    both = newest >= 0
    wanted = desired[newest[both]].reshape(-1, 3, 4)
    return time[both] - time[0], measured[both].reshape(-1, 3, 4), wanted


def judge(recording: Cycles) -> Result:
    """Return what became of a run."""
    time, there, wanted = bodies(recording)
    far: Floats = 1e3 * np.linalg.norm(there[:, :, 3] - wanted[:, :, 3], axis=1)
    height = there[:, 2, 3]
    before = time < PUSHED
    tilt = degrees(acos(float(np.clip(there[:, 2, 2].min(), -1.0, 1.0))))
    return Result(
        rms=float(np.sqrt((far[before] @ far[before]) / before.sum())),
        depth=1e3 * float(height[0] - height[before].min()),
        away=float(far[~before].max()),
        left=float(far[-1]),
        tilt=tilt,
        feet=int(recording.series("CONTACT")[1].sum(axis=1).min()),
        lost=recording.missed(),
        stands=bool(height.min() > LOW) and tilt < TILTED,
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
        f"body from its way       {result.rms:.2f} mm RMS, before the push\n"
        f"depth of the squat      {result.depth:.1f} mm\n"
        f"pushed away by          {result.away:.1f} mm; {result.left:.1f} in the end\n"
        f"largest tilt            {result.tilt:.1f} degrees\n"
        f"feet that touched       at least {result.feet} of 4\n"
        f"cycles missed           {lost}\n"
        f"verdict                 {'it stands' if result.stands else 'IT FELL'}\n"
    )
    if not result.stands:
        sys.exit(1)


if __name__ == "__main__":
    main()
