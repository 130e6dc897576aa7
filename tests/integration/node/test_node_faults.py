"""Modules that misbehave: reported, contained, cleaned up; siblings miss nothing."""

import os
import re
import signal
from pathlib import Path

import pytest
from c_modules import put_misbehaving
from nodekit import CORE, alive, level, rmod, wait_gone, wait_hung
from reference import Reference
from watching import wait_for

from pbonet.errors import (
    MethodError,
    ModuleLoadError,
    NoAnswerError,
    Severity,
    StateError,
    TaskDiedError,
)
from pbonet.node.wire import process_setup
from pbonet.xm.net import messages as m

DELETES_ITSELF = """
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Annotated as A

from pbonet import OutVar, PortBasedObject, Vector


class DeletesItself(PortBasedObject):
    y: A[Vector, OutVar("Y", "2", "none", "cycles")]

    def init(self) -> None:
        Path(__file__).unlink()

    def cycle(self, dt: float) -> None:
        self.y[0] += 1.0
"""


@pytest.fixture
def sibling(arm):
    """A good neighbour, which misses nothing unless the machine stands still."""
    arm.spawn("good", "counts", out="Y7", freq=40.0)
    arm.on("good")
    tid = arm.wait_cycles("good", 5).tid
    with Reference(CORE, beside=tid) as reference:
        before = arm.status("good")
        yield tid
        after = arm.wait_cycles("good", 5)
        assert after.state == "ON"
        assert (after.tid, after.on_ns) == (before.tid, before.on_ns)
        assert after.miss - before.miss <= reference.lost(40.0)


def names(folder):
    """Return what stands in a folder."""
    return sorted(path.name for path in folder.iterdir())


def slots_in_use(arm, nodes):
    """Return the tasks that the core table has, as (RTPU, task)."""
    from pbonet.node.rt import _rt

    core = arm.nodes.state("arm0").core
    table = _rt.CoreTable(core, member=False)
    try:
        slots = [table.snapshot(i) for i in table.slots(f"{nodes.domain}/arm0")]
        return {slot.task for slot in slots}
    finally:
        table.close()


@pytest.mark.usefixtures("sibling")
class TestRaising:
    """An exception in a method ends in the state that the thesis gives it."""

    def test_in_init(self, arm):
        error = arm.refused(MethodError, arm.spawn, "bad", "raises_in_init")
        assert "RuntimeError: init does not work" in str(error)
        assert "raises_in_init.py" in error.debug
        assert "line" in error.debug
        assert "bad" not in arm.status()
        assert arm.wait_event("OUTPUT", "bad").text == "kill after init"
        assert arm.wait_event("SPAWN_FAILED", "bad").severity == Severity.ERROR

    def test_in_on(self, arm):
        arm.spawn("bad", "raises_in_on")
        error = arm.refused(MethodError, arm.on, "bad")
        assert "ValueError: on does not work" in str(error)
        status = arm.status("bad")
        assert status.state == "ERROR"
        assert "on does not work" in status.error

    def test_in_cycle(self, arm):
        arm.spawn("bad", "raises_in_cycle")
        arm.on("bad")
        event = arm.wait_event("METHOD", "bad")
        assert "ZeroDivisionError: the tenth cycle does not work" in event.text
        status = wait_for(
            lambda: (one := arm.status("bad")).state == "ERROR" and one, "ERROR"
        )
        assert "the tenth cycle does not work" in status.error
        assert (status.cycle, status.failed) == (9, 1)
        assert arm.value("Y0").values == [9.0, 0.0]  # the tenth is discarded
        assert arm.rtpu_status().illegal == ["bad is in ERROR (arm0/bad)"]
        arm.refused(StateError, arm.on, "bad")
        assert arm.control("bad", "clear").state == "OFF"
        assert arm.status("bad").error == ""
        assert arm.rtpu_status().illegal == []

    def test_in_off(self, arm):
        arm.spawn("bad", "raises_in_off")
        arm.on("bad")
        arm.refused(MethodError, arm.off, "bad")
        assert arm.status("bad").state == "ERROR"
        assert arm.kill("bad").state == "NOT-CREATED"

    def test_in_off_within_kill(self, arm):
        tid = arm.spawn("bad", "raises_in_off").tid
        arm.on("bad")
        error = arm.refused(MethodError, arm.kill, "bad")
        assert "off does not work" in str(error)
        assert "bad" not in arm.status()  # gone all the same
        assert not alive(tid)

    def test_in_kill(self, arm):
        tid = arm.spawn("bad", "raises_in_kill").tid
        arm.on("bad")
        error = arm.refused(MethodError, arm.kill, "bad")
        assert "kill does not work" in str(error)
        assert "bad" not in arm.status()  # gone all the same
        wait_gone([tid])

    def test_sys_exit(self, arm):
        arm.spawn("bad", "exits")
        arm.on("bad")
        assert "SystemExit: 3" in arm.wait_event("METHOD", "bad").text
        assert arm.status("bad").state == "ERROR"

    @pytest.mark.parametrize("module", ["not_finite", "c_not_finite"])
    def test_value_that_is_not_finite(self, arm, nodes, module):
        put_misbehaving(nodes.library)
        arm.spawn("bad", module)
        arm.on("bad")
        event = arm.wait_event("METHOD", "bad")
        assert "not a finite number: Y0[1] (got nan)" in event.text
        assert arm.value("Y0").values == [9.0, 0.0]


