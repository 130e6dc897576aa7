"""multiprocessing.Lock around one numpy.copyto, in shared memory."""

from __future__ import annotations

import mmap
import multiprocessing

import numpy as np

from benchmarks.rivals.rival import Reader, Rival, Writer, whole


class LockedNumpy(Rival):
    """All arrays are one block, which is copied by one call."""

    name = "multiprocessing.Lock + numpy"

    def __init__(self, length: int, tag: str) -> None:
        super().__init__(length, tag)
        self.lock = multiprocessing.Lock()
        self.memory = mmap.mmap(-1, 8 * self.floats)

    def writer(self) -> Writer:
        """Use the memory that was inherited."""
        lock, copyto = self.lock, np.copyto
        own = np.zeros(self.floats)
        common = np.frombuffer(self.memory, np.float64)

        def publish() -> None:
            with lock:
                copyto(common, own)

        return Writer([own], publish)

    def reader(self) -> Reader:
        """Use the memory that was inherited."""
        lock, copyto = self.lock, np.copyto
        own = np.zeros(self.floats)
        common = np.frombuffer(self.memory, np.float64)

        def take() -> list[np.ndarray[tuple[int], np.dtype[np.float64]]]:
            with lock:
                copyto(own, common)
            return numbers

        numbers = [own]
        return Reader(take, whole)
