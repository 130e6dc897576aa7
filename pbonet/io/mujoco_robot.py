"""A robot simulated by MuJoCo, with the interface of a real one.

A robot-interface module sends torques and reads joint positions and velocities. Time
passes only by `advance`, in steps of equal length that fill it exactly; so a run is the
same every time, in real time, in simulation and in replay.
"""

from __future__ import annotations

from contextlib import suppress
from math import ceil
from typing import TYPE_CHECKING, Any
from xml.etree.ElementTree import ParseError, iterparse

import numpy as np

from pbonet.errors import DeviceError, ParameterError

from ._mujoco_memory import BaseMemory, JointMemory
from .optional_packages import load_mujoco
from .robot_model import find_file

if TYPE_CHECKING:
    from collections.abc import Iterable
    from pathlib import Path

    from numpy.typing import NDArray

    Floats = NDArray[np.float64]


class MujocoRobot:
    """A robot whose joints turn or slide, on a base that stands or moves freely.

    Torques act at the joints themselves, within the limits that the file gives them;
    actuators of the file are off. Joints are in the order in which bodies are nested,
    from the base, and branches by the names of their first joints, as pinocchio has
    them. One exception: a branch that begins with a fixed joint has that joint's name
    in pinocchio, and MuJoCo knows no such name. In an MJCF file, begin it with a body
    that has this name and no joint; from URDF such branches can be in another order.

    Args:
        file: Its MJCF or URDF file, as for `find_file`.
        libraries: Folders in which it is looked for.
        step: Longest integration step, seconds.
        floats: Whether its first joint is free, and so its base moves.

    Raises:
        ParameterError: There is no such file, MuJoCo cannot read it, it has no joint
            that turns or slides, or one of another kind.
        DeviceError: MuJoCo is not installed.
    """

    def __init__(
        self,
        file: str,
        libraries: Iterable[str | Path] = (),
        *,
        step: float = 1e-3,
        floats: bool = False,
    ) -> None:
        self._mujoco: Any = load_mujoco("the simulated robot")
        self.path = find_file(file, libraries)
        self._model = self._read(floats=floats)
        model, first = self._model, int(floats)
        self._order = order = np.array(_nested(model)[first:]) - first
        self.joints = tuple(str(model.joint(k + first).name) for k in order)
        self.n = n = len(self.joints)
        self._base = int(model.jnt_bodyid[0]) if floats else 0
        self.base = str(model.body(self._base).name)
        """The name of the body that moves freely, or of the world."""
        self._data = data = self._mujoco.MjData(model)
        self._step = step
        limited = np.array(model.jnt_actfrclimited[first:], dtype=bool)[order]
        limits = np.array(model.jnt_actfrcrange[first:], dtype=np.float64)[order]
        low = np.where(limited, limits[:, 0], -np.inf)
        high = np.where(limited, limits[:, 1], np.inf)
        self._bounds = low, high
        self._wish, self._product = np.zeros(model.nv), np.zeros(model.nv)
        self._push = data.xfrc_applied[self._base, :3]
        self.q: Floats = np.zeros(n)
        """Joint positions, rad or m."""
        self.qd: Floats = np.zeros(n)
        """Joint velocities, rad/s or m/s."""
        self.torque: Floats = np.zeros(n)
        """Torques that act at the joints, N*m or N."""
        self._joints = JointMemory(
            data, order, self._bounds, self.q, self.qd, self.torque
        )
        self._dt = 0.0
        if floats:
            self._pose = BaseMemory(data, self._base)
            self.turn: Floats = data.qvel[3:6]
            """Angular velocity of a base that moves, in its own axes, rad/s."""

    def place(self, q: Floats, qd: Floats) -> None:
        """Put the robot where its file does, its joints at `q` and moving with `qd`.

        Nothing else moves, and no torques act.
        """
        self._mujoco.mj_resetData(self._model, self._data)
        for values, now in ((self._data.qpos, q), (self._data.qvel, qd)):
            values[-self.n :][self._order] = now
        self.q[:], self.qd[:], self.torque[:] = q, qd, 0.0
        self._mujoco.mj_forward(self._model, self._data)

    def place_base(self, pose: Floats, velocity: Floats) -> None:
        """Put a base that moves somewhere, with a velocity; joints are as they were.

        Args:
            pose: [R p], [3, 4], p in m.
            velocity: m/s of its origin and rad/s, in the axes of the world.
        """
        data = self._data
        data.qpos[:3], data.qvel[:3] = pose[:, 3], velocity[:3]
        self._mujoco.mju_mat2Quat(data.qpos[3:7], pose[:, :3].ravel())
        data.qvel[3:6] = velocity[3:] @ pose[:, :3]
        self._mujoco.mj_forward(self._model, data)

    def sense_base(self, pose: Floats, velocity: Floats) -> None:
        """Write pose and velocity of a base that moves, as `place_base` takes them."""
        self._pose.read(pose, velocity)

    def push(self, force: Floats) -> None:
        """Let a force (N) act at the centre of mass of a base that moves, from now."""
        self._push[:] = force

    def command(self, torque: Floats) -> None:
        """Set the torques at the joints, N*m or N; their limits bound them."""
        self._joints.command(torque)

    def torque_for(self, qdd: Floats) -> Floats:
        """Return the torques that accelerate the joints by `qdd`, as they move now.

        The base is taken not to accelerate.
        """
        self._wish[-self.n :][self._order] = qdd
        self._mujoco.mj_mulM(self._model, self._data, self._product, self._wish)
        self._product += self._data.qfrc_bias
        self._product -= self._data.qfrc_passive
        torque: Floats = self._product[-self.n :][self._order]
        return torque

    def advance(self, dt: float) -> None:
        """Let `dt` seconds pass.

        Raises:
            DeviceError: The robot's motion grows without bounds; the joint is named.
        """
        if dt != self._dt:
            self._dt, self._steps = dt, max(1, ceil(dt / self._step - 1e-9))
            self._model.opt.timestep = dt / self._steps
        self._mujoco.mj_step(self._model, self._data, self._steps)
        self._mujoco.mj_forward(self._model, self._data)  # of now, not of a step ago
        bad = self._joints.read(_ABSURD)
        if bad >= 0:
            raise DeviceError(
                f"the simulated robot flies apart at {self._dof(bad)}",
                where=str(self.path),
                got=f"{abs(self._data.qvel[bad]):g} rad/s or m/s",
                remedy="shorten STEP, or correct masses and limits of the model",
            )

    def _dof(self, index: int) -> str:
        """Return the name of what moves with an element of the velocity."""
        joint = index - (int(self._model.nv) - self.n)
        if joint < 0:
            return f"base {self.base}"
        return f"joint {self.joints[int(np.flatnonzero(self._order == joint)[0])]}"

    def _read(self, *, floats: bool) -> Any:  # noqa: ANN401 - it has no stubs
        try:
            model = self._mujoco.MjModel.from_xml_path(str(self.path))
        except ValueError as error:
            raise ParameterError(
                "MuJoCo cannot read the model of the robot",
                where=str(self.path),
                got=" ".join(str(error).split()),
                remedy="correct it, or name another file",
            ) from None
        for path in _included(self.path.absolute()):
            find_file(str(path))  # so that a replay names it if it has changed
        self._check(model, floats=floats)
        off = self._mujoco.mjtDisableBit
        model.opt.disableflags |= off.mjDSBL_ACTUATION | off.mjDSBL_AUTORESET
        return model

    def _check(self, model: Any, *, floats: bool) -> None:  # noqa: ANN401 - as above
        """Refuse joints that are not as they must be."""
        kinds, types = self._mujoco.mjtJoint, [int(one) for one in model.jnt_type]
        if floats and types[:1] != [int(kinds.mjJNT_FREE)]:
            raise ParameterError(
                "the base of the robot cannot move: its first joint is not free",
                where=str(self.path),
                expected="a <freejoint/> in the first body",
                got=f"joint {model.joint(0).name}" if types else "no joint",
                remedy="give the base a free joint, and put the robot first in its "
                "scene",
            )
        plain = {int(kinds.mjJNT_HINGE), int(kinds.mjJNT_SLIDE)}
        for k in range(int(floats), len(types)):
            if types[k] not in plain:
                raise ParameterError(
                    f"joint {model.joint(k).name} is a ball or free",
                    where=str(self.path),
                    expected="hinges and slides only",
                    remedy="take out what else lies in the scene"
                    if floats
                    else "fix the robot's base, and what else lies in the scene",
                )
        if len(types) == int(floats):
            raise ParameterError(
                "the model has no joint",
                where=str(self.path),
                expected="at least one hinge or slide",
                remedy="name the model of a robot that moves",
            )


