"""Tasks that take over from tasks of several RTPUs of one machine at once."""

from __future__ import annotations

import pytest
from nodekit import rmod, svar
from watching import causes, states, wait_for

from pbonet.errors import MethodError, ReconfigError
from pbonet.master.subsystem.subsystem import Subsystem
from pbonet.node.ring._ring import Ring
from pbonet.svar import Table

SBS = "SUBSYSTEM t\nSVARFILE t.svar\nRTPU arm0\nRTPU arm1\nRTPU arm2\nEOF\n"
RATE = 100.0
PERIOD = 1e9 / RATE
SLOW = 4.0
"""Hz of a task whose last cycle is further away than a message takes."""
PAIR = """
    from typing import Annotated as A

    from pbonet import OutVar, PortBasedObject, Vector


    class Pair(PortBasedObject):
        '''Writes two variables.'''

        a: A[Vector, OutVar("A", "2", "none", "cycles")]
        b: A[Vector, OutVar("B", "2", "none", "cycles")]

        def cycle(self, dt: float) -> None:
            self.a[0] += 1.0
            self.b[0] += 1.0
"""
PAIR_RMOD = f"""\
MODULE pair
DESC writes two
SVARALIAS A=Y0
SVARALIAS B=Y1
INCONST none
OUTCONST none
INVAR none
OUTVAR A B
TASKTYPE periodic
FREQ {RATE:g}
EOF
"""


@pytest.fixture
def arm(nodes, tmp_path):
    """On arm0 `a` (Y0), on arm1 `b` (Y1), both ON; `pair`, who writes both, is none."""
    nodes.agent_processes("arm0", "arm1", "arm2")
    nodes.write_module("pair", PAIR)
    (tmp_path / "t.sbs").write_text(SBS)
    (tmp_path / "t.svar").write_text(svar())
    (tmp_path / "a.rmod").write_text(rmod("counts", "Y0", RATE))
    (tmp_path / "b.rmod").write_text(rmod("counts", "Y1", RATE))
    (tmp_path / "pair.rmod").write_text(PAIR_RMOD)
    subsystem = Subsystem(
        tmp_path / "t.sbs",
        domain=nodes.domain,
        libraries=nodes.config("arm0").libraries,
        warned=lambda _text: None,
        record="off",  # the rings are read here
    ).open()
    for name, rtpu in (("a", "arm0"), ("b", "arm1")):
        subsystem.spawn(name, rtpu)
        subsystem.control(name, "on")
    yield subsystem
    subsystem.finish()


def engaged(arm):
    """Return what tasks said that came on by themselves."""
    return [(e.task, e.text) for e in arm.events() if e.code == "ENGAGED"]


def raised(arm):
    """Return what was said of the flag, whether it stands or not."""
    return [e.text for e in arm.events() if e.code == "ILLEGAL"]


class Watched:
    """What the tasks' rings say of an exchange."""

    def __init__(self, arm):
        self._rings = {one.task: Ring.attach(one.ring) for one in arm.status_all()}
        self._cycles = {task: [] for task in self._rings}

    def __enter__(self):
        return self

    def __exit__(self, *_):
        for ring in self._rings.values():
            ring.close()

    def cycles(self, task):
        """Return the cycles of a task until now."""
        found = self._rings[task].drain()
        self._cycles[task] += [one for one in found if not one.kind]
        return self._cycles[task]

    def gap(self, olds, news):
        """Return the periods from the last release of the old ones to the others'."""
        for task in news:
            wait_for(lambda task=task: self.cycles(task), f"cycles of {task}")
        last = max(self.cycles(old)[-1].release_ns for old in olds)
        return (max(self.cycles(new)[0].release_ns for new in news) - last) / PERIOD

    def stalled(self, olds, news):
        """Tell whether the machine stood still in it: releases have no cycle.

        Then the exchange did take longer than a cycle, and the flag says so rightly.
        """
        beside = [c for old in olds for c in self.cycles(old)[-5:]]
        return self.gap(olds, news) > 1 or any(c.dt_ns > PERIOD for c in beside)


