"""Robots with any number of legs and joints as URDF files, drawn by chance."""

from __future__ import annotations

from pathlib import Path

import numpy as np


def write_walker(folder: Path, legs: int, joints: int, *, effort: float = 500.0) -> str:
    """Write `walker.urdf`, the same each time: links `body`, `foot1`, `foot2` ...

    The first three joints of a leg turn about x, y and y, so that its foot moves in
    all directions; more of them turn about any axis.
    """
    rng = np.random.default_rng([legs, joints])
    parts = ['<robot name="walker">', _link("body", rng, 5.0)]
    for leg in range(1, legs + 1):
        angle = 2.0 * np.pi * leg / legs
        place = np.array([0.3 * np.cos(angle), 0.3 * np.sin(angle), 0.0])
        parent = "body"
        for k in range(joints):
            name = f"leg{leg}_{k + 1}"
            axis = np.eye(3)[min(k, 1)] if k < 3 else rng.normal(size=3)
            axis = axis / np.linalg.norm(axis)
            parts += [
                f'<joint name="{name}" type="revolute"><parent link="{parent}"/>'
                f'<child link="{name}_link"/><origin xyz="{_words(place)}"/>'
                f'<axis xyz="{_words(axis)}"/><dynamics damping="0.2"/>'
                f'<limit lower="-3" upper="3" velocity="8" effort="{effort}"/></joint>',
                _link(f"{name}_link", rng, 0.5),
            ]
            parent = f"{name}_link"
            place = np.array([0.0, 0.0, -0.2]) + 0.02 * rng.normal(size=3)
        parts += [
            f'<joint name="ankle{leg}" type="fixed"><parent link="{parent}"/>'
            f'<child link="foot{leg}"/><origin xyz="{_words(place)}"/></joint>'
            f'<link name="foot{leg}"/>'
        ]
    path = folder / "walker.urdf"
    path.write_text("".join(parts) + "</robot>", encoding="utf-8")
    return path.name


def feet_of(legs: int) -> tuple[str, ...]:
    """Return the names of the feet."""
    return tuple(f"foot{leg}" for leg in range(1, legs + 1))


def _link(name: str, rng: np.random.Generator, mass: float) -> str:
    xx, yy, zz = (mass * rng.uniform(0.01, 0.012, 3)).tolist()
    com = _words(rng.uniform(-0.05, 0.05, 3))
    return (
        f'<link name="{name}"><inertial><origin xyz="{com}"/><mass value="{mass}"/>'
        f'<inertia ixx="{xx}" iyy="{yy}" izz="{zz}" ixy="0" ixz="0" iyz="0"/>'
        "</inertial></link>"
    )


def _words(values: np.ndarray) -> str:
    return " ".join(repr(float(value)) for value in values)
