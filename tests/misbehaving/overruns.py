"""Takes more CPU time than it has, in every `every`th cycle, and does as it is told."""

import itertools
import os
import time
from typing import Annotated as A

import numpy as np

from pbonet import (
    OutVar,
    Params,
    PortBasedObject,
    Recovery,
    TimingFailure,
    Vector,
    param,
)


class Settings(Params):
    """What it does."""

    busy: A[float, param("s", "CPU time of a long cycle", ge=0)] = 0.02
    every: A[int, param("none", "which cycles are long", ge=1)] = 5
    work: A[str, param("none", "python, numpy, sleep, locked or endless")] = "python"
    answer: A[str, param("none", "what the handler does")] = "continue"
    fifo: A[str, param("none", "named pipe of the device, where one times it")] = ""


class Overruns(PortBasedObject[Settings]):
    """Counts its cycles and its failures."""

    y: A[
        Vector,
        OutVar("Y", "2", "none", "cycles that ended, calls of the handler", safe=-7.0),
    ]

    def init(self) -> None:
        fifo = self.params.fifo
        self._device = os.open(fifo, os.O_RDWR) if fifo else -1

    def sync(self) -> None:
        os.read(self._device, 1)

    def on(self) -> None:
        self._begun = 0
        self._failures = 0.0
        self._matrix = np.ones((300, 300))

    def cycle(self, dt: float) -> None:
        self._begun += 1
        self.y[1] = -1.0
        if self._begun % self.params.every == 0:
            self._work()
        self.y[0] += 1.0
        self.y[1] = self._failures

    def _work(self) -> None:
        if self.params.work == "locked":
            with self.task.critical():
                self._spend(self.params.busy)
            self._spend(self.params.busy)
        elif self.params.work == "endless":
            sum(itertools.repeat(0, 10**12))
        elif self.params.work == "sleep":
            time.sleep(self.params.busy)
        else:
            with self.task.timed("work"):
                self._spend(self.params.busy)

    def _spend(self, seconds: float) -> None:
        end = time.thread_time() + seconds
        while time.thread_time() < end:
            if self.params.work == "numpy":
                self._matrix @ self._matrix

    def timing_failure(self, kind: TimingFailure) -> Recovery | None:
        self._failures += 1.0
        match self.params.answer:
            case "abort":
                return Recovery.ABORT
            case "skip":
                return Recovery.SKIP
            case "raise":
                raise ValueError(f"the handler does not like {kind}")
            case "hang":
                while True:
                    pass
            case "hang_in_c":
                sum(itertools.repeat(0, 10**11))
            case "lower":
                self.task.criticality = 2
                self.task.deadline = 0.5
        return None
