"""A table's file is cut short or overwritten: only its tasks end by it.

A process that accesses a page which its file no longer has gets SIGBUS.
"""

from __future__ import annotations

import contextlib
import os
import subprocess
import sys
from functools import partial

import pytest
from nodekit import CORE, alive, wait_gone
from watching import wait_for

from pbonet.errors import PbonetError, SvarDamagedError, TaskDiedError
from pbonet.node.restart import desired_state
from pbonet.xm.net import messages as m

SURVIVOR = """
import os, sys
from pbonet.config.model import Variable
from pbonet.errors import SvarDamagedError
from pbonet.svar import Table, survive_cuts
assert survive_cuts()
assert survive_cuts()  # harmless
variables = [Variable(name="X", type="double", nelem=100, init=[7.0])]
sound = Table.create("sound", variables)
table = Table.create("cut", variables)
for size in (4096, 0):
    os.truncate(table.path, size)
    try:
        table.registers()
    except SvarDamagedError as error:
        print(error.what)
    table.raise_illegal("cut", "me")
    try:
        table.must_be_whole()
    except SvarDamagedError as error:
        print(error.got)
sound.must_be_whole()
assert sound.read("X")[0] == 7.0
sound.destroy(), table.destroy()
print("alive")
sys.stdout.flush()
import mmap  # another bus error is no business of ours
with open("other", "w+b") as other:
    other.truncate(4096)
    memory = mmap.mmap(other.fileno(), 4096)
    other.truncate(0)
    memory[0]
"""


ZEROS = "the table was overwritten in shared memory"


def test_a_process_may_survive_it_and_dies_of_other_bus_errors(tmp_path, monkeypatch):
    monkeypatch.setenv("PBONET_SHM_DIR", str(tmp_path))
    done = subprocess.run(
        [sys.executable, "-c", SURVIVOR],
        capture_output=True,
        text=True,
        check=False,
        cwd=tmp_path,
    )
    assert (done.stdout.split("\n"), done.stderr) == (
        [ZEROS, "4096 bytes", ZEROS, "0 bytes", "alive", ""],
        "",
    )
    assert done.returncode == -7


@pytest.fixture
def arm(nodes):
    nodes.agent("arm0")
    return nodes.master("arm0", "arm", usage="shared")


@pytest.mark.parametrize("left", [0, 4096])
def test_tasks_die_with_a_clear_cause_and_the_rtpu_goes_on(
    arm, nodes, shared_memory, left
):
    other = nodes.master("arm0", "leg", usage="shared")
    other.spawn("sibling", "counts")
    other.on("sibling")
    pids = [
        arm.spawn(name, "counts", out=out).tid
        for name, out in (("a", "Y0"), ("b", "Y1"))
    ]
    arm.on("a")
    arm.on("b")
    rtpu = nodes.state("arm0").pid
    (path,) = shared_memory.glob("*.arm.svar")
    size = path.stat().st_size
    os.truncate(path, left)
    wait_gone(pids)
    cause = (
        f"{path}: the table's file was truncated while it was in use (expected {size} "
        f"bytes, got {left} bytes); its tasks will die: stop the subsystem, which "
        "removes the file, and start it again; find out who writes to shared memory "
        "files"
    )
    assert arm.wait_event("TABLE_DAMAGED").text == cause
    wait_for(lambda: len(arm.events("TASK_DIED")) == 2, "both ends to be told")
    for event in arm.events("TASK_DIED"):
        assert event.text.startswith(f"the task ended with its table: {cause}")
    wait_for(
        lambda: {s.state for s in arm.status().values()} == {"NOT-CREATED"},
        "both to be known as dead",
    )
    assert cause in arm.status()["a"].error
    for refused in (arm.value, lambda _: arm.spawn("c", "counts", out="Y2")):
        error = arm.refused(SvarDamagedError, refused, "Y0")
        assert "was truncated" in error.what
    other.wait_cycles("sibling", 20)
    assert nodes.state("arm0").pid == rtpu
    assert alive(rtpu)
    arm.stop()
    arm.ask(m.CloseTable())
    arm.open_table()
    arm.spawn("a", "counts")
    arm.on("a")
    arm.wait_cycles("a", 5)


