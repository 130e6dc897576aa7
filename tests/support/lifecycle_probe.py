"""A module with hooks, for tests of the executor."""

from typing import Annotated as A

from pbonet import (
    Answer,
    InConst,
    InVar,
    OutConst,
    OutVar,
    Params,
    PortBasedObject,
    Vector,
    param,
)
from pbonet.testing import Bench


class Gain(Params):
    gain: A[float, param("none", "factor", ge=0, le=10)] = 1.0


class Scale(PortBasedObject[Gain]):
    """Multiply, and do what a test puts into the hooks."""

    ndof: A[int, InConst("NDOF", "1", "none", "size")]
    dim: A[int, OutConst("DIM", "1", "none", "size again")]
    x: A[Vector, InVar("X", "ndof", "m", "input")]
    y: A[Vector, OutVar("Y", "ndof", "m", "output")]
    level: A[float, OutVar("LEVEL", "1", "none", "how many cycles")]

    hooks = {}  # noqa: RUF012 - each test makes a class of its own

    def init(self):
        self.dim = self.ndof
        self.run("init")

    def on(self):
        return self.run("on")

    def cycle(self, dt):  # noqa: ARG002
        self.y[:] = self.params.gain * self.x
        self.level = self.level + 1
        self.run("cycle")

    def stable(self, dt):  # noqa: ARG002
        self.level = -1.0

    def off(self):
        self.run("off")

    def kill(self):
        self.run("kill")

    def sync(self):
        self.run("sync")

    def error(self, error):
        self.last = error
        return self.run("error") or Answer.ERROR

    def reinit(self):
        self.run("reinit")

    def set(self, name, value):  # noqa: ARG002
        self.run("set")

    def get(self, name):
        return 2 * getattr(self.params, name)

    def run(self, method):
        hook = self.hooks.get(method)
        return hook(self) if hook else None


def make(**hooks):
    made = type("Scale", (Scale,), {"hooks": hooks, "__module__": __name__})
    return Bench(made, ndof=2, name="scale")


def boom(_):
    raise ZeroDivisionError("division by zero")
