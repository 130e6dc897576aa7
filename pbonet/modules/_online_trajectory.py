"""Online trajectories with limited velocity, acceleration and jerk, by ruckig.

Ruckig computes the fastest motion that keeps the limits of every axis, from any state
to a new goal, within one cycle (Berscheid and Kroeger 2021, "Jerk-limited Real-time
Trajectory Generation with Arbitrary Target States").
"""

from __future__ import annotations

from importlib import import_module
from typing import TYPE_CHECKING, Any

from pbonet.errors import DeviceError

if TYPE_CHECKING:
    from types import ModuleType

    from pbonet import Vector

LESS = 1.0 - 1e-9
"""The share of the jerk with which a motion is found that ruckig did not find.

Where a phase of a motion has no length, as on a way of exactly 2 a^3 / j^2, rounding
makes ruckig refuse it: a few of a thousand goals in whole centimetres.
"""


class OnlineTrajectory:
    """A motion of `n` axes that is brought to a goal, which may change in each cycle.

    All axes arrive at the same time.

    Args:
        n: Number of axes.

    Attributes:
        position: In the unit of the axis, as of the last `step`.
        velocity: The same per s.
        acceleration: The same per s^2.

    Raises:
        DeviceError: ruckig is not installed.
    """

    position: list[float]
    velocity: list[float]
    acceleration: list[float]

    def __init__(self, n: int) -> None:
        self._ruckig: Any = _ruckig()
        self._solver = self._ruckig.Ruckig(n, 0.01)  # each step sets its own time
        self._state = self._ruckig.InputParameter(n)
        self._next = self._ruckig.OutputParameter(n)
        self._rest = [0.0] * n
        self._to_position = self._ruckig.ControlInterface.Position

    def limit(self, velocity: Vector, acceleration: Vector, jerk: Vector) -> None:
        """Set the limits of each axis, also during a motion."""
        self._state.max_velocity = velocity.tolist()
        self._state.max_acceleration = acceleration.tolist()
        self._state.max_jerk = jerk.tolist()

    def start(self, position: Vector, velocity: Vector, acceleration: Vector) -> None:
        """Begin in this state, whatever was before, and brake."""
        state = self._state
        self._solver.reset()
        state.current_position = self.position = position.tolist()
        state.current_velocity = self.velocity = velocity.tolist()
        state.current_acceleration = self.acceleration = acceleration.tolist()
        self.brake()

    def aim(self, goal: list[float]) -> None:
        """Go to this position, and rest there."""
        self._state.control_interface = self._to_position
        self._state.target_position = goal

    def brake(self) -> None:
        """Come to rest, wherever that is."""
        self._state.control_interface = self._ruckig.ControlInterface.Velocity
        self._state.target_velocity = self._rest

    def step(self, dt: float) -> bool:
        """Go on by `dt` seconds; return whether the motion has ended.

        Raises:
            ValueError: There is no such motion, such as with a speed of 1e300.
        """
        self._solver.delta_time = dt
        try:
            result = self._update()
        except self._ruckig.RuckigError as error:
            raise ValueError(
                "ruckig finds no trajectory: " + str(error).strip().partition("\n")[0]
            ) from None
        self._next.pass_to_input(self._state)
        self.position = self._next.new_position
        self.velocity = self._next.new_velocity
        self.acceleration = self._next.new_acceleration
        return bool(result == self._ruckig.Result.Finished)

    def _update(self) -> Any:  # noqa: ANN401 - ruckig's
        state = self._state
        try:
            return self._solver.update(state, self._next)
        except self._ruckig.RuckigError:
            state.max_jerk = [LESS * jerk for jerk in state.max_jerk]
            return self._solver.update(state, self._next)


def _ruckig() -> ModuleType:
    try:
        return import_module("ruckig")
    except ImportError:
        raise DeviceError(
            "online trajectories need ruckig, which is not installed",
            where="modules otg and otg_cart",
            remedy="pip install 'pbonet[trajectory]'",
        ) from None
