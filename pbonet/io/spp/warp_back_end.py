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
        super().__init__()
        self._wp = wp = warp()
        self.device = device
        self._on = wp.get_device(device)

    @property
    def said(self) -> Any:  # noqa: ANN401 - Warp's own
        return self._on

    def make(self, variable: Variable) -> Any:  # noqa: ANN401 - Warp's own
        wp = self._wp
        kind = wp.dtype_from_numpy(variable.dtype)
        shape = variable.shape or (1,)
        array = wp.zeros(shape, dtype=kind, device=self._on)
        pinned = bool(self._on.is_cuda)
        for kept in (self._sent, self._taken):
            host = wp.zeros(shape, dtype=kind, device="cpu", pinned=pinned)
            kept[id(array)] = host
        return array

    def write(self, array: Any, values: NDArray[Any]) -> None:  # noqa: ANN401
        host = self._free_to_send(array)
        np.copyto(host.numpy(), values.reshape(array.shape))
        self._wp.copy(array, host)

    def read(self, array: Any) -> None:  # noqa: ANN401
        self._wp.copy(self._taken[id(array)], array)

    def taken(self, array: Any) -> NDArray[Any]:  # noqa: ANN401
        found: NDArray[Any] = self._taken[id(array)].numpy()
        return found

    def prepare(self, module: str) -> None:
        # By its object: a library that has no kernels of its own is no error then.
        self._wp.load_module(self._wp.get_module(module), device=self._on)

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
