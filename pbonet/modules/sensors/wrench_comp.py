"""Gravity compensation of a wrench sensor at the wrist."""

from typing import Annotated as A, Literal

import numpy as np

from pbonet import InVar, Matrix, OutVar, Params, PortBasedObject, Vector, param


class Tool(Params):
    """The tool that hangs at the sensor, and the sensor's zero."""

    mass: A[float, param("kg", "mass of the tool", ge=0)]
    com: A[
        tuple[float, float, float],
        param("m", "its centre of mass in the sensor's frame, x y z"),
    ] = (0.0, 0.0, 0.0)
    bias: A[
        tuple[float, float, float, float, float, float],
        param("none", "what the sensor shows without a load: N, then N*m"),
    ] = (0.0, 0.0, 0.0, 0.0, 0.0, 0.0)
    tare: A[bool, param("none", "whether `on` makes the present wrench the zero")] = (
        False
    )
    gravity: A[float, param("m/s^2", "along -z of the base", ge=0)] = 9.80665
    frame: A[
        Literal["sensor", "base"],
        param("none", "whose axes F_MEZ has; its point is the sensor's origin"),
    ] = "sensor"


class WrenchComp(PortBasedObject[Tool], module_class="sensor"):
    """f = f_raw - bias - w, with w the weight m R^T g of the tool and its torque c x w.

    R is the orientation of the sensor, from X_MEZ, and g points down along z of the
    base. What remains is what the tool touches, and what its acceleration needs. With
    TARE the present wrench counts as nothing when the module is turned on: then nothing
    may touch the tool. With FRAME base, force and torque are turned to the axes of the
    base.
    """

    raw: A[Vector, InVar("F_RAW", "6", "mixed", "measured wrench, N and N*m")]
    x: A[Matrix, InVar("X_MEZ", "3,4", "mixed", "pose of the sensor, [R p], p in m")]
    f: A[Vector, OutVar("F_MEZ", "6", "mixed", "wrench of contact, N and N*m")]

    def init(self) -> None:
        self._bias = np.array(self.params.bias)

    def set(self, name: str, value: object) -> None:  # noqa: ARG002
        if name == "bias":
            self._bias = np.array(self.params.bias)

    def on(self) -> None:
        if self.params.tare:
            self._bias = self.raw - self._weight()

    def cycle(self, dt: float) -> None:  # noqa: ARG002 - statics
        wrench = self.raw - self._bias - self._weight()
        if self.params.frame == "base":
            wrench = (self.x[:, :3] @ wrench.reshape(2, 3).T).T.reshape(6)
        self.f[:] = wrench

    def _weight(self) -> Vector:
        k = self.params
        u, v, w = (-k.mass * k.gravity * self.x[2, :3]).tolist()
        x, y, z = k.com
        return np.array((u, v, w, y * w - z * v, z * u - x * w, x * v - y * u))
