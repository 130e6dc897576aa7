"""The robot interface of a base on wheels that MuJoCo simulates.

A module with these ports and the drives of a real base in place of `MujocoRobot` would
replace it without a change anywhere else.
"""

from typing import Annotated as A

import numpy as np

from pbonet import InVar, Matrix, OutVar, Params, PortBasedObject, Vector, param
from pbonet.errors import ParameterError, did_you_mean
from pbonet.io import MujocoRobot, all_finite, fault_of_pose
from pbonet.modules._values import PerElement, keep, spread


class Drives(Params):
    """The model of the base, and the drives of its wheels."""

    model: A[str, param("none", "MJCF file of the base, in a folder of modules")]
    wheels: A[tuple[str, ...], param("none", "joints of the wheels, as in W_REF")]
    gain: A[PerElement, param("N*m*s/rad", "torque for each rad/s of error", gt=0)]
    slow: A[PerElement, param("rad/s^2", "deceleration in `stable`", gt=0)] = (20.0,)
    step: A[float, param("s", "longest step of the simulation", gt=0)] = 1e-3


class MujocoBase(PortBasedObject[Drives], module_class="robot interface"):
    """tau = gain * (w_ref - w) at each wheel, within what its joint bears.

    Any base that moves freely and is driven by the rates of its wheels: two with a
    castor, four of mecanum. Joints that are not named as wheels turn without a torque.
    X_FIX is where the base really is, as a camera or a laser would see it, and GYR what
    a gyroscope on it shows. The base begins where the table says that it was seen last,
    or, while X_FIX is no pose, where the file puts it; it and its wheels move as the
    table says, and so go on at a handover. Without rates that are fresh, or while the
    configuration is illegal, the wheels slow down by SLOW and stop. Their drives hold
    rates and not places: on a slope the base then creeps. While the task is OFF the
    brakes are on: no time passes for the base.
    """

    w_ref: A[
        Vector,
        InVar("W_REF", "nwheels", "rad/s", "wheel rates", max_age=0.1, stale="stable"),
    ]
    w: A[Vector, OutVar("W_MEZ", "nwheels", "rad/s", "measured wheel rates", new=True)]
    gyr: A[
        Vector,
        OutVar("GYR", "3", "rad/s", "angular velocity in the base's axes", new=True),
    ]
    x: A[Matrix, OutVar("X_FIX", "3,4", "mixed", "pose of the base, [R p]", new=True)]
    v: A[
        Vector,
        OutVar("X^_FIX", "6", "mixed", "its velocity, m/s and rad/s", new=True),
    ]

    def init(self) -> None:
        k = self.params
        self._robot = MujocoRobot(
            k.model, self.task.libraries, step=k.step, floats=True
        )
        self._wheels = np.array(self._find_wheels())
        self._q, self._torque = np.zeros(self._robot.n), np.zeros(self._robot.n)
        self._take_drives()

    def set(self, name: str, value: object) -> None:  # noqa: ARG002 - by its name
        keep(name, {"model", "wheels", "step"})
        self._take_drives()

    def on(self) -> None:
        # A simulated base stands where the table says that it was seen last; that of a
        # real one would be overwritten here by what its sensors say.
        robot, rates = self._robot, np.zeros(self._robot.n)
        rates[self._wheels] = self.w
        robot.place(self._q, rates)
        if not fault_of_pose(self.x):
            robot.place_base(self.x, self.v)
        self._measure()
        self._wish = self.w.copy()

    def cycle(self, dt: float) -> None:
        if not all_finite(self.w_ref):
            wheel = self.params.wheels[int(np.argmin(np.isfinite(self.w_ref)))]
            self.task.fail(f"W_REF of wheel {wheel} is not finite; the brakes are on")
            return
        self._sense(dt)
        self._wish[:] = self.w_ref
        self._drive()

    def stable(self, dt: float) -> None:
        """Slow the wheels down, to a rate of zero."""
        self._sense(dt)
        step = self._slow * dt
        self._wish -= self._wish.clip(-step, step)
        self._drive()

    def off(self) -> None:
        self._q[:] = self._robot.q
        if not self.task.handover:
            self.w[:], self.gyr[:], self.v[:] = 0.0, 0.0, 0.0

    def _sense(self, dt: float) -> None:
        self._robot.advance(dt)
        self._measure()

    def _measure(self) -> None:
        robot = self._robot
        self.w[:] = robot.qd[self._wheels]
        self.gyr[:] = robot.turn
        robot.sense_base(self.x, self.v)

    def _drive(self) -> None:
        self._torque[self._wheels] = self._gain * (self._wish - self.w)
        self._robot.command(self._torque)

    def _find_wheels(self) -> list[int]:
        names, known = self.params.wheels, self._robot.joints
        if len(names) != len(self.w):
            raise ParameterError(
                "WHEELS names another number of wheels than W_REF has elements",
                expected=f"{len(self.w)} wheels",
                got=f"{len(names)}: {' '.join(names)}",
                remedy=f"set NELEM of W_REF and W_MEZ to {len(names)}, or name others",
            )
        for name in names:
            if name not in known or names.count(name) > 1:
                raise ParameterError(
                    f"the base has no joint {name}"
                    if name not in known
                    else f"WHEELS names joint {name} twice",
                    where=str(self._robot.path),
                    expected=" or ".join(known),
                    remedy=did_you_mean(name, known) or "name each wheel once",
                )
        return [known.index(name) for name in names]

    def _take_drives(self) -> None:
        k, n = self.params, len(self.w)
        self._gain, self._slow = spread(k.gain, n, "gain"), spread(k.slow, n, "slow")
