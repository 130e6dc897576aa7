"""Reads address zero in `init`."""

import ctypes

from pbonet import PortBasedObject


class Segfaults(PortBasedObject):
    """Brings its own process down before it is OFF."""

    def init(self) -> None:
        ctypes.string_at(0)

    def cycle(self, dt: float) -> None:
        pass
