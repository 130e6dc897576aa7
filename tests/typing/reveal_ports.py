"""What type checkers make of ports and parameters; read by test_typing_reveal.

Every line with ``reveal_type`` ends in a comment: ``= type`` for exactly that, else the
parts that the answer has. Every line that ends in ``error`` must be refused, by both
checkers or by the one that is named, and no other line may be.
"""

from typing import Annotated as A, Literal, reveal_type

import numpy as np
from numpy.typing import NDArray

from pbonet import (
    Answer,
    InConst,
    InVar,
    Matrix,
    OutVar,
    Params,
    PortBasedObject,
    Vector,
    param,
)
from pbonet.testing import Bench


class Gains(Params):
    kp: A[float, param("N*m/rad", "stiffness", ge=0)]
    axes: A[tuple[int, ...], param("none", "axes")] = (1, 2)
    mode: A[Literal["a", "b"], param("none", "mode")] = "a"


class Law(PortBasedObject[Gains]):
    ndof: A[int, InConst("NDOF", "1", "none", "degrees of freedom")]
    dh: A[Matrix, InConst("DH", "ndof,4", "none", "geometry")]
    q: A[Vector, InVar("Q", "ndof", "rad", "position")]
    raw: A[NDArray[np.int16], InVar("RAW", "8", "none", "counts")]
    tau: A[Vector, OutVar("T", "ndof", "N*m", "torque")]
    level: A[float, OutVar("LEVEL", "1", "none", "level")]
    ok: A[bool, OutVar("OK", "1", "none", "flag")]

    def on(self) -> None:
        reveal_type(self.ndof)  # = int
        reveal_type(self.q)  # ndarray & float64
        reveal_type(self.dh)  # ndarray & float64
        reveal_type(self.raw)  # ndarray & signedinteger & 16Bit
        reveal_type(self.level)  # = float
        reveal_type(self.ok)  # = bool
        reveal_type(self.params)  # Gains
        reveal_type(self.params.kp)  # = float
        reveal_type(self.params.axes)  # = tuple[int, ...]
        reveal_type(self.params.mode)  # Literal & 'a' & 'b'
        reveal_type(self.task.now)  # = int
        reveal_type(self.task.freq)  # = float

    def cycle(self, dt: float) -> None:
        reveal_type(dt)  # = float
        self.tau[:] = self.params.kp * self.q
        self.tau += 1.0
        self.level = dt
        self.level = "high"  # error
        self.params.kp = 2.0  # error: pyright
        self.level = self.params.ki  # error
        self.level = self.speed  # error

    def clear(self) -> Answer:
        return Answer.OFF


class Bare(PortBasedObject):
    def on(self) -> None:
        reveal_type(self.params)  # Params

    def cycle(self, dt: float) -> None: ...


class Wrong(PortBasedObject):
    def cycle(self, dt: str) -> None: ...  # error

    def off(self, now: int) -> None: ...  # error

    def clear(self) -> str: ...  # error


InVar("Q", "ndof", "rad")  # error
InConst("NDOF", "1", "degrees of freedom")
InConst("NDOF", "1")  # error
param("rad")  # error
Gains(kp=1.0)
Gains()  # error
Gains(kp="1")  # error
Gains(kp=1.0, mode="c")  # error

bench = Bench(Law, params=Gains(kp=1.0), ndof=2)
reveal_type(bench.module)  # Law
reveal_type(bench.module.q)  # ndarray & float64
