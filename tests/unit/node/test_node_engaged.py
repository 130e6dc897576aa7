"""From whom a task that stands by takes over, and from whom not any more."""

from __future__ import annotations

import contextlib
import os
from types import SimpleNamespace

import pytest

from pbonet.config.model import Variable
from pbonet.errors import SvarOwnerError
from pbonet.node.task.task_process import Host
from pbonet.node.wire import rtpu_messages
from pbonet.pbo import State
from pbonet.svar import Table

ME = os.getpid()


class Standing(Host):
    """A task's process without one: OFF, and its `on` does what a test says."""

    def __init__(self, local):
        self.local = local
        self.spec = SimpleNamespace(task="new")
        self.slot = SimpleNamespace(after=1, arm=lambda: None)
        self.time = SimpleNamespace(turned_on=lambda: None)
        self.journal = SimpleNamespace(doing=self._doing)
        self.executor = SimpleNamespace(state=State.OFF, signal=self._come_on)
        self.to_rtpu = SimpleNamespace(send=lambda _: None, notice=self._failed)
        self.core = SimpleNamespace()
        self.predecessors = []
        self.meanwhile = lambda: None
        self.error = None

    def prepare(self, *after, **more):
        self._prepare(rtpu_messages.Prepare(1, list(after), **more))

    def engage(self, meanwhile=lambda: None):
        self.meanwhile = meanwhile
        self._engage()

    def _doing(self, did):
        self.logged = did
        return contextlib.nullcontext()

    def _come_on(self, _signal, *, handover):
        self.handover = handover
        self.local.check_claim()
        self.meanwhile()
        try:
            self.local.claim()
        except SvarOwnerError:
            self.executor.state = State.ERROR
            raise
        self.executor.state = State.ON

    def _after_signal(self, *, cede=False): ...

    def _failed(self, *_, error, **_more):
        self.error = error


@pytest.fixture
def table(tmp_path, monkeypatch):
    monkeypatch.setenv("PBONET_SHM_DIR", str(tmp_path))
    with Table.create("arm", [Variable(name="Y0", type="double")]) as made:
        yield made


@pytest.fixture
def old(table):
    """A task that is ON."""
    local = table.local("old", ME, outvar=["Y0"])
    local.claim()
    return local


@pytest.fixture
def far_old(table):
    """What stands here for a task of another machine that is ON."""
    local = table.local("old@host-a", ME, outvar=["Y0"])
    local.claim()
    return local


@pytest.fixture
def new(table):
    return Standing(table.local("new", ME, outvar=["Y0"]))


def writer(table):
    return table.info("Y0").owner


def test_an_heir_takes_over_from_who_has_ended(table, old, new):
    new.prepare("old")
    old.cede()
    new.engage()
    assert (new.executor.state, writer(table)) == (State.ON, "new")
    assert new.handover, "its `on` goes on from what stands there"
    assert new.logged.handover, "a replay begins alike"


def test_an_heir_whose_on_is_slow_takes_nothing_from_who_came_back(table, old, new):
    """It is turned on again by a second order, on another RTPU."""
    new.prepare("old")
    old.cede()
    new.engage(old.claim)
    assert (new.executor.state, writer(table)) == (State.ERROR, "old")
    assert "new cannot write Y0: another task does" in str(new.error)


def test_a_fallback_whose_on_is_slow_takes_nothing_from_the_one_before(table, old, new):
    """On another RTPU; its original had come in the place of that one, and failed."""
    failed = table.local("original", ME, outvar=["Y0"])
    new.prepare("original", owners=["old"])
    old.cede()
    failed.take_over_from(["old"])
    failed.claim()
    failed.release()  # it is in ERROR
    new.engage(old.claim)
    assert (new.executor.state, writer(table)) == (State.ERROR, "old")


def test_a_fallback_takes_over_from_its_original(table, old, new):
    failed = table.local("original", ME, outvar=["Y0"])
    new.prepare("original", owners=["old"])
    old.cede()
    failed.take_over_from(["old"])
    failed.claim()
    new.engage()
    assert (new.executor.state, writer(table)) == (State.ON, "new")


def test_a_far_heir_takes_over_what_nobody_owns(table, far_old, new):
    new.prepare("old", owners=["old@host-a"], far=["old"])
    far_old.release()
    new.engage()
    assert (new.executor.state, writer(table)) == (State.ON, "new")


def test_a_far_heir_whose_on_is_slow_takes_nothing_from_who_came_back(
    table, far_old, new
):
    new.prepare("old", owners=["old@host-a"], far=["old"])
    far_old.release()
    new.engage(far_old.claim)
    assert (new.executor.state, writer(table)) == (State.ERROR, "old@host-a")


@pytest.mark.usefixtures("far_old")
def test_a_far_heir_does_not_come_on_where_somebody_came_back_before_it_ran(table, new):
    new.prepare("old", owners=["old@host-a"], far=["old"])
    new.engage()
    assert (new.executor.state, writer(table)) == (State.OFF, "old@host-a")
    assert "owner old@host-a" in str(new.error)


def test_who_cannot_take_over_does_not_stand_by(far_old, new):
    with pytest.raises(SvarOwnerError, match="owner old@host-a"):
        new.prepare("old", far=["old"])
    assert new.predecessors == []
    far_old.release()
    new.prepare("old", far=["old"])
    assert new.predecessors == ["old"]
