"""Signals that a module declares in its class body."""

import pytest

from pbonet import PortBasedObject, Signal, UserSignal
from pbonet.errors import DeclarationError
from pbonet.pbo import SignalInfo, describe, render, signal_bits, signal_names
from pbonet.testing import Bench


class Gripper(PortBasedObject):
    """Closes."""

    GRASPED = UserSignal(0, "it holds an object")
    LOST = UserSignal(24, "it holds nothing any more")

    def cycle(self, dt: float) -> None:  # noqa: ARG002 - as it is called
        self.task.signal(self.GRASPED, "gently")


class Soft(Gripper):
    """Closes softly."""

    SLIPS = UserSignal(1, "the object slips")


def test_they_are_described_with_those_of_the_base_class():
    info = describe(Soft)
    assert info.signals == (
        SignalInfo("GRASPED", 0, "it holds an object"),
        SignalInfo("LOST", 24, "it holds nothing any more"),
        SignalInfo("SLIPS", 1, "the object slips"),
    )
    assert "  GRASPED  user 0   it holds an object\n" in render(info)
    assert [one.bit for one in info.signals] == [1 << 7, 1 << 31, 1 << 8]


def test_they_are_sent_as_their_bits():
    bench = Bench(Gripper)
    bench.on()
    bench.step()
    (notice,) = bench.notices()
    assert (notice.bits, notice.text) == (1 << 7, "gently")


def test_names_and_bits():
    own = {"GRASPED": 1 << 7}
    assert signal_names(Signal.OFF | 1 << 7 | 1 << 9, own) == [
        "OFF",
        "GRASPED",
        "user 2",
    ]
    assert signal_bits(["OFF", "GRASPED", "UNKNOWN"], own) == 1 | 1 << 7


def declare(**signals):
    body = dict(signals)
    return type("Wrong", (Gripper,), body)


@pytest.mark.parametrize(
    ("signals", "text"),
    [
        ({"AGAIN": UserSignal(0, "x")}, "user signal 0 is GRASPED already"),
        ({"GRASPED": UserSignal(5, "x")}, "the signal GRASPED has two numbers"),
        ({"OFF": UserSignal(5, "x")}, "every task has a signal OFF already"),
        ({"slips": UserSignal(5, "x")}, "1 to 31 capital letters"),
        ({"S" * 32: UserSignal(5, "x")}, "1 to 31 capital letters"),
    ],
)
def test_what_cannot_be_declared(signals, text):
    with pytest.raises(DeclarationError, match=text):
        declare(**signals)
