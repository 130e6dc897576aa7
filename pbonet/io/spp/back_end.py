"""Base of the back ends: makes variables, and moves their values in and out."""

from __future__ import annotations

from abc import ABC, abstractmethod
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    import numpy as np
    from numpy.typing import NDArray

    from .kernel_library import Variable


class BackEnd(ABC):
    """Where routines run.

    Attributes:
        name: "numpy", "warp" or "torch".
        device: Where it computes, such as ``cpu`` or ``cuda:0``.
    """

    name: str
    device: str

    def __init__(self) -> None:
        self._sent: dict[int, Any] = {}
        """Memory of the host out of which a variable is written, if it needs that."""
        self._taken: dict[int, Any] = {}
        """Memory of the host into which a variable is read."""
        self._busy: set[int] = set()
        """Variables whose memory in `_sent` may still be read by the device."""

    def forget(self, array: Any) -> None:  # noqa: ANN401
        """Give up what was reserved for a variable."""
        self._sent.pop(id(array), None)
        self._taken.pop(id(array), None)
        self._busy.discard(id(array))

    def _free_to_send(self, array: Any) -> Any:  # noqa: ANN401
        """Return the memory of the host for a write, which the device has read."""
        key = id(array)
        if key in self._busy:
            self.finish()
        self._busy.add(key)
        return self._sent[key]

    @property
    def said(self) -> Any:  # noqa: ANN401 - the back end's own
        """The device as routines have it, in `m.device`."""
        return self.device

    @abstractmethod
    def make(self, variable: Variable) -> Any:  # noqa: ANN401
        """Return a variable of zeros, as routines have it."""

    @abstractmethod
    def write(self, array: Any, values: NDArray[Any]) -> None:  # noqa: ANN401
        """Begin to copy values to a variable."""

    @abstractmethod
    def read(self, array: Any) -> None:  # noqa: ANN401
        """Begin to copy a variable back; `taken` returns it after `finish`."""

    @abstractmethod
    def taken(self, array: Any) -> np.ndarray[Any, Any]:  # noqa: ANN401
        """Return the values that were copied back."""

    def prepare(self, module: str) -> None:  # noqa: B027 - not all compile
        """Compile the kernels that a library's Python module has defined."""

    def finish(self) -> None:  # noqa: B027 - not all are asynchronous
        """Wait until all that was begun is done."""

    def limit(self, memory: int) -> None:  # noqa: B027 - not all have their own
        """Bound the memory of the device itself, if it has its own.

        Args:
            memory: Bytes.
        """
