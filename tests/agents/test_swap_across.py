"""Tasks that take each other's place across two RTPUs of one machine."""

from __future__ import annotations

import os
import signal
from concurrent.futures import ThreadPoolExecutor
from contextlib import closing, suppress

import pytest
from long_limits import LIMIT
from nodekit import rmod, svar
from watching import causes, states, wait_for

from pbonet.errors import (
    ClaimError,
    PbonetError,
    ProtocolError,
    ReconfigError,
    SeveralError,
    SvarOwnerError,
)
from pbonet.master.subsystem.subsystem import Subsystem
from pbonet.node.ring._ring import Ring
from pbonet.node.rt import _rt
from pbonet.svar import Table
from pbonet.xm.net import messages as m

SBS = "SUBSYSTEM t\nSVARFILE t.svar\nRTPU arm0\nRTPU arm1\nEOF\n"
RATE = 100.0
PERIOD = 1e9 / RATE
NOBODY = "off a is done, and no task took over Y0 (arm0/unfinished)"
NEVER_ON = """
    import time
    from pathlib import Path
    from typing import Annotated as A

    from pbonet import OutVar, Params, PortBasedObject, Vector, param


    class Files(Params):
        begun: A[str, param("none", "written when `on` begins")]


    class Never(PortBasedObject[Files]):
        y: A[Vector, OutVar("Y", "2", "none", "cycles")]

        def on(self) -> None:
            Path(self.params.begun).touch()
            while True:
                time.sleep(0.005)

        def cycle(self, dt: float) -> None:
            self.y[0] += 1.0
"""


SLOW_ON = """
    import time
    from typing import Annotated as A

    from pbonet import OutVar, PortBasedObject, Vector


    class Slow(PortBasedObject):
        y: A[Vector, OutVar("Y", "2", "none", "cycles")]

        def on(self) -> None:
            time.sleep(0.15)

        def cycle(self, dt: float) -> None:
            self.y[0] += 1.0
"""


@pytest.fixture
def arm(nodes, tmp_path):
    """On arm0 `a` (ON) and `c`, on arm1 `b` and `d`; a and b write Y0, c and d Y1."""
    nodes.agent_processes("arm0", "arm1")
    (tmp_path / "t.sbs").write_text(SBS)
    (tmp_path / "t.svar").write_text(svar())
    outputs = {"a": "Y0", "b": "Y0", "c": "Y1", "d": "Y1"}
    for name, out in outputs.items():
        text = rmod("counts", out, RATE, local={"DIARY": tmp_path / f"{name}.txt"})
        (tmp_path / f"{name}.rmod").write_text(text)
    subsystem = Subsystem(
        tmp_path / "t.sbs",
        domain=nodes.domain,
        libraries=nodes.config("arm0").libraries,
        warned=lambda _text: None,
        record="off",  # the rings are read here
    ).open()
    for name, rtpu in (("a", "arm0"), ("c", "arm0"), ("b", "arm1"), ("d", "arm1")):
        subsystem.spawn(name, rtpu)
    subsystem.control("a", "on")
    yield subsystem
    subsystem.finish()


def stand_by(arm, heir, *olds, limit=LIMIT):
    """Have a task of arm1 stand by for some of arm0; return whom these have to call."""
    request = m.Successors(after={heir: list(olds)}, timeout=limit)
    return arm.clients.call("arm1", request, dict[str, list[m.Call]])


def turn_off(arm, old, calls):
    """Turn a task of arm0 off that has an heir; nobody tells arm1."""
    handover = {old: [f"Y{'ac'.index(old)}"]}
    request = m.Reconfig(items=[(old, "off")], handover=handover, calls=calls)
    return arm.clients.call("arm0", request, m.Reconfigured)


def test_the_new_one_begins_on_the_grid_behind_the_old_one(arm):
    rings = {one.task: Ring.attach(one.ring) for one in arm.status_all()}

    def cycles(task):
        """Return what has come since the last time; what came last is kept."""
        found = [record for record in rings[task].drain() if not record.kind]
        if found:
            latest[task] = found[-1]
        return found

    gaps, latest = [], {}
    old, new = "a", "b"
    try:
        for _ in range(8):
            wait_for(lambda old=old: cycles(old), f"a cycle of {old}")
            arm.swap(old, new)
            first = wait_for(lambda new=new: cycles(new), f"cycles of {new}")[0]
            cycles(old)
            gaps.append((first.release_ns - latest[old].release_ns) / PERIOD)
            old, new = new, old
    finally:
        for ring in rings.values():
            ring.close()
    assert all(gap == round(gap) >= 1 for gap in gaps), gaps


