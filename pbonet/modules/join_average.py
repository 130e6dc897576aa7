"""A join connector: two conflicting outputs become one (Stewart 1994, Figure 3.6)."""

from typing import Annotated as A

from pbonet import InConst, InVar, OutVar, Params, PortBasedObject, Vector, param
from pbonet.errors import ParameterError


class Weights(Params):
    """How much each input counts; only their ratio matters."""

    first: A[float, param("none", "weight of Z1", ge=0)] = 1.0
    second: A[float, param("none", "weight of Z2", ge=0)] = 1.0


class JoinAverage(PortBasedObject[Weights]):
    """z = (first*z1 + second*z2) / (first + second).

    Two modules that produce the same variable get different ones by SVARALIAS, and this
    module makes the one that others read out of the two. Joins can be chained.
    """

    ndof: A[int, InConst("NDOF", "1", "none", "number of elements of Z")]
    z1: A[Vector, InVar("Z1", "ndof", "any", "what one producer says")]
    z2: A[Vector, InVar("Z2", "ndof", "any", "what the other producer says")]
    z: A[Vector, OutVar("Z", "ndof", "any", "their weighted average")]

    def init(self) -> None:
        self._take_weights()

    def set(self, name: str, value: object) -> None:  # noqa: ARG002 - both at once
        self._take_weights()

    def cycle(self, dt: float) -> None:  # noqa: ARG002 - the present only
        self.z[:] = self._share * self.z1 + (1.0 - self._share) * self.z2

    def _take_weights(self) -> None:
        total = self.params.first + self.params.second
        if not total:
            raise ParameterError(
                "both weights are zero",
                expected="FIRST or SECOND above zero",
                remedy="raise one of them",
            )
        self._share = self.params.first / total
