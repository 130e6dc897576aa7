"""Steps of a legged robot, from the velocity that its body is to have."""

from typing import Annotated as A

import numpy as np
from numpy.typing import NDArray

from pbonet import InVar, Matrix, OutVar, Params, PortBasedObject, Vector, param
from pbonet.errors import ParameterError
from pbonet.modules._values import PerElement, grid, spread
from pbonet.modules._wheeled_base import Command, motion

Flags = NDArray[np.bool_]

NEAR = 1e-6
"""Distance from its place, m, at which a foot need not step."""


class Steps(Params):
    """Places and times of the steps; the defaults are a trot of four legs."""

    feet: A[
        PerElement, param("m", "place of each foot in the body: x y z, foot by foot")
    ]
    period: A[float, param("s", "time from step to step of a foot", gt=0)] = 0.5
    stance: A[float, param("none", "share of it on the ground", gt=0, lt=1)] = 0.6
    phases: A[
        PerElement,
        param("none", "share of the period by which each foot is ahead", ge=0, lt=1),
    ] = (0.0, 0.5, 0.5, 0.0)
    height: A[float, param("m", "height to which a foot is lifted", ge=0)] = 0.05


class Gait(PortBasedObject[Steps], module_class="trajectory"):
    """Feet on the ground move as it does; the others step to where the body will be.

    On the ground a foot moves by the inverse of the body's motion, exactly for a
    constant velocity (the exponential of SE(2)), so that it does not slip. In the air
    it goes to where the body's motion in half the time of a stance takes its place
    (Raibert 1986), by the share b = 10 s^3 - 15 s^4 + 6 s^5 of the way, and up by 16
    HEIGHT s^2 (1 - s)^2, with s the share of the time. Without a velocity the feet step
    to their places, and then stand. When V_DES is older than 0.5 s or not finite, and
    in `stable`, they do the same. They begin where the table says they are; without
    that, in their places. All feet are on the ground at first, so each phase is
    less than STANCE.
    """

    v_des: A[
        Vector,
        InVar(
            "V_DES",
            "3",
            "mixed",
            "velocity of the body: m/s forward, m/s to the left, rad/s",
            max_age=0.5,
            stale="stable",
        ),
    ]
    feet: A[
        Matrix, OutVar("X_FEET_DES", "nfeet,3", "m", "feet in the body's axes, x y z")
    ]
    contact: A[
        Vector,
        OutVar("CONTACT_DES", "nfeet", "none", "1 for a foot on the ground, or 0"),
    ]

    def init(self) -> None:
        self._command = Command(self.task, sideways=True)
        self._take_steps()

    def set(self, name: str, value: object) -> None:  # noqa: ARG002 - all at once
        self._take_steps()

    def on(self) -> None:
        if not (self.feet.any() and np.isfinite(self.feet).all()):
            self.feet[:] = self._places
        self._share = np.zeros(len(self.feet))  # of the time in the air, 0 before
        self._clock = 0.0
        self.contact[:] = 1.0

    def cycle(self, dt: float) -> None:
        self._walk(self._command.take(self.v_des), dt)

    def stable(self, dt: float) -> None:
        """Step to the places of the feet, and stand there."""
        self._walk((0.0, 0.0, 0.0), dt)

    def _walk(self, v: tuple[float, float, float], dt: float) -> None:
        k = self.params
        away = np.abs(self.feet - self._places).max() > NEAR
        if any(v) or away or not self.contact.all():
            self._clock = (self._clock + dt / k.period) % 1.0
        phase = (self._clock + self._phases) % 1.0
        lifted = phase >= k.stance
        landing = ~lifted & (self._share > 0.0)
        share = np.where(lifted, (phase - k.stance) / (1.0 - k.stance), 0.0)
        self._push_back(v, dt, ~lifted & ~landing)
        self._step(v, np.where(landing, 1.0, share), lifted | landing)
        self._share = share
        self.contact[:] = ~lifted

    def _push_back(
        self, v: tuple[float, float, float], dt: float, which: Flags
    ) -> None:
        """Move the feet on the ground against the body."""
        moved = motion(*v, dt)
        ground = (self.feet - moved[:, 3]) @ moved[:, :3]
        self.feet[which] = ground[which]

    def _step(self, v: tuple[float, float, float], share: Vector, which: Flags) -> None:
        """Move the feet in the air to this share of their time."""
        k = self.params
        ahead = motion(*v, 0.5 * k.stance * k.period)
        goal = self._places @ ahead[:, :3].T + ahead[:, 3]
        was, now = _least_jerk(self._share), _least_jerk(share)
        part = (now - was) / np.maximum(1.0 - was, 1e-12)
        part = np.minimum(np.maximum(part, 0.0), 1.0)[:, None]
        level = self.feet + part * (goal - self.feet)
        level[:, 2] = (
            self._places[:, 2] + k.height * 16.0 * (share * (1.0 - share)) ** 2
        )
        self.feet[which] = level[which]

    def _take_steps(self) -> None:
        k, n = self.params, len(self.feet)
        self._places = grid(k.feet, n, 3, "feet")
        self._phases = spread(k.phases, n, "phases")
        if (self._phases >= k.stance).any():
            raise ParameterError(
                "the robot would have to begin with a foot in the air",
                expected=f"each of PHASES below STANCE, {k.stance:g}",
                got=" ".join(f"{phase:g}" for phase in self._phases),
                remedy="raise STANCE, or count the phases from another foot",
            )


def _least_jerk(share: Vector) -> Vector:
    """Return the share of the way for shares of the time."""
    way: Vector = share**3 * (10.0 - 15.0 * share + 6.0 * share**2)
    return way
