"""A library of kernels: variables and routines of a special purpose processor.

It is an ordinary Python file with a `Library` in it. Only the executive runs the file,
so a task never loads what its routines import.
"""

from __future__ import annotations

import importlib
import importlib.util
import math
import sys
import zlib
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final, TypeVar

import numpy as np

from pbonet.errors import SppError, did_you_mean

if TYPE_CHECKING:
    from collections.abc import Callable

    from numpy.typing import DTypeLike

F = TypeVar("F", bound="Callable[..., Any]")
BACK_ENDS: Final = ("warp", "torch", "numpy")
"""Back ends by name, the first choice of ``driver = "auto"`` first."""


class Variable:
    """A variable that lives in the executive.

    Attributes:
        shape: Its shape.
        dtype: Type of its elements.
        size: Its bytes.
    """

    __slots__ = ("dtype", "shape", "size")

    def __init__(self, shape: tuple[int, ...], dtype: np.dtype[Any]) -> None:
        self.shape, self.dtype = shape, dtype
        self.size = math.prod(shape) * dtype.itemsize


class Library:
    """Variables and routines; each client of the executive has its own variables."""

    def __init__(self) -> None:
        self.variables: dict[str, Variable] = {}
        self.routines: dict[str, dict[str, Callable[..., None]]] = {}
        """By name and back end."""
        self.setups: dict[str, Callable[[Any], None]] = {}
        """By back end."""
        self.module = ""
        """Name of the Python module that it was loaded as."""

    def variable(
        self, name: str, shape: int | tuple[int, ...] = (), dtype: DTypeLike = "f8"
    ) -> None:
        """Declare a variable of zeros, an attribute of the `m` of all routines.

        Args:
            name: Its name, an identifier.
            shape: Its shape; () for a single element.
            dtype: Type of its elements: a number or a truth value.

        Raises:
            SppError: It cannot be.
        """
        kind = np.dtype(dtype)
        wrong = ""
        if not name.isidentifier() or name in {"local", "device"}:
            wrong = "its name is not an identifier, or is taken: local, device"
        elif name in self.variables or name in self.routines:
            wrong = "its name is given twice"
        elif kind.kind not in "biuf":
            wrong = f"its elements are {kind}, no numbers or truth values"
        if wrong:
            raise SppError(
                f"the variable {name!r} of a library cannot be",
                got=wrong,
                remedy='write for example library.variable("x", (7,), "f8")',
            )
        whole = (shape,) if isinstance(shape, int) else tuple(shape)
        self.variables[name] = Variable(whole, kind)

    def routine(self, back_end: str, name: str = "") -> Callable[[F], F]:
        """Make the function below this line a routine, for one back end.

        It is called with `m`, which has the variables as arrays of the back end, with
        `m.local`, where it keeps what it likes, and with the numbers of the call.

        Args:
            back_end: "numpy", "warp" or "torch"; a routine may have several.
            name: Its name; by default that of the function.

        Raises:
            SppError: There is no such back end.
        """
        _check_back_end(back_end)

        def take(function: F) -> F:
            routine = self.routines.setdefault(name or function.__name__, {})
            routine[back_end] = function
            return function

        return take

    def setup(self, back_end: str) -> Callable[[F], F]:
        """Have the function below this line called once with `m`, before all routines.

        Args:
            back_end: As for `routine`.

        Raises:
            SppError: There is no such back end.
        """
        _check_back_end(back_end)

        def take(function: F) -> F:
            self.setups[back_end] = function
            return function

        return take

    def lacks(self, back_end: str) -> list[str]:
        """Return the routines that a back end does not have."""
        return [name for name, one in self.routines.items() if back_end not in one]


def _check_back_end(name: str) -> None:
    if name not in BACK_ENDS:
        raise SppError(
            f"there is no back end {name}",
            expected=" ".join(sorted(BACK_ENDS)),
            remedy=did_you_mean(name, BACK_ENDS) or "name one of these",
        )


def find_file(name: str, folders: tuple[str, ...]) -> str:
    """Return where a library is: an absolute path, or the name of a Python module.

    Args:
        name: A path ending in ``.py``, absolute or in one of the folders; else the name
            of a module that is installed.
        folders: Where it is looked for.

    Raises:
        SppError: There is no such file.
    """
    if not name.endswith(".py"):
        return name
    for folder in (*folders, "."):
        path = Path(folder) / name
        if path.is_file():
            return str(path.absolute())
    raise SppError(
        "there is no such library of kernels",
        where=name,
        expected="a file in " + " or ".join([*folders, "the working folder"]),
        remedy="correct its name, or name a module that is installed",
    )


def load(place: str) -> Library:
    """Run a library's file, and return the `Library` in it.

    Args:
        place: As `find_file` returns it.

    Raises:
        SppError: It cannot be run, or has no library.
    """
    try:
        module = (
            _file(place) if place.endswith(".py") else importlib.import_module(place)
        )
    except (Exception, SystemExit) as error:
        raise SppError(
            "the library of kernels cannot be run",
            where=place,
            got=f"{type(error).__name__}: {error}",
            remedy="correct the file, or install what it imports",
        ) from error
    found = [one for one in vars(module).values() if isinstance(one, Library)]
    if len(found) == 1:
        found[0].module = str(module.__name__)
    else:
        raise SppError(
            "this is no library of kernels",
            where=place,
            expected="one Library in it",
            got=str(len(found)),
            remedy="write library = Library(), and below it variables and routines",
        )
    return found[0]


def _file(place: str) -> Any:  # noqa: ANN401 - a module
    # The same in each run: Warp finds compiled kernels by it.
    name = f"pbonet_spp_{Path(place).stem}_{zlib.crc32(place.encode()):08x}"
    spec = importlib.util.spec_from_file_location(name, place)
    if spec is None or spec.loader is None:
        raise ImportError(place)
    module = importlib.util.module_from_spec(spec)
    sys.modules[name] = module  # warp looks a kernel's module up by its name
    spec.loader.exec_module(module)
    return module
