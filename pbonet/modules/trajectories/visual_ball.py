"""Visual servoing after a ball that a camera on the hand sees."""

from typing import Annotated as A

import numpy as np

from pbonet import (
    InConst,
    InVar,
    Matrix,
    OutVar,
    Params,
    PortBasedObject,
    Vector,
    param,
)
from pbonet.io import Blob, Pinhole, Seen
from pbonet.io.spp import Spp
from pbonet.modules._path import pose_of
from pbonet.modules._tracked_point import TrackedPoint
from pbonet.modules._values import PerElement, keep, spread
from pbonet.modules._warn_once import WarnOnce

ASKED = 4
"""Pictures of which the module knows where the hand was when it asked for them."""


class Sight(Params):
    """The camera, the ball, and where the hand is to be."""

    spp: A[str, param("none", "special purpose processor that takes the pictures")]
    library: A[str, param("none", "its library, in a folder of modules")]
    size: A[tuple[int, ...], param("none", "width and height, pixels", ge=1)]
    fovy: A[float, param("rad", "angle of view from top to bottom", gt=0, lt=3.1)]
    eye: A[PerElement, param("mixed", "pose of the camera in the hand, see below")]
    radius: A[float, param("m", "radius of the ball", gt=0)]
    distance: A[float, param("m", "of the hand from the ball's centre", gt=0)]
    angles: A[PerElement, param("rad", "roll pitch yaw of the hand")]
    smooth: A[float, param("none", "share of the past, per picture", ge=0, lt=1)] = 0.5
    round: A[float, param("none", "least roundness of a ball, at most 1", gt=0)] = 0.8
    every: A[float, param("s", "least time from picture to picture", ge=0)] = 0.04
    lost: A[float, param("s", "how long its motion goes on unseen", gt=0)] = 0.5


