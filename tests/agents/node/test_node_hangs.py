"""Modules that misbehave, judged by what is said of them and by who goes on."""

import os
import re
import signal
import threading
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import pytest
from c_modules import put_misbehaving
from nodekit import alive, level, others_go_first, rmod, wait_gone, wait_hung
from watching import wait_for

from pbonet.errors import (
    PbonetError,
    Severity,
    TaskDiedError,
)
from pbonet.xm.net import messages as m


def test_a_stop_says_which_tasks_failed_as_they_ended(arm):
    modules = (
        "raises_in_off", "raises_in_kill", "segfaults_in_off", "segfaults_in_kill"
    )  # fmt: skip
    for number, module in enumerate(modules):
        arm.spawn(module, module, out=f"Y{number}")
        arm.on(module)
    done = arm.stop()
    assert done.killed == []
    assert done.off == ["segfaults_in_kill", "raises_in_kill"]
    crash = "the task ended by itself: signal SIGSEGV (segmentation fault)"
    places = {name: text.rpartition(" (/")[0] or text for name, text in
              done.failed.items()}  # fmt: skip
    assert places == {
        "raises_in_off": "off: KeyError: 'off does not work'",
        "raises_in_kill": "kill: KeyError: 'kill does not work'",
        "segfaults_in_off": f"off: {crash}",
        "segfaults_in_kill": f"kill: {crash}",
    }
    assert not any(task.state != "NOT-CREATED" for task in arm.status().values())
    assert {one.task for one in arm.events("TASK_DIED")} == {*modules[2:]}
    assert {one.task for one in arm.events("SIGNAL_FAILED")} >= {*modules[:2]}
    assert "with an error: " in arm.wait_event("STOPPED").text


def test_of_two_stops_at_once_none_says_that_the_other_made_tasks_fail(arm, nodes):
    for name in ("slow", "slower"):
        arm.spawn(name, "ends_slowly", out=f"Y{len(name) - 4}")
        arm.on(name)

    def stop(_):
        return nodes.client().call("arm0", m.Stop(subsystem="arm"), m.Stopped)

    with ThreadPoolExecutor(2) as threads:
        both = list(threads.map(stop, range(2)))
    turned_off = sorted(name for one in both for name in one.off)
    assert turned_off == ["slow", "slower"], "each by one of them, which may share them"
    assert [one.failed for one in both] == [{}, {}]


def test_kill_says_that_the_task_crashed_in_it(arm):
    arm.spawn("bad", "segfaults_in_kill")
    error = arm.refused(TaskDiedError, arm.kill, "bad")
    assert "SIGSEGV" in str(error)
    assert arm.wait_event("TASK_DIED", "bad").place.endswith("in kill")


def test_children_end_when_the_rtpu_process_is_killed(arm, tmp_path):
    file = tmp_path / "pids"
    arm.spawn("bad", "leaves_children", local={"PIDS": file})
    old = arm.nodes.state("arm0").pid
    os.kill(old, signal.SIGKILL)
    arm.nodes.wait_restarted("arm0", old)
    wait_gone(map(int, file.read_text().split()))


@pytest.mark.parametrize("which", ["task", "fork server"])
def test_a_stopped_process_does_not_hold_a_kill_up(arm, which):
    tid = arm.spawn("bad", "counts").tid
    server = arm.nodes.fork_server("arm0")
    os.kill(tid if which == "task" else server, signal.SIGSTOP)
    arm.kill("bad", limit=0.5)
    wait_gone([tid])
    assert arm.status() == {}
    arm.spawn("bad", "counts")  # the fork server works


@pytest.mark.parametrize(
    ("scheduler", "module", "maxc", "backend"),
    [
        ("MUF", "hangs_in_cycle", "", "auto"),
        ("MUF", "hangs_in_cycle", "", "park"),
        ("MUF", "hangs_in_c", "MAXC 0.001\n", "auto"),
        ("EDF", "hangs_in_c", "", "auto"),
        ("RM", "hangs_in_cycle", "MAXC 0.001\n", "auto"),
    ],
)
def test_a_more_urgent_task_that_hangs_blocks_nobody(
    nodes, scheduler, module, maxc, backend
):
    """It has a higher rate than the other task, so it comes first until it hangs."""
    nodes.agent("arm0", backend=backend)
    arm = nodes.master("arm0", "arm", scheduler=scheduler)
    arm.spawn("good", "counts", out="Y7", freq=40.0)
    text = rmod(module, freq=200.0).replace("FREQ 200\n", f"FREQ 200\n{maxc}")
    tid = arm.spawn("bad", module, text=text).tid
    arm.on("good")
    arm.on("bad")
    event = arm.wait_event("HANGS", "bad")
    assert event.severity == Severity.ERROR
    assert "does not return" in event.text
    if arm.rtpu_status().backend == "fifo":
        assert os.sched_getscheduler(tid) & ~os.SCHED_RESET_ON_FORK == os.SCHED_OTHER
    arm.wait_cycles("good", 20)
    assert arm.ask(m.Freq(task="good", hz=50.0), float) == 50.0
    arm.wait_cycles("good", 20)
    arm.off("good")
    arm.on("good")
    arm.spawn("late", "counts", out="Y6", freq=50.0)
    arm.on("late")
    arm.wait_cycles("late", 5)
    arm.kill("bad")
    assert "did not end within 1 s" in arm.wait_event("FORCED", "bad").text
    assert not alive(tid)
    arm.wait_cycles("good", 5)
    assert len(arm.events("HANGS", "bad")) == 1


