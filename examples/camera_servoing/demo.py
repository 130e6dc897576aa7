"""A PUMA 560 follows a ball that a camera on its hand sees, in pictures that are drawn.

    python examples/camera_servoing/demo.py [--sim] [--pictures FOLDER]

The ball goes round twice. In the first round `target` reports it, as a camera would
that sees everything 80 ms late. Then `eye` takes its place, while the arm moves: it has
pictures drawn of what the hand's camera sees, in a process beside the tasks, and looks
for the ball in them. What is printed is how well the point ahead of the hand followed
the ball in each round, how old the pictures were, and which cycles were missed.
"""

from __future__ import annotations

import argparse
import os
import sys
from importlib import import_module
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from pbonet import Subsystem
from pbonet.errors import PbonetError, StateError
from pbonet.io import MujocoCamera

if TYPE_CHECKING:
    from pbonet.log import Cycles

Floats = NDArray[np.float64]

HERE = Path(__file__).parent
JOB = HERE / "simulated.job"
AGENT = HERE / "agent.toml"
BUILD = HERE.parents[1] / "build"
TARGET, EYE = ["target"], ["eye"]
ROUND = 11.0
"""Seconds in which the ball goes round."""
AHEAD = 0.4
"""How far before the hand the ball is to be, m."""
SETTLED = 1.0
"""Seconds after the start and after the swap that are not judged."""
CAMERAS = "eye", "side"
SIZE = 320, 240
"""Width and height of the pictures that are kept, pixels."""
KEPT = (3.0, 5.5, 8.0)
"""When pictures are kept, s after the swap."""


class Round(NamedTuple):
    """How well one round was followed."""

    title: str
    rms: float
    """Distance of the point ahead of the hand from the ball, mm, RMS."""
    far: float
    """The most of it, mm."""


def run(*, sim: bool) -> Cycles:
    """Run both rounds; return every cycle."""
    arm = Subsystem(
        JOB,
        domain=f"camera{os.getpid()}",
        embed=False if sim else AGENT,
        virtual=sim,
    )
    arm.open()
    try:
        arm.start()
        arm.spawn("eye", "arm1")
        arm.wait(ROUND)
        arm.swap(TARGET, EYE)
        arm.wait(ROUND)
    finally:
        arm.finish()
    if arm.simulation is not None:
        return arm.simulation.recording
    log = arm.recordings.log()
    if log is None:
        raise StateError("the job was never started", where=arm.name)
    return log


def swapped(recording: Cycles) -> float:
    """Return when `eye` was turned on, s after the first cycle of any task."""
    first = int(recording.arrays("eye")["release_ns"][0])
    return (first - recording.begin_ns) * 1e-9


def way_of_ball(recording: Cycles) -> tuple[Floats, Floats]:
    """Return time (s), and where the ball was, m."""
    time, poses = recording.series("X_BALL")
    return time, poses.reshape(-1, 3, 4)[:, :, 3]


def distance(recording: Cycles) -> tuple[Floats, Floats]:
    """Return time (s), and how far the ball was from ahead of the hand (mm)."""
    time, poses = recording.series("X_MEZ")
    told, ball = way_of_ball(recording)
    newest = np.searchsorted(told, time, side="right") - 1
    both = newest >= 0
    pose = poses[both].reshape(-1, 3, 4)
    ahead = pose[:, :, 3] + AHEAD * pose[:, :, 2]
    return time[both], 1e3 * np.linalg.norm(ahead - ball[newest[both]], axis=1)


def judge(recording: Cycles) -> list[Round]:
    """Return how well each round was followed."""
    time, far = distance(recording)
    when = swapped(recording)
    first = far[(time > SETTLED) & (time < when)]
    second = far[time > when + SETTLED]
    return [
        Round(title, float(np.sqrt(np.mean(one**2))), float(one.max()))
        for title, one in (("simulated", first), ("drawn", second))
    ]


