"""Kernels in Warp, on a processor or with CUDA."""

from __future__ import annotations

from importlib import import_module
from typing import TYPE_CHECKING, Any

import numpy as np

from pbonet.xm.net import run_folder

from .back_end import BackEnd

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from .kernel_library import Variable


class WarpBackEnd(BackEnd):
    """Variables are ``wp.array``; values go through pinned memory where CUDA is.

    Args:
        device: ``cpu`` or ``cuda:N``.

    Raises:
        ImportError: Warp is not installed.
        RuntimeError: There is no such device.
    """

    name = "warp"

    def __init__(self, device: str) -> None:
        self._wp = wp = warp()
        self.device = device
        self._on = wp.get_device(device)
        self._staged: dict[int, Any] = {}
        """Host copies, by the variable."""
        self._busy: set[int] = set()

    @property
    def said(self) -> Any:  # noqa: ANN401 - Warp's own
        return self._on

    def make(self, variable: Variable) -> Any:  # noqa: ANN401 - Warp's own
        wp = self._wp
        kind = wp.dtype_from_numpy(variable.dtype)
        shape = variable.shape or (1,)
        array = wp.zeros(shape, dtype=kind, device=self._on)
        if self._on.is_cuda:
            host = wp.zeros(shape, dtype=kind, device="cpu", pinned=True)
            self._staged[id(array)] = host
        return array

    def _host(self, array: Any) -> Any:  # noqa: ANN401 - Warp's own
        """Return the host's copy of a variable, which no transfer uses any more."""
        key = id(array)
        if key in self._busy:
            self.finish()
        self._busy.add(key)
        return self._staged[key]

    def write(self, array: Any, values: NDArray[Any]) -> None:  # noqa: ANN401
        if not self._on.is_cuda:
            np.copyto(array.numpy(), values.reshape(array.shape))
            return
        host = self._host(array)
        np.copyto(host.numpy(), values.reshape(array.shape))
        self._wp.copy(array, host)

    def read(self, array: Any) -> None:  # noqa: ANN401
        if self._on.is_cuda:
            self._wp.copy(self._host(array), array)
        else:
            self._staged[id(array)] = array.numpy().copy()

    def taken(self, array: Any) -> NDArray[Any]:  # noqa: ANN401
        host = self._staged[id(array)]
        found: NDArray[Any] = host.numpy() if self._on.is_cuda else host
        return found

    def prepare(self, module: str) -> None:
        self._wp.load_module(module, device=self._on)

    def finish(self) -> None:
        self._wp.synchronize_device(self._on)
        self._busy.clear()


def warp() -> Any:  # noqa: ANN401 - a module
    """Return Warp, with the cache of its kernels in the runtime folder.

    Raises:
        ImportError: It is not installed.
    """
    wp: Any = import_module("warp")
    wp.config.kernel_cache_dir = str(run_folder.folder() / "warp")
    if hasattr(wp.config, "log_level"):
        wp.config.log_level = wp.LOG_WARNING
    else:  # before 1.15
        wp.config.quiet = True
    wp.init()
    return wp
