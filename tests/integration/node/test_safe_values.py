"""Safe values at a timing failure: in the table while the cycle still runs."""

import os
import random
import select
import signal
import threading
import time

import pytest
from nodekit import rmod
from watching import wait_for

from pbonet.config import Variable
from pbonet.errors import UnknownTaskError
from pbonet.node.rt import _rt
from pbonet.svar import Action, Freshness, Table
from pbonet.svar.mirror import packets
from pbonet.svar.mirror.table_mirror import Mirror

MS = 1_000_000

FAIL_SIGNAL = signal.SIGRTMIN + 3
SAFE = (-7.0, -7.0)
"""What tests/misbehaving/overruns.py declares."""


def overruns(*more, **local):
    """Return the RMOD of a task whose every fifth cycle fails in time."""
    lines = rmod("overruns", out="Y0", freq=50.0, local=local).splitlines()
    at = lines.index("FREQ 50") + 1
    return "\n".join([*lines[:at], *more, *lines[at:], ""])


def start(arm, text, name="bad"):
    arm.spawn(name, "overruns", text=text)
    arm.on(name)


def wait_safe(arm, count=1, name="bad"):
    return wait_for(
        lambda: (status := arm.status(name)).made_safe >= count and status,
        f"{count} failures that were made safe",
    )


def test_while_a_c_call_does_not_return_the_table_has_the_safe_values(arm):
    start(arm, overruns("SAFE deadline", work="endless"))
    wait_safe(arm)
    assert tuple(arm.value("Y0").values) == SAFE
    wait_for(lambda: arm.status("bad").failures["deadline"] > 5, "later failures")
    status = arm.status("bad")
    assert status.made_safe == 1, "once for a cycle"
    assert status.cycle == 4, "that cycle has not ended"
    assert status.aborted == 0
    arm.kill("bad", limit=1.0)
    start(arm, overruns(work="sleep", busy=0.0), "other")
    wait_for(lambda: arm.value("Y0").values[0] > 0, "another task that writes it")


@pytest.mark.parametrize("work", ["python", "numpy", "sleep", "locked"])
def test_a_failed_cycle_is_discarded_and_the_task_goes_on(arm, work):
    start(arm, overruns("SAFE deadline", work=work, busy=0.05))
    seen = set()

    def enough():
        seen.add(tuple(arm.value("Y0").values))
        return len({values for values in seen if values != SAFE}) > 2 and (
            arm.status("bad").made_safe > 2
        )

    wait_for(enough, "cycles that fail, and others")
    assert all(values == SAFE or values[1] >= 0.0 for values in seen)
    status = arm.status("bad")
    assert status.aborted >= status.made_safe - 1
    assert status.state == "ON"
    arm.off("bad")
    arm.on("bad")
    wait_safe(arm, status.made_safe + 1)
    wait_for(lambda: tuple(arm.value("Y0").values) != SAFE, "a whole cycle")


def test_the_module_s_handler_runs_afterwards_and_the_event_says_both(arm):
    start(arm, overruns("MAXC 0.005", "SAFE maxexec", work="python", busy=0.05))
    assert wait_safe(arm, 2).handlers >= 1
    text = wait_for(
        lambda: [
            event.text
            for event in arm.events("TIMING_FAILURE", "bad")
            if "safe values were written" in event.text
        ],
        "the event",
    )[0]
    assert "us after the failure" in text


def test_a_handler_that_answers_skip_has_a_release_left_out(arm):
    start(arm, overruns("SAFE deadline", work="python", busy=0.03, answer="skip"))
    status = wait_safe(arm, 2)
    assert status.skipped >= 1
    assert status.aborted >= 1, "`on` has run again all the same"
    assert status.state == "ON"


def test_only_the_failures_that_are_named_count(arm):
    start(
        arm,
        overruns(
            "MINC 0.00001", "MAXC 0.005", "SAFE minexec", work="python", busy=0.05
        ),
    )
    wait_for(lambda: arm.status("bad").failures["maxexec"] > 2, "failures")
    assert arm.status("bad").made_safe == 0


def is_off(arm, name="bad"):
    try:
        return arm.status(name).state == "OFF"
    except UnknownTaskError:
        return False


def test_whichever_rtpu_leads_the_core_and_when_it_is_killed(nodes):
    """One of two leads, and knows its own tasks' values alone."""
    nodes.agent_processes("arm0", "arm1")
    arms = nodes.master("arm0", "one"), nodes.master("arm1", "two")
    late = overruns("SAFE deadline", work="sleep", busy=0.05)
    for arm in arms:
        start(arm, late)
    for arm in arms:
        wait_safe(arm, 2)
    old = nodes.state("arm0").pid
    os.kill(old, signal.SIGKILL)
    wait_safe(arms[1], arms[1].status("bad").made_safe + 2)
    nodes.wait_restarted("arm0", old)
    wait_for(lambda: is_off(arms[0]), "that it is spawned again")
    arms[0].on("bad")
    for arm in arms:
        wait_safe(arm, arm.status("bad").made_safe + 2)


N = 4096
"""Elements of a variable whose commits take long enough to be met."""


