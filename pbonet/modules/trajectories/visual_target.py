"""A stand-in for a vision subsystem: reports its target rarely and late."""

from typing import Annotated as A

from pbonet import Matrix, OutVar, Params, PortBasedObject, Vector, param
from pbonet.modules._path import PosePath
from pbonet.modules._values import PerElement


class Sight(Params):
    """The target's motion, and the delay with which it is seen."""

    time: A[PerElement, param("s", "when each pose is reached, 0 first", ge=0)]
    position: A[PerElement, param("m", "x y z of each pose")]
    angles: A[PerElement, param("rad", "roll pitch yaw of each pose")]
    delay: A[float, param("s", "delay from measurement to output", ge=0)] = 0.0
    repeat: A[bool, param("none", "whether the path repeats at its end")] = False


class VisualTarget(PortBasedObject[Sight], module_class="trajectory"):
    """x_des = where the target was DELAY ago, on its path from pose to pose.

    It stands where a camera, its image processing and a link from another subsystem
    would: as often as the task's rate, which is that of the pictures, and late. The
    path begins when the module is turned on; from pose to pose the target goes along a
    straight line with the least jerk, and rests in each.
    """

    x: A[Matrix, OutVar("X_DES", "3,4", "mixed", "desired pose, [R p], p in m")]
    v: A[Vector, OutVar("X^_DES", "6", "mixed", "its velocity, m/s and rad/s")]

    def init(self) -> None:
        self._take_path()

    def set(self, name: str, value: object) -> None:  # noqa: ARG002 - all at once
        self._take_path()

    def on(self) -> None:
        self._time = 0.0
        self._project()

    def cycle(self, dt: float) -> None:
        self._time += dt
        self._project()

    def off(self) -> None:
        if not self.task.handover:
            self.v[:] = 0.0  # a target that is out of sight moves no hand

    def _project(self) -> None:
        seen = self._time - self.params.delay
        self.x[:], self.v[:] = self._path.at(max(seen, 0.0))

    def _take_path(self) -> None:
        k = self.params
        self._path = PosePath(k.time, k.position, k.angles, repeat=k.repeat)
