"""Inverse kinematics within the limits of the joints, by placo."""

from typing import Annotated as A

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
from pbonet.io import FrameStep, RobotModel, all_finite, fault_of_pose
from pbonet.modules._placo_motion import PlacoMotion
from pbonet.modules._values import keep, rest
from pbonet.modules._warn_once import WarnOnce


class Pursuit(Params):
    """The robot, and how its hand is taken to the goal."""

    urdf: A[str, param("none", "file of the robot, in a folder of modules")]
    frame: A[str, param("none", "link whose frame is the hand")]
    gain: A[float, param("1/s", "gain of the error, at most one per cycle", gt=0)] = (
        10.0
    )
    linear: A[float, param("m/s", "largest linear speed of the hand", gt=0)] = 0.5
    angular: A[float, param("rad/s", "largest angular speed of the hand", gt=0)] = 1.5
    joint_accel: A[
        float, param("rad/s^2", "how fast a joint's velocity may change", gt=0)
    ] = 20.0
    length: A[float, param("m", "counts as much as one radian", gt=0)] = 0.2
    damping: A[float, param("none", "weight of the joints' own motion", gt=0)] = 1e-4
    short: A[float, param("m/s", "speed that may be missing unreported", gt=0)] = 0.01


class IkPlaco(PortBasedObject[Pursuit], module_class="kinematics"):
    """min (J dq - v dt)^2 + damping dq^2, with v = gain * (x_des - x) + xd_des.

    Solved in each cycle by placo's quadratic program, within the limits of position
    and velocity that the URDF file gives each joint; x and J are those at Q_REF itself,
    so nothing is measured. Rows of positions are counted in LENGTH. Q_REF goes on from
    where it stands when the module is turned on, and a goal far away is approached at
    LINEAR and ANGULAR. No joint's velocity changes faster than JOINT_ACCEL, from a
    predecessor's Q^_REF on, and each brakes before its limit. Where GAIN times their
    speeds is more than JOINT_ACCEL, the hand passes its goal and comes back. A goal
    that cannot be reached takes the hand as near as the joints allow, and DAMPING grows
    with what is missing, so that they come to rest there; a warning names those that
    stand at a limit. What is no pose, or a program without a solution, leaves Q_REF
    where it is.
    """

    ndof: A[int, InConst("NDOF", "1", "none", "degrees of freedom")]
    x_des: A[Matrix, InVar("X_DES", "3,4", "mixed", "desired pose, [R p], p in m")]
    v_des: A[Vector, InVar("X^_DES", "6", "mixed", "its velocity, m/s and rad/s")]
    q_ref: A[Vector, OutVar("Q_REF", "ndof", "rad", "reference joint position")]
    qd_ref: A[Vector, OutVar("Q^_REF", "ndof", "rad/s", "reference joint velocity")]

    def init(self) -> None:
        self._take_robot()

    def set(self, name: str, value: object) -> None:  # noqa: ARG002 - by its name
        keep(name, {"urdf", "frame", "length", "damping"})

    def on(self) -> None:
        rest(self.task, self.qd_ref)
        self._told.clear()
        self._motion.q[:] = self.q_ref
        self._motion.show()
        self._x = self._motion.robot.get_T_world_frame(self.params.frame)

    def cycle(self, dt: float) -> None:
        if why := self._fault():
            self._hold("goal", why)
            return
        k, motion, hand = self.params, self._motion, self._hand
        hand.aim(self._x, min(k.gain, 1.0 / dt), k.linear, k.angular, dt)
        self._task.T_world_frame = hand.goal
        if motion.step(dt, k.joint_accel):
            motion.robot.update_kinematics()
            self._x = motion.robot.get_T_world_frame(k.frame)
            missing = hand.missing(self._x, k.length)
            motion.missed(missing / k.length)
            self._watch(missing / dt)
        else:
            why = motion.stopped()
            self._hold("limits", f"no joint motion keeps the limits: {why}")

    def off(self) -> None:
        rest(self.task, self.qd_ref)

    def _fault(self) -> str:
        """Return why the goal is none."""
        if why := fault_of_pose(self.x_des):
            return f"X_DES of frame {self.params.frame} is not a pose: {why}"
        if not all_finite(self.v_des):
            return f"X^_DES of frame {self.params.frame} is not finite"
        return ""

    def _hold(self, kind: str, text: str) -> None:
        """Leave Q_REF unchanged, and report the reason once."""
        self.qd_ref[:] = 0.0
        self._told.warn(kind, f"{text}; Q_REF does not change")

    def _watch(self, missing: float) -> None:
        """Report once that the hand does not move as it should, by so many m/s."""
        short = self.params.short
        if missing < 0.5 * short:
            self._told.clear()
        elif missing >= short and not (
            self._motion.speeds_up or self._told.of("reach")
        ):
            why = self._motion.stopped()
            self._told.warn(
                "reach", f"frame {self.params.frame} cannot follow X_DES: {why}"
            )

    def _take_robot(self) -> None:
        k = self.params
        self._model = RobotModel(k.urdf, self.task.libraries)
        self._model.must_have(self.ndof)
        self._model.frame(k.frame)  # which must be there
        self._told = WarnOnce(self.task)
        self._hand = FrameStep(self.x_des, self.v_des)
        self._motion = PlacoMotion(
            self._model,
            k.damping,
            floats=False,
            q_ref=self.q_ref,
            qd_ref=self.qd_ref,
        )
        self._task = self._motion.solver.add_frame_task(k.frame, self._hand.goal)
        self._task.configure("hand", "soft", k.length**-2, 1.0)
