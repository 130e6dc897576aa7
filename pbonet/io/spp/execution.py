"""Carries batches out: the part of the executive that knows no processes."""

from __future__ import annotations

import time
import traceback
from types import SimpleNamespace
from typing import TYPE_CHECKING, Any

import numpy as np

from pbonet.errors import PbonetError, SppError

from . import batches, kernel_library
from .back_end_choice import BackEnds

if TYPE_CHECKING:
    from pbonet.config import SppEntry

    from .back_end import BackEnd
    from .kernel_library import Library

_MOST_TEXT = 1000
"""Characters of an error's message."""


class Loaded:
    """A library with a client's own variables, on a back end.

    Args:
        library: The library.
        back_end: Where it runs.
        place: Where it was found.

    Attributes:
        is_lost: Whether its back end cannot be used any more, as after a fault of a
            kernel with CUDA; only another process can use the device then.
    """

    is_lost = False

    def __init__(self, library: Library, back_end: BackEnd, place: str) -> None:
        self.back_end = back_end
        self.place = place
        self.variables = list(library.variables.values())
        self._names = list(library.variables)
        self._routines = [
            (name, one[back_end.name]) for name, one in library.routines.items()
        ]
        self._arrays = [back_end.make(one) for one in self.variables]
        arrays = dict(zip(self._names, self._arrays, strict=True))
        self.m = SimpleNamespace(
            **arrays, local=SimpleNamespace(), device=back_end.said
        )
        if setup := library.setups.get(back_end.name):
            setup(self.m)
        back_end.prepare(library.module)

    def manifest(self) -> dict[str, Any]:
        """Return what a client must know of the library, as plain data."""
        return {
            "back_end": self.back_end.name,
            "device": self.back_end.device,
            "variables": [
                (name, list(one.shape), one.dtype.str)
                for name, one in zip(self._names, self.variables, strict=True)
            ],
            "routines": [name for name, _ in self._routines],
        }

    def run(self, batch: bytes | memoryview, starts: int) -> bytes:
        """Carry a batch out; return its result."""
        number = batches.number_of(batch)
        wanted: dict[int, None] = {}
        error: PbonetError | None = None
        values: list[tuple[int, bytes]] = []
        routine = ""
        try:
            for kind, index, data in batches.commands(batch):
                if kind == batches.CALL:
                    routine, call = self._routines[index]
                    call(self.m, *batches.arguments(data))
                elif kind == batches.WRITE:
                    one = self.variables[index]
                    new = np.frombuffer(data, one.dtype).reshape(one.shape)
                    self.back_end.write(self._arrays[index], new)
                else:
                    self.back_end.read(self._arrays[index])
                    wanted[index] = None
            self.back_end.finish()
            for index in wanted:
                taken = self.back_end.taken(self._arrays[index])
                values.append((index, taken.tobytes()))
        except (Exception, SystemExit) as caught:  # noqa: BLE001 - whatever it raises
            error, values = failed(f"the routine {routine}", caught), []
            self.is_lost = self._is_lost()
        stamp_ns = time.monotonic_ns()
        return batches.pack_result(number, starts, stamp_ns, values, error)

    def close(self) -> None:
        """Give up its variables."""
        for one in self._arrays:
            self.back_end.forget(one)

    def _is_lost(self) -> bool:
        try:
            self.back_end.finish()
        except Exception:  # noqa: BLE001 - whatever a device's driver raises
            return True
        return False


class Execution:
    """Loads libraries for an entry of ``agent.toml``.

    Args:
        entry: ``[spp.NAME]``.
        name: Its name.

    Raises:
        SppError: Its back end is not there.
    """

    def __init__(self, entry: SppEntry, name: str) -> None:
        self.back_ends = BackEnds(entry, name)

    def load(self, place: str) -> Loaded:
        """Load a library for a client.

        Args:
            place: As `kernel_library.find_file` returns it.

        Raises:
            SppError: It cannot be run, or not here.
        """
        library = kernel_library.load(place)
        back_end = self.back_ends.choose(library, place)
        try:
            return Loaded(library, back_end, place)
        except (Exception, SystemExit) as error:  # noqa: BLE001 - such as no memory
            raise failed("loading", error, place) from None


def failed(what: str, error: BaseException, place: str = "") -> SppError:
    """Return the error that a client gets for an exception of its library."""
    if isinstance(error, SppError):
        return error
    frames = traceback.extract_tb(error.__traceback__)
    last = next((one for one in reversed(frames) if _is_own(one.filename)), None)
    where = f"{last.filename}:{last.lineno}" if last else place
    return SppError(
        f"{what} of a library of kernels raised",
        where=where,
        got=f"{type(error).__name__}: {error}"[:_MOST_TEXT],
        remedy="correct it there; the executive goes on",
    )


def _is_own(file: str) -> bool:
    """Return whether a file is the user's, not an installed package's or pbonet's."""
    return (
        "site-packages" not in file
        and "/pbonet/io/spp/" not in file
        and file[:1] == "/"
    )
