"""The production build between real processes: full speed, kills, 1 kHz, full disks."""

import os
import random
import signal
import subprocess
import sys
import time

import pytest
from svar_rig import Child, counters, fill, is_cut, is_whole, names, variables, wait_for

from pbonet.svar import Flags, Table

KILLS = 200
STOP, TORN, FALSE_CUTS, LOST, UNPROVEN, READS, TURNS = 0, 1, 2, 3, 4, 5, 8
EVERYTHING = [*names(0), *names(1)]


@pytest.fixture
def table(tmp_path, monkeypatch):
    monkeypatch.setenv("PBONET_SHM_DIR", str(tmp_path))
    with Table.create("hostile", variables(32)) as made:
        yield made


def read_for_ever(shared, slot: int) -> None:
    with Table.attach("hostile") as table:
        local = table.local(f"r{slot}", os.getpid(), invar=EVERYTHING)
        while not shared[STOP]:
            flags = local.copy_in()
            shared[TURNS + slot] += 1
            shared[READS] += 1
            if flags & Flags.COPY_LOST:
                shared[LOST] += 1
                continue
            shared[TORN] += not (is_whole(local, 0) and is_whole(local, 1))
            if flags & Flags.COPY_TORN:
                shared[UNPROVEN] += 1
            else:
                shared[FALSE_CUTS] += not is_cut(local)


def write_for_ever(shared, writer: int, pause: float = 0.0) -> None:
    with Table.attach("hostile") as table:
        local = table.local(
            f"w{writer}", os.getpid(), invar=names(1 - writer), outvar=names(writer)
        )
        while local.copy_in_on() & Flags.COPY_LOST:
            pass
        counter = int(local.array(names(writer)[0])[0])  # go on where it stopped
        while not shared[STOP]:
            fill(local, writer, counter := counter + 1)
            assert local.claim() == 0
            for _ in range(100):
                local.copy_in()
                fill(local, writer, counter := counter + 1)
                assert local.commit(cycle=counter) == 0
                shared[TURNS + writer] += 1
                if pause:
                    time.sleep(pause)
            local.release()


def test_two_readers_and_two_writers_of_whom_one_is_killed_two_hundred_times(table):
    shared = counters(16)
    dice = random.Random(5)
    writers = [Child(write_for_ever, shared, w, core=w) for w in range(2)]
    readers = [Child(read_for_ever, shared, 2 + r, core=r) for r in range(2)]
    everybody = range(TURNS, TURNS + 4)
    try:
        for _ in range(KILLS):
            writer = dice.randrange(2)
            seen = int(shared[TURNS + writer])
            wait_for(lambda w=writer, n=seen: shared[TURNS + w] > n, "the writer")
            time.sleep(dice.random() * 0.004)  # anywhere in its work
            writers[writer].kill(signal.SIGKILL)
            writers[writer] = Child(write_for_ever, shared, writer, core=writer)
        seen = [int(shared[i]) for i in everybody]
        wait_for(
            lambda: all(shared[i] > n for i, n in zip(everybody, seen, strict=True)),
            "everybody to go on behind the last kill",
        )
    finally:
        shared[STOP] = 1
        ends = [child.end() for child in [*writers, *readers]]
    assert ends == [0, 0, 0, 0]
    assert shared[TORN] == 0
    assert shared[FALSE_CUTS] == 0
    assert shared[LOST] == 0
    assert shared[READS] > KILLS
    assert len(table.registers()) <= 4, "the registers of the dead were used again"


def test_a_million_reads_beside_writers_at_1_khz_never_meet_the_retry_bound(table):
    shared = counters(16)
    writers = [Child(write_for_ever, shared, w, 0.001, core=1) for w in range(2)]
    local = table.local("r", os.getpid(), invar=EVERYTHING)
    copy_in = local.copy_in
    try:
        wait_for(lambda: shared[TURNS] and shared[TURNS + 1], "the writers")
        before = int(shared[TURNS] + shared[TURNS + 1])
        while local.counters.copies < 1_000_000 or (
            shared[TURNS] + shared[TURNS + 1] < before + 1500
        ):
            for _ in range(10_000):
                if copy_in():
                    pytest.fail(f"flags {Flags(local.flags)!r}")
    finally:
        shared[STOP] = 1
        ends = [child.end() for child in writers]
    assert ends == [0, 0]
    counted = local.counters
    assert counted.torn == counted.lost == 0
    assert counted.copies >= 1_000_000


