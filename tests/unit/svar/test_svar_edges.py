"""The table at its edges: numbers that wrap, processes out of sight, damage."""

import os
import struct
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

from pbonet.config.model import Variable
from pbonet.errors import SvarDamagedError, SvarFullError, SvarMissingError
from pbonet.svar import Flags, Table, _svar

ME = os.getpid()
VARIABLES = [Variable(name=f"V{i}", type="double", nelem=3) for i in range(4)]
LIVE, REGS, DIR, DIR_STRIDE, ARENA = range(80, 120, 8)  # places in the header
REG_BYTES, SLOTS, STRIDE = 256, 72, 80  # of a register's description
WRAP = 1 << 56  # a head has 56 bits for its number


@pytest.fixture
def table(tmp_path, monkeypatch):
    monkeypatch.setenv("PBONET_SHM_DIR", str(tmp_path))
    with Table.create("arm", VARIABLES) as made:
        yield made


def word(path: Path, at: int) -> int:
    with path.open("rb") as file:
        file.seek(at)
        return struct.unpack("<Q", file.read(8))[0]


def patch(path: Path, at: int, value: int) -> None:
    with path.open("r+b") as file:
        file.seek(at)
        file.write(struct.pack("<Q", value))


def age(path: Path, at: int) -> None:
    """Let a head be three commits away from the first number."""
    patch(path, at, (WRAP - 3) << 8 | word(path, at) & 0xFF)


def test_commits_go_on_behind_the_last_number(table):
    age(table.path, word(table.path, REGS) + REG_BYTES)  # the first free register
    writer = table.local("w", ME, outvar=["V0"])
    reader = table.local("r", ME, invar=["V0", "V1"])
    writer.claim()
    numbers = []
    for value in range(6):
        writer.array("V0")[:] = value
        assert writer.commit() == 0
        assert reader.copy_in() == 0
        assert reader.array("V0").tolist() == [value] * 3
        numbers.append(writer.out_number)
    assert numbers == [WRAP - 1, 0, 1, 2, 3, 4]


def test_generations_go_on_behind_the_last_number(table):
    live = word(table.path, LIVE)
    age(table.path, live)
    slot = word(table.path, live) % 4 * word(table.path, DIR_STRIDE)
    patch(table.path, word(table.path, DIR) + slot + 8, WRAP - 3)
    reader = table.local("r", ME, invar=["V0"])
    tasks = [table.local(f"t{i}", ME, outvar=["V0"]) for i in range(2)]
    for value in range(6):
        task = tasks[value % 2]
        task.array("V0")[:] = value
        assert task.claim() == 0
        assert reader.copy_in() == 0
        assert reader.array("V0").tolist() == [value] * 3
        task.release()
    assert table.generation < 100
    for value in range(6):
        table.write("V0", [value] * 3)
        assert table.read("V0").tolist() == [value] * 3


# -- processes ------------------------------------------------------------------------

THIEF = """
import os
from pbonet.errors import SvarOwnerError
from pbonet.svar import Table
table = Table.attach("arm")
task = table.local("thief", os.getpid(), outvar=["V0"])
held = []
try:
    while True:
        held.append(os.dup(0))
except OSError:
    pass
try:
    task.claim()
    print("stolen")
except SvarOwnerError as error:
    print(error)
try:
    table.reap("owner")
    print("reaped")
except SvarOwnerError as error:
    print(error)
"""


def test_an_owner_that_cannot_be_looked_at_counts_as_alive(table):
    """A claimer without a descriptor left cannot open /proc; it steals nothing."""
    owner = table.local("owner", ME, outvar=["V0"])
    owner.claim()
    done = subprocess.run(
        [sys.executable, "-c", THIEF],
        capture_output=True,
        text=True,
        check=True,
        stdin=subprocess.DEVNULL,
    )
    assert "thief cannot write V0: another task does" in done.stdout
    assert "the claims of owner remain, because its process runs" in done.stdout
    assert owner.commit() == 0


def test_a_process_is_known_by_its_start_and_gone_when_it_has_ended():
    child = subprocess.Popen(["sleep", "60"])
    try:
        assert 0 < _svar.process_start(child.pid) < 1 << 63
    finally:
        child.kill()
        os.waitid(os.P_PID, child.pid, os.WEXITED | os.WNOWAIT)
        assert _svar.process_start(child.pid) == 0, "a zombie does nothing more"
        child.wait()
    assert _svar.process_start(child.pid) == 0