@pytest.mark.usefixtures("sibling")
class TestDying:
    """A task's process that ends is cleaned away and can be spawned again."""

    @pytest.mark.parametrize(
        ("module", "how"),
        [
            ("dies_by_sigkill", "signal SIGKILL (killed)"),
            ("segfaults", "signal SIGSEGV (segmentation fault)"),
            ("c_segfaults", "signal SIGSEGV (segmentation fault)"),
            ("c_exits", "exit code 3"),
        ],
    )
    def test_in_cycle(self, arm, nodes, shared_memory, module, how):
        put_misbehaving(nodes.library)
        before = names(shared_memory)
        slots = slots_in_use(arm, nodes)
        arm.spawn("bad", module)
        arm.on("bad")
        event = arm.wait_event("TASK_DIED", "bad")
        assert f"the task ended by itself: {how}" in event.text
        if module == "segfaults":
            assert "segfaults.py" in event.text  # where it stood
            assert "in cycle" in event.text
        status = arm.status("bad")
        assert (status.state, status.tid) == ("NOT-CREATED", 0)
        assert how in status.error
        assert status.cycle == 9
        assert arm.value("Y0").values == [9.0, 0.0]
        assert arm.rtpu_status().illegal == ["bad has died (arm0/bad)"]
        assert slots_in_use(arm, nodes) == slots
        wait_for(lambda: names(shared_memory) == before, "its ring to go")
        arm.spawn("other", "counts", out="Y0")
        assert arm.on("other").state == "ON"  # the dead one's claim is gone
        arm.kill("other")
        assert arm.spawn("bad", module).state == "OFF"
        assert arm.rtpu_status().illegal == []

    def test_an_heir_relieves_the_flag(self, arm):
        arm.spawn("bad", "dies_by_sigkill")
        arm.spawn("heir", "counts", out="Y0")
        arm.on("bad")
        arm.wait_event("TASK_DIED", "bad")
        assert arm.rtpu_status().illegal == ["bad has died (arm0/bad)"]
        arm.on("heir")
        assert arm.rtpu_status().illegal == []

    def test_in_init(self, arm):
        error = arm.refused(
            TaskDiedError, arm.spawn, "bad", "segfaults_in_init", out=""
        )
        assert "segmentation fault" in error.what
        assert "segfaults_in_init.py" in error.debug
        assert "bad" not in arm.status()

    def test_on_import(self, arm):
        error = arm.refused(TaskDiedError, arm.spawn, "bad", "dies_on_import", out="")
        assert "exit code 5" in error.what

    def test_while_off_and_from_outside(self, arm):
        tid = arm.spawn("bad", "counts").tid
        os.kill(tid, signal.SIGKILL)
        arm.wait_event("TASK_DIED", "bad")
        assert arm.rtpu_status().illegal == []  # it wrote nothing that anybody reads
        assert arm.kill("bad").state == "NOT-CREATED"
        assert "bad" not in arm.status()

    def test_stopped_by_a_signal_and_told_to_do_something(self, arm):
        """A command continues it: nothing waits for a task that somebody stopped."""
        tid = arm.spawn("bad", "counts").tid
        os.kill(tid, signal.SIGSTOP)
        arm.on("bad")
        arm.wait_cycles("bad", 5)
        os.kill(tid, signal.SIGSTOP)
        assert arm.off("bad").state == "OFF"
        assert arm.kill("bad").state == "NOT-CREATED"
        assert not alive(tid)

    @pytest.mark.parametrize("which", [signal.SIGTERM, signal.SIGINT])
    @pytest.mark.parametrize("state", ["OFF", "ON"])
    def test_told_to_end(self, arm, tmp_path, which, state):
        book = tmp_path / "diary"
        tid = arm.spawn("bad", "counts", local={"DIARY": book}).tid
        if state == "ON":
            arm.on("bad")
        os.kill(tid, which)
        event = arm.wait_event("ENDING", "bad")
        assert which.name in event.text
        arm.wait_event("TASK_DIED", "bad")
        last = book.read_text().splitlines()[-1]
        assert last.endswith("kill")
        assert ("off False" in book.read_text()) == (state == "ON")


