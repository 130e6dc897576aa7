"""A gripper that is simulated, and the part that it may hold."""

from typing import Annotated as A

import numpy as np

from pbonet import (
    InVar,
    OutConst,
    OutVar,
    Params,
    PortBasedObject,
    UserSignal,
    Vector,
    param,
)

OPEN = 0.08
"""Width at which the jaws are open, m."""


class Drive(Params):
    """The jaws, and the part that lies there."""

    speed: A[float, param("m/s", "of the jaws", gt=0)] = 0.1
    force: A[float, param("N", "with which they press", gt=0)] = 40.0
    reach: A[float, param("m", "a part within is between the jaws", gt=0)] = 0.01
    stuck: A[bool, param("none", "a fault: the jaws do not move")] = False
    thick: A[float, param("m", "of the part", gt=0)] = 0.03
    x: A[float, param("m", "where a new part lies")] = 0.50
    y: A[float, param("m", "where it lies")] = -0.25
    z: A[float, param("m", "where it lies")] = -0.42


class Jaws(PortBasedObject[Drive], module_class="robot interface"):
    """WIDTH follows WIDTH_REF; what is between closing jaws is HELD and goes with them.

    It tells CLOSED and OPENED when the jaws have come to rest, CLOSED also without a
    part between them. Setting `x` brings a new part. When it is turned off, as by a
    stop, it lets go of the part.
    """

    CLOSED = UserSignal(0, "the jaws have stopped closing")
    OPENED = UserSignal(1, "the jaws are open")

    drives: A[int, OutConst("DRIVES", "1", "none", "number of drives")]
    wish: A[float, InVar("WIDTH_REF", "1", "m", "how far open they shall be")]
    tip: A[Vector, InVar("X_TIP", "3", "m", "where the jaws are")]
    width: A[float, OutVar("WIDTH", "1", "m", "how far open they are", new=True)]
    pressing: A[float, OutVar("FORCE", "1", "N", "with which they press", new=True)]
    held: A[bool, OutVar("HELD", "1", "none", "whether they hold a part", new=True)]
    part: A[Vector, OutVar("PART", "3", "m", "where the part is", new=True)]

    def init(self) -> None:
        """Put a part where it lies."""
        self.drives = 1
        self._new = True

    def on(self) -> None:
        """Begin with the jaws as they stand."""
        self._rests = "open" if self.width > OPEN / 2 else "closed"

    def set(self, name: str, value: object) -> None:  # noqa: ARG002
        """Bring a new part with its place."""
        self._new = self._new or name == "x"

    def cycle(self, dt: float) -> None:
        """Move the jaws, and the part with them if they hold it."""
        k = self.params
        if self._new:
            self.part[:], self._new, self.held = (k.x, k.y, k.z), False, False
        near = float(np.linalg.norm(self.part - self.tip)) < k.reach
        between = self.held or near
        least = k.thick if between else 0.0
        step = 0.0 if k.stuck else k.speed * dt
        wish = min(max(self.wish, least), OPEN)
        before = self.width
        self.width += min(max(wish - before, -step), step)
        closing = self.wish < least
        self.held = between and closing and self.width <= least
        self.pressing = k.force if self.held else 0.0
        if self.held:
            self.part[:] = self.tip
        wanted = "closed" if self.wish < OPEN / 2 else "open"
        self._tell(wanted, moved=self.width != before)

    def stable(self, dt: float) -> None:  # noqa: ARG002
        """Leave the jaws where they are, and what they hold in them."""
        if self.held:
            self.part[:] = self.tip

    def off(self) -> None:
        """Let go: without a program the drive has no force."""
        if not self.task.handover:
            self.held, self.pressing = False, 0.0

    def _tell(self, wanted: str, *, moved: bool) -> None:
        """Tell once that the jaws have come to rest."""
        if moved or wanted == self._rests:
            return
        self._rests = wanted
        self.task.signal(self.OPENED if wanted == "open" else self.CLOSED)
