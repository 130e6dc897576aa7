"""Where the tip of the tool is."""

from typing import Annotated as A

from pbonet import (
    InConst,
    InVar,
    Matrix,
    OutVar,
    Params,
    PortBasedObject,
    Vector,
)


class Tip(PortBasedObject[Params]):
    """x_tip = p + length * z, of the hand's pose [R p] and the last column z of R."""

    length: A[float, InConst("TOOL_LENGTH", "1", "m", "from the hand to the tip")]
    x: A[Matrix, InVar("X_MEZ", "3,4", "mixed", "measured pose of the hand")]
    tip: A[Vector, OutVar("X_TIP", "3", "m", "where the tip is")]

    def reinit(self) -> None:
        """Take another tool's length, which is read where it is needed."""

    def cycle(self, dt: float) -> None:  # noqa: ARG002 - geometry
        """Add the tool to the hand."""
        self.tip[:] = self.x[:, 3] + self.length * self.x[:, 2]
