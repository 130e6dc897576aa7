"""Kernels in PyTorch, on a processor or with CUDA."""

from __future__ import annotations

from importlib import import_module
from typing import TYPE_CHECKING, Any

import numpy as np

from .back_end import BackEnd

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from .kernel_library import Variable


class TorchBackEnd(BackEnd):
    """Variables are tensors; values go through pinned memory where CUDA is.

    Args:
        device: ``cpu`` or ``cuda:N``.

    Raises:
        ImportError: PyTorch is not installed.
        RuntimeError: There is no such device.
    """

    name = "torch"

    def __init__(self, device: str) -> None:
        super().__init__()
        self._torch: Any = import_module("torch")
        torch = self._torch
        self.device = device
        self._on = torch.device(device)
        self._cuda = self._on.type == "cuda"
        torch.zeros(1, device=self._on)  # a device that is not there is refused now

    @property
    def said(self) -> Any:  # noqa: ANN401 - torch's own
        return self._on

    def make(self, variable: Variable) -> Any:  # noqa: ANN401 - torch's own
        zeros = self._torch.from_numpy(np.zeros(variable.shape, variable.dtype))
        tensor = zeros.to(self._on, copy=True)
        for kept in (self._sent, self._taken):
            kept[id(tensor)] = zeros.pin_memory() if self._cuda else zeros.clone()
        return tensor

    def write(self, array: Any, values: NDArray[Any]) -> None:  # noqa: ANN401
        host = self._free_to_send(array)
        np.copyto(host.numpy(), values)
        array.copy_(host, non_blocking=True)

    def read(self, array: Any) -> None:  # noqa: ANN401
        self._taken[id(array)].copy_(array, non_blocking=True)

    def taken(self, array: Any) -> NDArray[Any]:  # noqa: ANN401
        found: NDArray[Any] = self._taken[id(array)].numpy()
        return found

    def finish(self) -> None:
        if self._cuda:
            self._torch.cuda.synchronize(self._on)
        self._busy.clear()

    def limit(self, memory: int) -> None:
        if self._cuda:
            _, whole = self._torch.cuda.mem_get_info(self._on)
            self._torch.cuda.set_per_process_memory_fraction(
                min(1.0, memory / whole), self._on
            )
