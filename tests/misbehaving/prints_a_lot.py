"""Prints in every method, from Python and from below."""

import contextlib
import os
import sys
from typing import Annotated as A

from pbonet import OutVar, PortBasedObject, Vector


class Prints(PortBasedObject):
    """y = (cycles, missed ones), and ten kilobytes of text in each cycle."""

    y: A[Vector, OutVar("Y", "2", "none", "cycles")]

    def init(self) -> None:
        print("hello from init")

    def cycle(self, dt: float) -> None:
        self.y[0] += 1.0
        self.y[1] += round(dt * self.task.freq) - 1
        for i in range(100):
            print(f"line {i} of cycle {self.y[0]:.0f}" + "." * 70)
        print("to standard error", file=sys.stderr)
        with contextlib.suppress(BlockingIOError):
            os.write(1, b"straight to the file\n")
