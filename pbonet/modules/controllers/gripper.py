"""Control of a gripper: it opens, closes, and holds what is between its fingers."""

from typing import Annotated as A

import numpy as np

from pbonet import InVar, OutVar, Params, PortBasedObject, UserSignal, Vector, param
from pbonet.modules.controllers._takeover import Takeover

MOVES, ARRIVED, HOLDS = range(3)


class Grip(Params):
    """How fast and how strongly it grips, and what counts as held."""

    kp: A[float, param("N/m", "stiffness", gt=0)]
    kd: A[float, param("N*s/m", "damping", ge=0)]
    speed: A[float, param("m/s", "speed of the reference", gt=0)]
    force: A[float, param("N", "largest force of a drive", gt=0)]
    near: A[float, param("m", "from W_DES that counts as there", gt=0)] = 1e-3
    still: A[float, param("m/s", "speed that counts as none", gt=0)] = 2e-3
    settle: A[float, param("s", "how long they must stand to hold", ge=0)] = 0.1
    fade: A[float, param("s", "time until F_GRIP is what the law says", gt=0)] = 0.1


class Gripper(PortBasedObject[Grip], module_class="controller"):
    """f = kp (r - w) - kd w_dot, within +-FORCE, where r goes to w_des at SPEED.

    One W for each drive. r is never further from w than FORCE / KP: fingers that
    something holds up press on it by KP times the way that is left, at most FORCE, and
    when it gives way they go on from where they are. GRIP is 1 while all drives are as
    near as NEAR to W_DES. It is 2, something is held, when drives and r have not moved
    faster than STILL for SETTLE seconds; and stays 2 until W_DES is another one, or a
    drive is further than NEAR from there, which is signalled as LOST. Else it is 0.
    When the module is turned on r begins where the spring has the F_GRIP that is there,
    so that what another gripper holds is not let go; what is left of it fades.
    """

    ARRIVED = UserSignal(0, "the fingers are at W_DES")
    HOLDS = UserSignal(1, "the fingers hold something")
    LOST = UserSignal(2, "what the fingers held is gone, or slips")

    w_des: A[Vector, InVar("W_DES", "ngrip", "m", "desired opening")]
    w: A[Vector, InVar("W_MEZ", "ngrip", "m", "measured opening")]
    wd: A[Vector, InVar("W^_MEZ", "ngrip", "m/s", "its velocity")]
    f: A[Vector, OutVar("F_GRIP", "ngrip", "N", "commanded force, positive opens")]
    grip: A[int, OutVar("GRIP", "1", "none", "0 moves, 1 is at W_DES, 2 holds")]

    def init(self) -> None:
        self._r, self._goal, self._held = np.zeros((3, len(self.f)))
        self._takeover = Takeover(self.f)
        self._take_force()

    def set(self, name: str, value: object) -> None:  # noqa: ARG002 - all at once
        self._take_force()

    def on(self) -> None:
        k = self.params
        self._r[:] = self.w + self.f.clip(-k.force, k.force) / k.kp
        self._state, self._stood = MOVES, 0.0
        self._takeover.begin()

    def cycle(self, dt: float) -> None:
        k, r = self.params, self._r
        step, reach = k.speed * dt, k.force / k.kp
        before = r.copy()
        r += (self.w_des - r).clip(-step, step)
        ahead = (r - self.w).clip(-reach, reach)
        np.add(self.w, ahead, out=r)
        self._takeover.apply(k.kp * ahead - k.kd * self.wd, dt, k.fade)
        still = np.abs(r - before).max() < k.still * dt
        still = still and np.abs(self.wd).max() < k.still
        self._stood = self._stood + dt if still else 0.0
        state = self._judge()
        if state != self._state:
            self._report(state)
        self._state = self.grip = state

    def _judge(self) -> int:
        """Return whether the fingers move, are where they are to be, or hold."""
        k = self.params
        if self._state == HOLDS:
            if self._is_told() and not self._is_gone():
                return HOLDS
            self._stood = 0.0
        if np.abs(self.w_des - self.w).max() <= k.near:
            return ARRIVED
        return HOLDS if self._stood > k.settle else MOVES

    def _is_told(self) -> bool:
        """Return whether W_DES is the one at which the fingers hold something."""
        return bool((self.w_des == self._goal).all())

    def _is_gone(self) -> bool:
        """Return whether a drive has moved since the fingers hold something."""
        return bool(np.abs(self.w - self._held).max() > self.params.near)

    def _report(self, state: int) -> None:
        """Signal what has changed; remember where the fingers hold something."""
        if self._state == HOLDS and self._is_told():
            self.task.signal(self.LOST)
        if state == ARRIVED:
            self.task.signal(self.ARRIVED)
        elif state == HOLDS:
            self.task.signal(self.HOLDS)
            self._held[:], self._goal[:] = self.w, self.w_des

    def _take_force(self) -> None:
        self._takeover.bound(-self.params.force, self.params.force)
