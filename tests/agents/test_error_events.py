"""Errors that are put right, and those that are not, as events (chapter 8)."""

from __future__ import annotations

import json
import subprocess
import sys

import pytest
from nodekit import svar
from watching import wait_for

from pbonet.errors import MethodError, Severity

NUMBERED = """
    from typing import Annotated as A

    from pbonet import Answer, OutVar, PortBasedObject, Vector


    class Numbered(PortBasedObject):
        '''Warns in its fourth cycle, fails in its fifth, and comes on once.'''

        y: A[Vector, OutVar("Y", "2", "none", "nothing")]

        def init(self) -> None:
            self._been_on = False

        def on(self) -> None:
            if self._been_on:
                raise ValueError("not twice")
            self._been_on = True

        def clear(self) -> Answer:
            return Answer.OFF

        def cycle(self, dt: float) -> None:
            done = self.task.cyclecount
            if done == 3:
                self.task.warn(f"in {done}", 13)
            elif done == 4:
                self.task.fail(f"too hot in {done}", 42)
"""


def place(event):
    """Return the file's name and the method of an event's line."""
    where, method = event.place.split(" in ")
    file, line = where.rsplit(":", 1)
    assert int(line) > 0
    return file.rpartition("/")[2], method


@pytest.mark.parametrize("way", ["continue", "jump"])
def test_a_scope_keeps_the_task_on_and_says_so(arm, way):
    arm.spawn("a", "handles", local={"WAY": way})
    arm.on("a")
    arm.wait_cycles("a", 10)
    assert arm.status("a").state == "ON"
    event = arm.wait_event("HANDLED", "a")
    assert (event.severity, event.errnum) == (Severity.WARNING, 7)
    assert event.text == f"too hot: {way}"
    assert place(event) == ("handles.py", "cycle")
    cycles, errors = arm.value("Y0").values
    assert cycles == errors > 0


def test_a_kept_handler_discards_the_cycle_and_the_task_goes_on(arm):
    arm.spawn("a", "handles", local={"WAY": "kept"})
    arm.on("a")
    event = arm.wait_event("HANDLED", "a")
    assert event.text == "DeviceError: no encoder: jump"
    assert place(event) == ("handles.py", "cycle")
    arm.wait_cycles("a", 10)
    assert arm.status("a").state == "ON"
    assert arm.events("METHOD", "a") == []


def test_by_default_the_task_is_in_error_with_its_line(arm):
    arm.spawn("a", "handles", local={"WAY": "none"})
    arm.spawn("good", "counts", out="Y1")
    arm.on("good")
    arm.on("a")
    event = arm.wait_event("METHOD", "a")
    assert event.severity == Severity.ERROR
    assert event.text == "a.cycle: no encoder; it is ERROR"
    assert place(event) == ("handles.py", "cycle")
    assert arm.status("a").error == f"no encoder ({event.place})"
    assert (event.cycle, event.errnum) == (0, 1), "none completed, none given"
    assert arm.status("a").state == "ERROR"
    arm.wait_cycles("good", 10)


def test_the_number_and_the_cycle_of_an_error(arm, nodes):
    """The module's own number, and what it read as its cycle count."""
    nodes.write_module("numbered", NUMBERED)
    arm.spawn("a", "numbered")
    arm.on("a")
    warning = arm.wait_event("WARNING", "a")
    assert (warning.cycle, warning.errnum, warning.text) == (3, 13, "in 3")
    failed = arm.wait_event("METHOD", "a")
    assert (failed.cycle, failed.errnum) == (4, 42)
    assert failed.text == "a.cycle: too hot in 4; it is ERROR"
    assert arm.status("a").cycle == 4
    arm.control("a", "clear")
    error = arm.refused(MethodError, arm.on, "a")
    assert "a.on: ValueError: not twice (" in str(error)
    assert str(error).count("numbered.py:") == 1, "its line, once"
    (refused,) = arm.events("SIGNAL_FAILED", "a")
    assert refused.errnum == 1
    assert place(refused) == ("numbered.py", "on")


def test_a_crash_in_native_code_has_a_line_too(arm):
    arm.spawn("a", "segfaults")
    arm.on("a")
    event = arm.wait_event("TASK_DIED", "a")
    assert place(event) == ("segfaults.py", "cycle"), "not a line of ctypes"


def test_a_flood_is_held_back_and_counted(arm):
    arm.spawn("a", "handles", freq=1000.0, local={"WAY": "continue"})
    arm.on("a")
    arm.wait_cycles("a", 600)
    arm.off("a")
    errors = int(arm.value("Y0").values[1])

    def counted():
        told = arm.rtpu_status().events["a"]["HANDLED"]
        return told == errors

    wait_for(counted, f"{errors} errors to be counted")
    assert len(arm.events("HANDLED", "a")) < errors


@pytest.fixture
def told(nodes, tmp_path):
    """Ask for events as somebody does who comes when all is over; return the text."""
    nodes.agent_process("arm0")
    (tmp_path / "s.svar").write_text(svar())
    (tmp_path / "s.sbs").write_text("SUBSYSTEM two\nSVARFILE s.svar\nRTPU arm0\nEOF\n")
    arm = nodes.master("arm0", "two")
    arm.spawn("a", "handles", local={"WAY": "none"})
    arm.on("a")
    arm.wait_event("METHOD", "a")

    def run(*words):
        command = [sys.executable, "-m", "pbonet.cli", "events", tmp_path / "s.sbs"]
        done = subprocess.run(
            [*command, "--domain", nodes.domain, *words],
            capture_output=True, text=True, check=True,
        )  # fmt: skip
        return done.stdout

    return run


def test_events_are_asked_for_afterwards(told):
    wanted = ("--json", "--since", "5m", "--task", "a")
    every = json.loads(told(*wanted))["events"]
    assert {"SPAWNED", "STATE", "METHOD"} <= {event["code"] for event in every}
    bad = json.loads(told(*wanted, "--severity", "warning"))["events"]
    assert bad == [event for event in every if event["severity"] >= 30]
    assert "METHOD" in {event["code"] for event in bad}
    assert {event["state"] for event in bad if event["code"] == "METHOD"} == {"ERROR"}
    assert told("--since", "0s").strip() == "no events"


def test_events_show_the_line(told):
    words = ("--code", "METHOD")
    assert "handles.py:" in told(*words)
    assert "in cycle)" in told(*words)
    (event,) = json.loads(told(*words, "--json"))["events"]
    assert event["place"].endswith(" in cycle")
