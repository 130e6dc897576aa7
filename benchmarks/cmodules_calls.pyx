# cython: language_level=3, boundscheck=False, wraparound=False
"""Calls of `cycle`, again and again, as the native loop makes them."""

from pbonet.cmodule._cmodule cimport NativeMethod, pbo_run


def bare(NativeMethod method, long count) -> None:
    """Call the function in C alone."""
    cdef long i
    for i in range(count):
        method.function(method.one.state, &method.one.task)


def by_pointer(NativeMethod method, long count) -> None:
    """Call it as the native loop does, with time and count of the cycle."""
    cdef long i
    for i in range(count):
        method.one.task.dt = i * 1e-9
        method.one.task.now_ns = i
        method.one.task.cyclecount = i - method.before
        if pbo_run(method.function, method.one):
            raise ValueError("the method has something to say")


def by_object(method, long count) -> None:
    """Call a method as the native loop calls one in Python."""
    cdef long i
    dt = 0.001
    for i in range(count):
        method(dt)
