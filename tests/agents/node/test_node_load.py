"""Many tasks at once, and many after each other: nothing runs out, nothing is left."""

import gc
import os
import signal
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import pytest
from nodekit import svar, wait_gone
from watching import wait_for

from pbonet.errors import PbonetError

TASKS = 64
GROWTH = 4 * 1024
"""KiB by which a process may grow: answers and events that are kept, up to a limit."""


class Held:
    """What the processes of an RTPU hold, and what stands in shared memory."""

    def __init__(self, nodes, folder):
        pids = (os.getpid(), nodes.state("arm0").pid, nodes.fork_server("arm0"))
        self.files = sorted(path.name for path in folder.iterdir())
        self.descriptors = [len(list(Path(f"/proc/{p}/fd").iterdir())) for p in pids]
        self.resident = [resident(pid) for pid in pids[1:]]

    def no_more_than(self, other):
        """Tell whether as few descriptors are open: the last ones close soon."""
        gc.collect()  # closes what earlier tests have left in this process
        pairs = zip(self.descriptors, other.descriptors, strict=True)
        return all(now <= then for now, then in pairs)


def resident(pid):
    """Return how much memory of a process is present, in KiB."""
    text = Path(f"/proc/{pid}/status").read_text()
    return int(text.split("VmRSS:")[1].split()[0])


def live_and_die(arm, count):
    """Spawn tasks that end in all ways there are."""
    for _ in range(count):
        arm.spawn("good", "counts")
        arm.on("good")
        arm.kill("good")
        for module in ("raises_in_init", "dies_on_import"):
            with pytest.raises(PbonetError):
                arm.spawn("bad", module)
        tid = arm.spawn("victim", "counts").tid
        os.kill(tid, signal.SIGKILL)
        wait_for(lambda: arm.status("victim").tid == 0, "its end is known")
        arm.kill("victim")


@pytest.mark.slow
@pytest.mark.timeout(300)
def test_nothing_is_left_of_tasks_that_ended(arm, nodes, shared_memory):
    live_and_die(arm, 5)
    before = Held(nodes, shared_memory)
    live_and_die(arm, 50)
    wait_for(lambda: Held(nodes, shared_memory).no_more_than(before), "the last files")
    after = Held(nodes, shared_memory)
    assert after.files == before.files
    for old, new in zip(before.resident, after.resident, strict=True):
        assert new - old < GROWTH


@pytest.mark.slow
@pytest.mark.timeout(300)
def test_as_many_tasks_as_one_likes(nodes):
    """All of 64 tasks on one RTPU are turned on, cycle, are turned off, and end."""
    nodes.agent("arm0")
    arm = nodes.master("arm0", "arm", table=False)
    arm.open_table(svar(TASKS))
    names = [f"t{i}" for i in range(TASKS)]

    def spawn(i):
        return arm.spawn(names[i], "counts", out=f"Y{i}", freq=10.0, limit=60.0)

    with ThreadPoolExecutor(4) as several:
        pids = [one.tid for one in several.map(spawn, range(TASKS))]
    assert len(set(pids)) == TASKS
    for name in names:
        assert arm.on(name).state == "ON"
    first = arm.status()
    wait_for(
        lambda: all(
            one.cycle > first[name].cycle + 1 for name, one in arm.status().items()
        ),
        "two cycles of each",
    )
    for name in names[:8]:
        assert arm.off(name).state == "OFF"
    for name in names[:16]:
        assert arm.kill(name).state == "NOT-CREATED"
    assert {one.state for one in arm.status().values()} == {"ON"}
    stopped = arm.stop(60.0)
    assert stopped.killed == []
    assert stopped.off == names[:15:-1]  # the last one on goes first
    wait_gone(pids)
    assert arm.status() == {}
