"""Pick and place with a PUMA 560, as an autonomous program (Stewart 1994, 4.4.4).

    python examples/pick_and_place/demo.py [--sim] [--stuck]

The program goes from job to job. Each says what must hold before it is entered and
before it is left, and the runtime looks at that before it changes anything. The first
part is carried with short fingers; then the tool is changed, and all who use its length
take the new one in by themselves; the second part is carried with long fingers.
With ``--stuck`` the jaws do not close on the second part: the job `lift` is refused,
and the program goes back without it.
"""

from __future__ import annotations

import argparse
import os
import sys
from pathlib import Path
from typing import TYPE_CHECKING, NamedTuple

from pbonet import Subsystem
from pbonet.errors import ConditionError, PbonetError

if TYPE_CHECKING:
    from collections.abc import Callable

HERE = Path(__file__).parent
WAIT = 5.0
"""Seconds that conditions may take to come true when a job is done."""
LONGEST = 30.0
"""Seconds that a job may take."""
STEPS = (
    ("approach", "FINISH"),
    ("descend", "FINISH"),
    ("grasp", "CLOSED"),
    ("lift", "FINISH"),
    ("move", "FINISH"),
    ("place", "FINISH"),
    ("release", "OPENED"),
    ("retreat", "FINISH"),
)
"""The jobs, and the signal that ends each."""


CARRIED = "both parts are in their place"
LEFT = "the second part lies where it lay"


class Done(NamedTuple):
    """One line of the timeline."""

    at: float
    """Seconds since the program began."""
    what: str
    hand: tuple[float, float, float]
    tip: tuple[float, float, float]
    width: float
    force: float


class Program:
    """Carries parts from one place to the other.

    Args:
        cell: The subsystem; it is open.
        say: Called with each line.
    """

    def __init__(self, cell: Subsystem, say: Callable[[str], object]) -> None:
        self.cell = cell
        self.timeline: list[Done] = []
        self.refused: list[str] = []
        """What was refused, in the runtime's words."""
        self._say = say
        self._begin = cell.clock.now()

    def run(self, *, stuck: bool = False) -> bool:
        """Carry two parts with two tools; return whether both have arrived."""
        self._say(
            f"{'s':>6s}  {'what':30s}{'hand m':>22s}{'tip m':>22s}   jaws mm     N"
        )
        self.cell.spawn("short_fingers", "arm1")
        first = self.carry()
        self.change_tool("short_fingers", "long_fingers")
        self.cell.set("jaws", "x", 0.5)  # a new part
        self.cell.set("jaws", "stuck", stuck)
        return self.carry() and first

    def carry(self) -> bool:
        """Carry one part, job by job; return whether it has arrived."""
        for job, signal in STEPS:
            try:
                self.enter(job)
            except ConditionError as error:
                self.refused.append(str(error))
                self._tell(f"{job} refused")
                self._say(f"        {error}")
                self.retreat()
                return False
            self._end(job, signal)
        return True

    def enter(self, job: str) -> None:
        """Go over to a job, once its conditions and those of the last one hold."""
        for text in self.cell.switch(job, wait=WAIT).conditions:
            self._say(f"        {text}")

    def retreat(self) -> None:
        """Open the jaws and go back, whatever they hold."""
        self.cell.set("jaws", "stuck", value=False)
        self.enter("retreat")
        self._end("retreat", "FINISH")

    def change_tool(self, old: str, new: str) -> None:
        """Take one tool off and put another on, while the arm is held where it is."""
        self.cell.kill(old)
        self.cell.spawn(new, "arm1")
        self._tell(f"{new} for {old}")
        self.cell.sigwait("FINISH", timeout=LONGEST)  # the tip is where it was
        self._tell("tip is back")

    def _end(self, job: str, signal: str) -> None:
        sent = self.cell.sigwait([signal, "ERROR", "SHUTDOWN"], timeout=LONGEST)
        if sent.signal != signal:
            raise SystemExit(f"{job}: {sent.task} sent {sent.signal}")
        self._tell(job)

    def _tell(self, what: str) -> None:
        values = {
            one.name: [float(value) for value in one.values]
            for one in self.cell.display(["X_MEZ", "X_TIP", "WIDTH", "FORCE"])
        }
        x, tip = values.get("X_MEZ", []), values["X_TIP"]
        done = Done(
            self.cell.clock.now() - self._begin,
            what,
            (x[3], x[7], x[11]),
            (tip[0], tip[1], tip[2]),
            values["WIDTH"][0],
            values["FORCE"][0],
        )
        self.timeline.append(done)
        hand, at = (" ".join(f"{v:6.3f}" for v in p) for p in (done.hand, done.tip))
        self._say(
            f"{done.at:6.2f}  {what:30s}  {hand}  {at}   {1e3 * done.width:7.1f}"
            f" {done.force:5.0f}"
        )


def open_cell(domain: str = "", *, sim: bool = False) -> Subsystem:
    """Return the cell, with agents of its own unless the domain has some.

    Args:
        domain: Where agents may run already; by default a new one.
        sim: In virtual time.
    """
    return Subsystem(
        HERE / "cell.sbs",
        domain=domain or f"cell{os.getpid()}",
        libraries=[HERE],
        embed=not sim,
        virtual=sim,
        warned=_show,
    )


def _show(text: str) -> None:
    """Print a line at once, also into a file."""
    sys.stdout.write(f"        {text}\n")
    sys.stdout.flush()


def main(argv: list[str] | None = None) -> None:
    """Run the program to its end."""
    words = argparse.ArgumentParser(description=(__doc__ or "").split("\n\n")[0])
    words.add_argument("--sim", action="store_true", help="in virtual time")
    words.add_argument("--stuck", action="store_true", help="the jaws do not close")
    told = words.parse_args(argv)
    try:
        with open_cell(sim=told.sim) as cell:
            program = Program(cell, lambda line: sys.stdout.write(f"{line}\n"))
            carried = program.run(stuck=told.stuck)
    except PbonetError as error:
        sys.exit(f"demo: {error}")
    sys.stdout.write(f"{CARRIED if carried else LEFT}\n")


if __name__ == "__main__":
    main()
