"""A join connector: the smaller of two outputs wins (Stewart 1994, Figure 3.6)."""

from typing import Annotated as A

import numpy as np

from pbonet import InConst, InVar, OutVar, Params, PortBasedObject, Vector


class JoinMin(PortBasedObject[Params], module_class="connector"):
    """z = the smaller of z1 and z2, element by element.

    Two modules that produce the same variable get different ones by SVARALIAS, and this
    module makes the one that others read out of the two. Joins can be chained.
    """

    ndof: A[int, InConst("NDOF", "1", "none", "number of elements of Z")]
    z1: A[Vector, InVar("Z1", "ndof", "any", "value of the first producer")]
    z2: A[Vector, InVar("Z2", "ndof", "any", "value of the second producer")]
    z: A[Vector, OutVar("Z", "ndof", "any", "the smaller of each pair of elements")]

    def cycle(self, dt: float) -> None:  # noqa: ARG002 - the present only
        np.minimum(self.z1, self.z2, out=self.z)
