"""Inverse kinematics of a whole robot: body and feet at once, by placo."""

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
from pbonet.io import (
    FrameStep,
    PlaceSteps,
    RobotModel,
    all_finite,
    fault_of_pose,
)
from pbonet.modules._legs import must_have_feet
from pbonet.modules._placo_motion import PlacoMotion
from pbonet.modules._values import keep, rest
from pbonet.modules._warn_once import WarnOnce

STILL = 1e-9
"""m/s that counts as no speed."""
OPEN = 1e-6
"""m^2; the weight of the body's own turn, where the feet leave it open."""


def fit(points: Matrix, places: Matrix, turn: Matrix) -> Matrix:
    """Return the pose that takes points nearest to places, [R p] (Kabsch 1976).

    Args:
        points: In the frame whose pose is wanted, [n, 3], m.
        places: Where they are to be, [n, 3], m.
        turn: The pose's orientation about axes that the points leave open.
    """
    middle, there = points.mean(axis=0), places.mean(axis=0)
    both: Matrix = (places - there).T @ (points - middle) + OPEN * turn
    u, _, vh = np.linalg.svd(both)
    u[:, 2] *= np.sign(np.linalg.det(u @ vh))
    turned = u @ vh
    return np.column_stack((turned, there - turned @ middle))


class Pursuit(Params):
    """The robot, and how its body and feet are taken to their goals."""

    urdf: A[str, param("none", "file of the robot, in a folder of modules")]
    body: A[str, param("none", "link whose frame is the body")]
    feet: A[tuple[str, ...], param("none", "frames of the feet")]
    gain: A[float, param("1/s", "gain of the errors, at most one per cycle", gt=0)] = (
        50.0
    )
    linear: A[float, param("m/s", "largest speed of body and feet", gt=0)] = 1.0
    accel: A[
        float, param("m/s^2", "how fast the largest of their speeds may grow", gt=0)
    ] = 10.0
    angular: A[float, param("rad/s", "largest angular speed of the body", gt=0)] = 3.0
    joint_accel: A[
        float, param("rad/s^2", "how fast a joint's velocity may change", gt=0)
    ] = 500.0
    length: A[float, param("m", "counts as much as one radian", gt=0)] = 0.2
    grip: A[float, param("none", "weight of a foot, the body's is 1", gt=0)] = 100.0
    damping: A[float, param("none", "weight of the joints' own motion", gt=0)] = 1e-4
    short: A[float, param("m/s", "speed that may be missing unreported", gt=0)] = 0.01