@pytest.mark.usefixtures("sibling")
class TestChildren:
    """Processes that a module starts are never the task, and end with it."""

    @pytest.fixture
    def pids(self, arm, tmp_path):
        """Turn the task on, and return its process ids: it, and all that it started."""
        file = tmp_path / "pids"
        tid = arm.spawn("bad", "leaves_children", local={"PIDS": file}).tid
        arm.on("bad")
        status = arm.wait_cycles("bad", 20)
        assert (status.state, status.tid) == ("ON", tid)
        pids = [tid, *map(int, file.read_text().split())]
        assert len(pids) == 4
        return pids

    def test_end_with_a_kill(self, arm, pids):
        arm.kill("bad")
        wait_gone(pids)
        assert arm.events("FORCED", "bad") == []

    def test_end_when_the_task_dies(self, arm, pids):
        os.kill(pids[0], signal.SIGKILL)
        arm.wait_event("TASK_DIED", "bad")
        wait_gone(pids)


@pytest.mark.usefixtures("sibling")
def test_a_module_cannot_take_priorities_or_processes_of_the_node(arm):
    tid = arm.spawn("bad", "takes_over").tid
    arm.on("bad")
    wait_for(lambda: arm.value("Y0").values[1], "the attempts")
    assert arm.value("Y0").values[1] == 6.0
    assert level(tid) <= 84
    assert os.sched_getaffinity(tid) == {CORE}
    lines = Path(f"/proc/{tid}/status").read_text().splitlines()
    status = dict(line.split(":\t", 1) for line in lines if ":\t" in line)
    assert (status["NoNewPrivs"], status["Seccomp"]) == ("1", "2")
    beyond = sum(
        1 << which for which in (16, 19, 21, 22)
    )  # module, ptrace, admin, boot
    assert int(status["CapEff"], 16) & beyond == 0
    assert int(status["CapBnd"], 16) & beyond == 0


@pytest.mark.usefixtures("sibling")
class TestHarming:
    """What else a module may do costs its own task, and is said by name."""

    def test_processes_without_end(self, arm):
        arm.spawn("bad", "forks_without_end", freq=20.0)
        arm.on("bad")
        text = arm.wait_event("TASK_DIED", "bad").text
        assert "module forks_without_end has started" in text
        assert "processes (expected at most 128 at a time)" in text
        server, good = arm.nodes.fork_server("arm0"), arm.status("good").tid
        wait_for(lambda: process_setup.children(server) == [good], "their end")

    def test_memory_without_end(self, arm):
        arm.spawn("bad", "eats_memory")
        arm.on("bad")
        wait_for(lambda: arm.status("bad").state == "ERROR", "the end of memory")
        assert "MemoryError" in arm.status("bad").error
        assert arm.control("bad", "clear").state == "OFF"  # it obeys without memory
        arm.kill("bad")

    def test_blocked_signals(self, arm):
        """It is contained without them, and `kill` ends it."""
        tid = arm.spawn("bad", "blocks_signals", freq=100.0).tid
        arm.on("bad")
        arm.wait_event("TIMING_FAILURE", "bad")
        assert arm.value("Y0").values[1] == 0.0
        arm.kill("bad")
        assert not alive(tid)

    def test_threads_that_stay(self, arm):
        tid = arm.spawn("bad", "leaves_threads").tid
        arm.on("bad")
        arm.wait_cycles("bad", 5)
        arm.kill("bad")
        assert not alive(tid)
        assert arm.events("FORCED", "bad") == []

    def test_its_own_file_deleted(self, arm, nodes):
        nodes.write_module("deletes_itself", DELETES_ITSELF)
        arm.spawn("bad", "deletes_itself")
        arm.on("bad")
        arm.wait_cycles("bad", 5)
        arm.kill("bad")
        arm.refused(ModuleLoadError, arm.spawn, "bad", "deletes_itself")

    def test_views_that_are_kept(self, arm):
        """What it writes after its last cycle is seen by no other task."""
        text = rmod("keeps_views", invar="X")
        tid = arm.spawn("bad", "keeps_views", text=text).tid
        arm.on("bad")
        arm.wait_cycles("bad", 5)
        arm.kill("bad")
        assert not alive(tid)
        assert arm.events("TASK_DIED", "bad") == []
        assert max(arm.value("Y0").values) < 1e6


