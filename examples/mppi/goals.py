"""Goals of a hand: random places that the arm can reach."""

from typing import Annotated as A

import numpy as np

from pbonet import (
    InConst,
    InVar,
    Matrix,
    OutVar,
    Params,
    PortBasedObject,
    Signal,
    Vector,
    param,
)
from pbonet.io import RobotModel


class Course(Params):
    """The arm, the goals, and when one is reached."""

    urdf: A[str, param("none", "file of the robot, in a folder of modules")]
    frame: A[str, param("none", "link or joint that is the hand")]
    count: A[int, param("none", "goals", ge=1)] = 20
    share: A[float, param("none", "of each joint's range, for goals", gt=0, le=1)] = 0.6
    low: A[float, param("m", "lowest goal above the base")] = 0.15
    front: A[float, param("m", "least distance of a goal in front of the base")] = 0.3
    within: A[float, param("m", "how near the hand must come", gt=0)] = 0.02
    stay: A[float, param("s", "how long it must stay there", gt=0)] = 0.2
    patience: A[float, param("s", "time after which a goal is given up", gt=0)] = 8.0


class Goals(PortBasedObject[Course], module_class="trajectory"):
    """x_goal = the hand's place in a random posture; the next one when it was reached.

    Postures are drawn by ``self.task.rng`` from the middle of each joint's range, until
    the hand is above LOW and, along x, beyond FRONT. When it has stayed WITHIN of the
    goal, or PATIENCE is over, the next goal comes; GOALS counts both. After the last
    one the signal FINISH is sent, and that goal stays.
    """

    ndof: A[int, InConst("NDOF", "1", "none", "degrees of freedom")]
    x: A[Matrix, InVar("X_MEZ", "3,4", "mixed", "measured pose, [R p], p in m")]
    goal: A[Vector, OutVar("X_GOAL", "3", "m", "where the hand shall go")]
    goals: A[Vector, OutVar("GOALS", "2", "none", "reached, and given up")]

    def init(self) -> None:
        """Read the arm's file."""
        k = self.params
        self._model = RobotModel(k.urdf, self.task.libraries)
        self._model.must_have(self.ndof)
        self._frame = self._model.frame(k.frame)
        self._pose = np.empty((3, 4))
        self._time = self._there = 0.0

    def on(self) -> None:
        """Begin with the first goal."""
        self.goals[:] = 0.0
        self._rests = False
        self._next()

    def cycle(self, dt: float) -> None:
        """Look whether the goal was reached."""
        if self._rests:
            return
        k = self.params
        self._time += dt
        near = np.linalg.norm(self.x[:, 3] - self.goal) < k.within
        self._there = self._there + dt if near else 0.0
        reached = self._there >= k.stay
        if not reached and self._time < k.patience:
            return
        self.goals[0 if reached else 1] += 1.0
        if self.goals.sum() < k.count:
            self._next()
        else:
            self._rests = True
            self.task.signal(Signal.FINISH)

    def _next(self) -> None:
        self._time = self._there = 0.0
        k, model = self.params, self._model
        middle, half = (model.upper + model.lower) / 2.0, model.upper - model.lower
        place = self._pose[:, 3]
        while True:
            draw = self.task.rng.random(model.n) - 0.5
            model.pose(middle + k.share * half * draw, self._frame, self._pose)
            if place[2] > k.low and place[0] > k.front:
                break
        self.goal[:] = place
