"""Axes that are simulated, with the ports of those that drives move."""

from typing import Annotated as A, TypeVar

from pbonet import param

from ._axes import Axes, Joints
from ._values import PerElement, spread


class Body(Joints, kw_only=True):
    """How the axes stop."""

    slow: A[PerElement, param("rad/s^2", "deceleration of a quick stop", gt=0)] = (
        10.0,
    )


B = TypeVar("B", bound=Body)


class SimulatedAxes(Axes[B], abstract=True):
    """Axes that begin where the table says that they were seen last."""

    def on(self) -> None:
        self._rest()
        self.ready = 1

    def cycle(self, dt: float) -> None:
        if not self._is_sound():
            return
        if not self.ready:
            self._rest()  # they were stopped
        self._wish(dt)
        self._move(dt)
        self.ready = 1

    def stable(self, dt: float) -> None:
        """Stop quickly."""
        slow = spread(self.params.slow, len(self.q), "slow") * dt
        self.qd -= self.qd.clip(-slow, slow)
        self.q += self.qd * dt
        self.tau[:] = 0.0
        self.ready = 0

    def off(self) -> None:
        if not self.task.handover:
            self.qd[:], self.tau[:] = 0.0, 0.0
            self.ready = 0

    def _move(self, dt: float) -> None:
        """Let the axes do what `_goal` says for `dt` seconds."""
        raise NotImplementedError
