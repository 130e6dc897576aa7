"""A multicopter takes off, flies a square and lands, over a MAVLink link.

    python examples/vehicle/demo.py [--real udpin:localhost:14550] [--plot FILE]

Two subsystems, each with an agent: `craft` is a simulated multicopter behind a MAVLink
link, `pilot` sees it over that link alone. The pilot arms it, sets the offboard mode,
exchanges the trajectory that stays for the square, and lets it land. With ``--real``
there is only the pilot, and the vehicle is whatever speaks MAVLink at that address with
PX4's modes: a simulated one at first, and a real one where nobody can be hit.

Then the logs of both are run again (`pbonet replay --verify`), and the way is drawn.
"""

from __future__ import annotations

import argparse
import os
import re
import shutil
import sys
import tempfile
from contextlib import ExitStack
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from pbonet import Subsystem
from pbonet.errors import PbonetError, StateError
from pbonet.testing import verify

if TYPE_CHECKING:
    from collections.abc import Callable

    from pbonet.log import Log

Floats = NDArray[np.float64]

HERE = Path(__file__).parent
BUILD = HERE.parents[1] / "build"
OFFBOARD, LAND = 6 << 16, 4 << 16 | 6 << 24
"""PX4's modes."""
PATIENCE = 30.0
"""Seconds in which the vehicle follows a command."""
FLIGHT = 60.0
"""Seconds in which the square is flown."""
ENDS = ["FINISH", "ERROR", "SHUTDOWN"]
NEAR = 0.6
"""m from the reference within which the vehicle flies."""
HOME = 0.5
"""m from the point of departure within which it lands."""


class Result(NamedTuple):
    """What became of a flight."""

    far: float
    """The most that the vehicle was from the reference while it flew the route, m."""
    top: float
    """The greatest height, m."""
    home: float
    """How far from the point of departure it stands on the ground, m."""
    armed: bool
    """Whether it is armed at the end."""
    differs: list[str]
    """What another run of the recorded code made different."""

    @property
    def good(self) -> bool:
        """Whether it flew as it should."""
        near = self.far < NEAR and self.home < HOME and self.top > 2.0  # noqa: PLR2004
        return near and not self.armed and not self.differs


def fly(
    address: str = "", domain: str = "", *, embed: bool = True, port: int = 0
) -> tuple[Log, list[Log]]:
    """Fly the square; return the pilot's log, and those of all.

    Args:
        address: Of a vehicle that is there; empty for the simulated one.
        domain: Where agents may run already; by default a new one.
        embed: Whether agents of its own are started.
        port: Of the link with the simulated one; by default that of the example.
    """
    told: dict[str, Any] = {"domain": domain or f"vehicle{os.getpid()}", "embed": embed}
    with ExitStack() as stack:
        systems: list[Subsystem] = []
        folder = _on_port(port, stack) if port else HERE
        if address:
            folder = _with_address(stack, vehicle=address)
        else:
            craft = Subsystem(folder / "craft.job", libraries=[folder], **told)
            systems.append(_started(craft, stack))
        pilot = Subsystem(folder / "pilot.job", libraries=[folder], **told)
        _started(pilot, stack)
        _square(pilot)
    logs = [_log(one) for one in (pilot, *systems)]
    return logs[0], logs


def _with_address(stack: ExitStack, **addresses: str) -> Path:
    """Return a copy of the example in which modules have other addresses, by name."""
    folder = Path(stack.enter_context(tempfile.TemporaryDirectory())) / "vehicle"
    shutil.copytree(HERE, folder)
    for name, address in addresses.items():
        rmod = folder / f"{name}.rmod"
        text = re.sub(r"(?m)^ADDRESS .*", f"ADDRESS   {address}", rmod.read_text())
        rmod.write_text(text)
    return folder


def _on_port(port: int, stack: ExitStack) -> Path:
    """Return a copy of the example whose link has another port."""
    calls, waits = f"udpout:localhost:{port}", f"udpin:localhost:{port}"
    return _with_address(stack, vehicle=calls, ground=waits)


def _started(subsystem: Subsystem, stack: ExitStack) -> Subsystem:
    subsystem.open()
    stack.callback(subsystem.finish)
    subsystem.start()
    return subsystem


def _square(pilot: Subsystem) -> None:
    """Arm, fly the route, land."""
    pilot.spawn("route", "pilot0")
    _wait(pilot, "GPS_FIX", lambda fix: fix >= 3)  # noqa: PLR2004 - in three dimensions
    _wait(pilot, "MODE", lambda mode: mode != 0)  # before its heartbeat nothing is sent
    pilot.set("mav_command", "arm", 1)
    _wait(pilot, "ARMED", lambda armed: armed == 1)
    pilot.set("mav_command", "mode", OFFBOARD)
    _wait(pilot, "MODE", lambda mode: mode == OFFBOARD)
    pilot.swap("hover", "route")
    while (ended := pilot.sigwait(ENDS, timeout=FLIGHT)).task != "route":
        pass  # `hover` has sent FINISH as well
    if ended.signal != "FINISH":
        raise StateError(f"{ended.task} sent {ended.signal}", where=pilot.name)
    pilot.set("mav_command", "mode", LAND)
    _wait(pilot, "ARMED", lambda armed: armed == 0)


