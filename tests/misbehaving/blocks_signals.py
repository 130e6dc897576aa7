"""Blocks all signals, and then overruns its period in every cycle."""

import signal
import time
from typing import Annotated as A

from pbonet import OutVar, PortBasedObject, TimingFailure, Vector


class BlocksSignals(PortBasedObject):
    """Neither a failure nor a request to be still reaches it."""

    y: A[Vector, OutVar("Y", "2", "none", "cycles, and failures that were handled")]

    def on(self) -> None:
        signal.pthread_sigmask(signal.SIG_BLOCK, range(1, signal.NSIG))

    def cycle(self, dt: float) -> None:
        self.y[0] += 1.0
        end = time.thread_time() + 0.015
        while time.thread_time() < end:
            pass

    def timing_failure(self, kind: TimingFailure) -> None:
        self.y[1] += 1.0