class WholeBody(PortBasedObject[Pursuit], module_class="kinematics"):
    """min e^2 + damping dq^2, with e = J dq - v dt of the body and of each foot.

    For each of them v = gain * (x_des - x). Solved in each cycle by placo's quadratic
    program over the joints and a base that moves freely, within the limits of position
    and velocity that the URDF file gives each joint. The poses of body and feet are
    those at Q_REF itself, in the frame in which their goals are given: with the places
    of `gait`, the body's own when it is level. Feet weigh GRIP times as much as the
    body, and rows of positions are counted in LENGTH. When the module is turned on,
    Q_REF goes on from where it is, as fast as a predecessor's Q^_REF; the body is where
    the feet then fit their goals best, turned as its own goal where they leave that
    open. Goals far away are approached at LINEAR and ANGULAR, which speeds reach by
    ACCEL; no joint's velocity changes faster than JOINT_ACCEL. Goals that cannot be
    reached are taken as near as the joints allow, and DAMPING grows with what is
    missing, so that they come to rest there; a warning names the frame, and joints that
    stand at a limit. Goals that are not finite, or a program without a solution, leave
    Q_REF where it is.
    """

    ndof: A[int, InConst("NDOF", "1", "none", "degrees of freedom")]
    x_body: A[Matrix, InVar("X_BODY_DES", "3,4", "mixed", "desired pose of the body")]
    x_feet: A[Matrix, InVar("X_FEET_DES", "nfeet,3", "m", "desired places of the feet")]
    q_ref: A[Vector, OutVar("Q_REF", "ndof", "rad", "reference joint position")]
    qd_ref: A[Vector, OutVar("Q^_REF", "ndof", "rad/s", "reference joint velocity")]

    def init(self) -> None:
        k, n = self.params, len(self.x_feet)
        model = RobotModel(k.urdf, self.task.libraries)
        model.must_have(self.ndof)
        model.frame(k.body)
        must_have_feet(model, k.feet, n, "X_FEET_DES")
        self._told = WarnOnce(self.task)
        self._motion = motion = PlacoMotion(
            model, k.damping, floats=True, q_ref=self.q_ref, qd_ref=self.qd_ref
        )
        self._pose = np.eye(4)
        self._body, self._feet = FrameStep(self.x_body), PlaceSteps(self.x_feet)
        solver, weight = motion.solver, k.length**-2
        self._body_task = solver.add_frame_task(k.body, self._pose)
        self._body_task.configure("body", "soft", weight, 1.0)
        goals = zip(k.feet, self._feet.goals, strict=True)
        self._feet_goals = [
            (solver.add_position_task(foot, goal), goal) for foot, goal in goals
        ]
        for foot, (task, _) in zip(k.feet, self._feet_goals, strict=True):
            task.configure(foot, "soft", weight * k.grip)

    def set(self, name: str, value: object) -> None:  # noqa: ARG002 - by its name
        keep(name, {"urdf", "body", "feet", "length", "grip", "damping"})

    def on(self) -> None:
        rest(self.task, self.qd_ref)
        self._told.clear()
        self._motion.q[:] = self.q_ref
        self._begins, self._limit = True, 0.0

    def cycle(self, dt: float) -> None:
        if why := self._fault():
            self._hold("goal", why)
            return
        if self._begins:
            self._begin(dt)
        self._aim(dt)
        if self._motion.step(dt, self.params.joint_accel):
            self._read_frames()
            self._watch(dt)
        else:
            why = self._motion.stopped()
            self._hold("limits", f"no joint motion keeps the limits: {why}")

    def off(self) -> None:
        rest(self.task, self.qd_ref)

    def _begin(self, dt: float) -> None:
        """Put the joints where Q_REF is, and the body where the feet fit their goals.

        The speed from which the motion goes on is that of the feet before the body, as
        Q^_REF moves them.
        """
        robot = self._motion.robot
        later = self._feet_from_body(self.q_ref + dt * self.qd_ref)
        feet = self._feet_from_body(self.q_ref)
        self._limit = float(np.sqrt(((later - feet) ** 2).sum(axis=1).max())) / dt
        pose = np.eye(4)
        pose[:3] = fit(feet, self.x_feet, self.x_body[:, :3])
        robot.set_T_world_frame(self.params.body, pose)
        self._begins = False
        self._read_frames()

    def _feet_from_body(self, q: Vector) -> Matrix:
        """Return the places of the feet in the body's frame, [nfeet, 3]."""
        self._motion.q[:] = q
        self._motion.show()
        self._read_frames()
        pose = self._pose
        found: Matrix = (self._feet.places - pose[:3, 3]) @ pose[:3, :3]
        return found

    def _read_frames(self) -> None:
        """Read the poses of body and feet from placo."""
        robot, k, feet = self._motion.robot, self.params, self._feet
        robot.update_kinematics()
        self._pose = robot.get_T_world_frame(k.body)
        for row, foot in enumerate(k.feet):
            feet.see(row, robot.get_T_world_frame(foot))

    def _aim(self, dt: float) -> None:
        """Set the tasks to what body and feet are to reach in this cycle."""
        k, body = self.params, self._body
        gain = min(k.gain, 1.0 / dt)
        limit, turns = min(max(self._limit, STILL), k.linear), k.angular / k.linear
        body.aim(self._pose, gain, limit, limit * turns, dt)
        fast = max(self._feet.aim(gain, limit, dt), body.speed, body.rate / turns)
        self._limit = min(limit, fast) + k.accel * dt
        self._body_task.T_world_frame = body.goal
        for task, goal in self._feet_goals:
            task.target_world = goal

    def _watch(self, dt: float) -> None:
        """Report once which frame does not move as it should."""
        k = self.params
        away = self._body.missing(self._pose, k.length)
        gap, foot = self._feet.farthest()
        far = max(away, gap)
        self._motion.missed(far / k.length)
        far /= dt
        if far < 0.5 * k.short:
            self._told.clear()
        elif far >= k.short and not (self._motion.speeds_up or self._told.of("reach")):
            which = f"{k.body} cannot follow X_BODY_DES"
            if gap > away:
                which = f"{k.feet[foot]} cannot follow X_FEET_DES"
            why = self._motion.stopped()
            self._told.warn("reach", f"frame {which}: {why}")

    def _hold(self, kind: str, text: str) -> None:
        """Leave Q_REF unchanged, and report the reason once."""
        self.qd_ref[:], self._limit = 0.0, 0.0
        self._told.warn(kind, f"{text}; Q_REF does not change")

    def _fault(self) -> str:
        """Return why a goal is none."""
        if why := fault_of_pose(self.x_body):
            return f"X_BODY_DES of frame {self.params.body} is not a pose: {why}"
        if not all_finite(self.x_feet):
            finite = np.isfinite(self.x_feet).all(axis=1)
            foot = self.params.feet[int(np.argmin(finite))]
            return f"X_FEET_DES of frame {foot} is not finite"
        return ""
