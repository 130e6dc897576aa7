"""How near a robot is to colliding with itself."""

from typing import Annotated as A

from pbonet import InConst, InVar, OutVar, Params, PortBasedObject, Vector, param
from pbonet.errors import ParameterError
from pbonet.io import CollisionModel
from pbonet.modules._legs import fault_of_joints
from pbonet.modules._values import keep

AGAIN = 1.5
"""A new warning needs a distance of NEAR times this in between."""


class Shapes(Params):
    """The robot, and what counts as near."""

    urdf: A[str, param("none", "file of the robot, in a folder of modules")]
    near: A[float, param("m", "warn when two links are closer than this", ge=0)] = 0.02
    ignore: A[
        tuple[str, ...], param("none", "pairs of links that may touch, as one:other")
    ] = ("none",)


class SelfCollision(PortBasedObject[Shapes], module_class="kinematics"):
    """dist = the least distance between two links, of their shapes at the measured q.

    Computed by coal from the `<collision>` shapes of the robot's URDF file (spheres,
    boxes, cylinders, meshes); negative while one link is within the other.
    Links that one joint parts are left out, and those of IGNORE. A warning names the
    two links when DIST falls below NEAR: once, until DIST has been above 1.5 NEAR. It
    stops nothing by itself: another task, or a condition such as `PRE DIST > 5 [cm]`,
    does. A measurement that is not finite ends in ERROR.
    """

    ndof: A[int, InConst("NDOF", "1", "none", "degrees of freedom")]
    q: A[Vector, InVar("Q_MEZ", "ndof", "rad", "measured joint position")]
    dist: A[float, OutVar("DIST", "1", "m", "least distance of two links")]

    def init(self) -> None:
        k = self.params
        pairs = [self._pair(text) for text in k.ignore if text != "none"]
        self._model = CollisionModel(k.urdf, self.task.libraries, pairs)
        self._model.joints.must_have(self.ndof)

    def set(self, name: str, value: object) -> None:  # noqa: ARG002 - by its name
        keep(name, {"urdf", "ignore"})

    def on(self) -> None:
        self._told = False
        self.cycle(0.0)

    def cycle(self, dt: float) -> None:  # noqa: ARG002 - the present only
        if why := fault_of_joints("Q_MEZ", self.q, self._model.joints.joints):
            self.task.fail(why)
            return
        found = self._model.nearest(self.q)
        self.dist = found.distance
        near = self.params.near
        if self.dist < near and not self._told:
            one, other = found.links
            self.task.warn(f"{one} and {other} are {self.dist:.3g} m apart")
        self._told = self.dist < near or (self._told and self.dist <= AGAIN * near)

    @staticmethod
    def _pair(text: str) -> tuple[str, str]:
        one, _, other = text.partition(":")
        if not one or not other:
            raise ParameterError(
                "IGNORE names no pair of links",
                expected="two links with a colon, such as base:hand",
                got=text,
                remedy="write each pair as one:other",
            )
        return one, other
