"""Torques of a whole robot on its feet, by placo's inverse dynamics."""

from typing import Annotated as A, Any

import numpy as np
from numpy.linalg import norm

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
from pbonet.io import FloatingModel, FrameStep, all_finite, fault_of_pose
from pbonet.modules._dh import fault_of_wrench
from pbonet.modules._legs import fault_of_base, fault_of_joints, must_have_feet
from pbonet.modules._placo_motion import placo_robot
from pbonet.modules._values import keep
from pbonet.modules._warn_once import WarnOnce
from pbonet.modules.controllers._takeover import Takeover

RATES = 6
"""Elements of placo's torques before the joints': those of the base."""
STANDS = 0.5
"""A foot of CONTACT_DES above it is one that stands."""
OFTEN = 0.05
"""Seconds from one comparison of the body's acceleration with a1 to the next."""
FULL = 1.0 - 1e-6
"""Share of its effort from which the torque of a joint is at its limit."""


class Gains(Params):
    """The robot, and how its body and joints are drawn to their references."""

    urdf: A[str, param("none", "file of the robot, in a folder of modules")]
    body: A[str, param("none", "link whose frame is the body")]
    feet: A[tuple[str, ...], param("none", "frames of the feet")]
    kp: A[float, param("1/s^2", "acceleration of the body per m or rad", ge=0)] = 200.0
    kd: A[float, param("1/s", "the same per m/s or rad/s", ge=0)] = 28.0
    joint_kp: A[float, param("1/s^2", "of a joint per rad of its error", ge=0)] = 400.0
    joint_kd: A[float, param("1/s", "the same per rad/s", ge=0)] = 40.0
    posture: A[float, param("none", "weight of the joints, the body's is 1", gt=0)] = (
        1e-3
    )
    torque: A[float, param("none", "weight of the torques, in N*m", gt=0)] = 1e-3
    grip: A[float, param("1/s", "how fast a foot that stands is to rest", ge=0)] = 20.0
    mu: A[float, param("none", "friction under the feet", gt=0)] = 0.5
    fade: A[float, param("s", "time until T_REF is what the law says", gt=0)] = 0.1
    short: A[
        float,
        param(
            "m/s^2", "acceleration, rad/s^2 too, that may be missing unreported", gt=0
        ),
    ] = 5.0


