"""Distances between the links of a robot, by pinocchio and coal.

A URDF file describes the robot and the shapes of its links, its `<collision>` elements.
"""

from __future__ import annotations

from itertools import combinations
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np

from pbonet.errors import ParameterError, did_you_mean

from .chain import pinocchio
from .robot_model import RobotModel

if TYPE_CHECKING:
    from collections.abc import Collection, Iterable
    from pathlib import Path

    from numpy.typing import NDArray

    Floats = NDArray[np.float64]


class Nearest(NamedTuple):
    """The two links that are nearest to each other."""

    distance: float
    """Between their surfaces, m; below 0: how deep one is in the other."""
    links: tuple[str, str]


class CollisionModel:
    """The shapes of a robot's links.

    Links that no joint or one joint alone parts are never compared: they touch.

    Args:
        file: The URDF file, as for `find_file`. Meshes are looked for in `libraries`.
        libraries: Folders in which it is looked for.
        ignored: Pairs of links that are not compared, either way round.

    Attributes:
        joints: The robot without its shapes.

    Raises:
        ParameterError: As for `RobotModel`; there is no such link, no link that can
            meet another, or a mesh is missing.
        DeviceError: pinocchio is not installed.
    """

    def __init__(
        self,
        file: str,
        libraries: Iterable[str | Path] = (),
        ignored: Collection[tuple[str, str]] = (),
    ) -> None:
        self._pin: Any = pinocchio()
        folders = [str(one) for one in libraries]
        self.joints = RobotModel(file, folders)
        self._model = self._pin.buildModelFromUrdf(str(self.joints.path))
        self._data = self._model.createData()
        self._shapes = self._read(folders)
        self._links = [
            str(self._model.frames[one.parentFrame].name)
            for one in self._shapes.geometryObjects
        ]
        self._add_pairs({frozenset(self._known(pair)) for pair in ignored})
        self._pairs: list[tuple[str, str]] = [
            (self._links[one.first], self._links[one.second])
            for one in self._shapes.collisionPairs
        ]
        self._found = self._pin.GeometryData(self._shapes)
        self._results = self._found.distanceResults

    def nearest(self, q: Floats) -> Nearest:
        """Return the nearest pair of links with the joints at `q` (rad or m)."""
        pin, shapes, found = self._pin, self._shapes, self._found
        pin.updateGeometryPlacements(self._model, self._data, shapes, found, q)
        k = int(pin.computeDistances(shapes, found))
        return Nearest(float(self._results[k].min_distance), self._pairs[k])

    def _read(self, folders: list[str]) -> Any:  # noqa: ANN401 - it has no stubs
        pin, path = self._pin, self.joints.path
        kind = pin.GeometryType.COLLISION
        places = [*folders, str(path.parent)]
        try:
            return pin.buildGeomFromUrdf(
                self._model, str(path), kind, package_dirs=places
            )
        except (ValueError, RuntimeError) as error:
            raise ParameterError(
                "a shape of the robot cannot be read",
                where=str(path),
                got=" ".join(str(error).split()),
                remedy="put the mesh into a folder of modules, or correct its name",
            ) from None

    def _known(self, pair: tuple[str, str]) -> tuple[str, str]:
        for name in pair:
            if name not in self._links:
                raise ParameterError(
                    f"the robot has no link {name} with a shape",
                    where=str(self.joints.path),
                    expected=" or ".join(dict.fromkeys(self._links)) or "none at all",
                    remedy=did_you_mean(name, self._links) or "name one of these",
                )
        return pair

    def _add_pairs(self, ignored: Collection[frozenset[str]]) -> None:
        parents = self._model.parents
        shapes = self._shapes.geometryObjects
        for i, k in combinations(range(len(shapes)), 2):
            a, b = shapes[i].parentJoint, shapes[k].parentJoint
            joined = a == b or parents[a] == b or parents[b] == a
            if (
                not joined
                and frozenset((self._links[i], self._links[k])) not in ignored
            ):
                self._shapes.addCollisionPair(self._pin.CollisionPair(i, k))
        if not len(self._shapes.collisionPairs):
            raise ParameterError(
                "the robot has no two links that could meet",
                where=str(self.joints.path),
                expected="<collision> elements of links that two joints or more part",
                got=f"{len(shapes)} shapes",
                remedy="give the links their shapes in the URDF file",
            )