def table(recording: Cycles) -> list[str]:
    """Return what is printed."""
    eye = recording.arrays("eye")
    ages = 1e3 * np.sort(eye["SIGHT_AGE"].ravel())
    lasted = (int(eye["release_ns"][-1]) - int(eye["release_ns"][0])) * 1e-9
    rate = eye["PICTURE"].max() / lasted
    missed = recording.missed()
    lost = ", ".join(f"{task} {n}" for task, n in missed.items() if n) or "none"
    return [
        "camera       ball from where it should be, mm: RMS    largest",
        *(f"{one.title:12s}{one.rms:35.1f}{one.far:11.1f}" for one in judge(recording)),
        f"pictures     {rate:.1f} per second",
        f"age of what X_DES is made of, ms: median {np.median(ages):.0f}, "
        f"99 of 100 at most {ages[int(0.99 * len(ages))]:.0f}, largest {ages[-1]:.0f}",
        f"cycles missed: {lost}",
    ]


def plot(recording: Cycles, file: Path) -> None:
    """Draw the distance, the age of the pictures, and the way of ball and hand."""
    import matplotlib as mpl

    mpl.use("Agg")
    import matplotlib.pyplot as plt

    drawn: Any = plt.subplots(3, 1, figsize=(9, 8), sharex=True)
    figure, axes = drawn
    time, far = distance(recording)
    axes[0].plot(time, far, linewidth=1.0)
    axes[0].set_ylabel("ball from where\nit should be, mm")
    told, age = recording.series("SIGHT_AGE")
    axes[1].plot(told, 1e3 * age, linewidth=1.0)
    axes[1].set_ylabel("age of the picture, ms")
    told, ball = way_of_ball(recording)
    time, poses = recording.series("X_MEZ")
    pose = poses.reshape(-1, 3, 4)
    ahead = pose[:, :, 3] + AHEAD * pose[:, :, 2]
    for k, name in enumerate("xyz"):
        (line,) = axes[2].plot(told, ball[:, k], linewidth=2.0, alpha=0.5)
        axes[2].plot(time, ahead[:, k], "--", color=line.get_color(), label=name)
    axes[2].set_ylabel("ball, and point ahead\nof the hand (dashed), m")
    axes[2].set_xlabel("time, s")
    axes[2].legend(loc="upper left", fontsize=8)
    for axis in axes:
        axis.grid(visible=True, alpha=0.3)
        axis.axvline(swapped(recording), color="0.4", linestyle="--", linewidth=1.0)
    figure.suptitle("PUMA 560 after a ball: simulated camera, then drawn pictures")
    figure.tight_layout()
    file.parent.mkdir(parents=True, exist_ok=True)
    figure.savefig(file, dpi=100)
    plt.close(figure)


def keep_pictures(recording: Cycles, folder: Path) -> list[Path]:
    """Draw again what the camera saw, with the arm from the side: a file each time."""
    files: Any = import_module("matplotlib.image")  # its types are incomplete
    cameras = [MujocoCamera(HERE / "scene.xml", name, *SIZE) for name in CAMERAS]
    when, joints = recording.series("Q_MEZ")
    told, ball = way_of_ball(recording)
    folder.mkdir(parents=True, exist_ok=True)
    made: list[Path] = []
    for number, after in enumerate(KEPT, 1):
        then = swapped(recording) + after
        place = ball[min(int(np.searchsorted(told, then)), len(ball) - 1)]
        q = joints[min(int(np.searchsorted(when, then)), len(joints) - 1)]
        seen = np.hstack([one.take(q, ball=place) for one in cameras])
        made.append(folder / f"camera_servoing{number}.png")
        files.imsave(made[-1], seen)
    for one in cameras:
        one.close()
    return made


def main(argv: list[str] | None = None) -> None:
    """Run both rounds, sum up, plot."""
    words = argparse.ArgumentParser(description=(__doc__ or "").split("\n\n")[0])
    words.add_argument("--sim", action="store_true", help="in virtual time")
    words.add_argument("--plot", type=Path, default=BUILD / "camera_servoing.png")
    words.add_argument("--pictures", type=Path, help="folder for some of the pictures")
    told = words.parse_args(argv)
    try:
        recording = run(sim=told.sim)
        plot(recording, told.plot)
        made = keep_pictures(recording, told.pictures) if told.pictures else []
    except PbonetError as error:
        sys.exit(f"demo: {error}")
    lines = [*table(recording), *(f"picture: {one}" for one in made)]
    sys.stdout.write("\n".join([*lines, f"plot: {told.plot}", ""]))


if __name__ == "__main__":
    main()
