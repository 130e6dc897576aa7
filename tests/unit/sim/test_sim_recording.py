"""A recording keeps every cycle, and gives back what was put in."""

from __future__ import annotations

import os

import numpy as np
import pytest

from pbonet.config.model import Variable
from pbonet.errors import UnknownVariableError
from pbonet.log import Step, TaskAbout
from pbonet.master.sim.sim_recording import Recording
from pbonet.node.ring._ring import Ring

A = Variable(name="A", type="int", nelem=3)
B = Variable(name="B", type="double", nelem=2)
C = Variable(name="C", type="byte", nelem=1)


def about(*outvar: Variable) -> TaskAbout:
    """Return what is said of a task that writes these variables."""
    names = dict.fromkeys(("domain", "rtpu", "subsystem", "task", "module"), "x")
    return TaskAbout(
        **names, pid=1, freq=1.0, rmod="", rmod_name="", outvar=list(outvar)
    )


def filled() -> Recording:
    recording = Recording({"job": "demo", "seconds": 1.5})
    first = recording.task("one", about(A, C))
    ring = Ring.create(f"recording{os.getpid()}")
    try:
        ring.put(b"", kind=Step.ON_IN, cycle=4)
        for k in range(3):
            values = np.array([k, -k, 7], "<i4").tobytes()
            group = values + bytes(4) + bytes([k]) + bytes(7)
            ring.put(group, now_ns=1000 + k, cycle=k + 5)
        first.add(ring.take())
        second = recording.task("two", about(B))
        ring.put(np.array([0.5, 1.5]).tobytes(), now_ns=900, cycle=1)
        second.drain = lambda: second.add(ring.take())
        assert len(recording.arrays("two")["cycle"]) == 1
        second.drain = lambda: None
    finally:
        ring.destroy()
    recording.task("idle", about())
    return recording


def test_it_gives_back_what_was_put_in() -> None:
    recording = filled()
    assert recording.about == {"job": "demo", "seconds": 1.5}
    assert recording.tasks == ["one", "two", "idle"]
    one = recording.arrays("one")
    assert one["A"].tolist() == [[0, 0, 7], [1, -1, 7], [2, -2, 7]]
    assert one["A"].dtype == np.dtype("<i4")
    assert one["C"].tolist() == [[0], [1], [2]]
    assert one["cycle"].tolist() == [1, 2, 3], "since it was turned on"
    assert one["release_ns"].tolist() == [1000, 1001, 1002]
    assert one["flags"].tolist() == [0, 0, 0]
    assert recording.variables("one") == ["A", "C"]
    assert [task for _, task in recording.writers("B")] == ["two"]
    assert recording.begin_ns == 900
    time, values = recording.series("A")
    assert time == pytest.approx([100e-9, 101e-9, 102e-9])
    assert values.shape == (3, 3)
    assert len(recording.arrays("idle")["cycle"]) == 0


def test_a_task_that_has_no_cycle_is_no_writer() -> None:
    recording = filled()
    recording.task("three", about(B))
    assert [task for _, task in recording.writers("B")] == ["two"]


def test_unknown_variable_offers_the_nearest() -> None:
    with pytest.raises(UnknownVariableError, match="no task of the run wrote BB") as e:
        filled().series("BB")
    assert e.value.remedy == "did you mean B?"
