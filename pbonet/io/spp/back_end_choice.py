"""The choice of a library's back end: ``[spp.NAME]``, or the first that can."""

from __future__ import annotations

from importlib import import_module
from typing import TYPE_CHECKING, Any

from pbonet.errors import SppError

from .kernel_library import BACK_ENDS
from .numpy_back_end import NumpyBackEnd

if TYPE_CHECKING:
    from collections.abc import Callable

    from pbonet.config import SppEntry

    from .back_end import BackEnd
    from .kernel_library import Library

AUTO = "auto"


class BackEnds:
    """The back ends that a machine has for an entry of its ``agent.toml``.

    Args:
        entry: ``[spp.NAME]``.
        name: Its name.

    Raises:
        SppError: What the entry names is not there.
    """

    def __init__(self, entry: SppEntry, name: str) -> None:
        self._name = name
        self._driver = entry.driver
        wanted = BACK_ENDS if entry.driver == AUTO else (entry.driver,)
        self.refused: dict[str, str] = {}
        """Why a back end cannot run here."""
        self.found: dict[str, BackEnd] = {}
        """Back ends that can, the first choice first."""
        for one in wanted:
            try:
                self.found[one] = _MAKERS[one](entry.device)
            except Exception as error:  # noqa: BLE001 - whatever a device's driver raises
                self.refused[one] = str(error).strip().partition("\n")[0]
        self._order(entry.device)
        if not self.found:
            raise SppError(
                "the back end cannot run on this machine",
                where=f"[spp.{name}]",
                expected=f"driver {entry.driver} on device {entry.device}",
                got="; ".join(f"{one}: {why}" for one, why in self.refused.items()),
                remedy="install it (pip install 'pbonet[spp]' brings Warp), "
                "or write another driver or device",
            )

    def _order(self, device: str) -> None:
        """With ``auto`` a back end on CUDA goes before those on the processor."""
        if device == AUTO:
            ranked = sorted(self.found.items(), key=lambda one: one[1].device == "cpu")
            self.found = dict(ranked)

    @property
    def first(self) -> BackEnd:
        """The first choice."""
        return next(iter(self.found.values()))

    def choose(self, library: Library, place: str) -> BackEnd:
        """Return the first back end that all routines of a library have.

        Raises:
            SppError: There is none.
        """
        for name, one in self.found.items():
            if not library.lacks(name):
                return one
        lacks = {name: library.lacks(name) for name in self.found}
        got = [f"{name} lacks {', '.join(some)}" for name, some in lacks.items()]
        raise SppError(
            "the library has no routines for the back end",
            where=place,
            expected=f"each routine for one of {' '.join(self.found)}",
            got="; ".join(got),
            remedy=f"add them, or write another driver into [spp.{self._name}]",
        )


def _numpy(device: str) -> BackEnd:
    if device not in {AUTO, "cpu"}:
        raise ValueError("it computes on the device cpu only")
    return NumpyBackEnd()


def _warp(device: str) -> BackEnd:
    from .warp_back_end import WarpBackEnd, warp

    if device == AUTO:
        device = "cuda:0" if warp().is_cuda_available() else "cpu"
    return WarpBackEnd(device)


def _torch(device: str) -> BackEnd:
    torch: Any = import_module("torch")
    from .torch_back_end import TorchBackEnd

    if device == AUTO:
        device = "cuda:0" if torch.cuda.is_available() else "cpu"
    return TorchBackEnd(device)


_MAKERS: dict[str, Callable[[str], BackEnd]] = {
    "numpy": _numpy,
    "warp": _warp,
    "torch": _torch,
}
