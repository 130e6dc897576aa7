"""Signals that a module sends to other tasks itself (Stewart 1994, section 8.2.1)."""

from __future__ import annotations

import pytest
from msgspec import structs

from pbonet.errors import StateError
from pbonet.master import Subsystem
from pbonet.pbo import State, TaskContext

MODULE = '''"""Breaks, and turns others off."""

from typing import Annotated as A

from pbonet import Answer, OutVar, Params, PortBasedObject, param


class When(Params):
    """When it fails."""

    fails: A[int, param("1", "cycle in which it fails", ge=0)] = 0
    off: A[str, param("none", "tasks that it turns off then")] = ""
    again: A[int, param("1", "b is turned on again", ge=0)] = 0


class Breaks(PortBasedObject[When]):
    """Count."""

    y: A[float, OutVar("Y", "1", "none", "count")]

    def on(self) -> None:
        self.y = 0.0

    def cycle(self, dt: float) -> None:
        self.y += 1.0
        if self.y == self.params.fails:
            raise ValueError("it breaks")

    def error(self, error: Exception) -> Answer:
        for task in self.params.off.split("+"):
            self.task.control(task, "off")
            if task == "b" and self.params.again:
                self.task.control(task, "off")
                self.task.control(task, "on")
        return Answer.ERROR
'''
RMOD = (
    "MODULE breaks\nDESC d\nSVARALIAS Y={y}\nINCONST none\nOUTCONST none\nINVAR none\n"
    "OUTVAR Y\nTASKTYPE periodic\nFREQ 100\nLOCAL\n{local}\nEOF\n"
)
SVAR = "NAME {}\nTYPE double\nDESC d\nUNITS none\nNELEM 1\n\n"


@pytest.fixture
def again():
    """Return what is added to the parameters of `a`."""
    return ""


@pytest.fixture
def subsystem(tmp_path, again):
    """Three tasks; `a` fails and turns `b`, on its RTPU, and `c`, on another, off.

    It tries the same with `d`, which does not exist.
    """
    (tmp_path / "breaks.py").write_text(MODULE)
    (tmp_path / "x.svar").write_text("".join(map(SVAR.format, "ABC")) + "EOF\n")
    (tmp_path / "x.sbs").write_text(
        "SUBSYSTEM x\nSVARFILE x.svar\nRTPU r\nRTPU s\nEOF\n"
    )
    (tmp_path / "x.job").write_text(
        "JOB x\nDESC\nSBS x.sbs\nTASK a\nTASK b\nTASK c s\nEOF\n"
    )
    for name in "abc":
        local = f"FAILS 5\nOFF b+c+d{again}" if name == "a" else ""
        text = RMOD.format(y=name.upper(), local=local)
        (tmp_path / f"{name}.rmod").write_text(text)
    with Subsystem(tmp_path / "x.job", libraries=[tmp_path], virtual=True) as opened:
        opened.start()
        yield opened


def test_a_handler_of_errors_turns_another_task_off_without_the_master(subsystem):
    assert {one.state for one in subsystem.status_all()} == {"ON"}
    subsystem.wait(0.2)
    states = {one.task: one.state for one in subsystem.status_all()}
    assert states == {"a": "ERROR", "b": "OFF", "c": "OFF"}
    events = [one for one in subsystem.events() if one.code == "SIGNAL_FAILED"]
    assert [(one.task, one.text.partition(":")[0]) for one in events] == [
        ("a", "off to d was refused")
    ]
    assert "no RTPU of this machine has task d" in events[0].text
    assert "asked: r, s" in events[0].text


def test_a_task_that_has_died_is_looked_for_on_the_other_rtpus(subsystem):
    """`c` died on `r`, and is on `s` now; `d` died on `r`, and is nowhere."""
    here, there = (subsystem.simulation.rtpus[name] for name in "rs")
    for name in "cd":
        here.tombs["x", name] = structs.replace(subsystem.status("c"), task=name)
    subsystem.wait(0.2)
    assert there.tasks["x", "c"].state is State.OFF
    failed = [one.text for one in subsystem.events() if one.code == "SIGNAL_FAILED"]
    assert len(failed) == 1
    assert "x has no task d here (got it has died: " in failed[0]


@pytest.mark.parametrize("again", ["\nAGAIN 1"])
def test_signals_to_one_task_are_carried_out_one_after_the_other(subsystem):
    """The state that the second needs is there when the first is done."""
    subsystem.wait(0.2)
    assert {one.task: one.state for one in subsystem.status_all()}["b"] == "ON"
    texts = [one.text for one in subsystem.events() if one.code == "SIGNAL_FAILED"]
    assert [text.partition(":")[0] for text in texts] == ["off to d was refused"]
    states = [e.text for e in subsystem.events() if (e.task, e.code) == ("b", "STATE")]
    assert states[-2:] == ["turned off", "turned on"]


@pytest.mark.parametrize(("task", "signal"), [("b", "swap"), ("a", "off")])
def test_what_cannot_be_sent_is_refused_at_once(task, signal):
    context = TaskContext("a")
    context.state = State.ON
    with pytest.raises(StateError, match="task a cannot send"):
        context.control(task, signal)
    assert context.outbox.drain() == []
