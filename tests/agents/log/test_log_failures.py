"""Timing failures are on record: what their handlers asked and answered is verified.

Where a failure came in a loop no log can say; what differs because of that is said to
be not verifiable, and is no divergence.
"""

from __future__ import annotations

import re

import pytest
from c_modules import put_misbehaving
from log_of_real_tasks import finish, record
from nodekit import rmod
from watching import wait_for

from pbonet.master import diagnosis
from pbonet.master.configuration import Place
from pbonet.testing import rerun, verify

ASKS = """
import time
from typing import Annotated as A

from pbonet import OutVar, Params, PortBasedObject, Recovery, Vector, param


class Told(Params):
    answer: A[str, param("none", "of the handler")] = "continue"
    busy: A[float, param("s", "CPU time of a long cycle")] = 0.02


class Asks(PortBasedObject[Told]):
    y: A[Vector, OutVar("Y", "2", "none", "what was told, and to the handler")]

    def on(self) -> None:
        self.cycles = 0
        self.told = 0.0

    def cycle(self, dt: float) -> None:
        self.cycles += 1
        self.y[0] = self.task.deadline + self.task.criticality + self.task.crit
        if self.cycles % 4 == 0:
            self.work(self.params.busy)
        self.y[1] = self.told

    def work(self, seconds: float) -> None:
        end = time.thread_time() + seconds
        while time.thread_time() < end:
            pass

    def timing_failure(self, kind):
        task = self.task
        self.told += task.deadline + task.crit + task.criticality / 7
        self.told += task.now % 1e9 + task.cyclecount
        if self.params.answer == "lower":
            task.criticality, task.deadline = 2, 0.5
            self.told += task.criticality / 3
        elif self.params.answer == "raise":
            raise ValueError("the handler does not like it")
        else:
            return Recovery(self.params.answer)
"""
STOPS = ASKS.replace("< end:", "< end and not self.stopped:").replace(
    "self.told += task.now", "self.stopped = True\n        self.told += task.now"
)
ANYTIME = (
    STOPS
    .replace("        end =", "        self.stopped = False\n        end =")
    .replace("            pass\n", "            self.steps += 1\n")
    .replace("self.told = 0.0", "self.told = self.steps = 0.0")
)
COUNTS = ANYTIME.replace("self.y[1] = self.told", "self.y[1] = self.steps")
ENDLESS = STOPS.replace("        end =", "        self.stopped = False\n        end =")
ENDLESS = ENDLESS.replace("time.thread_time() < end and not", "not")
LOCKED = ASKS.replace(
    "self.work(self.params.busy)",
    "with self.task.critical():\n                self.work(self.params.busy)",
)
KEEPS = ASKS.replace("    def on(", "    def init(").replace(
    "self.y[0] = self", "self.y[0] = self.cycles + self"
)


COPIES = """
from typing import Annotated as A

from pbonet import InVar, OutVar, PortBasedObject, Vector


class Copies(PortBasedObject):
    u: A[Vector, InVar("U", "2", "none", "what is read")]
    y: A[Vector, OutVar("Y", "2", "none", "the same")]

    def cycle(self, dt: float) -> None:
        self.y[:] = self.u
"""
COPIES_RMOD = """MODULE copies
DESC copies
SVARALIAS U=Y2
SVARALIAS Y=Y3
INCONST none
OUTCONST none
INVAR U
OUTVAR Y
TASKTYPE periodic
FREQ 200
EOF
"""
SAFE = -7.0
"""What tests/misbehaving/overruns.py declares."""


@pytest.fixture
def line(nodes):
    nodes.write_module("asks", ASKS)
    nodes.agent_process("arm0")
    return nodes.master("arm0", "arm")


def run(line, nodes, code=ASKS, *, module="asks", more=(), **local):
    """Record a task that fails in time; return the run."""
    if module == "asks":
        nodes.write_module("asks", code)
    path = record(line)
    lines = rmod(module, "Y2", freq=50.0, local=local).splitlines()
    at = lines.index("FREQ 50") + 1
    text = "\n".join([*lines[:at], "MAXC 0.005", *more, *lines[at:], ""])
    line.spawn("asks", module, text=text)
    line.on("asks")
    if local.get("answer") == "raise":
        wait_for(lambda: line.status("asks").state == "ERROR", "the state ERROR")
    else:
        wait_for(
            lambda: line.status("asks").failures.get("maxexec", 0) >= 3, "failures"
        )
        line.wait_cycles("asks", 6)
        line.off("asks")
    line.kill("asks")
    return finish(line, path)


def verdict_of(log):
    (verdict,) = verify(log, ["asks"])
    assert verdict.divergence is None, str(verdict)
    return verdict


def end_of(verdict):
    """Return what ended the verification, and in which cycle.

    Mostly the first long one; a cycle before it may have missed its deadline.
    """
    (gap,) = verdict.gaps
    cycle, gap = gap.split(": ", 1)
    number = verdict.cycles + 1
    assert cycle == f"cycle {number}"
    return gap, number


