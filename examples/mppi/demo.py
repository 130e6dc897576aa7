"""A seven-axis arm goes to random goals; a special purpose processor plans its motion.

    python examples/mppi/demo.py [--sim] [--rollouts N] [--plot FILE]

Runs `goals.job` until all goals were reached or given up. What is printed is the
time to each goal, how often plans came, and what the processor took of a core. In real
time it starts two agents; that of `arm1` has `agent.toml`.
"""

from __future__ import annotations

import argparse
import os
import subprocess
import sys
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple, Self

import numpy as np
from numpy.typing import NDArray

from pbonet import Subsystem
from pbonet.errors import PbonetError, StateError

if TYPE_CHECKING:
    from types import TracebackType

    from pbonet.log import Cycles

Floats = NDArray[np.float64]

HERE = Path(__file__).parent
JOB = HERE / "goals.job"
LIBRARIES = [HERE, HERE.parent / "panda"]
LONGEST = 180.0
"""How long a run lasts at most, s."""
READY = 60.0
"""Seconds that an agent may take to end, and a task to compile its kernels once."""


class Agents:
    """The two RTPUs, each with an agent of its own.

    Args:
        domain: Their domain.
    """

    def __init__(self, domain: str) -> None:
        self._domain = domain
        self._processes: list[subprocess.Popen[str]] = []

    def __enter__(self) -> Self:
        self._start("arm0")
        self._start("arm1", "--config", str(HERE / "agent.toml"))
        for process in self._processes:
            told = process.stdout.readline() if process.stdout else ""
            if "ready" not in told:
                raise StateError("an agent did not start", got=told.strip())
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        for process in self._processes:
            process.terminate()
        for process in self._processes:
            process.wait(READY)
            if process.stdout:
                process.stdout.close()

    def _start(self, name: str, *more: str) -> None:
        command = [sys.executable, "-m", "pbonet.cli", "agent", "--name", name]
        command += ["--domain", self._domain, "--with-parent", str(os.getpid())]
        for folder in LIBRARIES:
            command += ["--library", str(folder)]
        self._processes.append(
            subprocess.Popen([*command, *more], stdout=subprocess.PIPE, text=True)
        )


class Result(NamedTuple):
    """What became of a run."""

    times: Floats
    """From goal to goal, s, with the time that the hand stays there."""
    given_up: int
    rate: float
    """Plans a second."""
    age_ms: tuple[float, float]
    """Age of the plan that is followed: half of the cycles, and 99 in 100."""
    most: tuple[float, float]
    """Largest share of the limits of velocity and of torque."""
    lost: dict[str, int]
    """Cycles that tasks missed, as their RTPU counted."""


class Run(NamedTuple):
    """Every cycle of a run, and what planned."""

    recording: Cycles
    processor: str
    share: float
    """Of a core that the processor took; not a number in virtual time."""


def run(*, sim: bool, rollouts: int = 0) -> Run:
    """Run the job until the last goal."""
    domain = f"mppi{os.getpid()}"
    if sim:
        return _run(domain, rollouts, sim=True)
    with Agents(domain):
        return _run(domain, rollouts, sim=False)


def _run(domain: str, rollouts: int, *, sim: bool) -> Run:
    arm = Subsystem(JOB, domain=domain, virtual=sim, libraries=LIBRARIES)
    arm.open()
    processor, share = "numpy in virtual time", float("nan")
    try:
        arm.start()
        if rollouts:
            arm.set("plan", "ROLLOUTS", rollouts)
        if sim:
            arm.sigwait("FINISH", timeout=LONGEST)
        else:
            processor, share = _watch(arm)
    finally:
        arm.finish()
    if arm.simulation is not None:
        return Run(arm.simulation.recording, processor, share)
    log = arm.recordings.log()
    if log is None:
        raise StateError("the job was never started", where=arm.name)
    return Run(log, processor, share)


def _watch(arm: Subsystem) -> tuple[str, float]:
    """Wait for the last goal; return what planned, and its share of a core."""
    before, begin = _processor(arm), arm.clock.now()
    spent = _cpu_time(before.pid)
    arm.sigwait("FINISH", timeout=LONGEST)
    after = _processor(arm)
    share = float("nan")
    if after.pid == before.pid:
        share = (_cpu_time(after.pid) - spent) / (arm.clock.now() - begin)
    return ", ".join(after.libraries), share


def _processor(arm: Subsystem) -> Any:  # noqa: ANN401 - a record of the status
    return next(one for rtpu in arm.rtpu_status() for one in rtpu.spps)


def _cpu_time(pid: int) -> float:
    """Return the seconds that a process has run."""
    words = Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()
    return (int(words[11]) + int(words[12])) / os.sysconf("SC_CLK_TCK")


