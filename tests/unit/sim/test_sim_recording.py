"""A recording keeps every cycle, and gives back what was put in."""

from __future__ import annotations

import numpy as np
import pytest

from pbonet.config.model import Variable
from pbonet.errors import UnknownVariableError
from pbonet.master.sim.sim_recording import Recording

VARIABLES = (
    Variable(name="A", type="int", nelem=3),
    Variable(name="B", type="double", nelem=2),
    Variable(name="C", type="byte", nelem=1),
)


def filled() -> Recording:
    recording = Recording({"job": "demo", "seconds": 1.5})
    first = recording.task("one", VARIABLES, ["C", "A"])
    for k in range(3):
        group = np.array([k, -k, 7], "<i4").tobytes() + bytes(4) + bytes([k]) + bytes(7)
        first.add(group, release_ns=1000 + k, cycle=k + 1, cpu_ns=50 + k, flags=k)
    second = recording.task("two", VARIABLES, ["B"])
    second.add(np.array([0.5, 1.5]).tobytes(), release_ns=900, cycle=1)
    recording.task("idle", VARIABLES, [])
    return recording


def test_it_gives_back_what_was_put_in() -> None:
    recording = filled()
    assert recording.about == {"job": "demo", "seconds": 1.5}
    assert recording.tasks == ["one", "two", "idle"]
    one = recording.arrays("one")
    assert one["A"].tolist() == [[0, 0, 7], [1, -1, 7], [2, -2, 7]]
    assert one["A"].dtype == np.dtype("<i4")
    assert one["C"].tolist() == [[0], [1], [2]]
    assert one["cycle"].tolist() == [1, 2, 3]
    assert one["cpu_ns"].tolist() == [50, 51, 52]
    assert one["flags"].tolist() == [0, 1, 2]
    assert recording.variables("one") == ["A", "C"]
    assert recording.writer("B") == "two"
    assert recording.begin_ns == 900
    time, values = recording.series("A")
    assert time == pytest.approx([100e-9, 101e-9, 102e-9])
    assert values.shape == (3, 3)
    assert len(recording.arrays("idle")["cycle"]) == 0


def test_of_two_writers_the_first_counts() -> None:
    recording = filled()
    recording.task("three", VARIABLES, ["B"])
    assert recording.writer("B") == "two"


def test_unknown_variable_offers_the_nearest() -> None:
    with pytest.raises(UnknownVariableError, match="no task of the run wrote BB") as e:
        filled().series("BB")
    assert e.value.remedy == "did you mean B?"
