"""Robots of any number of joints as URDF files, and their kinematics by other means."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np


@dataclass
class Chain:
    """A serial robot with revolute joints; the last link is `hand`."""

    path: Path
    origins: np.ndarray
    angles: np.ndarray
    axes: np.ndarray
    masses: np.ndarray
    coms: np.ndarray

    @property
    def n(self) -> int:
        return len(self.masses)

    def frames(self, q: np.ndarray) -> list[np.ndarray]:
        """Return the frame of each link in the base, as 4x4 matrices."""
        found, at = [], np.eye(4)
        for origin, angle, axis, turn in zip(
            self.origins, self.angles, self.axes, q, strict=True
        ):
            step = np.eye(4)
            step[:3, :3], step[:3, 3] = _rpy(*angle), origin
            joint = np.eye(4)
            joint[:3, :3] = _about(axis, turn)
            at = at @ step @ joint
            found.append(at)
        return found

    def jacobian(self, q: np.ndarray, point: np.ndarray, last: int) -> np.ndarray:
        """Return the Jacobian of a point (m) of link `last`, by the joints' axes."""
        jacobian = np.zeros((6, self.n))
        for k, frame in enumerate(self.frames(q)[: last + 1]):
            axis = frame[:3, :3] @ self.axes[k]
            jacobian[:3, k] = np.cross(axis, point - frame[:3, 3])
            jacobian[3:, k] = axis
        return jacobian

    def gravity(self, q: np.ndarray) -> np.ndarray:
        """Return the torques that hold the robot: those of each weight, summed."""
        torque = np.zeros(self.n)
        for k, frame in enumerate(self.frames(q)):
            point = frame[:3, :3] @ self.coms[k] + frame[:3, 3]
            jacobian = self.jacobian(q, point, k)
            torque += jacobian[2] * self.masses[k] * 9.81
        return torque


def write_chain(folder: Path, n: int, *, damping: float = 0.0) -> Chain:
    """Write `robot.urdf` with n joints drawn by chance, the same each time."""
    rng = np.random.default_rng(n)
    axes = rng.normal(size=(n, 3))
    axes /= np.linalg.norm(axes, axis=1)[:, None]
    chain = Chain(
        folder / "robot.urdf",
        rng.uniform(-0.3, 0.3, (n, 3)),
        rng.uniform(-3.0, 3.0, (n, 3)),
        axes,
        rng.uniform(0.2, 2.0, n),
        rng.uniform(-0.1, 0.1, (n, 3)),
    )
    parts = ['<robot name="chain"><link name="base"/>']
    for k in range(n):
        parent = f"link{k}" if k else "base"
        child = f"link{k + 1}" if k < n - 1 else "hand"
        xx, yy, zz = rng.uniform(0.02, 0.03, 3).tolist()
        parts.append(
            f'<joint name="joint{k + 1}" type="revolute"><parent link="{parent}"/>'
            f'<child link="{child}"/><origin xyz="{_words(chain.origins[k])}" '
            f'rpy="{_words(chain.angles[k])}"/><axis xyz="{_words(axes[k])}"/>'
            f'<dynamics damping="{damping}"/>'
            '<limit lower="-3" upper="3" velocity="2" effort="1000"/></joint>'
            f'<link name="{child}"><inertial><origin xyz="{_words(chain.coms[k])}"/>'
            f'<mass value="{_words(chain.masses[k : k + 1])}"/>'
            f'<inertia ixx="{xx}" iyy="{yy}" izz="{zz}" ixy="0" ixz="0" iyz="0"/>'
            "</inertial></link>"
        )
    chain.path.write_text("".join(parts) + "</robot>", encoding="utf-8")
    return chain


BALL = '<collision><geometry><sphere radius="0.1"/></geometry></collision>'


def write_balls(folder: Path, n: int, last: str = BALL) -> Path:
    """Write `robot.urdf`, links of 1 m in a plane, each with a ball where it begins.

    Args:
        folder: Where to.
        n: Number of joints.
        last: The shape of the last link.
    """
    inertia = '<inertia ixx="1" iyy="1" izz="1" ixy="0" ixz="0" iyz="0"/>'
    mass = f'<inertial><mass value="1"/>{inertia}</inertial>'
    parts = [f'<robot name="balls"><link name="base">{BALL}</link>']
    for k in range(1, n + 1):
        before = "base" if k == 1 else f"l{k - 1}"
        parts.append(
            f'<link name="l{k}">{mass}{last if k == n else BALL}</link>'
            f'<joint name="j{k}" type="revolute"><parent link="{before}"/>'
            f'<child link="l{k}"/><origin xyz="1 0 0"/><axis xyz="0 0 1"/>'
            '<limit lower="-4" upper="4" effort="9" velocity="9"/></joint>'
        )
    path = folder / "robot.urdf"
    path.write_text("".join([*parts, "</robot>"]), encoding="utf-8")
    return path


def _words(values: np.ndarray) -> str:
    return " ".join(repr(float(value)) for value in values)


def _about(axis: np.ndarray, angle: float) -> np.ndarray:
    x, y, z = axis
    k = np.array([[0.0, -z, y], [z, 0.0, -x], [-y, x, 0.0]])
    return np.eye(3) + np.sin(angle) * k + (1.0 - np.cos(angle)) * k @ k


def _rpy(roll: float, pitch: float, yaw: float) -> np.ndarray:
    x, y, z = np.eye(3)
    return _about(z, yaw) @ _about(y, pitch) @ _about(x, roll)
