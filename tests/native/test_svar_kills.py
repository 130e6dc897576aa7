"""A process that dies at any step of a change leaves the old table or the new one.

`svar_steps` is built from the same headers with a hook between any two words copied to
shared memory and around every publishing store; it kills itself at the step it is told.
The table's other users are the production build: a reader in a process of its own that
looks all the time, and this process, which looks at what is left and goes on with it.
"""

import os
import subprocess
from functools import partial

import numpy as np
import pytest
from svar_rig import (
    Child,
    build,
    counters,
    fill,
    is_cut,
    is_whole,
    names,
    variables,
    wait_for,
)

from pbonet.errors import SvarError
from pbonet.svar import Flags, LocalTable, Table

WORDS = 3
STOP, READS, TORN, FALSE_CUTS, TROUBLE = range(5)


@pytest.fixture(scope="module")
def steps(tmp_path_factory):
    return build("svar_steps.c", tmp_path_factory.mktemp("steps") / "steps")


def watch(table_name: str, shared: np.ndarray, *, groups: bool) -> None:
    """Read cuts until told to stop, and count what must not be.

    Args:
        table_name: The table.
        shared: Where to count.
        groups: False when an operator sets variables: then only each of them is whole.
    """
    everything = [name for writer in range(2) for name in names(writer)]
    with Table.attach(table_name) as table:
        local = table.local("watch", os.getpid(), invar=everything)
        while not shared[STOP]:
            flags = local.copy_in()
            shared[TROUBLE] += bool(flags & Flags.COPY_LOST)
            if groups:
                whole = is_whole(local, 0) and is_whole(local, 1)
                proven = not flags & Flags.COPY_TORN
                shared[FALSE_CUTS] += proven and not is_cut(local)
            else:
                arrays = [local.array(name) for name in everything]
                whole = all((array == array[0]).all() for array in arrays)
            shared[TORN] += not whole
            shared[READS] += 1


@pytest.fixture
def table(request, tmp_path, monkeypatch):
    """Make a table with a reader beside it that never stops looking."""
    monkeypatch.setenv("PBONET_SHM_DIR", str(tmp_path))
    groups = getattr(request, "param", "groups") == "groups"
    shared = counters(5)
    with Table.create("kills", variables(WORDS)) as made:
        child = Child(lambda: watch("kills", shared, groups=groups))
        try:
            wait_for(lambda: shared[READS], "the first read")
            yield made
            seen = int(shared[READS])
            wait_for(lambda: shared[READS] > seen, "a read behind the last kill")
        finally:
            shared[STOP] = 1
            assert child.end() == 0
        assert shared[TORN] == 0
        assert shared[FALSE_CUTS] == 0
        assert shared[TROUBLE] == 0


class Steps:
    """Runs one kind of change again and again, killed one step later each time."""

    def __init__(self, program, table: Table, change: str, writer: int = 0) -> None:
        self.command = [str(program), str(table.path), change, str(writer)]
        self.step = 0
        self.counter = 1000

    def __iter__(self):
        return self

    def __next__(self) -> int:
        """Kill at the next step and return the counter; stop when there is none."""
        self.step += 1
        self.counter += 10
        done = subprocess.run(
            [*self.command, str(self.step), str(self.counter)],
            capture_output=True,
            check=False,
            timeout=20,
        )
        if done.returncode == 0:
            assert self.step > 3
            raise StopIteration
        assert done.returncode == -9, done.stderr
        return self.counter


def value(table: Table, writer: int = 0) -> int:
    """Return the counter that the whole group holds."""
    held = {int(x) for name in names(writer)[:-1] for x in table.read(name)}
    assert len(held) == 1, held
    return held.pop()


def owner(table: Table, writer: int = 0) -> tuple[int, bool]:
    """Return the register behind the group, and whether it is owned: one for all."""
    held = {
        (info.register, info.owner is not None)
        for info in map(table.info, names(writer))
    }
    assert len(held) == 1, held
    return held.pop()


@pytest.mark.parametrize("change", ["commit", "one"])
def test_a_commit_killed_at_any_step_is_whole_or_not_at_all(table, steps, change):
    results = set()
    for counter in Steps(steps, table, change):
        found = value(table)
        results.add(counter - found)
        assert owner(table)[1], "the dead owner stands until somebody reaps it"
        assert table.reap("writer0") == names(0)
    assert results <= {0, 1}
    assert results == ({1} if change == "one" else {0, 1}), "both sides were met"


def take(table: Table, task: LocalTable, counter: int) -> None:
    """Have a production task take the first group over, and give it up."""
    fill(task, 0, counter)
    assert task.claim() == 0, "a dead rival is taken over and blocks nobody"
    assert value(table) == counter
    task.release()


