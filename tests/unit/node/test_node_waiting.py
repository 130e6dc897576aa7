"""Cycles that wait are told from cycles that compute or that others delay."""

from types import SimpleNamespace as Plain

import pytest

from pbonet.analysis.schedule import Kind, Mode
from pbonet.node.rtpu import waiting_cycles
from pbonet.node.rtpu.waiting_cycles import WaitingCycles
from pbonet.node.wire.event_log import EventLog

MS = 1_000_000


class Rig:
    """One task of 100 Hz; each `after` is a check after half a second."""

    def __init__(self, monkeypatch):
        self.events = EventLog("arm0")
        self.checks = WaitingCycles(self.events)
        facts = Plain(subsystem="arm", rmod=Plain(module="sleepy"))
        self.task = Plain(name="pid", facts=facts, waits="")
        self.slot = Plain(
            pid=7, kind=Kind.PERIODIC, mode=Mode.ON, period_ns=10 * MS, cycles=0,
            on_cycles=0, failed=0, missed=0, wall_total_ns=0, cpu_total_ns=0, held_ns=0,
        )  # fmt: skip
        self.ready = 0
        monkeypatch.setattr(waiting_cycles, "ready_ns", lambda _: self.ready)
        self.check()

    def check(self):
        self.checks.check([(self.task, self.slot)])

    def after(self, cycles, wall, cpu, *, ready=0, held=0, missed=0):
        """Let cycles pass with these milliseconds each."""
        self.slot.cycles += cycles
        self.slot.missed += missed
        self.slot.wall_total_ns += cycles * wall * MS
        self.slot.cpu_total_ns += cycles * cpu * MS
        self.slot.held_ns += cycles * held * MS
        self.ready += cycles * ready * MS
        self.check()

    @property
    def told(self):
        return [event.text for event in self.events.since(0) if event.code == "WAITS"]


@pytest.fixture
def rig(monkeypatch):
    return Rig(monkeypatch)


def test_a_cycle_that_sleeps_is_reported_once_with_its_times(rig):
    for _ in range(4):
        rig.after(25, 20, 0.1, missed=25)
    assert rig.told == [
        "a cycle takes 20 ms, of which it computes for 0.1 ms and waits for 19.9; 25 "
        "of 50 releases were missed. Only `sync` may wait: see what cycle() of module "
        "sleepy waits for (a sleep, a file, a lock, a device)"
    ]
    assert rig.task.waits.endswith("waits for 19.9")
    rig.after(50, 1, 1)
    assert not rig.task.waits
    for _ in range(2):
        rig.after(25, 20, 0.1)
    assert len(rig.told) == 2, "it has begun again"


@pytest.mark.parametrize(
    "times",
    [
        {"wall": 20, "cpu": 20},
        {"wall": 20, "cpu": 5, "ready": 15},
        {"wall": 20, "cpu": 5, "held": 15},
        {"wall": 6, "cpu": 4.5},
    ],
    ids=["computes", "preempted", "held", "little"],
)
def test_a_cycle_that_does_not_wait_is_not_reported(rig, times):
    for _ in range(4):
        rig.after(25, **times)
    assert not rig.told
    assert not rig.task.waits


def test_a_single_wait_is_no_habit(rig):
    for _ in range(3):
        rig.after(25, 20, 0.1)
        rig.after(25, 1, 1)
    assert not rig.told


def test_a_task_that_is_off_does_not_wait(rig):
    for _ in range(2):
        rig.after(25, 20, 0.1)
    rig.slot.mode = Mode.OFF
    rig.check()
    assert not rig.task.waits
