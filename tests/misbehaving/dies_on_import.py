"""Ends the process that loads it."""

import os

from pbonet import PortBasedObject

os._exit(5)


class Dies(PortBasedObject):
    """Never seen."""

    def cycle(self, dt: float) -> None:
        pass
