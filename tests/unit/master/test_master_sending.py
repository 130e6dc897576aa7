"""Lists sent to several RTPUs at once, which answer as a test says."""

from __future__ import annotations

from types import SimpleNamespace

import pytest
from nodekit import rmod

from pbonet.config import parse_rmod
from pbonet.errors import MethodError, ReconfigError, StateError, UnreachableError
from pbonet.master.configuration.subsystem_files import RmodSource
from pbonet.master.configuration.task_model import Member, TaskModel
from pbonet.master.subsystem.send_signal_list import send
from pbonet.pbo import State
from pbonet.xm.net import messages as m

TASKS = {
    "a": ("arm0", "Y0", State.ON, 100.0),
    "b": ("arm1", "Y1", State.ON, 5.0),
    "both": ("arm2", "Y0 Y1", State.OFF, 100.0),
}
ITEMS = [("a", "off"), ("b", "off"), ("both", "on")]
FAILED = MethodError("off does not work", where="b").to_wire()
GONE = UnreachableError("no agent answers", where="arm1")


class Fleet:
    """RTPUs of one host name; each carries out its part, or answers as it is told."""

    def __init__(self, *, came=State.OFF, **answers):
        self.answers = answers
        self.came = came
        """The state of `both` when it is asked for; None: nobody answers."""
        self.machines = {}
        """Boot identities by RTPU, if they differ."""
        self.sent = []
        """(RTPU, request) in the order in which they were sent."""

    def agent(self, rtpu):
        machine = self.machines.get(rtpu, "here")
        return SimpleNamespace(machine=machine, host="robot")

    def call(self, rtpu, request, _result, **_limit):
        self.sent.append((rtpu, request))
        if isinstance(request, m.Successors):
            return {old: [call(old)] for olds in request.after.values() for old in olds}
        if isinstance(request, m.Status):
            if self.came is None:
                raise GONE
            return status(rtpu, request.task, self.came)
        answers = self.answers.get(rtpu, [])
        answer = answers.pop(0) if answers else done(request.items)
        if isinstance(answer, Exception):
            raise answer
        return answer

    def each(self, make, result, *, rtpus, timeout):
        assert timeout > 0
        results, errors = {}, []
        self.sent.append(("at once", list(rtpus)))
        for rtpu in rtpus:
            try:
                results[rtpu] = self.call(rtpu, make(rtpu), result)
            except (StateError, UnreachableError) as error:
                errors.append(error)
        return results, errors


def call(old):
    outputs = ["Y0", "Y1"]
    return m.Call(
        successor="both", outputs=outputs, core=1, slot=9, life=1, ticket=1,
        caller=int(old == "b"),
    )  # fmt: skip


def status(rtpu, task, state):
    counts = ["tid", "crit", "cycle", "miss", "tick", "warn"]
    times = ["ref_f", "mez_f", "mez_t", "ptime", "tot_c", "min_c", "max_c", "last_c"]
    numbers = dict.fromkeys([*counts, *times], 0)
    one = m.TaskStatus(
        rmod="counts", task=task, rtpu=rtpu, S="", state=state, **numbers
    )
    return m.RtpuStatus(rtpu=rtpu, backend="fifo", scheduler="MUF", tasks=[one])


def done(items):
    states = {task: "ON" if signal == "on" else "OFF" for task, signal in items}
    return m.Reconfigured(done=len(items), states=states)


@pytest.fixture
def model():
    made = TaskModel()
    for name, (rtpu, outputs, state, freq) in TASKS.items():
        text = rmod("counts", "Y0").replace("SVARALIAS Y=Y0\n", "")
        text = text.replace("OUTVAR Y", f"OUTVAR {outputs}")
        source = RmodSource(parse_rmod(text, f"{name}.rmod"), text)
        made.add(Member(source=source, rtpu=rtpu, freq=freq, state=state))
    return made


def stuck(model, fleet):
    """Return the error of the list, and what heirs were told last."""
    with pytest.raises(ReconfigError) as caught:
        send(model, fleet, ITEMS, 1.0)
    (rtpu, request), (asked, _) = fleet.sent[-2:]
    assert (rtpu, asked) == ("arm2", "arm2")
    assert request.after == {"both": []}, "it stands by no longer"
    return caught.value


