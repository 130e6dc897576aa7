"""A join connector: two conflicting outputs become one (Stewart 1994, Figure 3.6)."""

from typing import Annotated as A

from pbonet import (
    InConst,
    InVar,
    OutVar,
    Params,
    PortBasedObject,
    Vector,
    param,
)


class Weights(Params):
    """Weights of the inputs."""

    weights: A[
        tuple[float, float], param("none", "weights of Z1 and Z2", ge=0, total=1)
    ] = (0.5, 0.5)


class JoinAverage(PortBasedObject[Weights], module_class="connector"):
    """z = weights[0]*z1 + weights[1]*z2, and the weights sum to 1.

    Two modules that produce the same variable get different ones by SVARALIAS, and this
    module makes the one that others read out of the two. Joins can be chained.
    """

    ndof: A[int, InConst("NDOF", "1", "none", "number of elements of Z")]
    z1: A[Vector, InVar("Z1", "ndof", "any", "value of the first producer")]
    z2: A[Vector, InVar("Z2", "ndof", "any", "value of the second producer")]
    z: A[Vector, OutVar("Z", "ndof", "any", "their weighted average")]

    def cycle(self, dt: float) -> None:  # noqa: ARG002 - the present only
        first, second = self.params.weights
        self.z[:] = first * self.z1 + second * self.z2
