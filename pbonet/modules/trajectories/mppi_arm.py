"""Model predictive path integral control of an arm, on a special purpose processor."""

from math import isfinite
from typing import Annotated as A

import numpy as np
from numpy.typing import NDArray

from pbonet import InConst, InVar, OutVar, Params, PortBasedObject, Vector, param
from pbonet.errors import ParameterError, SppError
from pbonet.io import RobotModel
from pbonet.io.mppi import sizes as at
from pbonet.io.spp import Spp
from pbonet.modules._values import PerElement, keep, rest, spread
from pbonet.modules._warn_once import WarnOnce

Floats = NDArray[np.float32]

LIBRARY = "pbonet.io.mppi.kernels"
NS = 1e-9
_FIXED = {"urdf", "frame", "spp"}


class Planning(Params):
    """The arm, the processor, how plans are made, and what is weighed in them."""

    urdf: A[str, param("none", "file of the robot, in a folder of modules")]
    frame: A[str, param("none", "link or joint whose origin goes to the goal")]
    acceleration: A[PerElement, param("rad/s^2", "largest acceleration", gt=0)]
    posture: A[PerElement, param("rad", "posture that is preferred")]
    spp: A[str, param("none", "processor: [spp.NAME] of agent.toml")] = "gpu0"
    rate: A[float, param("Hz", "plans a second, at most", gt=0)] = 50.0
    rollouts: A[int, param("none", "changes tried each time", ge=2, le=65536)] = 256
    horizon: A[int, param("none", "steps of a plan", ge=2, le=at.STEPS)] = 30
    step: A[float, param("s", "time of a step", gt=0)] = 0.02
    late: A[float, param("s", "age from which a plan is not followed", gt=0)] = 0.2
    lead: A[float, param("rad", "most of q_ref before q", gt=0)] = 0.5
    noise: A[float, param("none", "deviation tried, of the largest", gt=0)] = 0.7
    correlation: A[float, param("none", "from step to step", ge=0, lt=1)] = 0.7
    near: A[float, param("m", "distance from which less is tried", gt=0)] = 0.3
    floor: A[float, param("none", "share tried at the goal", gt=0, le=1)] = 0.05
    temperature: A[float, param("none", "of the mean cost above the least", gt=0)] = (
        0.15
    )
    end: A[float, param("none", "weight of the distance at the end", ge=0)] = 5.0
    speed: A[float, param("m", "weight of velocities", ge=0)] = 0.02
    effort: A[float, param("m", "weight of accelerations", ge=0)] = 1e-3
    away: A[float, param("m/rad^2", "weight of leaving the posture", ge=0)] = 0.02
    ball: A[PerElement, param("m", "x y z and radius that the hand keeps out of")] = (
        0.0,
    )
    inside: A[float, param("none", "weight of a metre inside of it", ge=0)] = 20.0


