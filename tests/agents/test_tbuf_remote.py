"""Links between two machines: two real agents, each with shared memory of its own."""

import json
import os
import subprocess
import sys
from concurrent.futures import ThreadPoolExecutor
from contextlib import suppress
from pathlib import Path

import pytest
from tbuf_rig import END, Pair, flows
from watching import wait_for

from pbonet.node.rt import _rt
from pbonet.node.wire import process_setup

pytestmark = pytest.mark.timeout(300)


@pytest.fixture
def pair():
    """Two machines that are linked by zenoh alone."""
    both = Pair()
    try:
        both.start()
        yield both
    finally:
        both.close()


def ages(reader, seconds):
    """Wait until what a reader has is so old, and nothing newer has come."""

    def old():
        found = reader.look()
        return not found["new"] and found["age"] is not None and found["age"] > seconds

    wait_for(old, f"an age of {seconds} s")


def test_records_arrive_whole_whoever_comes_first(pair):
    reader = pair.b.reader("vision0:x", "(64,)f8")
    assert reader.look()["new"] is False
    writer = pair.a.writer(dtype="(64,)f8")
    first = flows(reader)
    later = wait_for(
        lambda: (now := reader.look())["number"] > first["number"] + 100 and now,
        "a hundred records more",
    )
    assert later["values"] == [later["number"]], "the newest whole record"
    writer.kill()
    ages(reader, 0.5)
    wait_for(lambda: pair.a.links() == [], "the buffer of the dead writer to go")
    pair.a.writer(dtype="(64,)f8")
    wait_for(lambda: flows(reader)["restarts"] == 1, "records of the other writer")


def levels(pid):
    """Return the real-time levels of a process's threads."""
    real_time = os.SCHED_FIFO | os.SCHED_RESET_ON_FORK
    found = set()
    for path in Path(f"/proc/{pid}/task").iterdir():
        thread = int(path.name)
        with suppress(ProcessLookupError):  # it has ended meanwhile
            if os.sched_getscheduler(thread) == real_time:
                found.add(os.sched_getparam(thread).sched_priority)
    return found


def test_who_carries_records_goes_before_all_but_tasks_and_commands(pair):
    pair.a.writer()
    flows(pair.b.reader("vision0:x"))
    with ThreadPoolExecutor(1) as pool:
        allowed = pool.submit(process_setup.go_before_others).result()
    expected = {process_setup.LINK_LEVEL} if allowed else set()
    for machine in (pair.a, pair.b):
        wait_for(
            lambda pid=machine.agent.pid: levels(pid) == expected, "the carrier's level"
        )
    assert process_setup.LINK_LEVEL < _rt.COMMAND_LEVEL


def test_killed_agents_come_back_without_anybody(pair):
    writer, reader = pair.a.writer(), pair.b.reader("vision0:x")
    flows(reader)
    for machine in (pair.a, pair.b):
        machine.kill_agent()
        ages(reader, 0.3)
        machine.start()
        assert flows(reader)["restarts"] == 0
    assert writer.process.poll() is None


def test_another_agent_of_the_machine_takes_over(pair):
    pair.a.writer()
    reader = pair.b.reader("vision0:x")
    flows(reader)
    pair.b.start_another("arm1")
    pair.b.kill_agent()
    ages(reader, 0.05)
    up = ["link vision0:x to arm1 is up"]
    wait_for(lambda: pair.events(pair.a, "LINK_UP")[-1:] == up, "the second agent")
    assert flows(reader)["restarts"] == 0


def test_a_killed_reader_leaves_its_place(pair):
    pair.a.writer()
    reader = pair.b.reader("vision0:x")
    flows(reader)
    reader.kill()
    second = pair.b.reader("vision0:x")
    found = flows(second)
    assert found["values"] == [found["number"]]


def test_a_cut_is_told_by_the_age_and_heals(pair):
    pair.a.writer()
    reader = pair.b.reader("vision0:x")
    flows(reader)
    pair.cable.cut()
    ages(reader, 1.0)
    wait_for(lambda: pair.events(pair.b, "LINK_DOWN"), "the agent to say so")
    pair.cable.heal()
    found = flows(reader)
    assert found["restarts"] == 0
    assert found["values"] == [found["number"]]
    (text,) = set(pair.events(pair.b, "LINK_UP"))
    assert text == "link vision0:x from vision0 is up"


def test_the_other_byte_order(pair):
    pair.a.writer(dtype=">f8", period=0.01)
    reader = pair.b.reader("vision0:x", "<f8")
    found = flows(reader)
    assert found["values"] == [found["number"]]
    assert found["dtype"] == "<f8"


def test_other_records_are_told_and_not_taken(pair):
    pair.a.writer(dtype="(3,)f8", period=0.01)
    reader = pair.b.reader("vision0:x", "(4,)f8")
    (text,) = set(wait_for(lambda: pair.events(pair.b, "LINK_MISFIT"), "the refusal"))
    assert text == (
        "records of link vision0:x are refused: vision0:x: the two ends of the link "
        "have different records (expected ('<f8', (4,)), got ('<f8', (3,))); give "
        "writer and reader the same fields and sizes"
    )
    assert reader.look()["number"] == 0


def test_clocks_far_apart():
    """The writer's machine started 5000 s earlier; ages are as if it had not."""
    clock = "unshare", "--time", "--monotonic", "5000"
    if subprocess.run([*clock, "true"], capture_output=True, check=False).returncode:
        pytest.skip("a clock of one's own needs the right to make time namespaces")
    pair = Pair(*clock)
    try:
        pair.start()
        reader = pair.b.reader("vision0:x")
        pair.a.writer()
        first = flows(reader)
        found = wait_for(
            lambda: (now := reader.look())["number"] > first["number"] + 3000 and now,
            "clocks to have been measured",
        )
        assert found["apart"] == pytest.approx(5000, abs=5)
        assert 0 < found["age"] < 5
    finally:
        pair.close()


def refused(machine, code):
    """Return the error that a program on a machine ends with."""
    settings = json.dumps({"home": machine.name, "domain": machine.domain})
    done = subprocess.run(
        [sys.executable, "-c", END + code, settings],
        env=machine.env,
        capture_output=True,
        text=True,
        check=False,
    )
    assert done.returncode == 1, done.stdout
    return done.stderr.splitlines()[-1]


def test_the_one_reader_and_the_one_writer_count_everywhere(pair):
    pair.a.writer()
    reader = pair.b.reader("vision0:x")
    flows(reader)
    error = refused(pair.a, 'tbuf.Reader("vision0:x", "f8")')
    assert "the link already has a reader (got agent vision0 for arm0)" in error
    code = 'xm.live_on("vision0", domain=settings["domain"]); tbuf.Writer("x", "f8")'
    error = refused(pair.b, code)
    assert "the link already has a writer (got agent arm0 from vision0)" in error