def test_no_master_is_needed_between_off_and_on(arm, nodes):
    """The second RTPU is sent nothing, and its agent does not even live."""
    calls = stand_by(arm, "b", "a")
    agent = nodes.processes.pop("arm1")
    agent.send_signal(signal.SIGKILL)
    agent.wait()
    with Table.attach(f"{nodes.domain}.t") as table:
        before = table.generation
        assert turn_off(arm, "a", calls).done == 1
        assert table.info("Y0").owner == "b"
        assert table.generation == before + 1  # one event, not a loss and a gain
    nodes.agent_process("arm1")
    wait_for(lambda: states(arm)["b"] == "ON", "what the restarted agent says")
    assert states(arm) == {"a": "OFF", "b": "ON", "c": "OFF", "d": "OFF"}
    assert causes(arm) == []
    assert arm.swap("a", "b").items == [], "nothing is left"


def test_the_old_one_is_told_that_somebody_takes_over(arm, tmp_path):
    arm.swap("a", "b")
    assert (tmp_path / "a.txt").read_text().splitlines()[-1].endswith("off True")
    said = [(e.code, e.text) for e in arm.events() if e.task == "b"]
    assert ("ENGAGED", "in place of a") in said


def test_pairs_in_both_directions(arm):
    arm.swap("a", "b")
    arm.control("c", "on")
    done = arm.swap(["b", "c"], ["a", "d"])
    assert done.states == {"a": "ON", "b": "OFF", "c": "OFF", "d": "ON"}
    assert {value.writer for value in arm.display(["Y0", "Y1"])} == {"a", "d"}
    wait_for(lambda: not causes(arm), "a legal configuration")


def test_two_that_leave_for_one(arm):
    arm.control("c", "on")
    calls = stand_by(arm, "b", "a")
    again = stand_by(arm, "b", "a", "c")
    assert set(again) == {"a", "c"}
    assert calls["a"][0].ticket != again["a"][0].ticket
    assert turn_off(arm, "c", again).done == 1
    assert states(arm)["b"] == "OFF", "it waits for a, too"
    assert turn_off(arm, "a", again).done == 1
    wait_for(lambda: states(arm)["b"] == "ON", "that it says that it is ON")


def test_an_heir_that_is_killed_between_two_calls(arm):
    """Who has ended counts on it: the flag is up from its death on."""
    arm.control("c", "on")
    calls = stand_by(arm, "b", "c", "a")
    assert turn_off(arm, "c", calls).done == 1
    os.kill(arm.status("b").tid, signal.SIGKILL)
    died = "b has died (arm1/b)"
    wait_for(lambda: "TASK_DIED" in {event.code for event in arm.events()}, "its end")
    refused = turn_off(arm, "a", calls).error
    assert refused["what"] == "b cannot take over: it is no longer a standby"
    told = [(event.code, event.text) for event in arm.events() if died in event.text]
    assert told[0] == ("ILLEGAL", died)
    wait_for(lambda: died not in causes(arm), "that a is seen to write all of it")
    arm.control("c", "on")
    wait_for(lambda: not causes(arm), "a legal configuration")


def test_a_call_that_nobody_waits_for_any_more_engages_nobody(arm):
    calls = stand_by(arm, "b", "a")
    arm.clients.call("arm1", m.Successors(after={"b": []}), dict[str, list[m.Call]])
    stand_by(arm, "b", "a")
    answer = turn_off(arm, "a", calls)
    assert answer.error["what"] == "b cannot take over: it is no longer a standby"
    assert (answer.done, answer.rest) == (0, [("a", "off")])
    assert states(arm) == {"a": "ON", "b": "OFF", "c": "OFF", "d": "OFF"}


def test_an_heir_stands_by_for_a_limited_time(arm):
    """As when the master is killed before it has sent the first signal."""

    def waits():
        """In a standstill it is not ready within that time, and does not wait."""
        with suppress(PbonetError):
            return stand_by(arm, "b", "a", limit=2.0)

    calls = wait_for(waits, "an heir that stands by")

    (one,) = calls["a"]
    with closing(_rt.CoreTable(one.core, member=False)) as core:
        slot = one.slot, one.life, one.ticket, one.caller
        wait_for(lambda: not core.expects(*slot), "the end of standing by")
    refused = turn_off(arm, "a", calls).error
    assert refused["what"] == "b cannot take over: it is no longer a standby"
    assert arm.control("b", "reinit").state == "OFF"
    assert arm.swap("a", "b").states == {"a": "OFF", "b": "ON"}


