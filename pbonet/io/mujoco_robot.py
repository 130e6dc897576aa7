"""A robot simulated by MuJoCo, with the interface of a real one.

A robot-interface module sends torques and reads joint positions and velocities. Time
passes only by `advance`, in steps of equal length that fill it exactly; so a run is the
same every time, in real time, in simulation and in replay.
"""

from __future__ import annotations

import re
from importlib import import_module
from math import ceil
from typing import TYPE_CHECKING, Any

import numpy as np

from pbonet.errors import DeviceError, ParameterError

from .optional_packages import from_extra
from .robot_model import find_file

if TYPE_CHECKING:
    from collections.abc import Iterable
    from pathlib import Path

    from numpy.typing import NDArray

    Floats = NDArray[np.float64]


class MujocoRobot:
    """A robot on a base that does not move, whose joints turn or slide.

    Torques act at the joints themselves, within the limits that the file gives them;
    actuators of the file are off.

    Args:
        file: Its MJCF or URDF file, as for `find_file`.
        libraries: Folders in which it is looked for.
        step: Longest integration step, seconds.

    Raises:
        ParameterError: There is no such file, MuJoCo cannot read it, or a joint is a
            ball or free.
        DeviceError: MuJoCo is not installed.
    """

    def __init__(
        self, file: str, libraries: Iterable[str | Path] = (), *, step: float = 1e-3
    ) -> None:
        with from_extra("mujoco", "the simulated robot"):
            self._mujoco: Any = import_module("mujoco")
        self.path = find_file(file, libraries)
        self._model = self._read()
        self.n = int(self._model.nv)
        self.joints = tuple(str(self._model.joint(k).name) for k in range(self.n))
        self._data = self._mujoco.MjData(self._model)
        self._step = step
        limited = np.array(self._model.jnt_actfrclimited, dtype=bool)
        limits = np.array(self._model.jnt_actfrcrange, dtype=np.float64)
        self._low: Floats = np.where(limited, limits[:, 0], -np.inf)
        self._high: Floats = np.where(limited, limits[:, 1], np.inf)
        self._product = np.zeros(self.n)
        self.q: Floats = self._data.qpos
        """Joint positions, rad or m."""
        self.qd: Floats = self._data.qvel
        """Joint velocities, rad/s or m/s."""

    def place(self, q: Floats, qd: Floats) -> None:
        """Put the robot somewhere, at rest but for `qd` and without torques."""
        self._mujoco.mj_resetData(self._model, self._data)
        self.q[:], self.qd[:] = q, qd
        self._mujoco.mj_forward(self._model, self._data)

    def command(self, torque: Floats) -> None:
        """Set the torques at the joints, N*m or N; their limits bound them."""
        np.clip(torque, self._low, self._high, out=self._data.qfrc_applied)

    def torque_for(self, qdd: Floats) -> Floats:
        """Return the torques that accelerate the joints by `qdd`, as they move now.

        It is memory that the next call writes again.
        """
        self._mujoco.mj_mulM(self._model, self._data, self._product, qdd)
        self._product += self._data.qfrc_bias
        self._product -= self._data.qfrc_passive
        return self._product

    def advance(self, dt: float) -> None:
        """Let `dt` seconds pass.

        Raises:
            DeviceError: The robot's motion grows without bounds; the joint is named.
        """
        steps = max(1, ceil(dt / self._step - 1e-9))
        self._model.opt.timestep = dt / steps
        self._mujoco.mj_step(self._model, self._data, steps)
        self._mujoco.mj_forward(self._model, self._data)  # of now, not of a step ago
        speed = np.where(np.isfinite(self.q), np.abs(self.qd), np.inf)
        bad = int(np.argmax(speed))
        if not speed[bad] < _ABSURD:
            raise DeviceError(
                f"the simulated robot flies apart at joint {self.joints[bad]}",
                where=str(self.path),
                got=f"{self.q[bad]:g} rad, {self.qd[bad]:g} rad/s",
                remedy="shorten STEP, or correct masses and limits of the model",
            )

    def _read(self) -> Any:  # noqa: ANN401 - it has no stubs
        mujoco = self._mujoco
        try:
            model = mujoco.MjModel.from_xml_path(str(self.path))
        except ValueError as error:
            raise ParameterError(
                "MuJoCo cannot read the model of the robot",
                where=str(self.path),
                got=" ".join(str(error).split()),
                remedy="correct it, or name another file",
            ) from None
        for name in _INCLUDE.findall(self.path.read_text(encoding="utf-8")):
            find_file(str(self.path.parent.absolute() / name))
        plain = {int(mujoco.mjtJoint.mjJNT_HINGE), int(mujoco.mjtJoint.mjJNT_SLIDE)}
        for k in range(model.njnt):
            if int(model.jnt_type[k]) not in plain:
                raise ParameterError(
                    f"joint {model.joint(k).name} is a ball or free",
                    where=str(self.path),
                    expected="hinges and slides only",
                    remedy="fix the robot's base, and what else lies in the scene",
                )
        if model.njnt == 0:
            raise ParameterError(
                "the model has no joint",
                where=str(self.path),
                expected="at least one hinge or slide",
                remedy="name the model of a robot that moves",
            )
        off = mujoco.mjtDisableBit
        model.opt.disableflags |= off.mjDSBL_ACTUATION | off.mjDSBL_AUTORESET
        return model


_INCLUDE = re.compile(r"""<include\s[^>]*?file\s*=\s*["']([^"']+)""")
_ABSURD = 1e4
"""rad/s or m/s that no joint of a robot has."""