class WholeBodyDyn(PortBasedObject[Gains], module_class="controller"):
    """min (a_body - a1)^2 + posture (qdd - a2)^2 + torque tau^2.

    With M a + h + d qd = tau + J^T f, where a1 = kp * (x_des - x) + kd * (xd_des - xd)
    of the body, and a2 is the same of the joints, by Q_REF. Solved in each cycle by
    placo's quadratic program for the accelerations, the torques, and the force f at
    each foot of which CONTACT_DES says that it stands: it pushes only, within the cone
    of friction MU, and the foot is not accelerated but to rest, by GRIP. Torques stay
    within the efforts of the URDF file. The other feet go where Q_REF takes them. M, h
    and the friction d are those of the file. When the module is turned on it goes on
    from the T_REF that is there, and the distance fades.

    A goal pulls by KP times its distance, with no limit but efforts and friction: one
    that jumps makes T_REF jump, so let goals move no faster than the robot can. While
    the body lacks at least SHORT of a1, as when its goal is out of reach, a warning
    says so within 0.05 s, with the joints at their efforts: once, until it lacks less
    than half of that. A program without a solution, or a value that is not finite, ends
    in ERROR: T_REF gets old, and the robot interface holds the robot.
    """

    ndof: A[int, InConst("NDOF", "1", "none", "degrees of freedom")]
    x_des: A[Matrix, InVar("X_BODY_DES", "3,4", "mixed", "desired pose of the body")]
    v_des: A[Vector, InVar("X^_BODY_DES", "6", "mixed", "its velocity, m/s and rad/s")]
    contact: A[Vector, InVar("CONTACT_DES", "nfeet", "none", "1 for a standing foot")]
    q_ref: A[Vector, InVar("Q_REF", "ndof", "rad", "reference position")]
    qd_ref: A[Vector, InVar("Q^_REF", "ndof", "rad/s", "reference velocity")]
    x: A[Matrix, InVar("X_MEZ", "3,4", "mixed", "pose of the base, [R p], p in m")]
    v: A[Vector, InVar("X^_MEZ", "6", "mixed", "its velocity, m/s and rad/s")]
    q: A[Vector, InVar("Q_MEZ", "ndof", "rad", "measured position")]
    qd: A[Vector, InVar("Q^_MEZ", "ndof", "rad/s", "measured velocity")]
    tau: A[Vector, OutVar("T_REF", "ndof", "N*m", "commanded torque")]

    def init(self) -> None:
        k = self.params
        self._model = FloatingModel(k.urdf, self.task.libraries)
        self._model.joints.must_have(self.ndof)
        self._model.frame(k.body)
        must_have_feet(self._model.joints, k.feet, len(self.contact), "CONTACT_DES")
        effort = self._model.joints.effort
        self._dt = 0.0
        self._told = WarnOnce(self.task)
        self._takeover = Takeover(self.tau)
        self._takeover.bound(-effort, effort)
        self._make_program()
        self._take_gains()

    def set(self, name: str, value: object) -> None:  # noqa: ARG002 - by its name
        keep(name, {"urdf", "body", "feet"})
        self._take_gains()

    def on(self) -> None:
        self._told.clear()
        self._unseen = OFTEN
        self._takeover.begin()

    def cycle(self, dt: float) -> None:
        if not self._show():
            self.task.fail(self._fault())
            return
        self._aim()
        law = self._solve(dt)
        if law is None:
            names = " ".join(foot for foot, _ in self._standing) or "no foot"
            self.task.fail(
                "no torques within the efforts of the joints and the friction under "
                f"the feet keep what stands where it is: {names}"
            )
            return
        self._takeover.apply(law, dt, self.params.fade)

    def _show(self) -> bool:
        """Tell placo where the robot is and how it moves; False if a value is none."""
        model, robot = self._model, self._robot
        given = self.v_des, self.contact, self.q_ref, self.qd_ref
        if (
            not model.move(self.x, self.v, self.q, self.qd)
            or not all_finite(*given)
            or not self._pose.take()
        ):
            return False
        robot.state.q, robot.state.qd = model.q, model.v
        robot.update_kinematics()
        return True

    def _aim(self) -> None:
        """Set goals of body and joints, and which feet stand where they are."""
        self._body.T_world_frame = self._pose.goal
        self._body_place.dtarget_world = self._v_des[0]
        self._body_turn.omega_world = self._v_des[1]
        joints, set_joint = self._model.joints.joints, self._posture.set_joint
        goals = zip(joints, self.q_ref.tolist(), self.qd_ref.tolist(), strict=True)
        for name, q, qd in goals:
            set_joint(name, q, qd)
        stands = [up > STANDS for up in self.contact.tolist()]
        if stands != self._stood:
            self._stand(stands)
        where = self._robot.get_T_world_frame
        for foot, task in self._standing:
            task.target_world = where(foot)[:3, 3]

    def _solve(self, dt: float) -> Vector | None:
        """Return the torques; None if there are none."""
        if dt != self._dt:
            self._dt = self._solver.dt = dt
        try:
            found = self._solver.solve(False)  # noqa: FBT003 - placo's
        except RuntimeError:
            return None
        if not found.success:
            return None
        torque: Vector = found.tau[RATES:]
        self._unseen += dt
        if self._unseen >= OFTEN:  # each time would take 4 us
            self._unseen = 0.0
            self._watch(found, torque)
        self._model.joints.add_damping(torque, self.qd)
        return torque

    def _watch(self, found: Any, torque: Vector) -> None:  # noqa: ANN401 - placo's
        """Report once that the body is not accelerated as its goal demands."""
        short, missing = self.params.short, 0.0
        for task in (self._body_place, self._body_turn):
            wanted = task.b
            if (
                np.dot(wanted, wanted) >= 0.25 * short * short
            ):  # else too little to lack
                missing = max(missing, float(norm(task.A @ found.qdd - wanted)))
        if missing < 0.5 * short:
            self._told.clear()
        elif missing >= short and not self._told.of("reach"):
            self._told.warn(
                "reach",
                f"frame {self.params.body} cannot follow X_BODY_DES, {missing:.2g} "
                f"m/s^2 or rad/s^2 are missing: {self._stopped(torque)}",
            )

    def _stopped(self, torque: Vector) -> str:
        """Return the joints whose torques are at their limits."""
        model = self._model.joints
        full = np.abs(torque) >= FULL * model.effort
        names = [
            name for name, is_full in zip(model.joints, full, strict=True) if is_full
        ]
        if not names:
            return "the friction under the feet or the weight of torques holds it back"
        return f"the torque of {', '.join(names)} is at its limit"

    def _fault(self) -> str:
        """Return which value is none."""
        k, names = self.params, self._model.joints.joints
        if why := fault_of_pose(self.x_des):
            return f"X_BODY_DES of frame {k.body} is not a pose: {why}"
        if why := fault_of_wrench(f"X^_BODY_DES of frame {k.body}", self.v_des):
            return why
        if not all_finite(self.contact):
            foot = k.feet[int(np.argmin(np.isfinite(self.contact)))]
            return f"CONTACT_DES of {foot} is not finite"
        return (
            fault_of_base(self.x, self.v)
            or fault_of_joints("Q_MEZ", self.q, names)
            or fault_of_joints("Q^_MEZ", self.qd, names)
            or fault_of_joints("Q_REF", self.q_ref, names)
            or fault_of_joints("Q^_REF", self.qd_ref, names)
        )

    def _make_program(self) -> None:
        """Make placo's program, in which no foot stands yet."""
        k = self.params
        placo, self._robot = placo_robot(self._model.joints, "inverse dynamics")
        self._solver = solver = placo.DynamicsSolver(self._robot)
        solver.enable_torque_limits(True)  # noqa: FBT003 - placo's
        self._pose = FrameStep(self.x_des)
        self._body = solver.add_frame_task(k.body, self._pose.goal)
        self._body_place = self._body.position()
        self._body_turn = self._body.orientation()
        self._v_des = self.v_des[:3], self.v_des[3:]
        self._posture = solver.add_joints_task()
        self._feet = [solver.add_position_task(foot, np.zeros(3)) for foot in k.feet]
        self._contacts = [
            solver.add_unilateral_point_contact(task) for task in self._feet
        ]
        self._stand([False] * len(k.feet))

    def _stand(self, stands: list[bool]) -> None:
        """Let feet stand; the others go where their joints take them."""
        self._stood = stands
        self._standing: list[tuple[str, Any]] = []
        feet = zip(self.params.feet, self._feet, self._contacts, stands, strict=True)
        for foot, task, contact, stands_there in feet:
            contact.active = stands_there
            if stands_there:
                task.configure(foot, "hard")
                self._standing.append((foot, task))
            else:
                task.configure(foot, "soft", 0.0)

    def _take_gains(self) -> None:
        k = self.params
        self._body.configure("body", "soft", 1.0, 1.0)
        for task in (self._body_place, self._body_turn):
            task.kp, task.kd = k.kp, k.kd
        self._posture.configure("posture", "soft", k.posture)
        self._posture.kp, self._posture.kd = k.joint_kp, k.joint_kd
        self._solver.torque_cost = k.torque
        for task, contact in zip(self._feet, self._contacts, strict=True):
            task.kp, task.kd, contact.mu = 0.0, k.grip, k.mu