@pytest.mark.parametrize("kind", ["deferrable", "sporadic", "background"])
def test_an_event_that_does_not_end_blocks_nobody(arm, kind):
    """A server's event hangs after its capacity; background tasks go after commands."""
    arm.spawn("good", "counts", out="Y7", freq=40.0)
    text = rmod("hangs_when_served", freq=20.0).replace("periodic", kind)
    timed = "" if kind == "background" else "FREQ 20\nCAPACITY 0.004\n"
    text = text.replace("FREQ 20\n", timed)
    tid = arm.spawn("bad", "hangs_when_served", text=text).tid
    arm.on("good")
    arm.on("bad")
    if kind == "background":
        used = Path(f"/proc/{tid}/schedstat")  # nanoseconds on the core come first
        wait_for(lambda: int(used.read_text().split()[0]) > 2e8, "its CPU time")
    else:
        assert "does not return" in arm.wait_event("HANGS", "bad").text
        arm.wait_cycles("good", 80)  # it is not taken for events without end later
    assert arm.ask(m.Freq(task="good", hz=50.0), float) == 50.0
    arm.wait_cycles("good", 20)
    arm.off("good")
    arm.on("good")
    arm.kill("bad", limit=1.0)
    assert arm.wait_event("FORCED", "bad").severity == Severity.WARNING
    assert not alive(tid)
    arm.wait_cycles("good", 5)
    assert len(arm.events("HANGS", "bad")) == (kind != "background")


@pytest.mark.parametrize(
    ("scheduler", "module", "kind"),
    [
        ("MUF", "hangs_in_sync", "synchronous"),
        ("EDF", "hangs_in_sync", "synchronous"),
        ("RM", "hangs_in_sync", "sporadic"),
        ("MUF", "never_waits", "synchronous"),
    ],
)
def test_a_sync_that_computes_or_does_not_wait_blocks_nobody(
    nodes, scheduler, module, kind
):
    """It has a higher rate than the other task, so it comes first until it hangs."""
    nodes.agent("arm0")
    arm = nodes.master("arm0", "arm", scheduler=scheduler)
    arm.spawn("good", "counts", out="Y7", freq=40.0)
    text = rmod(module, freq=100.0).replace("periodic", kind)
    if kind == "sporadic":
        text = text.replace("FREQ 100\n", "FREQ 100\nCAPACITY 0.002\n")
    tid = arm.spawn("bad", module, text=text).tid
    arm.on("good")
    arm.on("bad")
    assert arm.wait_event("HANGS", "bad").text.startswith("`sync` of module")
    if arm.rtpu_status().backend == "fifo":
        assert os.sched_getscheduler(tid) & ~os.SCHED_RESET_ON_FORK == os.SCHED_OTHER
    others_go_first(arm)


def test_a_cycle_hangs_after_the_time_that_the_subsystem_declares(nodes):
    nodes.agent("arm0")
    arm = nodes.master("arm0", "arm", hangtime=1.0)
    arm.spawn("bad", "hangs_in_cycle", freq=100.0)
    arm.on("bad")
    text = arm.wait_event("HANGS", "bad").text
    assert float(re.search(r"has taken (\S+) s of CPU time", text)[1]) >= 1.0


def test_a_task_that_is_only_slow_gets_its_level_back(arm):
    """Its tenth cycle takes longer than one may before it counts as hanging."""
    arm.spawn("slow", "slow_once", out="Y0", freq=200.0)
    arm.on("slow")
    arm.wait_event("HANGS", "slow")
    tid = arm.wait_cycles("slow", 20).tid
    if arm.rtpu_status().backend == "fifo":
        assert level(tid) > 1
    assert len(arm.events("HANGS", "slow")) == 1


