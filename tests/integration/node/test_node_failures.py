"""Timing failures of real tasks: contained, told in the task, survived by others."""

import os
import pathlib
import re
import signal

import pytest
from nodekit import CORE, level, rmod, wait_gone
from plain_dispatcher.dispatch import replay
from reference import Reference
from watching import wait_for

from pbonet.analysis.schedule.events import Event, turns
from pbonet.errors import Severity
from pbonet.node.rt import _rt


def overruns(*, out="Y0", freq=50.0, maxc=0.005, more=(), **local):
    """Return the RMOD of a task that overruns, with a reserve of `maxc` seconds."""
    lines = rmod("overruns", out=out, freq=freq, local=local).splitlines()
    at = lines.index(f"FREQ {freq:g}") + 1
    limits = [f"MAXC {maxc:g}"] if maxc else []
    return "\n".join([*lines[:at], *limits, *more, *lines[at:], ""])


@pytest.fixture
def sibling(arm):
    """A less urgent neighbour of the critical set, which misses nothing."""
    arm.spawn("good", "counts", out="Y7", freq=40.0)
    arm.on("good")
    tid = arm.wait_cycles("good", 5).tid
    with Reference(CORE, level(tid)) as reference:
        before = arm.status("good")
        yield
        after = arm.wait_cycles("good", 5)
        assert after.miss - before.miss <= reference.lost(40.0)


def start(arm, text, name="bad"):
    arm.spawn(name, "overruns", text=text)
    arm.on(name)


def wait_failures(arm, kind, count=3, name="bad"):
    return wait_for(
        lambda: (status := arm.status(name)).failures.get(kind, 0) >= count and status,
        f"{count} failures of kind {kind}",
    )


def records(nodes):
    """Return the decisions about tasks by name, from the core's trace."""
    table = _rt.CoreTable(nodes.state("arm0").core, member=False)
    try:
        names = {i: table.snapshot(i).task.split("/")[-1] for i in table.slots()}
        _, lost, trace = table.trace()
        assert not lost
        replay(trace)
        return [
            (names.get(record.slot, ""), Event(record.kind), record.arg, head.a)
            for head, _, decisions in turns(trace)
            for record in decisions
        ]
    finally:
        table.close()


@pytest.mark.usefixtures("sibling")
class TestReserve:
    """More CPU time than was reserved is taken from nobody."""

    @pytest.mark.parametrize("work", ["python", "numpy"])
    def test_an_overrun_is_contained_told_and_gone_on_with(self, arm, nodes, work):
        start(arm, overruns(work=work))
        status = wait_failures(arm, "maxexec")
        assert status.state == "ON"
        assert status.handlers > 0
        assert status.aborted == 0
        found = [r for r in records(nodes) if r[0] == "bad"]
        drops = [r for r in found if r[1:3] == (Event.CRIT, 3)]
        assert len(drops) >= 3
        assert all(
            any(r[1] is Event.FAIL and r[3] == at for r in found) for *_, at in drops
        )
        wait_for(lambda: arm.value("Y0").values[1] > 0, "a cycle after the handler")

        def told():
            events = arm.events("TIMING_FAILURE", "bad")
            return [event for event in events if "maxexec" in event.text]

        event = wait_for(told, "the event")[0]
        assert event.severity == Severity.WARNING
        assert "reserve 5 ms" in event.text

    def test_an_abort_discards_the_outputs_and_runs_on_again(self, arm):
        start(arm, overruns(answer="abort", busy=5.0))
        status = wait_failures(arm, "maxexec")
        assert status.aborted >= 2
        assert status.state == "ON"
        before = arm.value("Y0").values
        assert before[1] == 0.0  # never the -1 of a cycle under way
        wait_for(lambda: arm.value("Y0").values[0] > before[0], "cycles that end")

    def test_a_skip_leaves_the_next_release_out(self, arm):
        start(arm, overruns(answer="skip", busy=0.01))
        status = wait_failures(arm, "maxexec")
        wait_for(lambda: arm.status("bad").skipped >= 2, "skipped releases")
        assert status.state == "ON"

    def test_a_handler_that_raises_is_an_error_of_the_task(self, arm):
        start(arm, overruns(answer="raise"))
        wait_for(lambda: arm.status("bad").state == "ERROR", "the ERROR state")
        text = arm.wait_event("METHOD", "bad").text
        assert re.search("does not like (maxexec|deadline)", text)
        assert "timing_failure" in arm.status("bad").error

    def test_a_handler_that_does_not_return_is_stopped(self, arm):
        start(arm, overruns(answer="hang"))
        wait_for(lambda: arm.status("bad").state == "ERROR", "the ERROR state")
        assert "timing_failure() did not return" in arm.status("bad").error

    def test_one_that_cannot_even_be_stopped_ends_with_its_task(self, arm):
        start(arm, overruns(answer="hang_in_c"))
        tid = arm.status("bad").tid
        wait_gone([tid])
        text = arm.wait_event("TASK_DIED", "bad").text
        assert "timing_failure() did not return" in text

    def test_a_handler_may_lower_its_task(self, arm, nodes):
        start(arm, overruns(answer="lower", busy=0.05, more=["HANDLER 6"]))
        wait_failures(arm, "maxexec")
        found = [r for r in records(nodes) if r[0] == "bad"]
        assert (Event.CRIT, 6) in {r[1:3] for r in found}
        wait_for(
            lambda: (
                (Event.CRIT, 2) in {r[1:3] for r in records(nodes) if r[0] == "bad"}
            ),
            "the criticality that the handler set",
        )

    def test_a_handler_may_wish_two_things(self, arm, nodes):
        """Its wishes are one, whether the dispatcher looked between them or not."""
        start(arm, overruns(answer="lower", busy=0.05, more=["HANDLER 6"]))
        wait_failures(arm, "maxexec")
        table = _rt.CoreTable(nodes.state("arm0").core, member=False)
        wishes = [
            (record.arg, record.a)
            for record in table.trace()[2]
            if record.kind == Event.WISH
        ]
        table.close()
        assert any(crit == 2 and deadline > 0 for crit, deadline in wishes)

    def test_a_critical_section_is_overruled_after_its_bound_only(self, arm):
        start(arm, overruns(work="locked", busy=0.02, maxc=0.002))
        status = wait_failures(arm, "maxexec")
        wait_for(lambda: arm.status("bad").held_off >= 2, "overlong sections")
        assert status.state == "ON"

    def test_a_short_critical_section_keeps_its_criticality(self, arm, nodes):
        start(arm, overruns(work="locked", busy=0.0025, maxc=0.002))

        def kept():
            """Return the failures that were told at once, without a drop.

            On a busy machine the dispatcher may look behind the section's end.
            """
            found = [r for r in records(nodes) if r[0] == "bad"]
            fails = {r[3] for r in found if r[1] is Event.FAIL and r[2] & 3 == 1}
            drops = {r[3] for r in found if r[1:3] == (Event.CRIT, 3)}
            return len(fails - drops) >= 3 and len(drops) >= 3 and fails - drops

        told = wait_for(kept, "failures told amid a section, dropped at its end")
        assert arm.status("bad").held_off < len(told)