class VisualBall(PortBasedObject[Sight], module_class="trajectory"):
    """x_des = DISTANCE before the ball, where it is expected now; v_des = its velocity.

    The hand keeps its orientation ANGLES, and the ball is to be straight ahead on its z
    axis. The camera is at EYE in the hand (x y z in m, roll pitch yaw in rad); its x is
    to the right of the picture, y down, z forwards. LIBRARY takes the pictures and
    finds the ball in them, in the executive of the processor SPP, so that no cycle
    waits for that: routine `look`, with the number of the picture; variables `q` and
    `ball`, from which a simulated camera knows what there is to see, and `seen`, which
    has that number and the elements of `pbonet.io.Blob`. A library that has a real
    camera does not use `q` and `ball`.

    When the last picture is there, and EVERY has passed, the next one is asked for;
    meanwhile x_des goes on as the ball is expected to. Centroid and area of the
    ball give its place before the camera, and the hand's pose of when the picture was
    asked for gives that in the base. A filter (SMOOTH) makes the velocity of it. The
    outputs are as old as the newest picture that shows the ball whole. When that is
    longer ago than LOST, x_des stands still and v_des is zero, with a warning that says
    why: no ball, a ball cut by the picture's edge, something that is not round, or no
    new picture. It is the same in `stable`, which runs while X_MEZ is too old.
    """

    ndof: A[int, InConst("NDOF", "1", "none", "degrees of freedom")]
    x: A[
        Matrix,
        InVar("X_MEZ", "3,4", "mixed", "pose of the hand", max_age=0.3, stale="stable"),
    ]
    q: A[
        Vector, InVar("Q_MEZ", "ndof", "rad", "joint position, for a simulated camera")
    ]
    ball: A[Matrix, InVar("X_BALL", "3,4", "mixed", "pose of a simulated ball")]
    x_des: A[Matrix, OutVar("X_DES", "3,4", "mixed", "desired pose, [R p], p in m")]
    v: A[Vector, OutVar("X^_DES", "6", "mixed", "its velocity, m/s and rad/s")]
    picture: A[int, OutVar("PICTURE", "1", "none", "number of the newest picture")]
    age: A[float, OutVar("SIGHT_AGE", "1", "s", "since the ball was seen, or `on`")]

    def init(self) -> None:
        self._take()
        k = self.params
        self._spp = Spp(k.spp, k.library, task=self.task)
        self._look, self._q, self._ball, self._seen = map(
            self._spp.translate, ("look", "q", "ball", "seen")
        )
        self._track, self._told = TrackedPoint(), WarnOnce(self.task)
        self._poses = np.zeros((ASKED, 3, 4))
        self._times = [0] * ASKED
        self._asked = 0

    def set(self, name: str, value: object) -> None:  # noqa: ARG002 - by its name
        keep(name, {"spp", "library"})
        self._take()

    def on(self) -> None:
        self._next = 0
        self._first = self._asked + 1  # a picture of before is none of this run
        self._seen_ns = self.task.now
        self.picture, self._why = 0, ""
        self._track.forget()
        self._told.clear()
        self.v[:] = 0.0
        self._date()

    def cycle(self, dt: float) -> None:  # noqa: ARG002 - times are those of pictures
        idle = self._spp.wait(0.0)
        self._see(self._seen.value)
        if idle and self.task.now >= self._next:
            self._ask()
        self._date()
        if self.age > self.params.lost:
            why = self._why or "no new picture has come"
            self._told.warn("lost", f"{why}: X_DES stands still")
            self._stand()
        elif self._track.known:
            self._told.clear()
            self._aim()

    def stable(self, dt: float) -> None:  # noqa: ARG002 - it has nothing to do
        self._stand()

    def off(self) -> None:
        if not self.task.handover:
            self.v[:] = 0.0

    def kill(self) -> None:
        self._spp.finish()

    def _ask(self) -> None:
        """Ask for a picture of now."""
        self._asked += 1
        self._next = self.task.now + self._pause
        self._poses[self._asked % ASKED] = self.x
        self._times[self._asked % ASKED] = self.task.now
        spp = self._spp
        spp.write(self._q, self.q)
        spp.write(self._ball, self.ball[:, 3])
        spp.call(self._look, self._asked)
        spp.read(self._seen)
        spp.wait(0.0)

    def _see(self, seen: Vector | None) -> None:
        """Take the newest picture into account, unless that was done already."""
        number = 0 if seen is None else int(seen[0])
        if seen is None or number < self._first or number == self.picture:
            return
        self.picture = number
        blob = Blob(*seen[1:].tolist())
        self._why = self._fault_of(blob)
        if self._why:
            return
        self._seen_ns = self._times[self.picture % ASKED]
        pose = self._poses[self.picture % ASKED]
        eye = self._camera.centre(Seen(blob.u, blob.v, blob.area), self.params.radius)
        hand = self._eye[:, :3] @ eye + self._eye[:, 3]
        place = pose[:, :3] @ hand + pose[:, 3]
        self._track.correct(place, 1e-9 * self._seen_ns, self.params.smooth)

    def _fault_of(self, blob: Blob) -> str:
        """Return why a picture does not tell where the ball is; "" if it does."""
        if not blob.area:
            return "the picture shows no ball"
        if not blob.inside:
            return "the edge of the picture cuts the ball"
        if blob.roundness < self.params.round:
            return "what the picture shows is not round"
        return ""

    def _date(self) -> None:
        """Give the outputs the age of what they are made of."""
        self.task.stamp_ns = self._seen_ns
        self.age = 1e-9 * (self.task.now - self._seen_ns)

    def _aim(self) -> None:
        """Draw the hand to before the place where the ball is expected now."""
        self.x_des[:, :3] = self._turn
        self.x_des[:, 3] = self._track.at(1e-9 * self.task.now) - self._reach
        self.v[:3] = self._track.velocity

    def _stand(self) -> None:
        """Leave X_DES where it is until the ball is seen again."""
        self._track.forget()
        self.v[:] = 0.0

    def _take(self) -> None:
        """Take the parameters."""
        k = self.params
        width, height = spread(k.size, 2, "size").astype(int)
        self._camera = Pinhole(int(width), int(height), k.fovy)
        self._eye = pose_of(spread(k.eye, 6, "eye"))
        self._turn = pose_of(np.array([0.0, 0.0, 0.0, *spread(k.angles, 3, "angles")]))
        self._turn = self._turn[:, :3]
        self._pause = round(1e9 * (k.every - 0.5 * self.task.period))
        self._reach = k.distance * self._turn[:, 2]
