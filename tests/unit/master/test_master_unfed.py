"""What a master says of inputs without a writer, and what its keeper makes of it."""

from __future__ import annotations

import pytest

from pbonet.analysis import legality
from pbonet.errors import NoAnswerError
from pbonet.master.subsystem.unwritten_inputs import UNFED, UnwrittenInputs
from pbonet.master.subsystem.warning_dedup import WarningDedup


class Keeper:
    """The keeper of a table: knows who writes, and has the flag."""

    def __init__(self):
        self.written = set()
        self.standing = {}
        self.asked = []
        self.warnings = []
        self.silent = False
        self._said = WarningDedup()
        self.unfed = UnwrittenInputs(self.ask, self.say)

    def say(self, problems):
        self.warnings += self._said.say(problems)

    def ask(self, flag):
        if self.silent:
            raise NoAnswerError("the keeper does not answer")
        self.asked.append((flag.cause.removeprefix(UNFED), flag.up))
        self.standing.pop(flag.cause, None)
        if flag.up and not self.written.issuperset(flag.unwritten):
            self.standing[flag.cause] = flag.unwritten
        return self.causes()

    def causes(self):
        return [f"{cause} (master)" for cause in self.standing]


@pytest.fixture
def keeper():
    return Keeper()


def nobody_writes(*variables):
    return legality.Problem(
        code=legality.Code.NO_WRITER,
        what=f"no task that is ON writes {' and '.join(variables)}, which b reads",
        remedy="turn a on",
        tasks=("b",),
        variables=variables,
    )


def test_it_is_raised_told_once_and_withdrawn(keeper):
    keeper.unfed.settle([nobody_writes("X", "Y")])
    assert keeper.standing == {f"{UNFED}X Y for b": ["X", "Y"]}
    keeper.unfed.settle([nobody_writes("X", "Y")])
    (text,) = keeper.warnings
    assert text.startswith("no task that is ON writes X and Y, which b reads")
    keeper.unfed.settle([nobody_writes("X")])
    assert keeper.asked[-2:] == [("X for b", True), ("X Y for b", False)]
    keeper.unfed.settle([])
    assert keeper.standing == {}
    assert len(keeper.warnings) == 2


def test_what_was_raised_by_an_earlier_master_is_withdrawn(keeper):
    keeper.unfed.seen([f"{UNFED}X for b (master)", "b is in ERROR (arm0/b)"])
    keeper.unfed.settle([])
    assert keeper.asked == [("X for b", False)]


def test_what_its_keeper_withdrew_is_raised_again(keeper):
    """Between the look at the beginning of a command and its end."""
    keeper.unfed.settle([nobody_writes("X")])
    keeper.unfed.seen(keeper.causes())
    keeper.standing.clear()
    keeper.unfed.settle([nobody_writes("X")])
    assert keeper.causes() == [f"{UNFED}X for b (master)"]


def test_a_fallback_that_the_keeper_knows_of_is_no_reason_to_warn(keeper):
    keeper.written = {"X"}
    keeper.unfed.settle([nobody_writes("X")])
    assert keeper.warnings == keeper.causes() == []
    keeper.written.clear()
    keeper.unfed.settle([nobody_writes("X")])
    assert len(keeper.warnings) == len(keeper.causes()) == 1


def test_it_is_told_though_the_keeper_is_silent(keeper):
    keeper.silent = True
    with pytest.raises(NoAnswerError):
        keeper.unfed.settle([nobody_writes("X")])
    assert len(keeper.warnings) == 1
