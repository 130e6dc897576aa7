"""A module that adds random numbers up, from a source of the test's choice."""

DRAWS = '''
import os
import random
import secrets
import uuid
from typing import Annotated as A

import numpy as np

from pbonet import InConst, InVar, OutVar, Params, PortBasedObject, Vector, param


class Gain(Params):
    """How much is added."""

    gain: A[float, param("1", "of the noise")] = 1.0


class Adds(PortBasedObject[Gain]):
    """Adds noise to what it has."""

    n: A[int, InConst("N", "1", "size")]
    z: A[Vector, InVar("Z", "n", "none", "input")]
    y: A[Vector, OutVar("Y", "n", "none", "sum")]

    def init(self) -> None:
        self.made = FIRST

    def cycle(self, dt: float) -> None:
        self.y[0] = DRAWN
        self.y[1] = self.z[0]
'''


def draws(drawn: str, first: str = "None") -> str:
    """Return the code that evaluates `drawn` in its cycle, and `first` in `init`."""
    return DRAWS.replace("DRAWN", drawn).replace("FIRST", first)