@pytest.mark.parametrize("answer", ["continue", "skip", "abort", "lower"])
def test_a_handler_is_told_again_what_it_asked(line, nodes, answer):
    log = run(line, nodes, answer=answer, more=["HANDLER 6"])
    verdict = verdict_of(log)
    assert verdict.good, str(verdict)
    assert verdict.cycles >= 6
    assert rerun(log, ["asks"]).good
    told = log.arrays("asks")["Y2"][:, 1]
    assert answer == "abort" or told.max() > 10.0, "it has asked"


@pytest.mark.parametrize("answer", ["continue", "abort"])
def test_a_handler_of_another_module(line, nodes, answer):
    log = run(line, nodes, module="overruns", answer=answer, every=3, busy=0.01)
    assert verdict_of(log).good, str(verdict_of(log))


def test_safe_values_are_on_record_and_so_is_who_read_them(line, nodes):
    nodes.write_module("copies", COPIES)
    line.spawn("copies", "copies", text=COPIES_RMOD)
    line.on("copies")
    log = run(line, nodes, module="overruns", more=["SAFE maxexec"], busy=0.05, every=2)
    read = log.arrays("copies")["Y3"]
    assert (read == SAFE).all(axis=1).any(), "the other task has read them"
    assert {tuple(row == SAFE) for row in read} <= {(True, True), (False, False)}
    for verdict in verify(log, ["asks", "copies"]):
        assert verdict.good, str(verdict)
        assert verdict.cycles >= 2
    assert rerun(log, ["asks", "copies"]).good


def test_a_task_that_is_killed_while_it_hangs_leaves_word_of_its_safe_values(line):
    """Who has read them is verified up to there."""
    path = record(line)
    text = rmod("overruns", "Y2", freq=50.0, local={"work": "endless", "every": 3})
    text = text.replace("FREQ 50\n", "FREQ 50\nSAFE deadline\n")
    line.spawn("asks", "overruns", text=text)
    line.on("asks")
    wait_for(lambda: line.status("asks").made_safe, "safe values")
    line.kill("asks", limit=1.0)
    log = finish(line, path)
    (told,) = [event for event in log.events() if event["code"] == "LEFT_SAFE"]
    assert told["task"] == "asks"
    assert told["cycle"] == 2
    assert "Y2 got the safe values" in told["text"]
    text = str(diagnosis.answer(path, ("asks",), Place()))
    assert text.startswith("task asks on arm0 is NOT-CREATED"), text
    assert "LEFT_SAFE of arm0/asks" in text


@pytest.mark.parametrize("answer", [0, 3, -1], ids=["ok", "skip", "error"])
def test_a_handler_in_c_is_called_when_the_cycle_has_returned(line, nodes, answer):
    """And the cycle itself sees at once that it must end."""
    put_misbehaving(nodes.library)
    log = run(line, nodes, module="c_overruns", answer=answer, every=3)
    (warned,) = [one for one in line.events("WARNING", "asks") if "early" in one.text]
    assert warned
    assert verdict_of(log).good, str(verdict_of(log))
    assert log.arrays("asks")["Y2"][:, 1].max() >= 2


def test_other_code_of_a_handler_is_found_out(line, nodes):
    log = run(line, nodes, answer="continue")
    nodes.write_module("asks", ASKS.replace("Recovery(self", "Recovery.SKIP or (self"))
    (verdict,) = verify(log, ["asks"])
    assert not verdict.good
    assert "timing_failure answers skip, recorded continue" in str(verdict)
    assert "asks.py has changed" in str(verdict)


def test_a_failure_that_waits_for_the_end_of_a_critical_section(line, nodes):
    log = run(line, nodes, LOCKED, busy=0.012)
    assert verdict_of(log).good, str(verdict_of(log))


def test_a_loop_that_its_handler_ends(line, nodes):
    log = run(line, nodes, ANYTIME)
    assert verdict_of(log).good, str(verdict_of(log))


def test_a_loop_that_nothing_but_its_handler_ends(line, nodes):
    log = run(line, nodes, ENDLESS)
    assert verdict_of(log).good, str(verdict_of(log))


def test_how_often_a_loop_was_run_is_not_verifiable(line, nodes):
    verdict = verdict_of(run(line, nodes, COUNTS, busy=0.1))
    gap, number = end_of(verdict)
    assert number % 4 == 0, "a long one"
    assert re.match(
        r"Y2 differs, but a timing failure \((maxexec|deadline)\) came at ", gap
    )
    assert "asks.py:" in gap
    assert " in work, and how often that line had been run" in gap


def test_what_an_aborted_cycle_left_is_not_verifiable(line, nodes):
    verdict = verdict_of(run(line, nodes, KEEPS, answer="abort"))
    gap, number = end_of(verdict)
    assert gap == (
        f"Y2 differs, but the cycle after cycle {number - 1} was aborted, and what it "
        "had done by then is not recorded"
    )


def test_a_handler_that_raised_ends_what_can_be_verified(line, nodes):
    verdict = verdict_of(run(line, nodes, answer="raise"))
    (gap,) = verdict.gaps
    assert gap == (
        f"timing_failure after cycle {verdict.cycles}: the handler does not like it"
    )