@pytest.mark.usefixtures("sibling")
def test_a_priority_and_a_core_that_another_program_changes_are_put_right(arm):
    tid = arm.spawn("bad", "counts").tid
    arm.on("bad")
    arm.wait_cycles("bad", 5)
    os.sched_setaffinity(tid, range(os.cpu_count()))
    arm.wait_event("SCHEDULING_CHANGED", "bad")
    wait_for(lambda: os.sched_getaffinity(tid) == {CORE}, "its core")
    if arm.rtpu_status().backend == "fifo":
        os.sched_setscheduler(tid, os.SCHED_OTHER, os.sched_param(0))
        wait_for(lambda: len(arm.events("SCHEDULING_CHANGED", "bad")) == 2, "the event")
        texts = [event.text for event in arm.events("SCHEDULING_CHANGED", "bad")]
        assert [text.partition(" (expected ")[0] for text in texts] == [
            f"it may run on cores {' '.join(map(str, range(os.cpu_count())))}",
            "its main thread is scheduled by SCHED_OTHER 0",
        ]
        wait_for(lambda: level(tid) > 3, "its level")
    before = arm.status("bad").cycle
    arm.wait_cycles("bad", before + 5)
    assert not arm.events("SCHEDULING_CHANGED", "good")


@pytest.mark.usefixtures("sibling")
class TestHanging:
    """A method that never comes back costs its own task alone."""

    def test_in_init(self, arm):
        error = arm.refused(NoAnswerError, arm.spawn, "bad", "hangs_in_init", limit=4.0)
        assert "`init` did not return within" in str(error)
        assert "hangs_in_init.py" in error.debug  # where it stands
        assert "bad" not in arm.status()

    @pytest.mark.parametrize("module", ["hangs_in_cycle", "hangs_in_c", "c_hangs"])
    def test_in_cycle(self, arm, nodes, sibling, module):
        put_misbehaving(nodes.library)
        tid = arm.spawn("bad", module).tid
        arm.rank_low("bad")
        arm.on("bad")
        wait_hung(arm, "bad")
        if arm.rtpu_status().backend == "fifo":
            assert level(tid) < level(sibling)  # which therefore runs all the same
        arm.refused(NoAnswerError, arm.off, "bad", limit=0.1)
        error = arm.refused(StateError, arm.off, "bad", limit=0.1)
        assert "still busy with 'off'" in str(error)
        arm.kill("bad", limit=0.1)
        assert arm.wait_event("FORCED", "bad").severity == Severity.WARNING
        assert not alive(tid)

    def test_in_on(self, arm):
        arm.spawn("bad", "hangs_in_on")
        arm.refused(NoAnswerError, arm.on, "bad", limit=0.3)
        arm.kill("bad", limit=0.3)
        assert "bad" not in arm.status()

    def test_in_off(self, arm):
        """Commands share the core, so that those to other tasks are carried out."""
        arm.spawn("bad", "hangs_in_off", out="Y1")
        arm.on("bad")
        arm.refused(NoAnswerError, arm.off, "bad", limit=0.3)
        arm.spawn("other", "counts", out="Y2", freq=50.0)
        arm.on("other")
        assert arm.ask(m.Freq(task="other", hz=40.0), float) == 40.0
        arm.wait_cycles("other", 5)
        arm.kill("bad", limit=0.3)
        assert arm.status("bad").state == "NOT-CREATED"


@pytest.mark.parametrize("backend", ["auto", "park"])
def test_a_cycle_that_waits_is_told_from_one_that_others_delay(nodes, backend):
    nodes.agent("arm0", backend=backend)
    arm = nodes.master("arm0", "arm")
    arm.spawn("busy", "overruns", out="Y1", freq=60.0)
    arm.spawn("bad", "waits_in_cycle", freq=100.0)
    arm.spawn("below", "counts", out="Y2", freq=5.0)
    for task in ("busy", "bad", "below"):
        arm.on(task)
    text = arm.wait_event("WAITS", "bad").text
    assert re.search(r"takes 2\d(\.\d)? ms, of which it computes for 0\.\d+ ms", text)
    assert "cycle() of module waits_in_cycle" in text
    arm.wait_cycles("below", 5)
    status = arm.status()
    assert status["bad"].waits
    assert not status["busy"].waits
    assert not status["below"].waits
