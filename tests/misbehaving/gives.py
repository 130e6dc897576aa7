"""A good neighbour that gives a constant."""

from typing import Annotated as A

from pbonet import OutConst, Params, PortBasedObject, param


class Weight(Params):
    """What it gives."""

    mass: A[float, param("kg", "the constant", gt=0)]


class Gives(PortBasedObject[Weight]):
    """mass, from the first moment."""

    mass: A[float, OutConst("MASS", "1", "kg", "a mass")]

    def init(self) -> None:
        self.mass = self.params.mass

    def cycle(self, dt: float) -> None:
        pass
