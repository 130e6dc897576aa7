"""Kernels of `benchmarks.spp`: nothing, and many hyperbolic tangents."""

from __future__ import annotations

from typing import Any

import numpy as np

from pbonet.io.spp import Library

ROWS = 4096
library = Library()
library.variable("x", (7,))
library.variable("u", (7,), "f4")
library.variable("many", (ROWS, 7), "f4")
library.variable("squashed", (ROWS, 7), "f4")


def nothing(m: Any) -> None:  # noqa: ANN401 - of each back end its own
    """Do nothing."""


for _back_end in ("numpy", "warp", "torch"):
    library.routine(_back_end)(nothing)


@library.routine("numpy")
def squash(m: Any, gain: float) -> None:  # noqa: ANN401
    """Compute squashed = tanh(gain * many)."""
    np.tanh(m.many * np.float32(gain), out=m.squashed)


@library.routine("torch", "squash")
def squash_torch(m: Any, gain: float) -> None:  # noqa: ANN401
    """Compute the same."""
    m.squashed.copy_((m.many * gain).tanh())


@library.setup("warp")
def kernels(m: Any) -> None:  # noqa: ANN401
    """Make the kernel."""
    import warp as wp

    @wp.kernel
    def kernel(
        many: wp.array2d(dtype=wp.float32),  # type: ignore[valid-type]
        squashed: wp.array2d(dtype=wp.float32),  # type: ignore[valid-type]
        gain: wp.float32,
    ) -> None:
        i, j = wp.tid()
        squashed[i, j] = wp.tanh(gain * many[i, j])

    m.local.kernel, m.local.launch = kernel, wp.launch


@library.routine("warp", "squash")
def squash_warp(m: Any, gain: float) -> None:  # noqa: ANN401
    """Compute the same."""
    m.local.launch(
        m.local.kernel,
        dim=(ROWS, 7),
        inputs=[m.many, m.squashed, gain],
        device=m.device,
    )