def test_those_that_leave_together_are_told_at_once(model):
    fleet = Fleet()
    states = send(model, fleet, ITEMS, 1.0)
    assert states == {"a": "OFF", "b": "OFF", "both": "ON"}
    heirs, together, (_, first), (_, second), (last, _) = fleet.sent
    assert (heirs[0], heirs[1].after) == ("arm2", {"both": ["a", "b"]})
    assert together == ("at once", ["arm0", "arm1"])
    assert (list(first.calls), list(second.calls)) == (["a"], ["b"])
    assert (first.slowest, second.slowest) == (1 / 5.0, 1 / 100.0)
    assert last == "arm2"


@pytest.mark.parametrize(
    ("machines", "far"), [({}, []), ({"arm0": "another boot"}, ["a"])]
)
def test_machines_are_told_apart_by_their_boot_and_not_by_their_name(
    model, machines, far
):
    """A successor is called by an agent for tasks of another machine only."""
    fleet = Fleet()
    fleet.machines = machines
    send(model, fleet, ITEMS, 1.0)
    assert fleet.sent[0][1].far == far


def test_one_fails(model):
    answer = m.Reconfigured(done=0, rest=[("b", "off")], error=FAILED)
    error = stuck(model, Fleet(arm1=[answer]))
    assert str(error) == (
        "arm1/b: item 2 of 3, off b: off does not work; done: off a; not sent: on both"
    )
    assert error.rest == (("b", "off"), ("both", "on"))


def test_the_first_one_fails_while_the_other_goes(model):
    answer = m.Reconfigured(done=0, rest=[("a", "off")], error=FAILED)
    error = stuck(model, Fleet(arm0=[answer]))
    assert "item 2 of 3, off a" in str(error)
    assert "done: off b; not sent: on both" in str(error)
    assert error.rest == (("a", "off"), ("both", "on"))


def test_one_is_not_heard_of(model):
    error = stuck(model, Fleet(arm1=[GONE]))
    assert "item 2 of 3, off b: no agent answers" in str(error)
    assert (
        "done: off a; sent, and not known whether done: off b; not sent: on both"
    ) in str(error)
    assert error.rest == (("b", "off"), ("both", "on"))


def test_one_refuses(model):
    refused = StateError("another list is being carried out", where="arm1")
    error = stuck(model, Fleet(arm1=[refused]))
    assert "item 2 of 3, off b: another list" in str(error)
    assert "done: off a; not sent: on both" in str(error)


def called(model, came):
    """Return the error of a list in which an item fails after both has been called."""
    text = rmod("counts", "Y2").replace("SVARALIAS Y=Y2\n", "")
    source = RmodSource(parse_rmod(text, "bad.rmod"), text)
    model.add(Member(source=source, rtpu="arm1", freq=100.0, state=State.OFF))
    failed = MethodError("on does not work", where="bad").to_wire()
    answer = m.Reconfigured(done=0, rest=[("bad", "on")], error=failed)
    both = [m.Reconfigured(done=1, states={"b": "OFF"}), answer]
    items = [*ITEMS[:2], ("bad", "on"), ITEMS[2]]
    with pytest.raises(ReconfigError) as caught:
        send(model, Fleet(arm1=both, came=came), items, 1.0)
    assert caught.value.what.startswith("item")
    return caught.value


def test_a_successor_that_was_called_before_an_item_failed_is_done(model):
    error = called(model, State.ON)
    assert str(error) == (
        "arm1/bad: item 4 of 4, on bad: on does not work; done: off a, off b, on both"
    )
    assert (error.done, error.rest) == (3, (("bad", "on"),))
    assert model.find("both").state is State.ON


def test_a_successor_that_was_not_called_in_time_is_not_sent(model):
    error = called(model, State.OFF)
    assert "item 3 of 4, on bad: on does not work; " in str(error)
    assert str(error).endswith("done: off a, off b; not sent: on both")
    assert error.rest == (("bad", "on"), ("both", "on"))


@pytest.mark.parametrize(
    ("came", "remark"),
    [
        (State.ERROR, "was called, and is ERROR now"),
        (None, "may have come on: its RTPU does not say"),
    ],
)
def test_what_became_of_a_successor_is_said(model, came, remark):
    assert str(called(model, came)).endswith(f"not sent: on both ({remark})")


def test_an_item_that_stands_twice_in_a_list_was_done_once(model):
    answer = m.Reconfigured(done=2, rest=[("a", "off")], error=FAILED)
    items = [("a", "off"), ("a", "on"), ("a", "off")]
    with pytest.raises(ReconfigError) as caught:
        send(model, Fleet(arm0=[answer]), items, 1.0)
    assert (caught.value.done, caught.value.rest) == (2, (("a", "off"),))