@pytest.mark.parametrize("keep", [False, True])
def test_a_swap_is_one_event_for_readers_in_other_processes(table, keep):
    """Two tasks hand the same variables to and fro; a reader never sees a mixture."""
    shared = counters(16)
    group = names(0)

    def watch() -> None:
        with Table.attach("hostile") as mine:
            local = mine.local("r", os.getpid(), invar=group, keep=keep)
            while not shared[STOP]:
                flags = local.copy_in()
                if flags & Flags.COPY_LOST or not is_whole(local, 0):
                    shared[TORN] += 1
                shared[READS] += 1
                shared[TURNS] = int(local.array(group[0])[0])

    reader = Child(watch)
    tasks = [
        table.local(f"t{i}", os.getpid(), invar=names(1), outvar=group) for i in (0, 1)
    ]
    try:
        for counter in range(1, 20_000):
            task = tasks[counter % 2]
            fill(task, 0, counter)
            task.claim()
            task.release()
        wait_for(lambda: shared[TURNS] == counter, "the reader to see the last swap")
    finally:
        shared[STOP] = 1
        assert reader.end() == 0
    assert shared[TORN] == 0
    assert shared[READS] > 0


@pytest.mark.usefixtures("table")
def test_a_low_writer_on_the_same_core_never_blocks_a_high_reader():
    """Under SCHED_FIFO whoever spins for a lower task hangs the core; nobody does."""
    shared = counters(16)

    def fifo(level: int) -> None:
        os.sched_setscheduler(0, os.SCHED_FIFO, os.sched_param(level))

    try:
        before = os.sched_getparam(0), os.sched_getscheduler(0)
        fifo(5)
        os.sched_setscheduler(0, before[1], before[0])
    except PermissionError:
        pytest.skip("no real-time rights here")

    def low() -> None:
        fifo(5)
        write_for_ever(shared, 0)

    def high() -> None:
        fifo(10)
        with Table.attach("hostile") as mine:
            local = mine.local("high", os.getpid(), invar=EVERYTHING)
            while not shared[STOP]:
                if local.copy_in() & Flags.COPY_LOST or not is_whole(local, 0):
                    shared[TORN] += 1
                shared[TURNS + 1] += 1
                time.sleep(0.0002)

    children = [Child(low, core=1), Child(high, core=1)]
    try:
        wait_for(lambda: shared[TURNS] > 500 and shared[TURNS + 1] > 500, "both")
    finally:
        shared[STOP] = 1
        ends = [child.end() for child in children]
    assert ends == [0, 0]
    assert shared[TORN] == 0


def test_tasks_outlive_the_file_and_newcomers_are_told(table):
    shared = counters(16)
    writer = Child(write_for_ever, shared, 0)
    reader = table.local("r", os.getpid(), invar=names(0))
    try:
        wait_for(lambda: shared[TURNS], "the writer")
        table.path.unlink()
        seen = int(shared[TURNS])
        wait_for(lambda: shared[TURNS] > seen + 100, "the writer to go on")
        reader.copy_in()
        assert reader.array(names(0)[0])[0] >= seen
        done = subprocess.run(
            [
                sys.executable,
                "-c",
                "from pbonet.svar import Table; Table.attach('hostile')",
            ],
            capture_output=True,
            text=True,
            check=False,
        )
        assert "SvarMissingError" in done.stderr
    finally:
        shared[STOP] = 1
        assert writer.end() == 0


def test_a_full_shared_memory_is_an_error_not_a_crash(tmp_path):
    """A real tmpfs of 64 KiB, in a mount name space of its own."""
    inside = tmp_path / "small"
    inside.mkdir()
    script = (
        "from pbonet.errors import SvarFullError\n"
        "from pbonet.svar import Table\n"
        "try:\n    Table.create('full', [])\n"
        "except SvarFullError as error:\n    print(error)\n"
        "import os; print(os.listdir(os.environ['PBONET_SHM_DIR']))\n"
    )
    enter = ["unshare", "-Urm", "sh", "-c"]
    mount = f"mount -t tmpfs -o size=64k small {inside}"
    try:
        subprocess.run([*enter, mount], check=True, capture_output=True)
    except (OSError, subprocess.CalledProcessError) as error:
        pytest.skip(f"no mount name space here: {error}")
    done = subprocess.run(
        [*enter, f'{mount} && exec "$0" -c "$1"', sys.executable, script],
        env={**os.environ, "PBONET_SHM_DIR": str(inside)},
        capture_output=True,
        text=True,
        check=True,
    )
    assert "there is no room for the table in shared memory" in done.stdout, done.stderr
    assert "No space left on device" in done.stdout
    assert done.stdout.splitlines()[-1] == "[]", "nothing is left"
