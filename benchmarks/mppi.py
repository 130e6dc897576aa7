r"""How long an update of the plan of `mppi_arm` takes, by back end and rollouts.

An update is what the module asks for in one batch: all variables are written, the
routine is called, the plan is read back, and all is waited for. Seven joints, 30 steps.
Median and 99 % quantile in ms, and the updates a second that the latter allows. It
needs no agents, native parts or pinocchio, so that it runs where there is a GPU, numpy,
and Warp or torch.

    OMP_NUM_THREADS=1 OPENBLAS_NUM_THREADS=1 \
      python -m benchmarks.mppi [--updates 200] [--rollouts N ...]
"""

from __future__ import annotations

import argparse
import os
import platform
import sys
import time
from types import SimpleNamespace
from typing import TYPE_CHECKING, Any

import numpy as np

from pbonet.errors import SppError
from pbonet.io.mppi import sizes as at
from pbonet.io.spp import kernel_library
from pbonet.io.spp.back_end_choice import BackEnds
from pbonet.io.spp.numpy_back_end import NumpyBackEnd

if TYPE_CHECKING:
    from collections.abc import Iterator, Mapping

    from numpy.typing import NDArray

    from pbonet.io.spp.back_end import BackEnd
    from pbonet.io.spp.kernel_library import Library

LIBRARY = "pbonet.io.mppi.kernels"
JOINTS, STEPS = 7, 30
ROLLOUTS = 256, 2048, 16384
WARM_UP = 5
CLOSE = 1e-4
"""rad/s^2 that a back end's plan may differ from that of numpy: the goal."""
MISSED = 3
HOME = 0.0, -0.5, 0.0, -2.2, 0.0, 1.8, 0.785398
AXES = (
    (0, 0, 1, 0, 0, 0.333),
    (0, 1, 0, 0, 0, 0.333),
    (0, 0, 1, 0, 0, 0.649),
    (0, -1, 0, 0.0825, 0, 0.649),
    (0, 0, 1, 0, 0, 1.033),
    (0, -1, 0, 0, 0, 1.033),
    (0, 0, -1, 0.088, 0, 1.033),
)
"""The arm of examples/panda when its joints are 0: directions, and points in m."""
TIP = 0.088, 0.0, 0.926
GOAL = 0.5, 0.3, 0.4
LIMITS = (
    (-2.8973, -1.7628, -2.8973, -3.0718, -2.8973, -0.0175, -2.8973),
    (2.8973, 1.7628, 2.8973, -0.0698, 2.8973, 3.7525, 2.8973),
    (2.175, 2.175, 2.175, 2.175, 2.61, 2.61, 2.61),
    (8.0, 8.0, 8.0, 8.0, 10.0, 10.0, 10.0),
)


def problem(library: Library) -> dict[str, NDArray[Any]]:
    """Return values of the variables: the arm at rest, and a goal."""
    found = {k: np.zeros(one.shape, one.dtype) for k, one in library.variables.items()}
    found["joints"][:4, :JOINTS] = LIMITS
    found["joints"][4, :JOINTS] = found["state"][0, :JOINTS] = HOME
    found["axes"][:JOINTS, :6] = AXES
    found["tip"][:], found["goal"][:] = TIP, GOAL
    places = {
        at.STEP: 0.02, at.NOISE: 0.7, at.KEEP: 0.7, at.FLOOR: 0.05, at.NEAR: 0.3,
        at.TEMPERATURE: 0.15, at.DISTANT: 1.0, at.END: 5.0, at.SPEED: 0.02,
        at.EFFORT: 1e-3, at.POSTURE: 0.02,
    }  # fmt: skip
    for place, value in places.items():
        found["settings"][place] = value
    return found


class Planner:
    """The library on a back end.

    Args:
        library: The library.
        back_end: The back end.
        values: Of its variables.
    """

    def __init__(
        self, library: Library, back_end: BackEnd, values: Mapping[str, NDArray[Any]]
    ) -> None:
        self._back_end, self._values = back_end, values
        self._routine = library.routines["update"][back_end.name]
        self._arrays = {k: back_end.make(one) for k, one in library.variables.items()}
        self._m = SimpleNamespace(
            **self._arrays, local=SimpleNamespace(), device=back_end.said
        )
        self._back_end.write(self._arrays["plan"], values["plan"])

    def update(self, rollouts: int, seed: int, shift: float = 1.0) -> NDArray[Any]:
        """Do one update as a batch does; return the plan."""
        for name, value in self._values.items():
            if name != "plan":
                self._back_end.write(self._arrays[name], value)
        self._routine(self._m, JOINTS, STEPS, rollouts, seed, shift)
        self._back_end.read(self._arrays["plan"])
        self._back_end.finish()
        return self._back_end.taken(self._arrays["plan"])


def back_ends() -> Iterator[BackEnd]:
    """Yield all back ends of this machine, on the processor and on a GPU."""
    for device in ("cpu", "cuda:0"):
        for driver in kernel_library.BACK_ENDS:
            if driver == "numpy" and device != "cpu":
                continue
            entry: Any = SimpleNamespace(driver=driver, device=device)
            try:  # an SppEntry would need msgspec
                yield BackEnds(entry, "gpu0").first
            except SppError as error:
                sys.stdout.write(f"{driver} on {device}: {error.got}\n")


def timed(planner: Planner, rollouts: int, updates: int) -> str:
    """Return the figures of a back end."""
    for seed in range(WARM_UP):
        planner.update(rollouts, seed)
    times: list[float] = []
    for seed in range(updates):
        begin = time.perf_counter()
        planner.update(rollouts, seed)
        times.append(1e3 * (time.perf_counter() - begin))
    half, most = np.quantile(times, (0.5, 0.99))
    return f"{half:.2f} / {most:.2f} / {max(times):.2f} ms, {1e3 / most:.0f} Hz"


def main(argv: list[str] | None = None) -> None:
    """Measure all back ends that are installed."""
    words = argparse.ArgumentParser(description=(__doc__ or "").split("\n\n")[0])
    words.add_argument("--updates", type=int, default=200)
    words.add_argument("--rollouts", type=int, nargs="+", default=ROLLOUTS)
    told = words.parse_args(argv)
    library = kernel_library.load(LIBRARY)
    load = os.getloadavg()[0]
    sys.stdout.write(f"{platform.machine()}, load {load:.1f}; p50 / p99 / longest\n")
    values = problem(library)
    first = Planner(library, NumpyBackEnd(), values).update(told.rollouts[0], 0).copy()
    agree = True
    for back_end in back_ends():
        planner = Planner(library, back_end, values)
        apart = np.abs(planner.update(told.rollouts[0], 0) - first).max()
        agree = agree and bool(apart <= CLOSE)
        sys.stdout.write(
            f"{back_end.name} on {back_end.device}: plan {apart:.1e} rad/s^2 from "
            f"that of numpy\n"
        )
        for rollouts in told.rollouts:
            name = f"{back_end.name} on {back_end.device}"
            figures = timed(planner, rollouts, told.updates)
            sys.stdout.write(f"{name:16} {rollouts:6} rollouts: {figures}\n")
            sys.stdout.flush()
    sys.exit(0 if agree else MISSED)


if __name__ == "__main__":
    main()