def judge(recording: Cycles) -> Result:
    """Return what became of a run."""
    goals = recording.arrays("goals")
    seconds = (goals["release_ns"] - goals["release_ns"][0]) * 1e-9
    reached, given_up = goals["GOALS"].T
    turns = np.flatnonzero(np.diff(reached + given_up)) + 1
    took = np.diff(np.concatenate(([0.0], seconds[turns])))
    plan = recording.arrays("plan")
    end = goals["release_ns"][turns[-1]] if len(turns) else plan["release_ns"][-1]
    under_way = plan["release_ns"] <= end
    age = plan["PLAN_AGE"][under_way].ravel()
    came = int((np.diff(age) < 0.0).sum())
    fast, strong = (_share(recording, name) for name in ("Q^_REF", "T_REF"))
    return Result(
        times=took[np.diff(np.concatenate(([0.0], reached[turns]))) > 0.0],
        given_up=int(given_up[-1]),
        rate=came / float(np.ptp(plan["release_ns"][under_way]) * 1e-9),
        age_ms=(1e3 * float(np.median(age)), 1e3 * float(np.quantile(age, 0.99))),
        most=(fast, strong),
        lost=recording.missed(),
    )


LIMITS = {
    "Q^_REF": (2.175, 2.175, 2.175, 2.175, 2.61, 2.61, 2.61),
    "T_REF": (87.0, 87.0, 87.0, 87.0, 12.0, 12.0, 12.0),
}
"""Of the arm's URDF file: rad/s and N*m."""


def _share(recording: Cycles, name: str) -> float:
    _, values = recording.series(name)
    return float((np.abs(values) / LIMITS[name]).max())


def distances(recording: Cycles) -> tuple[Floats, Floats]:
    """Return time (s) and how far the hand was from its goal (m)."""
    time, measured = recording.series("X_MEZ")
    told, goal = recording.series("X_GOAL")
    newest = np.searchsorted(told, time, side="right") - 1
    both = newest >= 0
    there = measured[both].reshape(-1, 3, 4)[:, :, 3]
    far = there - goal[newest[both]]
    return time[both], np.sqrt((far**2).sum(axis=1))


def plot(recording: Cycles, file: Path) -> None:
    """Draw the distance to the goal, the velocities, and the age of the plan."""
    import matplotlib as mpl

    mpl.use("Agg")
    import matplotlib.pyplot as plt

    drawn: Any = plt.subplots(3, 1, figsize=(10, 8), sharex=True)
    figure, axes = drawn
    time, far = distances(recording)
    axes[0].plot(time, 1e3 * far, linewidth=1.0)
    axes[0].axhline(20.0, color="0.4", linestyle="--", linewidth=1.0)
    axes[0].set_ylabel("hand from its goal, mm")
    time, velocity = recording.series("Q^_REF")
    for joint in range(velocity.shape[1]):
        axes[1].plot(time, velocity[:, joint], linewidth=0.8, label=f"axis {joint + 1}")
    axes[1].legend(loc="upper right", fontsize=7, ncols=4)
    axes[1].set_ylabel("velocity, rad/s")
    time, age = recording.series("PLAN_AGE")
    axes[2].plot(time, 1e3 * age, linewidth=0.8)
    axes[2].set_ylabel("age of the plan, ms")
    axes[2].set_xlabel("time, s")
    for axis in axes:
        axis.grid(visible=True, alpha=0.3)
    figure.tight_layout()
    file.parent.mkdir(parents=True, exist_ok=True)
    figure.savefig(file, dpi=90)
    plt.close(figure)


def main(argv: list[str] | None = None) -> None:
    """Run, and say what became of it."""
    words = argparse.ArgumentParser(description=(__doc__ or "").split("\n\n")[0])
    words.add_argument("--sim", action="store_true", help="in virtual time")
    words.add_argument("--rollouts", type=int, default=0, help="not plan.rmod's")
    words.add_argument("--plot", type=Path, help="a picture of the run")
    told = words.parse_args(argv)
    try:
        done = run(sim=told.sim, rollouts=told.rollouts)
        result = judge(done.recording)
    except PbonetError as error:
        sys.exit(f"demo: {error}")
    lost = ", ".join(f"{task} {n}" for task, n in result.lost.items() if n) or "none"
    times = " ".join(f"{one:.2f}" for one in result.times)
    sys.stdout.write(
        f"planned by              {done.processor}\n"
        f"goals reached           {len(result.times)}, given up {result.given_up}\n"
        f"time to each, s         {times}\n"
        f"on the average          {result.times.mean():.2f} s\n"
        f"plans                   {result.rate:.1f} a second, {result.age_ms[0]:.1f} "
        f"ms old, 99 in 100 at most {result.age_ms[1]:.1f}\n"
        f"share of a core         {done.share:.2f}\n"
        f"of the limits at most   velocity {result.most[0]:.3f}, torque "
        f"{result.most[1]:.3f}\n"
        f"cycles missed           {lost}\n"
    )
    if told.plot:
        plot(done.recording, told.plot)


if __name__ == "__main__":
    main()
