"""Kernels of the tests of special purpose processors, for each back end."""

import os
import time

import numpy as np

from pbonet.io.spp import Library

library = Library()
library.variable("x", (7,))
library.variable("u", (7,), "f4")
library.variable("n", (), "i8")


@library.routine("numpy")
def update(m, gain):
    m.u[:] = gain * np.tanh(m.x)


@library.routine("torch", "update")
def update_torch(m, gain):
    m.u.copy_(gain * m.x.tanh())


@library.setup("warp")
def kernels(m):
    import warp as wp

    @wp.kernel
    def squash(
        x: wp.array(dtype=wp.float64), u: wp.array(dtype=wp.float32), gain: wp.float64
    ):
        i = wp.tid()
        u[i] = wp.float32(gain * wp.tanh(x[i]))

    m.local.squash = squash
    m.local.launch = wp.launch


@library.routine("warp", "update")
def update_warp(m, gain):
    m.local.launch(m.local.squash, dim=7, inputs=[m.x, m.u, gain], device=m.device)


def everywhere(function):
    """Make a function that uses no arrays of a back end a routine of all."""
    for back_end in ("numpy", "warp", "torch"):
        library.routine(back_end)(function)
    return function


@everywhere
def count(m, whole, truth):
    """Keep state between calls, and see what the numbers of a call are."""
    m.local.kinds = type(whole), type(truth)
    assert m.local.kinds == (int, bool)
    m.local.n = getattr(m.local, "n", 0) + whole


@everywhere
def fail(m, number):  # noqa: ARG001 - the interface
    raise ValueError(f"not {number}")


@everywhere
def nap(m, seconds):  # noqa: ARG001 - the interface
    time.sleep(seconds)


@everywhere
def die(m):  # noqa: ARG001 - the interface
    os._exit(3)