class TestDeadline:
    """The deadline, and the least time before it."""

    def test_a_cycle_past_its_deadline_is_told_and_missed(self, arm):
        start(arm, overruns(maxc=0, busy=0.05))
        status = wait_failures(arm, "deadline")
        assert status.miss >= 3
        assert status.handlers > 0
        assert status.delivery_max > 0

    def test_a_blocked_cycle_is_told_in_its_sleep(self, arm):
        start(arm, overruns(maxc=0, busy=30.0, work="sleep", answer="abort"))
        wait_for(lambda: arm.status("bad").aborted >= 2, "aborts of a sleep")
        assert arm.status("bad").state == "ON"

    def test_a_cycle_without_its_least_time_is_not_begun(self, arm, nodes):
        arm.spawn(
            "hog",
            "overruns",
            text=overruns(out="Y1", maxc=0, busy=0.06, freq=10.0, every=1),
        )
        start(
            arm,
            overruns(
                maxc=0.012, busy=0.01, freq=50.0, every=1, more=["MINC 0.009", "CRIT 2"]
            ),
        )
        arm.on("hog")
        status = wait_failures(arm, "minexec")
        assert status.skipped + status.miss >= 2
        found = [r for r in records(nodes) if r[0] == "bad"]
        assert any(r[1] is Event.SKIP for r in found)

    def test_a_silent_device_is_told(self, arm, tmp_path):
        path = tmp_path / "events"
        os.mkfifo(path)
        fd = os.open(path, os.O_RDWR)
        text = rmod("waits", local={"FIFO": path}, freq=50.0)
        arm.spawn("w", "waits", text=text.replace("periodic", "synchronous"))
        arm.on("w")
        status = wait_failures(arm, "deadline", name="w")
        assert status.state == "ON"
        os.write(fd, b"\x07")
        wait_for(lambda: arm.value("Y0").values[1] == 7.0, "its event")
        os.close(fd)


def test_stopped_processes_do_not_catch_up(arm, nodes):
    """SIGSTOP for 2 s, as a suspended machine: counted, and no burst behind it."""
    arm.spawn("t", "counts", out="Y0", freq=100.0)
    arm.on("t")
    tid = arm.wait_cycles("t", 5).tid
    rtpu = nodes.state("arm0").pid
    before = arm.status("t")
    nodes.stop_rtpu("arm0")
    os.kill(tid, signal.SIGSTOP)
    try:
        wait_for(lambda: _stopped(tid) and _stopped(rtpu), "both to stand still")
        now = _rt.monotonic_ns()
        wait_for(lambda: _rt.monotonic_ns() - now > 2_000_000_000, "two seconds")
    finally:
        os.kill(tid, signal.SIGCONT)
        os.kill(rtpu, signal.SIGCONT)
    after = arm.wait_cycles("t", before.cycle + 10)
    assert after.miss - before.miss >= 190
    periods = (after.now - before.now) * 1e-9 * 100.0
    assert after.cycle - before.cycle + after.miss - before.miss <= periods + 2
    assert arm.wait_event("CORE_STALLED").severity == Severity.WARNING


def _stopped(pid):
    with pathlib.Path(f"/proc/{pid}/stat").open(encoding="ascii") as file:
        return file.read().rpartition(")")[2].split()[0] == "T"


def test_timed_sections_are_in_the_status(arm):
    start(arm, overruns(busy=0.001, every=1))
    status = arm.wait_cycles("bad", 20)
    section = arm.status("bad").sections["work"]
    assert section.count >= 20
    assert 0.001 <= section.min <= section.max
    assert section.min * section.count <= section.total <= section.max * section.count
    assert status.failures["maxexec"] == 0