def _included(model: Path) -> list[Path]:
    """Return the files that a model includes, and those that they include.

    MuJoCo looks for them beside the model, and then beside the file that names them. A
    name without a file is left out: MuJoCo did not need it.
    """
    found = [model]
    for path in found:
        for name in _include_names(path):
            places = (model.parent / name, path.parent / name)
            place = next((one for one in places if one.is_file()), model)
            if place not in found:
                found.append(place)
    return found[1:]


def _include_names(path: Path) -> list[str]:
    """Return what a file includes, as far as it is XML: MuJoCo takes more than that."""
    names: list[str] = []
    with suppress(ParseError, LookupError, ValueError):
        for _, element in iterparse(path, ("start",)):  # noqa: S314 - MuJoCo read it
            if element.tag == "include":
                names.append(element.get("file", ""))
    return names


def _nested(model: Any) -> list[int]:  # noqa: ANN401 - as above
    """Return the numbers of the joints: outwards, branches by names."""
    children: dict[int, list[int]] = {}
    for body in range(1, int(model.nbody)):
        children.setdefault(int(model.body_parentid[body]), []).append(body)

    def first(body: int) -> str:
        has = int(model.body_jntnum[body])
        joint = int(model.body_jntadr[body])
        return str(model.joint(joint).name if has else model.body(body).name)

    found: list[int] = []
    ahead = [0]
    while ahead:
        body = ahead.pop()
        joint = int(model.body_jntadr[body])
        found += range(joint, joint + int(model.body_jntnum[body]))
        ahead += sorted(children.get(body, []), key=first, reverse=True)
    return found


_ABSURD = 1e4
"""rad/s or m/s that no joint of a robot has."""
