"""Parameters that a vehicle serves over MAVLink, and a station's view of them."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np

if TYPE_CHECKING:
    from collections.abc import Sequence

    from pbonet import Vector
    from pbonet.io import MavLink

REAL32 = 9
BURST = 10
"""Parameters of a list that one cycle sends."""
LONGEST = 16
"""Characters of a parameter's name."""


class ParameterServer:
    """Serves a vector of numbers by name.

    Args:
        link: The link of the vehicle.
        names: A name for each element.
        values: What they are at first.

    Attributes:
        values: What they are; stations change them.
    """

    def __init__(
        self, link: MavLink, names: Sequence[str], values: Sequence[float]
    ) -> None:
        self._link, self._names = link, tuple(names)
        self.values: Vector = np.array(values, dtype=np.float64)
        self._next = len(names)

    def run(self) -> list[str]:
        """Answer what has arrived; return what was changed, as ``name = value``."""
        link, changed = self._link, list[str]()
        for m in link.all_of("PARAM_REQUEST_READ"):
            k = m.param_index if m.param_index >= 0 else self._find(m.param_id)
            if 0 <= k < len(self._names):
                self._send(k)
        for m in link.all_of("PARAM_SET"):
            k = self._find(m.param_id)
            if k < 0:
                continue
            if np.isfinite(m.param_value) and self.values[k] != m.param_value:
                self.values[k] = m.param_value
                changed.append(f"{self._names[k]} = {m.param_value:g}")
            self._send(k)  # what holds, which refuses another value
        if link.all_of("PARAM_REQUEST_LIST"):
            self._next = 0
        end = min(self._next + BURST, len(self._names))
        for k in range(self._next, end):
            self._send(k)
        self._next = end
        return changed

    def _find(self, name: str | bytes) -> int:
        wanted = name_of(name)
        return self._names.index(wanted) if wanted in self._names else -1

    def _send(self, k: int) -> None:
        message: Any = self._link.mav.param_value_encode(
            self._names[k].encode(), self.values[k], REAL32, len(self._names), k
        )
        self._link.send(message)


def name_of(name: str | bytes) -> str:
    """Return the name of a parameter as a message has it."""
    text = name.decode("ascii", "replace") if isinstance(name, bytes) else name
    return text.rstrip("\0")