def test_extremes_restart_on_request_and_the_profile_keeps_all_cycles(arm):
    arm.spawn("slow", "slow_once", out="Y0", freq=200.0)
    arm.on("slow")
    arm.wait_cycles("slow", 20)
    assert arm.status("slow").max_c >= 0.5
    asked = arm.ask(m.Status(task="slow", reset=True), m.RtpuStatus).tasks[0]
    assert asked.max_c >= 0.5, "the extremes until then"
    now = wait_for(
        lambda: (one := arm.status("slow")).max_c < 0.5 and one, "new extremes"
    )
    assert 0 < now.min_c <= now.max_c
    assert now.first_c == asked.first_c
    assert arm.ask(m.Profile(), list[m.TaskProfile])[0].most >= 0.5
    arm.off("slow")
    arm.on("slow")
    arm.wait_cycles("slow", 2)
    assert arm.status("slow").max_c < 0.5


def test_stop_is_bounded_and_says_what_was_forced(arm):
    arm.spawn("good", "counts", out="Y1")
    arm.spawn("bad", "hangs_in_off", out="Y2")
    arm.spawn("worse", "hangs_in_c", out="Y3")
    arm.rank_low("worse")
    for name in ("good", "bad", "worse"):
        arm.on(name)
    wait_hung(arm, "worse")
    pids = [one.tid for one in arm.status().values()]
    stopped = arm.stop(6.0)
    assert sorted(stopped.killed) == ["bad", "worse"]
    assert "good" in stopped.off
    assert arm.status() == {}
    assert not any(map(alive, pids))


def meanwhile(do, *args, **more):
    """Do something that fails in a thread; return the thread and the error's list."""
    errors = []

    def run():
        try:
            do(*args, **more)
        except PbonetError as error:
            errors.append(error)

    thread = threading.Thread(target=run)
    thread.start()
    return thread, errors


def test_stop_ends_a_task_in_init(arm):
    thread, errors = meanwhile(arm.spawn, "bad", "hangs_in_init", limit=30.0)
    wait_for(lambda: "bad" in arm.status(), "its process")
    assert arm.stop(0.5).killed == ["bad"]
    thread.join()
    assert isinstance(errors[0], TaskDiedError)
    assert arm.status() == {}


@pytest.mark.parametrize("how", ["stop", "kill"])
def test_the_end_waits_for_no_command_under_way(arm, how):
    """Its limit is its own, however long the other command may take."""
    arm.spawn("bad", "hangs_in_on")
    thread, errors = meanwhile(arm.on, "bad", limit=3000.0)
    assert arm.wait_event("OUTPUT", "bad").text == "in on"
    if how == "stop":
        assert arm.stop(0.5).killed == ["bad"]
    else:
        assert arm.kill("bad", limit=0.5).state == "NOT-CREATED"
    thread.join()
    assert isinstance(errors[0], TaskDiedError)
    assert arm.status() == {}


def test_a_task_that_prints_a_lot_never_waits(arm):
    arm.spawn("bad", "prints_a_lot", freq=100.0)
    arm.on("bad")
    arm.wait_cycles("bad", 100)
    arm.off("bad")

    def texts():
        return [event.text for event in arm.events("OUTPUT", "bad")]

    flood = "held back: printed too fast"
    wait_for(lambda: any(flood in text for text in texts()), "what was held back")
    assert texts()[0] == "hello from init"
    assert any("line 0 of cycle 1" in text for text in texts())
    assert len(texts()) < 1000


def test_a_task_that_warns_always_floods_nobody(arm):
    arm.spawn("bad", "warns_always", freq=500.0)
    arm.on("bad")
    arm.wait_cycles("bad", 500)
    wait_for(lambda: arm.status("bad").warn >= 490, "the count of its warnings")

    def told():
        return arm.events("WARNING", "bad") + arm.events("SIGNAL", "bad")

    held = "notices held back"
    wait_for(lambda: any(held in event.text for event in told()), "what was held back")
    assert len(told()) < arm.status("bad").warn
    newest = int(arm.status("bad").warning.split()[-1])
    assert newest > 400, "the newest warning is shown, not the first"
    assert arm.off("bad").state == "OFF"


@pytest.mark.parametrize("which", [signal.SIGTERM, signal.SIGINT])
def test_a_task_in_c_that_is_nearly_always_busy_is_told_to_end(arm, nodes, which):
    """The signal comes amid a cycle, where no wait notices it."""
    put_misbehaving(nodes.library)
    tid = arm.spawn("bad", "c_works", freq=50.0).tid
    arm.on("bad")
    arm.wait_cycles("bad", 3)
    os.kill(tid, which)
    assert which.name in arm.wait_event("ENDING", "bad").text
    arm.wait_event("TASK_DIED", "bad")
    assert not alive(tid)


def test_a_deaf_task_is_killed_all_the_same(arm):
    tid = arm.spawn("bad", "ignores_sigterm").tid
    arm.on("bad")
    os.kill(tid, signal.SIGTERM)
    arm.wait_cycles("bad", 5)
    assert arm.kill("bad").state == "NOT-CREATED"
    assert not alive(tid)
