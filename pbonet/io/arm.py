"""A simulated arm with the interface of a real one.

A robot-interface module sends torques and reads joint angles and velocities. Here they
come from the equations of motion of the published arm, with its motors' inertia and the
friction of its gears, instead of from amplifiers and encoders. Only `advance` differs
from a real arm, which needs no call for time to pass.

The integration is semi-implicit with sub-steps: viscous and Coulomb friction and the
end stops act on the velocity at the end of a step. So a joint sticks when friction can
hold it and slips when it cannot, exactly and without chatter, at any step.
"""

from __future__ import annotations

from math import ceil
from typing import TYPE_CHECKING

import numpy as np

from ._friction import FrictionStep
from .chain import Chain

if TYPE_CHECKING:
    from numpy.typing import ArrayLike, NDArray

    from .puma560 import ArmData

    Floats = NDArray[np.float64]


class SimulatedArm:
    """The equations of motion of an arm, advanced as time passes.

    It starts with its brakes on. Like a real drive it brakes by itself when no torque
    command has come for `watchdog` seconds; that also bounds the work of `advance`.

    Args:
        data: The arm's numbers.
        substep: Longest integration step, seconds. At 1 ms the joints of an arm that
            swings are within 1 mrad of where steps sixteen times as short take them.
        watchdog: Seconds that a torque command is good for.
    """

    def __init__(
        self, data: ArmData, *, substep: float = 1e-3, watchdog: float = 0.1
    ) -> None:
        self.data = data
        self.chain = Chain(data.dh, data.mass, data.com, data.inertia, data.rotor)
        self.braked = True
        self._substep = substep
        self._watchdog = watchdog
        self._since_command = 0.0
        self._q = np.zeros(data.ndof)
        self._qd = np.zeros(data.ndof)
        self._torque = np.zeros(data.ndof)
        self._lowest = -np.asarray(data.torque, np.float64)
        self._step = FrictionStep(
            self._q,
            self._qd,
            self._torque,
            viscous=data.viscous,
            down=data.coulomb_down,
            up=data.coulomb_up,
            lower=data.lower,
            upper=data.upper,
        )

    @property
    def q(self) -> Floats:
        """Joint angles as measured by the encoders, rad."""
        return self._q

    @property
    def qd(self) -> Floats:
        """Joint velocities, rad/s."""
        return self._qd

    def place(self, q: ArrayLike, qd: ArrayLike) -> None:
        """Put the arm somewhere, which can be done to a simulated one only."""
        np.clip(q, self.data.lower, self.data.upper, out=self._q)
        self._qd[:] = qd

    def release_brakes(self) -> None:
        """Let the motors carry the arm; a command must follow within the watchdog."""
        self.braked = False
        self._since_command = 0.0
        self._torque[:] = 0.0

    def brake(self) -> None:
        """Stop the arm where it is and cut the motors off."""
        self.braked = True
        self._qd[:] = 0.0
        self._torque[:] = 0.0

    def command(self, torque: Floats) -> None:
        """Set the motors' torques at the joints, N*m; the drives limit them."""
        np.minimum(
            np.maximum(torque, self._lowest, self._torque),
            self.data.torque,
            self._torque,
        )
        self._since_command = 0.0

    def advance(self, dt: float) -> None:
        """Let `dt` seconds pass."""
        if self.braked:
            return
        left = self._watchdog - self._since_command
        self._since_command += dt
        time, chain, q = min(dt, left), self.chain, self._q
        steps = max(1, ceil(time / self._substep))
        for _ in range(steps):
            mass = chain.mass_matrix(q)
            self._step.advance(mass, chain.bias(q, self._qd), time / steps)
        if dt > left:
            self.brake()