def test_a_task_whose_ring_was_truncated_dies_alone_and_says_so(arm, shared_memory):
    for name, out in (("a", "Y0"), ("b", "Y1")):
        arm.spawn(name, "counts", out=out)
        arm.on(name)
    (path,) = shared_memory.glob("*.arm.a.ring")
    os.truncate(path, 0)
    died = arm.wait_event("TASK_DIED")
    assert died.task == "a"
    assert died.text.startswith(f"the task ended with its ring: {path}: the file, in ")
    arm.wait_cycles("b", 20)


def test_a_command_that_waits_for_such_a_task_is_told(arm, shared_memory):
    arm.spawn("a", "counts")
    (path,) = shared_memory.glob("*.svar")
    os.truncate(path, 0)
    error = arm.refused(TaskDiedError, arm.on, "a")
    assert "the task ended with its table" in error.what


@pytest.mark.parametrize("fill", [os.urandom, bytes])
def test_tasks_of_an_overwritten_table_go_to_error_with_one_sentence(
    arm, nodes, shared_memory, fill
):
    other = nodes.master("arm0", "leg", usage="shared")
    other.spawn("sibling", "counts")
    other.on("sibling")
    for name, out in (("a", "Y0"), ("b", "Y1")):
        arm.spawn(name, "counts", out=out)
        arm.on(name)
    pids = [task.tid for task in arm.status().values()]
    rtpu = nodes.state("arm0").pid
    (path,) = shared_memory.glob("*.arm.svar")
    with path.open("r+b") as file:
        file.write(fill(path.stat().st_size))
    cause = (
        "the table was overwritten in shared memory (expected what its tasks "
        "committed); stop the subsystem, which removes the file, and start it again; "
        "find the module or program that wrote there: an index out of bounds in native "
        "code, or a file opened by mistake"
    )
    wait_for(
        lambda: {s.state for s in arm.status().values()} == {"ERROR"},
        "both to be in ERROR",
    )
    assert all(cause in task.error for task in arm.status().values())
    assert arm.wait_event("TABLE_DAMAGED").text == f"{path}: {cause}"
    for refused in (arm.value, lambda _: arm.spawn("c", "counts", out="Y2")):
        error = arm.refused(SvarDamagedError, refused, "Y0")
        assert error.what == ZEROS
    other.wait_cycles("sibling", 20)
    assert all(map(alive, [rtpu, *pids]))
    assert len(arm.events("TABLE_DAMAGED")) == 1
    arm.stop()
    wait_gone(pids)
    arm.ask(m.CloseTable())
    arm.open_table()
    arm.spawn("a", "counts")
    arm.on("a")
    arm.wait_cycles("a", 5)


def is_kept_on(nodes, rtpu):
    """Tell whether an agent would turn a task on again."""
    kept = desired_state.path_of(nodes.domain, rtpu)
    return kept.exists() and '"on":["a"]' in kept.read_text()


def is_on(master):
    return {one.task: one.state for one in master.status().values()} == {"a": "ON"}


@pytest.mark.parametrize("asked", [False, True])
def test_the_rtpus_of_a_core_whose_schedule_was_truncated_start_again(
    nodes, shared_memory, asked
):
    """Their RTPU processes and tasks have it in their memory, and die.

    The agents have it, too, and read it when they are asked.
    """
    names = ("arm0", "arm1")
    nodes.agent_processes(*names)
    masters = {name: nodes.master(name, f"of_{name}") for name in names}
    for master in masters.values():
        master.spawn("a", "counts", restart="on")
        master.on("a")
    for name in names:
        wait_for(partial(is_kept_on, nodes, name), "its state")
    before = {name: nodes.state(name).pid for name in names}
    (path,) = shared_memory.glob(f"*core{CORE}")
    os.truncate(path, 0)
    if asked:
        for master in masters.values():
            with contextlib.suppress(PbonetError):
                master.status()
    for name, pid in before.items():
        nodes.wait_restarted(name, pid)
    for master in masters.values():
        wait_for(partial(is_on, master), "the task is there again")
        assert "SIGBUS" in master.wait_event("RTPU_DIED").text
        master.wait_cycles("a", 5)
    assert all(process.poll() is None for process in nodes.processes.values())