class MppiArm(PortBasedObject[Planning], module_class="trajectory"):
    """q_ref goes where the best of many tried motions bring the hand to the goal.

    A processor makes RATE plans a second by path integrals (Williams, Aldrich and
    Theodorou 2017). A plan has one acceleration for each joint and STEP of the HORIZON,
    and begins at the measured q and qd. ROLLOUTS changes of the last plan are tried:
    normal, NOISE times the largest acceleration, correlated from step to step, and less
    within NEAR of the goal. Each is followed through v' = v + a STEP, q' = q + v' STEP
    within the limits. Its cost is the sum of the distance d from hand to goal, of
    SPEED (v/v_max)^2 + EFFORT (a/a_max)^2 + AWAY (q - POSTURE)^2 over the joints, and
    of INSIDE times the depth of the hand in BALL, and END d at the end. The new plan is
    the mean of all, weighted by exp(-(cost - least) / (TEMPERATURE (mean - least))).

    In each cycle q_ref takes the acceleration that the newest plan has for now. It
    never leaves the limits of position, velocity (those of the URDF file) and
    acceleration, and is never faster than it can stop at them, or LEAD from q. When the
    plan is older than LATE, so also before the first one and when the processor is
    lost, and when X_GOAL is not finite, it brakes, rests, and goes on with the next
    plan; so it does in `stable`. Only the hand keeps out of BALL, not the arm.
    """

    ndof: A[int, InConst("NDOF", "1", "none", "degrees of freedom")]
    q: A[Vector, InVar("Q_MEZ", "ndof", "rad", "measured position")]
    qd: A[Vector, InVar("Q^_MEZ", "ndof", "rad/s", "measured velocity")]
    goal: A[Vector, InVar("X_GOAL", "3", "m", "goal of the hand")]
    q_ref: A[Vector, OutVar("Q_REF", "ndof", "rad", "reference joint position")]
    qd_ref: A[Vector, OutVar("Q^_REF", "ndof", "rad/s", "its velocity")]
    qdd_ref: A[Vector, OutVar("Q^^_REF", "ndof", "rad/s^2", "its acceleration")]
    age: A[float, OutVar("PLAN_AGE", "1", "s", "since the measurement of the plan")]

    def init(self) -> None:
        k = self.params
        model = RobotModel(k.urdf, self.task.libraries)
        model.must_have(self.ndof)
        if self.ndof > at.JOINTS:
            raise ParameterError(
                "the arm has more joints than the kernels can plan for",
                where=str(model.path),
                expected=f"at most {at.JOINTS}",
                got=str(self.ndof),
                remedy="fix joints in the URDF file that need not move",
            )
        self._axes, self._tip = axes_of(model, k.frame)
        self._lower, self._upper, self._fast = model.lower, model.upper, model.velocity
        self._joints = np.zeros((5, at.JOINTS), np.float32)
        self._settings = np.zeros(at.SETTINGS, np.float32)
        self._state = np.zeros((2, at.JOINTS), np.float32)
        self._spp = Spp(k.spp, LIBRARY, task=self.task)
        names = "joints", "axes", "tip", "settings", "state", "goal", "begun", "plan"
        self._at = {name: self._spp.translate(name) for name in names}
        self._update = self._spp.translate("update")
        self._told = WarnOnce(self.task)
        self._seed = self._asked = 0
        self._take()

    def set(self, name: str, value: object) -> None:  # noqa: ARG002 - by its name
        keep(name, _FIXED)
        self._take()

    def on(self) -> None:
        rest(self.task, self.qd_ref, self.qdd_ref)
        self._since = self._next = self.task.now

    def cycle(self, dt: float) -> None:
        if not all(map(isfinite, self.goal.tolist())):
            if not self._told.of("goal"):
                self._told.warn("goal", "X_GOAL is not finite: the arm stops")
            self.stable(dt)
            return
        try:
            self._ask()
        except SppError as error:
            self.task.warn(str(error))
        self._follow(dt)

    def stable(self, dt: float) -> None:
        """Brake and rest; no plan is asked for."""
        self._move(self.qd_ref / -dt, dt)

    def off(self) -> None:
        rest(self.task, self.qd_ref, self.qdd_ref)

    def kill(self) -> None:
        if spp := getattr(self, "_spp", None):
            spp.finish()

    def _ask(self) -> None:
        """Ask for the next plan, when it is time and the last one is there."""
        now, spp = self.task.now, self._spp
        if not spp.wait() or now < self._next:
            return
        k, n = self.params, self.ndof
        self._state[0, :n], self._state[1, :n] = self.q, self.qd
        passed = min((now - self._asked) * NS / k.step, float(k.horizon))
        for name, values in (
            ("joints", self._joints),
            ("axes", self._axes),
            ("tip", self._tip),
            ("settings", self._settings),
            ("state", self._state),
            ("goal", self.goal),
            ("begun", now * NS),
        ):
            spp.write(self._at[name], values)
        spp.call(self._update, n, k.horizon, k.rollouts, self._seed, passed)
        spp.read(self._at["plan"])
        spp.read(self._at["begun"])
        spp.wait()
        self._seed = (self._seed + 1) & 0x7FFFFFFF
        self._asked = now
        self._next = max(self._next + round(1e9 / k.rate), now)

    def _follow(self, dt: float) -> None:
        """Do what the newest plan says for now; brake if there is none that is new."""
        k, since = self.params, self._since * NS
        begun, plan = self._at["begun"].value, self._at["plan"].value
        start = since if begun is None else max(float(begun), since)
        self.age = self.task.now * NS - start
        place = int(self.age / k.step)
        if plan is None or start == since or self.age > k.late or place >= k.horizon:
            self.stable(dt)
            return
        self._told.clear()
        self._move(plan[place, : self.ndof], dt)

    def _move(self, wish: Vector, dt: float) -> None:
        """Let the reference take an acceleration as far as the limits allow."""
        most, v, k = self._most, self.qd_ref, self.params
        upper = np.minimum(self._upper, self.q + k.lead) - self.q_ref
        lower = self.q_ref - np.maximum(self._lower, self.q - k.lead)
        up, down = reach(upper, most, dt), reach(lower, most, dt)
        new = v + dt * wish
        np.minimum(new, np.minimum(up, self._fast), out=new)
        np.maximum(new, -np.minimum(down, self._fast), out=new)
        np.clip(new, v - dt * most, v + dt * most, out=new)
        self.qdd_ref[:] = (new - v) / dt
        self.qd_ref[:] = new
        self.q_ref += dt * new

    def _take(self) -> None:
        k, n = self.params, self.ndof
        self._most = spread(k.acceleration, n, "acceleration")
        rows = self._lower, self._upper, self._fast, self._most
        for row, values in enumerate((*rows, spread(k.posture, n, "posture"))):
            self._joints[row, :n] = values
        ball = spread(k.ball, 4, "ball")
        self._settings[at.STEP], self._settings[at.NOISE] = k.step, k.noise
        self._settings[at.KEEP], self._settings[at.FLOOR] = k.correlation, k.floor
        self._settings[at.NEAR] = k.near
        self._settings[at.TEMPERATURE] = k.temperature
        self._settings[at.DISTANT], self._settings[at.END] = 1.0, k.end
        self._settings[at.SPEED], self._settings[at.EFFORT] = k.speed, k.effort
        self._settings[at.POSTURE] = k.away
        self._settings[at.INSIDE] = k.inside if ball[3] > 0.0 else 0.0
        self._settings[at.BALL : at.BALL + 4] = ball


def reach(room: Vector, most: Vector, dt: float) -> Vector:
    """Return the velocity from which joints can stop within the room.

    The next cycle may have another length: dt room for this one, and v^2 / 2a to stop.
    """
    found: Vector = most * (np.sqrt(dt * dt + 2.0 / most * room.clip(0.0)) - dt)
    return found


def axes_of(model: RobotModel, frame: str) -> tuple[Floats, Floats]:
    """Return the axes of all joints, and where the frame is, when each joint is at 0.

    A row is the direction of a joint that turns, a point on its axis, and the way of
    one that slides; zeros for what does not move the frame.
    """
    pose, jacobian = np.empty((3, 4)), np.empty((6, model.n))
    model.jacobian(np.zeros(model.n), model.frame(frame), pose, jacobian)
    axes = np.zeros((at.JOINTS, at.AXIS), np.float32)
    for j, (way, turn) in enumerate(zip(jacobian[:3].T, jacobian[3:].T, strict=True)):
        if turn.any():
            axes[j, :3], axes[j, 3:6] = turn, pose[:, 3] + np.cross(turn, way)
        else:
            axes[j, 6:] = way
    return axes, np.asarray(pose[:, 3], dtype=np.float32)
