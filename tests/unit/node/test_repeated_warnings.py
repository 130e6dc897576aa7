"""A module that warns in every cycle is reported at once, then every ten seconds."""

from types import SimpleNamespace
from typing import Any

import pytest

from pbonet.errors import Severity
from pbonet.node.rtpu.illegal_flag import CHANGES, CauseEvents
from pbonet.node.rtpu.task_signals import (
    CAUSES,
    SINGLE,
    WINDOW_NS,
    RepeatedWarnings,
)
from pbonet.node.wire.event_log import EventLog, by_task
from pbonet.node.wire.rtpu_messages import Notice
from pbonet.pbo import Signal


class Namespace(SimpleNamespace):
    __hash__ = object.__hash__


class Rig:
    def __init__(self) -> None:
        self.events = EventLog("arm0", clock_ns=lambda: 0, wall=lambda: 0.0)
        self.warnings = RepeatedWarnings(self.events)
        facts = SimpleNamespace(subsystem="s")
        self.task: Any = Namespace(name="t", facts=facts)

    def warn(self, text: str, now_ns: int, code="WARNING", bits=Signal.WARNING) -> bool:
        """Report a warning; return whether it became an event."""
        notice = Notice(
            severity=int(Severity.WARNING), code=code, text=text, bits=int(bits)
        )
        if self.warnings.repeats(self.task, notice, now_ns):
            return False
        self.events.add(Severity.WARNING, code, text, subsystem="s", task="t")
        return True

    def texts(self) -> list[str]:
        return [event.text for event in self.events.since(0)]


@pytest.fixture
def rig() -> Rig:
    return Rig()


def test_a_flood_becomes_one_event_in_ten_seconds(rig: Rig) -> None:
    for i in range(600):  # ten a second, for a minute
        now = i * 100_000_000
        rig.warn(f"motor is warm: {60 + i / 100:.2f} C", now)
        rig.warnings.report(now)
    rig.warnings.end(rig.task, 60 * 10**9)
    texts = rig.texts()
    assert texts[0] == "motor is warm: 60.00 C", "the first ones come at once"
    assert texts[SINGLE] == "[98 more in 10 s] motor is warm: 61.00 C"
    assert len(texts) == SINGLE + 6
    assert by_task(rig.events.counts(), "s") == {"t": {"WARNING": 600}}


def test_inputs_that_change_to_and_fro_are_one_cause_and_the_newest_counts(
    rig: Rig,
) -> None:
    for i in range(600):
        now = i * 100_000_000
        code = "FRESH" if i % 2 else "STALE"
        rig.warn(f"the inputs are {code}", now, code=code, bits=Signal(0))
        rig.warnings.report(now)
    rig.warnings.end(rig.task, 60 * 10**9)
    events = rig.events.since(0)
    assert len(events) == SINGLE + 6
    assert [one.code for one in events[:SINGLE]] == ["STALE", "FRESH", "STALE"]
    assert events[-1].code == "FRESH"
    assert events[-1].text.endswith("more in 10 s] the inputs are FRESH")
    assert by_task(rig.events.counts(), "s") == {"t": {"STALE": 300, "FRESH": 300}}


def test_another_cause_is_not_held_back(rig: Rig) -> None:
    for _ in range(SINGLE):
        assert rig.warn("Z2 is taken, not Z1", 0)
    assert not rig.warn("Z2 is taken, not Z1", 1)
    assert rig.warn("Z1 is taken, not Z2", 1)


def test_it_is_new_again_after_a_pause(rig: Rig) -> None:
    assert rig.warn("warm", 0)
    rig.warnings.report(WINDOW_NS)
    assert rig.warn("warm", WINDOW_NS + 1)
    assert rig.texts() == ["warm", "warm"]


def test_signals_are_never_held_back(rig: Rig) -> None:
    for _ in range(SINGLE + 1):
        assert rig.warn("done", 0, bits=Signal.WARNING | Signal.FINISH)
        assert rig.warn("STATE", 0, code="STATE", bits=Signal(0))


def test_a_module_with_ever_new_texts_uses_little_memory(rig: Rig) -> None:
    passed = [rig.warn(f"text {'x' * i}", 0) for i in range(CAUSES + 20)]
    assert all(passed)
    assert rig.warn("text " + "x" * (CAUSES + 10), 1), "it is not followed"


class TestCauses:
    """A cause of the flag that comes and goes again and again."""

    def events(self, changes: int, every_ns: int) -> EventLog:
        now = [0]
        log = EventLog("arm0", clock_ns=lambda: now[0], wall=lambda: 0.0)
        causes = CauseEvents(log)
        for i in range(changes):
            now[0] = i * every_ns
            causes.update("s", [("x is stale", "arm0/t")] if i % 2 == 0 else [])
        now[0] += WINDOW_NS
        causes.update("s", [])
        return log

    def test_a_few_are_reported_one_by_one(self) -> None:
        events = self.events(4, 1).since(0)
        assert [(one.code, one.text) for one in events] == [
            ("ILLEGAL", "x is stale (arm0/t)"),
            ("LEGAL", "no longer: x is stale (arm0/t)"),
        ] * 2

    def test_many_are_joined_and_the_newest_state_follows(self) -> None:
        log = self.events(1000, 40_000_000)  # for 40 s
        events = log.since(0)
        assert len(events) <= 5 * (CHANGES + 1)
        assert events[CHANGES].text.startswith("[24")
        assert events[-1].code == "LEGAL"
        assert by_task(log.counts(), "s") == {"": {"ILLEGAL": 500, "LEGAL": 500}}

    def test_slow_changes_are_all_reported(self) -> None:
        assert len(self.events(100, WINDOW_NS // 4).since(0)) == 100

    def test_nothing_is_kept_of_a_cause_that_is_gone(self) -> None:
        log = EventLog("arm0", clock_ns=lambda: 0, wall=lambda: 0.0)
        causes = CauseEvents(log)
        causes.update("s", [("x", "arm0/t")])
        causes.forget("s")
        assert causes.subsystems() == []