def test_on_that_raises_frees_the_place(arm, tmp_path, nodes):
    (tmp_path / "bad.rmod").write_text(rmod("raises_in_on", "Y0", RATE))
    arm.spawn("bad", "arm1")
    with pytest.raises(ReconfigError, match="item 2 of 2, on bad") as caught:
        arm.swap("a", "bad")
    assert "done: off a" in str(caught.value)
    assert states(arm)["bad"] == "ERROR"
    said = [event for event in arm.events() if "bad is in ERROR" in event.text]
    assert {event.code for event in said} == {"ILLEGAL"}, "it was up all the time"
    (failed,) = [event for event in arm.events() if event.code == "SIGNAL_FAILED"]
    assert (failed.task, failed.errnum) == ("bad", 1)
    with Table.attach(f"{nodes.domain}.t") as table:
        assert table.info("Y0").owner is None  # and not a, which ceded it
    assert any("no task took over Y0" in cause for cause in causes(arm))
    assert arm.reconfig([("b", "on")]) == {"b": "ON"}
    wait_for(lambda: not causes(arm), "a legal configuration")


def test_an_heir_that_is_killed_within_on(arm, nodes, tmp_path):
    """The flag goes up with its death, and does not go down before somebody writes."""
    begun = tmp_path / "begun"
    nodes.write_module("never_on", NEVER_ON)
    text = rmod("never_on", "Y0", RATE, local={"BEGUN": begun})
    for heir, rtpu in {"beside": "arm0", "elsewhere": "arm1"}.items():
        (tmp_path / f"{heir}.rmod").write_text(text)
        arm.spawn(heir, rtpu)
        with ThreadPoolExecutor(1) as pool:
            swap = pool.submit(arm.swap, "a", heir)
            wait_for(begun.exists, "the beginning of on")
            os.kill(arm.status(heir).tid, signal.SIGKILL)
            error = swap.exception(60.0)
        assert isinstance(error, ReconfigError), error
        with Table.attach(f"{nodes.domain}.t") as table:
            wait_for(lambda t=table: t.info("Y0").owner is None, "that nobody owns Y0")
        died = f"{heir} has died ({rtpu}/{heir})"
        wait_for(
            lambda both={died, NOBODY}: both <= set(causes(arm)), "the flag's causes"
        )
        legal = [event.text for event in arm.events() if event.code == "LEGAL"]
        assert f"no longer: {died}" not in legal, "it was up all the time"
        (tmp_path / f"{heir}.rmod").write_text(rmod("counts", "Y0", RATE))
        done = arm.swap("a", heir, rtpu=rtpu)  # what is left, with a task spawned anew
        assert (done.items, done.states) == ([(heir, "on")], {heir: "ON"})
        assert arm.swap(heir, "a").states == {heir: "OFF", "a": "ON"}
        wait_for(lambda: not causes(arm), "a legal configuration")
        begun.unlink()


def test_off_that_raises_engages_nobody(arm, tmp_path):
    (tmp_path / "bad.rmod").write_text(rmod("raises_in_off", "Y1", RATE))
    arm.spawn("bad", "arm0")
    arm.control("bad", "on")
    with pytest.raises(ReconfigError, match="item 1 of 2, off bad") as caught:
        arm.swap("bad", "d")
    assert caught.value.rest == (("bad", "off"), ("d", "on"))
    assert (states(arm)["bad"], states(arm)["d"]) == ("ERROR", "OFF")
    assert arm.swap("bad", "d").items == [("d", "on")], "what is left"


def test_an_heir_that_could_not_take_over_is_told_before_anything_is_done(arm):
    with pytest.raises(SvarOwnerError, match="Y0"):
        stand_by(arm, "b", "c")  # Y0 is a's
    with pytest.raises(ProtocolError, match="time limit"):
        stand_by(arm, "d", "c", limit=-1.0)
    assert states(arm) == {"a": "ON", "b": "OFF", "c": "OFF", "d": "OFF"}
    assert arm.swap("a", "b").states == {"a": "OFF", "b": "ON"}


def test_the_heir_is_called_before_garbage_is_collected(arm, tmp_path):
    begun, go_on = tmp_path / "begun", tmp_path / "go_on"
    text = rmod("waits_in_collection", "Y1", local={"BEGUN": begun, "GO_ON": go_on})
    (tmp_path / "old.rmod").write_text(text)
    arm.spawn("old", "arm0")
    arm.control("old", "on")
    with ThreadPoolExecutor(1) as pool:
        swap = pool.submit(arm.swap, "old", "d")
        try:
            wait_for(begun.exists, "the collection behind off")
            wait_for(lambda: states(arm)["d"] == "ON", "that the heir comes on")
        finally:
            go_on.touch()
        assert swap.result(60.0).states == {"d": "ON", "old": "OFF"}


@pytest.fixture
def gate(tmp_path, arm):
    """`old` on arm0 waits in `off` for a file; return what says that, and that file."""
    begun, go_on = tmp_path / "begun", tmp_path / "go_on"
    files = {"BEGUN": begun, "GO_ON": go_on}
    (tmp_path / "old.rmod").write_text(rmod("waits_in_off", "Y1", local=files))
    arm.spawn("old", "arm0")
    arm.control("old", "on")
    return begun, go_on


