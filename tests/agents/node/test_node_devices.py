"""Tasks that a device times are watched and ranked like periodic ones."""

import os
import threading

import pytest
from nodekit import rmod
from plain_dispatcher.dispatch import replay
from watching import wait_for

from pbonet.analysis.schedule.events import Event, turns
from pbonet.node.rt import _rt

MS = 1_000_000


@pytest.fixture
def device(tmp_path):
    """A pipe in the place of a device; each byte is an event."""
    path = tmp_path / "device"
    os.mkfifo(path)
    fd = os.open(path, os.O_RDWR)
    yield path, lambda: os.write(fd, b"x")
    os.close(fd)


def text(device, *more, freq=20.0, **local):
    """Return the RMOD of a task that `device` times."""
    lines = rmod("overruns", freq=freq, local={"FIFO": device[0], **local})
    return lines.replace("periodic", "synchronous").replace(
        f"FREQ {freq:g}", "\n".join([f"FREQ {freq:g}", *more])
    )


def start(arm, device, *more, **local):
    arm.spawn("dev", "overruns", text=text(device, *more, **local))
    arm.on("dev")


def wait_failure(arm, kind):
    return wait_for(
        lambda: (one := arm.status("dev")).failures[kind] and one, f"a {kind} failure"
    )


def trace(nodes):
    """Return the turns of the core, checked, and the slots by name."""
    table = _rt.CoreTable(nodes.state("arm0").core, member=False)
    try:
        slots = {table.snapshot(i).task.split("/")[-1]: i for i in table.slots()}
        _, lost, records = table.trace()
    finally:
        table.close()
    assert not lost
    replay(records)
    return slots, list(turns(records))


def test_an_overrun_is_contained_and_told_and_over_with_its_cycle(arm, nodes, device):
    start(arm, device, "MAXC 0.002", every=1, busy=0.006)
    device[1]()
    status = wait_failure(arm, "maxexec")
    assert status.reserve == pytest.approx(0.002)
    assert wait_for(lambda: arm.status("dev").handlers, "its handler") >= 1
    wait_for(lambda: arm.value("Y0").values[0] == 1, "the end of the cycle")
    wait_for(lambda: arm.status("dev").rank == 5, "its criticality")
    slots, seen = trace(nodes)
    ranks = [
        record.arg
        for _, _, decisions in seen
        for record in decisions
        if (record.slot, record.kind) == (slots["dev"], Event.CRIT)
    ]
    assert ranks[-2:] == [3, 5]


def test_a_cycle_past_its_deadline_is_told(arm, device):
    start(arm, device, every=1, busy=30.0, work="sleep", answer="abort")
    device[1]()
    wait_failure(arm, "deadline")
    status = wait_for(lambda: (s := arm.status("dev")).aborted and s, "its abort")
    assert status.state == "ON"
    assert arm.value("Y0").values[0] == 0.0
    device[1]()  # `on` has run, and the device is listened to again
    wait_for(lambda: arm.status("dev").aborted == 2, "another one")


def test_a_least_time_that_cannot_be_had_is_told(arm, device):
    start(arm, device, "MINC 0.04", every=1, busy=0.1, work="sleep")
    device[1]()
    assert wait_failure(arm, "minexec").state == "ON"


@pytest.fixture
def clocked(device):
    """A device with a clock of its own: an event every 20 ms, or a little more."""
    over = threading.Event()

    def tick():
        while not over.wait(0.02):
            device[1]()

    thread = threading.Thread(target=tick)
    thread.start()
    yield device
    over.set()
    thread.join()


def beside(nodes, other):
    """Return whether `dev` was above `other`, before and behind the turn of an event.

    Only where `other` was amid a cycle, and the device had not been silent.
    """
    slots, seen = trace(nodes)
    dev, other = slots["dev"], slots[other]
    level, running, last, found = {dev: 0, other: 0}, False, 0, []
    for _, inputs, decisions in seen:
        before = level[dev] > level[other]
        running &= all((r.slot, r.kind) != (other, Event.DONE) for r in inputs)
        level |= {r.slot: r.arg for r in decisions if r.kind == Event.LEVEL}
        for event in inputs:
            if (event.slot, event.kind, event.arg & 1) == (dev, Event.EVENT, 1):
                if running and event.a - last < 40 * MS:
                    found.append((before, level[dev] > level[other]))
                last = event.a
        running |= any((r.slot, r.kind) == (other, Event.RELEASE) for r in decisions)
    return found


def test_its_deadline_ranks_it_among_its_equals(arm, nodes, clocked):
    """It waits for nobody who is as critical and due later, not even to wake up."""
    hog = rmod("overruns", out="Y1", freq=4.0, local={"EVERY": 1, "BUSY": 0.1})
    arm.spawn("hog", "overruns", text=hog)
    start(arm, clocked, freq=50.0, every=1, busy=0.0)
    arm.on("hog")
    found = wait_for(
        lambda: len(found := beside(nodes, "hog")) >= 3 and found,
        "events amid the other one's cycles",
    )
    assert all(before and behind for before, behind in found), found
