"""A table's file is overwritten: no process dies of it, and no value is a lie."""

import os
import struct
import subprocess
import sys
from pathlib import Path

import pytest

from pbonet.config.model import Variable
from pbonet.errors import SvarDamagedError
from pbonet.svar import Flags, Table

ME = os.getpid()
LIVE, REGS, DIR, DIR_STRIDE, ARENA = range(80, 120, 8)  # places in the header
LOST = Flags.TABLE_OVERWRITTEN

VICTIM = Path(__file__).with_name("overwritten_table.py")
KINDS = ("random", "zero")
DIRECTED = ("header", "live", "registers", "directory", "prefix", "whole")
"""What is overwritten; each hits something that can be recognized."""


@pytest.fixture
def table(tmp_path, monkeypatch):
    monkeypatch.setenv("PBONET_SHM_DIR", str(tmp_path))
    variables = [Variable(name=f"V{i}", type="double", nelem=3) for i in range(4)]
    with Table.create("arm", variables) as made:
        yield made


def overwritten(path: Path, at: int, data: bytes) -> bytes:
    """Overwrite bytes of a file; return what was there."""
    with path.open("r+b") as file:
        file.seek(at)
        before = file.read(len(data))
        file.seek(at)
        file.write(data)
    return before


def places(path: Path) -> tuple[int, ...]:
    """Return where live part, registers, directory, its slots and arena begin."""
    return struct.unpack_from("<5Q", path.read_bytes(), LIVE)


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("what", [*DIRECTED, "anywhere"])
def test_no_access_ends_with_a_signal_and_no_value_is_invented(kind, what, tmp_path):
    done = subprocess.run(
        [sys.executable, str(VICTIM), kind, what, "25"],
        env={**os.environ, "PBONET_SHM_DIR": str(tmp_path)},
        capture_output=True,
        text=True,
        check=False,
    )
    assert (done.returncode, done.stderr) == (0, "")
    assert done.stdout == "25 survived\n"
    for left in tmp_path.iterdir():
        left.unlink()


def test_the_static_part_is_private(table):
    """A process that is attached needs nothing of it in the file any more."""
    writer = table.local("w", ME, outvar=["V0", "V1"])
    reader = table.local("r", ME, invar=["V0", "V3"])
    writer.claim()
    size = places(table.path)[0]
    before = overwritten(table.path, 0, os.urandom(size))
    writer.array("V0")[:] = 5
    assert writer.commit() == reader.copy_in() == 0
    assert reader.array("V0").tolist() == table.read("V0").tolist() == [5] * 3
    assert table.variable("V3").nelem == 3
    with pytest.raises(SvarDamagedError):
        Table.attach("arm")
    overwritten(table.path, 0, before)
    Table.attach("arm").close()


def test_a_directory_of_zeros_is_no_directory(table):
    """Generation 0: a cached plan must not make a frozen value look sound."""
    writer = table.local("w", ME, outvar=["V0"])
    reader = table.local("r", ME, invar=["V0"])
    keeping = table.local("k", ME, invar=["V0"], keep=True)
    writer.claim()
    assert reader.copy_in() == keeping.copy_in() == 0
    overwritten(table.path, places(table.path)[0], bytes(8))
    for _ in range(3):
        assert writer.commit() == reader.copy_in() == keeping.copy_in() == LOST
        assert reader.read("V0") == writer.write("V0") == LOST
    assert reader.counters.torn == 0


def test_every_use_says_that_the_table_is_lost(table):
    writer = table.local("w", ME, outvar=["V0"])
    writer.claim()
    live, regs = places(table.path)[:2]
    overwritten(table.path, live, bytes(regs - live))
    uses = (
        lambda: table.read("V1"),
        lambda: table.info("V1"),
        lambda: table.write("V1", [1, 2, 3]),
        lambda: table.put(1, writer.array("V0").view("u1"), 1),
        table.registers,
        table.must_be_whole,
        lambda: table.reap("w"),
        lambda: table.local("x", ME, outvar=["V2"]),
        writer.claim,
        writer.check_claim,
        writer.release,
        writer.have_ended,
        lambda: Table.attach("arm"),
    )
    for use in uses:
        with pytest.raises(SvarDamagedError) as found:
            use()
        assert found.value.what == ("the table was overwritten in shared memory")
        assert "stop the subsystem" in found.value.remedy


@pytest.mark.parametrize("head", [0, 0x3FF0_0000_0000_0000, 2**64 - 1, 1 << 16])
def test_a_head_that_jumped_is_recognized_by_readers_and_by_its_writer(table, head):
    writer = table.local("w", ME, outvar=["V0"])
    reader = table.local("r", ME, invar=["V0"])
    writer.claim()
    for _ in range(3):
        assert writer.commit() == reader.copy_in() == 0
    at = places(table.path)[1] + 256
    good = overwritten(table.path, at, struct.pack("<Q", head))
    assert writer.commit() == LOST
    assert reader.copy_in() == LOST
    assert writer.write("V0") == LOST
    overwritten(table.path, at, good)
    assert writer.commit() == reader.copy_in() == 0


def test_an_entry_of_another_directory_is_not_followed(table):
    """Each entry has a sum, so that zeros and old ones are not valid."""
    reader = table.local("r", ME, invar=["V1"])
    _, _, directory, stride, _ = places(table.path)
    head = struct.unpack_from("<Q", table.path.read_bytes(), places(table.path)[0])[0]
    entry = directory + head % 4 * stride + 64 + 24
    for word in range(3):
        good = overwritten(table.path, entry + 8 * word, struct.pack("<Q", 1 << 32))
        assert reader.copy_in() == LOST
        overwritten(table.path, entry + 8 * word, good)
    good = overwritten(table.path, entry, bytes(24))
    assert reader.copy_in() == LOST
    overwritten(table.path, entry, good)
    assert reader.copy_in() == 0


def test_a_lock_that_was_overwritten_is_not_touched(table):
    """A C library may abort the process that locks arbitrary bytes."""
    live = places(table.path)[0]
    overwritten(table.path, live + 64, os.urandom(64))
    with pytest.raises(SvarDamagedError, match="was overwritten in shared memory"):
        table.registers()
    assert table.read("V0").tolist() == [0] * 3, "readers need no lock"
