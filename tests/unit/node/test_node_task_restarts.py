"""What was lost is given again, also where the first attempt fails."""

from __future__ import annotations

import threading
from types import SimpleNamespace

import pytest
import zenoh

from pbonet.errors import NoAnswerError
from pbonet.node.restart import TaskRestarts, task_restarts
from pbonet.xm.net import messages as m


class State:
    """The subsystem t, with a task that is lost."""

    def __init__(self):
        self.guard, self.stops = threading.Lock(), []
        self.subsystems = {"t": SimpleNamespace(stages={"ctl": "lost"}, claimed=True)}

    def note_lost(self, _text):
        """Do nothing."""

    def ended(self, name):
        self.subsystems.pop(name)


@pytest.mark.parametrize(
    "error", [zenoh.ZError("the session is closed"), NoAnswerError("none", where="d")]
)
def test_others_that_cannot_be_asked_now_are_asked_again(monkeypatch, error):
    """Nothing is given without their word: here that the subsystem was stopped."""
    monkeypatch.setattr(task_restarts, "TURN", 0.001)
    answers = [error, ["arm0", "arm1"]]
    notes, state = [], State()

    def rtpus():
        answer = answers.pop(0)
        if isinstance(answer, Exception):
            raise answer
        return answer

    info = SimpleNamespace(due={"arm0": [("s1", "t")]})
    peers = SimpleNamespace(rtpus=rtpus, call_all=lambda *_: ({"arm1": info}, []))
    restarts = TaskRestarts("arm0", state, peers, None, note=notes.append, mark="x")
    restarts.begin("it was killed", wait=60)
    (run,) = restarts._runs
    run.thread.join(60)
    assert [note.code for note in notes] == ["NOT_SPAWNED"]
    assert not state.subsystems
    restarts.stop()


def test_an_answer_may_come_as_late_as_a_busy_core_lets_it(monkeypatch):
    """The RTPU process waits up to three times the time limit of a signal."""
    state, asked = State(), []
    state.subsystems["t"] = SimpleNamespace(stages={"a": "lost"}, on={"a"}, epoch=1)
    node = SimpleNamespace(submit=lambda *_: None)
    restarts = TaskRestarts("arm0", state, None, node, note=print, mark="x")
    run = task_restarts._Run(restarts, "it was killed")

    def received(_answers, given):
        asked.append(given)
        raise task_restarts._OverError

    monkeypatch.setattr(run, "_receive", received)
    request = m.Control(task="a", signal="on", timeout=5.0)
    with pytest.raises(task_restarts._OverError):
        run._ask("t", request, m.TaskStatus, "a")
    assert asked == [3 * 5.0 + task_restarts.MARGIN]