def test_a_register_that_is_somebody_elses_is_not_given_up(table):
    """Its former holder closes late: the register's number is used again by then."""
    child = subprocess.Popen(["sleep", "60"])
    late = table.local("late", child.pid, outvar=["V0"])
    late.claim()
    child.kill()
    child.wait()
    table.write("V0", [1, 1, 1])  # nothing stands in the dead one's register now
    heir = table.local("heir", ME, outvar=["V1"])
    heir.claim()
    assert [r.task for r in table.registers()] == ["heir"], "the register is used again"
    late.close()
    assert table.info("V1").owner == "heir"
    assert heir.commit() == 0
    assert [r.held for r in table.registers()] == [True]


# -- registers ------------------------------------------------------------------------


def test_a_fresh_register_that_is_not_there_is_said_before_a_module_is_turned_on(
    tmp_path, monkeypatch
):
    monkeypatch.setenv("PBONET_SHM_DIR", str(tmp_path))
    big = [Variable(name=n, type="double", nelem=20_000) for n in ("X", "Y")]
    with Table.create("full", big, spare=2) as table:
        task = table.local("task", ME, outvar=["X", "Y"])
        task.claim()
        task.release()
        other = table.local("other", ME, outvar=["X", "Y"])
        table.write("Y", [5.0] * 20_000)
        task.array("X")[:] = task.array("Y")[:] = 2
        before = table.generation
        for call in (task.check_claim, task.claim):
            with pytest.raises(SvarFullError, match="no register is free for task"):
                call()
        assert table.generation == before
        assert table.read("X")[0] == 0
        assert table.read("Y")[0] == 5
        other.close()
        task.check_claim()
        assert table.generation == before, "asking takes nothing"
        assert task.claim() == 0
        assert table.read("X")[0] == table.read("Y")[0] == 2
        assert task.write("Y") == 0
        task.release()
        assert table.info("X").owner is None


# -- files ----------------------------------------------------------------------------


def test_a_file_that_took_the_place_of_a_removed_one_is_left_alone(table):
    table.path.unlink()
    with Table.create("arm", VARIABLES) as fresh:
        table.destroy()
        assert fresh.path.exists()
        Table.attach("arm").close()
        fresh.destroy()
        with pytest.raises(SvarMissingError):
            Table.attach("arm")


@pytest.mark.parametrize("what", ["register", "place", "slots", "stride"])
def test_a_directory_that_points_nowhere_is_refused(table, what):
    """A stray write may hit what changes; nobody must follow it out of the file."""
    reader = table.local("r", ME, invar=["V0"])
    with table.local("w", ME, outvar=["V0"]) as writer:
        writer.claim()
        head = word(table.path, word(table.path, LIVE))
        entry = word(table.path, DIR) + head % 4 * word(table.path, DIR_STRIDE) + 64
        reg = word(table.path, REGS) + REG_BYTES
        at = {
            "register": entry,
            "place": entry + 8,
            "slots": reg + SLOTS,
            "stride": reg + STRIDE,
        }[what]
        good = word(table.path, at)
        for bad in (0x7FFFFFFF, (1 << 64) - 64, 1 << 20):
            patch(table.path, at, bad)
            with pytest.raises(
                SvarDamagedError, match="was overwritten in shared memory"
            ):
                Table.attach("arm")
            assert reader.copy_in() == Flags.TABLE_OVERWRITTEN
            patch(table.path, at, good)
        Table.attach("arm").close()
        assert reader.copy_in() == 0


def test_a_file_that_cannot_be_mapped_is_an_error(table):
    script = (
        "import resource, sys\n"
        "from pbonet.svar import Table\n"
        "from pbonet.errors import SvarFullError\n"
        "used = int(open('/proc/self/statm').read().split()[0]) * 4096\n"
        "resource.setrlimit(resource.RLIMIT_AS, (used + 60000, -1))\n"
        "try:\n    Table.attach('arm')\n"
        "except SvarFullError as error:\n    print(error)\n"
    )
    done = subprocess.run(
        [sys.executable, "-c", script], capture_output=True, text=True, check=False
    )
    assert "cannot be mapped into memory" in done.stdout, done.stderr
    assert np.isfinite(table.read("V0")).all()
