"""Kernels of tests and benchmarks of special purpose processors, for each back end."""

import os
import time

import numpy as np

from pbonet.io.spp import Library

library = Library()
library.variable("x", (7,))
library.variable("u", (7,), "f4")
library.variable("n", (), "i8")
library.variable("many", (4096, 7), "f4")
library.variable("squashed", (4096, 7), "f4")


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

    @wp.kernel
    def squash_many(
        many: wp.array2d(dtype=wp.float32),
        squashed: wp.array2d(dtype=wp.float32),
        gain: wp.float32,
    ):
        i, j = wp.tid()
        squashed[i, j] = wp.tanh(gain * many[i, j])

    m.local.squash, m.local.squash_many = squash, squash_many
    m.local.launch = wp.launch


@library.routine("warp", "update")
def update_warp(m, gain):
    m.local.launch(m.local.squash, dim=7, inputs=[m.x, m.u, gain], device=m.device)


@library.routine("numpy")
def squash(m, gain):
    np.tanh(m.many * np.float32(gain), out=m.squashed)


@library.routine("torch", "squash")
def squash_torch(m, gain):
    m.squashed.copy_((m.many * gain).tanh())


@library.routine("warp", "squash")
def squash_warp(m, gain):
    m.local.launch(
        m.local.squash_many,
        dim=(4096, 7),
        inputs=[m.many, m.squashed, gain],
        device=m.device,
    )


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
def nothing(m):
    """Do nothing."""


@everywhere
def die(m):  # noqa: ARG001 - the interface
    os._exit(3)