def _wait(pilot: Subsystem, name: str, holds: Callable[[float], bool]) -> None:
    begin = pilot.clock.now()
    while not holds(value := float(pilot.display(name)[0].values[0])):
        if pilot.clock.now() - begin > PATIENCE:
            raise StateError(
                f"the vehicle does not follow: {name} is {value:g}",
                where=pilot.name,
                remedy="read `pbonet events pilot.sbs`, and what the vehicle says",
            )
        pilot.wait(0.05)


def _log(subsystem: Subsystem) -> Log:
    log = subsystem.recordings.log()
    if log is None:
        raise StateError("the job was never started", where=subsystem.name)
    return log


def way(log: Log) -> tuple[Floats, Floats, Floats]:
    """Return time (s), where the vehicle was, and where it should have been (m)."""
    time, measured = log.series("X_MEZ")
    parts = [log.arrays(task) for task in ("hover", "route") if task in log.tasks]
    told = np.concatenate([one["release_ns"] for one in parts])
    desired = np.concatenate([one["X_DES"] for one in parts]).reshape(-1, 3)
    order = np.argsort(told, kind="stable")
    seconds = (told[order] - log.begin_ns) * 1e-9
    newest = np.searchsorted(seconds, time, side="right") - 1
    both = newest >= 0
    return time[both], measured[both], desired[order][newest[both]]


def judge(pilot: Log, logs: list[Log]) -> Result:
    """Return what became of a flight, and run its code again."""
    time, measured, desired = way(pilot)
    route = pilot.arrays("route")["release_ns"]
    begin, end = ((int(route[k]) - pilot.begin_ns) * 1e-9 for k in (0, -1))
    modes = pilot.series("MODE")
    offboard = modes[0][np.ravel(modes[1]) == OFFBOARD]
    flown = (time >= begin) & (time <= min(end, float(offboard[-1])))
    far = np.linalg.norm(measured - desired, axis=1)[flown]
    verdicts = [one for log in logs for one in verify(log, libraries=[HERE])]
    return Result(
        far=float(far.max()),
        top=float(-measured[:, 2].min()),
        home=float(np.linalg.norm(measured[-1])),
        armed=bool(np.ravel(pilot.series("ARMED")[1])[-1]),
        differs=[str(one) for one in verdicts if not one.good],
    )


def plot(log: Log, file: Path) -> None:
    """Draw the way from above, and the height."""
    import matplotlib as mpl

    mpl.use("Agg")
    import matplotlib.pyplot as plt

    time, measured, desired = way(log)
    drawn: Any = plt.subplots(1, 2, figsize=(11, 5))  # its types are incomplete
    figure, (above, height) = drawn
    for place, label, style in ((desired, "reference", "--"), (measured, "flown", "-")):
        above.plot(place[:, 1], place[:, 0], style, label=label)
        height.plot(time, -place[:, 2], style, label=label)
    above.set(xlabel="east, m", ylabel="north, m", aspect="equal")
    height.set(xlabel="time, s", ylabel="height, m")
    for axes in (above, height):
        axes.grid(visible=True, alpha=0.3)
        axes.legend()
    figure.suptitle("A multicopter flies a square over MAVLink")
    figure.tight_layout()
    file.parent.mkdir(parents=True, exist_ok=True)
    figure.savefig(file, dpi=100)
    plt.close(figure)


def main(argv: list[str] | None = None) -> None:
    """Fly, judge, plot."""
    words = argparse.ArgumentParser(description=(__doc__ or "").split("\n\n")[0])
    words.add_argument("--real", default="", metavar="ADDRESS", help="another vehicle")
    words.add_argument("--plot", type=Path, default=BUILD / "vehicle.png")
    told = words.parse_args(argv)
    try:
        pilot, logs = fly(told.real)
        result = judge(pilot, logs)
    except PbonetError as error:
        sys.exit(f"demo: {error}")
    plot(pilot, told.plot)
    replay = "; ".join(result.differs) or "the same to the bit"
    sys.stdout.write(
        f"from the reference      at most {result.far:.2f} m\n"
        f"greatest height         {result.top:.2f} m\n"
        f"landed                  {result.home:.2f} m from the point of departure, "
        f"{'armed' if result.armed else 'disarmed'}\n"
        f"the logs run again      {replay}\n"
        f"plot                    {told.plot}\n"
        f"{'the flight is good' if result.good else 'THE FLIGHT IS NOT GOOD'}\n"
    )
    if not result.good:
        sys.exit(1)


if __name__ == "__main__":
    main()