@pytest.fixture
def rig(tmp_path, monkeypatch):
    """Return a dispatcher on another core than this process, a slot, and a table."""
    monkeypatch.setenv("PBONET_SHM_DIR", str(tmp_path))
    core = _rt.CoreTable(1)
    dispatcher = _rt.Dispatcher(core, "park")
    dispatcher.start()
    i = core.alloc("r", "t")
    core.configure(i, period_ns=10 * MS, deadline_ns=2 * MS, crit=5, pid=os.getpid())
    core.configure(i, tells=False, safe_at=["deadline"])
    slot = _rt.Slot(core, i)
    with Table.create("safe", [Variable(name="Y", type="double", nelem=N)]) as table:
        yield core, dispatcher, slot, table
        slot.disarm()
        dispatcher.drop_values(slot.index)
        dispatcher.stop()
    core.close()


def reads_whole_sets(name: str, until: int) -> int:
    """Read in a process of its own until `until` is closed; how many sets were torn."""
    torn = 0
    with Table.attach(name) as table:
        while not select.select([until], [], [], 0)[0]:
            values = table.read("Y")
            torn += values.min() != values.max()
    return torn


@pytest.mark.parametrize("kept", [True, False], ids=["dispatcher", "signal"])
def test_random_failures_never_tear_a_set(rig, kept):
    core, dispatcher, slot, table = rig
    local = table.local("t", os.getpid(), outvar=["Y"])
    values = local.keep_safe({"Y": -7.0})
    if kept:
        dispatcher.keep_values(slot.index, table.arena, values)
    assert local.claim() == 0
    until, end = os.pipe()
    child = os.fork()
    if not child:
        os.close(end)
        os._exit(min(reads_whole_sets("safe", until), 100))
    pick, done, y = random.Random(1), [], local.array("Y")

    def cycle(_dt):
        y[:] = len(done) + 1.0
        stop = time.monotonic_ns() + pick.randrange(4 * MS)
        while time.monotonic_ns() < stop:
            pass
        done.append(1)
        if len(done) == 150:
            core.request(slot.index)

    safe = 0
    while (reason := slot.run(cycle, local)) == _rt.ABORTED:
        assert slot.safe
        assert table.read("Y")[0] == -7.0, "what the cycle computed is discarded"
        safe += 1
    assert reason == _rt.COMMAND
    assert safe == core.snapshot(slot.index).safe
    assert 10 < safe < 140
    os.close(end)
    assert os.waitstatus_to_exitcode(os.waitpid(child, 0)[1]) == 0
    os.close(until)


def test_a_cycle_that_fails_amid_a_report_that_raises_is_closed(rig):
    """The module has not been called; the task knows of the commit all the same."""
    core, dispatcher, slot, _ = rig
    variables = [Variable(name=name, type="double") for name in ("U", "Y")]

    def reports(_stale):
        wait_for(lambda: core.snapshot(slot.index).safe, "safe values")
        raise OSError("the report does not work")

    with Table.create("aged", variables) as table:
        local = table.local("t", os.getpid(), invar=["U"], outvar=["Y"])
        local.keep_fresh({table.index("U"): Freshness(1e-3, Action.HOLD)})
        values = local.keep_safe({"Y": -7.0})
        dispatcher.keep_values(slot.index, table.arena, values)
        assert local.claim() == 0
        with pytest.raises(OSError, match="the report"):
            slot.run(lambda _dt: None, local, aged=reports)
        assert slot.safe
        assert table.read("Y")[0] == -7.0
        assert local.commit() == 0, "it is its only writer again"
        dispatcher.drop_values(slot.index)


def test_another_machine_has_them_while_the_cycle_still_runs(rig):
    core, dispatcher, slot, _ = rig
    variables, seen = [Variable(name="Y", type="double")], []
    with (
        Table.create("here", variables) as here,
        Table.create("there", variables) as there,
    ):
        sides = [
            Mirror(table, name, 1, keep=name == "here", late=lambda *_: 0)
            for table, name in ((here, "here"), (there, "there"))
        ]

        def carry(one, other, *, full=False):
            packet = one.next_packet(full=full)
            other.take(packets.unpack(packets.pack(packet)))

        def cycle(_dt):
            wait_for(lambda: core.snapshot(slot.index).safe, "safe values")
            carry(*sides)
            seen.append(there.read("Y")[0])

        local = here.local("t", os.getpid(), outvar=["Y"])
        values = local.keep_safe({"Y": -7.0})
        dispatcher.keep_values(slot.index, here.arena, values)
        assert local.claim() == 0
        for _ in range(2):
            carry(*sides, full=True)
            carry(*reversed(sides), full=True)
        assert slot.run(cycle, local) == _rt.ABORTED
        assert seen == [-7.0]
        dispatcher.drop_values(slot.index)
        for side in sides:
            side.close()


def test_a_signal_that_comes_to_another_thread_writes_nothing(rig):
    """The task would not know that its cycle is being taken."""
    core, _, slot, table = rig
    local = table.local("t", os.getpid(), outvar=["Y"])
    local.keep_safe({"Y": -7.0})
    assert local.claim() == 0
    ready, sent = threading.Event(), threading.Event()
    found = []

    def other():
        ready.wait()
        os.kill(os.getpid(), FAIL_SIGNAL)
        sent.set()

    def cycle(_dt):
        signal.pthread_sigmask(signal.SIG_BLOCK, {FAIL_SIGNAL})
        wait_for(lambda: core.snapshot(slot.index).failures[0], "the deadline")
        ready.set()
        sent.wait()
        found.append(core.snapshot(slot.index).safe)
        signal.pthread_sigmask(signal.SIG_UNBLOCK, {FAIL_SIGNAL})
        found.append(core.snapshot(slot.index).safe)

    thread = threading.Thread(target=other)
    thread.start()
    assert slot.run(cycle, local) == _rt.ABORTED
    thread.join()
    assert found == [0, 1]