def test_a_claim_killed_at_any_step_moves_all_variables_or_none(table, steps):
    task = table.local("before", os.getpid(), invar=names(1), outvar=names(0))
    old = 1
    take(table, task, old)
    before = owner(table)
    sides = set()
    for counter in Steps(steps, table, "claim"):
        moved = owner(table) != before
        sides.add(moved)
        assert value(table) == (counter if moved else old)
        old = counter + 1
        take(table, task, old)
        assert owner(table) == before
    assert sides == {True, False}


def test_a_release_killed_at_any_step_frees_all_variables_or_none(table, steps):
    sides = set()
    for counter in Steps(steps, table, "release"):
        assert value(table) == counter, "values stand"
        sides.add(owner(table)[1])
        table.reap("writer0")
        assert owner(table)[1] is False
    assert sides == {True, False}


@pytest.mark.parametrize("table", ["variables"], indirect=True)
@pytest.mark.parametrize("moves", [False, True])
def test_an_operator_killed_at_any_step_leaves_old_or_new(table, steps, moves):
    name = names(0)[0]
    task = table.local("t", os.getpid(), invar=names(1), outvar=names(0))
    sides = set()
    old = 0
    for counter in Steps(steps, table, "set"):
        found = set(table.read(name).tolist())
        assert found in ({old}, {counter})
        sides.add(found == {counter})
        old = found.pop()
        if moves:
            old = counter + 1
            take(table, task, old)
        else:
            info = table.info(name)
            assert (info.time_ns == 0) == (old == 0), "value and stamp move together"
    assert sides == {True, False}


def test_registers_of_the_killed_are_used_again(table, steps):
    for _ in Steps(steps, table, "enter"):
        assert len(table.registers()) <= 2
        task = table.local("t", os.getpid(), outvar=names(0))
        assert [r.task for r in table.registers()] == ["t"], "the dead one is swept"
        task.close()


def test_a_task_killed_at_any_step_of_being_turned_on_again_moves_all_or_none(
    table, steps
):
    sides = set()
    for counter in Steps(steps, table, "again"):
        found = value(table)
        assert found in {counter - 1, counter}
        moved = {table.info(name).owner for name in names(0)}
        assert moved == ({"writer0"} if found == counter else {None})
        sides.add(found == counter)
        with table.local("heir", os.getpid(), invar=names(1), outvar=names(0)) as heir:
            take(table, heir, counter + 1)
        assert len(table.registers()) <= 3, "what the dead left is used again"
    assert sides == {True, False}


@pytest.mark.parametrize("change", ["raise", "clear"])
def test_a_cause_stands_whole_or_not_at_all_and_goes_when_the_dead_is_reaped(
    table, steps, change
):
    looker = table.local("looker", os.getpid())
    sides = set()
    killed = Steps(steps, table, change)
    for counter in killed:
        texts = {(c.cause, c.raiser, c.machine) for c in table.illegal}
        sides.add(bool(texts))
        ed = {"raise": "raised", "clear": "cleared"}[change]
        assert texts <= {(f"killed while it {ed}", str(counter), "here")}
        if change == "clear":
            assert looker.illegal or not texts, "up too long at most, never too short"
        assert table.clear_illegal(str(counter), machine="here") == len(texts)
        assert table.illegal == []
        assert not looker.illegal
        table.raise_illegal("mine", "me")
        assert looker.illegal
        assert [c.cause for c in table.illegal] == ["mine"]
        table.clear_illegal("me")
        assert not looker.illegal
    assert sides == {True, False}
    table.clear_illegal(str(killed.counter), machine="here")  # of the one that lived
    for n in range(64):
        table.raise_illegal(f"{n}", "me")
    assert [c.cause for c in table.illegal] == [str(n) for n in range(64)], (
        "no entry is lost to the dead"
    )
    assert table.clear_illegal("me") == 64


def test_a_claimer_that_stops_blocks_claimers_for_two_seconds_and_nobody_else(
    table, steps
):
    other = table.local("other", os.getpid(), invar=names(0), outvar=names(1))
    heir = partial(table.local, "heir", os.getpid(), invar=names(1), outvar=names(0))
    fill(other, 1, 1)
    other.claim()
    stopped = subprocess.Popen([str(steps), str(table.path), "claim", "0", "-9", "5"])
    try:
        _, status = os.waitpid(stopped.pid, os.WUNTRACED)
        assert os.WIFSTOPPED(status)
        fill(other, 1, 2)
        assert other.commit() == 0
        assert table.read(names(1)[0]).tolist() == [2] * WORDS
        with pytest.raises(SvarError, match="lock between claimers was not free"):
            heir()
    finally:
        stopped.kill()
        stopped.wait()
    with heir() as task:
        take(table, task, 7)
