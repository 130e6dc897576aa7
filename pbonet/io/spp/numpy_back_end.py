"""Kernels in numpy."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np

from .back_end import BackEnd

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from .kernel_library import Variable


class NumpyBackEnd(BackEnd):
    """Variables are arrays of numpy.

    Args:
        device: Always ``cpu``.
    """

    name = "numpy"

    def __init__(self, device: str = "cpu") -> None:
        super().__init__()
        self.device = device

    def make(self, variable: Variable) -> NDArray[Any]:
        array = np.zeros(variable.shape, variable.dtype)
        self._taken[id(array)] = np.empty_like(array)
        return array

    def write(self, array: NDArray[Any], values: NDArray[Any]) -> None:
        np.copyto(array, values)

    def read(self, array: NDArray[Any]) -> None:
        np.copyto(self._taken[id(array)], array)

    def taken(self, array: NDArray[Any]) -> NDArray[Any]:
        found: NDArray[Any] = self._taken[id(array)]
        return found
