"""Joint rate control with a six-axis ball: deflection sets speed."""

from typing import Annotated as A

import numpy as np

from pbonet import InConst, OutVar, Params, PortBasedObject, Vector, param
from pbonet.errors import ParameterError
from pbonet.io import AXES, Ball, RecordedBall, SerialLine
from pbonet.modules._values import PerElement, keep, spread


class Steering(Params):
    """Assignment of axes to joints, speeds and limits."""

    speed: A[PerElement, param("rad/s", "speed of each joint at full push", ge=0)]
    lower: A[PerElement, param("rad", "smallest reference of each joint")]
    upper: A[PerElement, param("rad", "largest reference of each joint")]
    device: A[str, param("none", "device file of the ball's serial line")] = ""
    trace: A[str, param("none", "name of a recorded trace to play instead")] = ""
    repeat: A[bool, param("none", "whether the trace repeats at its end")] = False
    axes: A[
        tuple[int, ...],
        param(
            "none",
            "axis of the ball for each joint, 1 to 6, minus reverses",
            ge=-6,
            le=6,
        ),
    ] = (1, 2, 3, 4, 5, 6)
    full: A[float, param("counts", "deflection at full push", gt=0)] = 400.0
    dead: A[float, param("counts", "largest deflection at rest", ge=0)] = 15.0
    enable: A[
        int, param("none", "button that must be held, 1 to 9; 0 for none", ge=0, le=9)
    ] = 0


class JtBall(PortBasedObject[Steering], module_class="teleoperation"):
    """q_ref += rate * dt, within the limits; rate = speed * push of the joint's axis.

    The reference goes on from wherever it stands when the module is turned on. When
    the ball is lost it rests: the reference stays, a warning says so, and the ball is
    looked for once a second until it is back.
    """

    ndof: A[int, InConst("NDOF", "1", "none", "degrees of freedom")]
    q_ref: A[Vector, OutVar("Q_REF", "ndof", "rad", "reference joint position")]

    def init(self) -> None:
        self._ball = self._find_ball()
        self._fault = False
        self._take_parameters()
        self._poll()  # a missing ball is reported at once

    def set(self, name: str, value: object) -> None:  # noqa: ARG002 - nearly all at once
        keep(name, {"device", "trace", "repeat"})
        self._take_parameters()

    def on(self) -> None:
        self._ball.restart()

    def cycle(self, dt: float) -> None:
        push = self._poll()[self._axis]
        size = np.minimum(np.abs(push), self.params.full) - self.params.dead
        step = np.sign(push) * np.maximum(size, 0.0) * self._gain * dt
        # a reference that starts beyond a limit may return, but not go further
        low = np.minimum(self._lower, self.q_ref)
        high = np.maximum(self._upper, self.q_ref)
        (self.q_ref + step).clip(low, high, out=self.q_ref)

    def kill(self) -> None:
        if ball := getattr(self, "_ball", None):
            ball.close()

    def _find_ball(self) -> Ball | RecordedBall:
        k = self.params
        if bool(k.device) == bool(k.trace):
            raise ParameterError(
                "the ball is either a device or a trace",
                expected="one of DEVICE and TRACE under LOCAL",
                got="both" if k.device else "none of them",
                remedy="remove one" if k.device else "add one",
            )
        if k.trace:
            return RecordedBall(k.trace, repeat=k.repeat)
        return Ball(SerialLine(k.device, 9600))

    def _take_parameters(self) -> None:
        k, n = self.params, self.ndof
        axes = np.array(k.axes[:n])
        if len(axes) < n or not axes.all() or k.dead >= k.full:
            raise ParameterError(
                "the ball's axes cannot control the joints",
                expected=f"{n} AXES out of 1 to {AXES}, and DEAD below FULL",
                got=f"AXES {k.axes}, DEAD {k.dead:g}, FULL {k.full:g}",
                remedy="give each joint an axis, and FULL more than DEAD",
            )
        speed = np.sign(axes) * spread(k.speed, n, "speed")
        limits = spread(k.lower, n, "lower"), spread(k.upper, n, "upper")
        self._axis, self._gain = np.abs(axes) - 1, speed / (k.full - k.dead)
        self._lower, self._upper = limits

    def _poll(self) -> Vector:
        ball = self._ball
        motion = ball.poll(self.task.now)
        if ball.fault and not self._fault:
            self.task.warn(f"the ball rests: {ball.fault}")
        self._fault = ball.fault is not None
        button = self.params.enable
        if button and not ball.keys.mask >> (button - 1) & 1:
            return np.zeros(AXES)
        return np.array(motion.axes, dtype=np.float64)