@pytest.mark.parametrize("rtpu", ["arm1", "arm2"])
def test_one_takes_over_from_two_rtpus(arm, nodes, rtpu):
    """One of which may be its own; nobody is without a writer at any instant."""
    arm.spawn("pair", rtpu)
    with Watched(arm) as watched, Table.attach(f"{nodes.domain}.t") as table:
        wait_for(lambda: watched.cycles("a") and watched.cycles("b"), "cycles of both")
        before = table.generation
        done = arm.swap(["a", "b"], "pair")
        assert done.items == [("b", "off"), ("a", "off"), ("pair", "on")]
        assert done.states == {"a": "OFF", "b": "OFF", "pair": "ON"}
        assert {table.info(name).owner for name in ("Y0", "Y1")} == {"pair"}
        assert table.generation == before + 1
        gap = watched.gap(["a", "b"], ["pair"])
        stalled = watched.stalled(["a", "b"], ["pair"])
    assert gap == round(gap) >= 1
    assert ("pair", "in place of b and a") in engaged(arm)
    assert stalled or raised(arm) == []
    assert arm.swap("pair", ["a", "b"]).states == {"a": "ON", "b": "ON", "pair": "OFF"}
    wait_for(lambda: not causes(arm), "a legal configuration")


def test_a_slow_task_elsewhere_is_waited_for(arm):
    """Its last cycle is a quarter of a second away; until then nothing is illegal."""
    arm.freq("b", SLOW)
    arm.spawn("pair", "arm2")
    for _ in range(3):  # at whatever phase
        arm.swap(["a", "b"], "pair")
        arm.swap("pair", ["a", "b"])
    assert states(arm) == {"a": "ON", "b": "ON", "pair": "OFF"}
    assert [text for text in raised(arm) if "no task took over" in text] == []


@pytest.mark.parametrize("rtpu", ["arm1", "arm2"])
def test_an_heir_may_write_less(arm, rtpu):
    """Nobody reads what it does not write, so that nobody has to take it over."""
    arm.control("b", "off")
    arm.spawn("pair", rtpu)
    arm.swap("a", "pair")
    arm.swap("pair", "a" if rtpu == "arm2" else "b")
    first = arm.status_all()
    wait_for(
        lambda: any(
            now.state == "ON" and now.cycle > before.cycle + 0.5 * RATE
            for before, now in zip(first, arm.status_all(), strict=True)
        ),
        "cycles of half a second",
    )
    assert [text for text in raised(arm) if "no task took over" in text] == []


def test_one_of_two_that_leave_fails(arm, nodes, tmp_path):
    (tmp_path / "bad.rmod").write_text(rmod("raises_in_off", "Y1", RATE))
    arm.control("b", "off")
    arm.spawn("bad", "arm1")
    arm.control("bad", "on")
    arm.spawn("pair", "arm2")
    with pytest.raises(ReconfigError, match="item 2 of 3, off bad") as caught:
        arm.swap(["a", "bad"], "pair")
    assert isinstance(caught.value.__cause__, MethodError)
    assert "done: off a; not sent: on pair" in str(caught.value)
    assert caught.value.rest == (("bad", "off"), ("pair", "on"))
    assert states(arm) == {"a": "OFF", "b": "OFF", "bad": "ERROR", "pair": "OFF"}
    with Table.attach(f"{nodes.domain}.t") as table:
        assert table.info("Y0").owner is None  # and not a, which ceded it
    assert any("off a is done, and no task took over Y0" in one for one in causes(arm))
    assert arm.swap(["a", "bad"], "pair").items == [("pair", "on")], "what is left"
    wait_for(lambda: not causes(arm), "a legal configuration")


def test_two_on_two_rtpus_take_over_from_one(arm):
    """One of them is beside the one that leaves."""
    arm.spawn("pair", "arm0")
    arm.swap(["a", "b"], "pair")
    before = raised(arm)
    with Watched(arm) as watched:
        wait_for(lambda: watched.cycles("pair"), "cycles of the pair")
        for task in ("a", "b"):
            watched.cycles(task).clear()
        done = arm.swap("pair", ["a", "b"])
        stalled = watched.stalled(["pair"], ["a", "b"])
    assert done.items == [("pair", "off"), ("a", "on"), ("b", "on")]
    assert done.states == {"a": "ON", "b": "ON", "pair": "OFF"}
    both = {("a", "in place of pair"), ("b", "in place of pair")}
    assert both <= set(engaged(arm))
    assert stalled or raised(arm) == before