def is_opened(arm):
    """Open the subsystem anew unless its last master is still to be seen."""
    with suppress(ClaimError, SeveralError):  # at one RTPU, or at both
        return arm.open()


def releases(ring):
    """Return when the cycles were due that a task has put on record, not read yet."""
    with closing(Ring.attach(ring)) as records:
        return [one.release_ns for one in records.drain() if not one.kind]


@pytest.mark.parametrize("killed", ["arm0", "arm1"])
def test_an_agent_is_killed_amid_the_exchange(arm, gate, nodes, killed):
    """The RTPUs go on by themselves; a new master finds what has become of it."""
    begun, go_on = gate
    tids = {status.task: status.tid for status in arm.status_all()}
    rings = {one.task: one.ring for one in arm.status_all()}
    with ThreadPoolExecutor(1) as pool:
        swap = pool.submit(arm.swap, "old", "d")
        wait_for(begun.exists, "the beginning of off")
        agent = nodes.processes.pop(killed)
        agent.send_signal(signal.SIGKILL)
        agent.wait()
        go_on.touch()
        error = swap.exception(60.0)
    assert isinstance(error, ReconfigError), error
    what, rest = {
        "arm0": ("done: on d; sent, and not known whether done: off old", "off old"),
        "arm1": ("done: off old; sent, and not known whether done: on d", "on d"),
    }[killed]
    assert what in str(error)
    assert [f"{verb} {task}" for task, verb in error.rest] == [rest]
    nodes.agent_process(killed)
    arm.detach()
    wait_for(lambda: is_opened(arm), "the end of the old master's token")
    end = {"a": "ON", "b": "OFF", "c": "OFF", "d": "ON", "old": "OFF"}
    wait_for(lambda: states(arm) == end, "that it came on by itself")
    assert {status.task: status.tid for status in arm.status_all()} == tids
    assert arm.display(["Y1"])[0].writer == "d"
    first = wait_for(lambda: releases(rings["d"]), "a cycle of d")[0]
    assert releases(rings["old"])[-1] < first, "the two wrote one after the other"
    assert arm.swap("old", "d").items == [], "nothing is left to be done"
    assert arm.swap("d", "old").items == [("d", "off"), ("old", "on")]
    wait_for(lambda: not causes(arm), "a legal configuration")


def test_what_came_on_before_an_item_failed_is_said_to_be_done(arm, tmp_path):
    """The dispatcher engages a successor as soon as its predecessor has ended."""
    (tmp_path / "bad.rmod").write_text(rmod("raises_in_on", "Y1", RATE))
    arm.spawn("bad", "arm0")
    with pytest.raises(ReconfigError, match="item 3 of 3, on bad") as caught:
        arm.reconfig([("a", "off"), ("bad", "on"), ("b", "on")])
    assert str(caught.value).endswith("done: off a, on b")
    assert caught.value.rest == (("bad", "on"),)
    assert (states(arm)["b"], arm.display(["Y0"])[0].writer) == ("ON", "b")


def test_the_flag_goes_down_as_soon_as_the_successor_writes(arm, nodes, tmp_path):
    """A swap that takes long makes others stable no longer across RTPUs than on one."""
    nodes.write_module("slow_on", SLOW_ON)
    for name, rtpu in (("beside", "arm0"), ("elsewhere", "arm1")):
        (tmp_path / f"{name}.rmod").write_text(rmod("slow_on", "Y0", RATE))
        arm.spawn(name, rtpu)
    text = rmod("holds", "Y1", RATE, invar="Y0", critical=True, local={"LEVEL": 3})
    (tmp_path / "hold.rmod").write_text(text)
    arm.spawn("hold", "arm1")
    arm.control("hold", "on")
    rings = {one.task: Ring.attach(one.ring) for one in arm.status_all()}

    def needless(successor):
        """Return how many cycles were stable though the successor wrote."""
        for ring in rings.values():
            ring.drain()
        arm.swap("a", successor)
        (first, *_) = wait_for(
            lambda: [one for one in rings[successor].drain() if not one.kind],
            "a cycle of the successor",
        )
        count = 0

        def is_over():
            nonlocal count
            cycles = [one for one in rings["hold"].drain() if not one.kind]
            mine = [one for one in cycles if one.release_ns > first.release_ns]
            count += sum(one.stable for one in mine)
            return mine and not mine[-1].stable and not causes(arm)

        wait_for(is_over, "cycles that are not stable")
        arm.swap(successor, "a")
        wait_for(lambda: not causes(arm), "a legal configuration")
        return count

    try:
        found = [(needless("beside"), needless("elsewhere")) for _ in range(4)]
    finally:
        for ring in rings.values():
            ring.close()
    beside, elsewhere = (sum(some) for some in zip(*found, strict=True))
    assert elsewhere <= beside + 3 * len(found), found
