"""A link's file is overwritten: no process dies of it, and no record is invented."""

import os
import struct
import subprocess
import sys

import numpy as np
import pytest

from pbonet import tbuf, xm
from pbonet.errors import XmDamagedError

SIX = ("f8", 6)
WORD = 3392  # place of the word in the file
VICTIM = """
import os, sys
import numpy as np
from pbonet import tbuf, xm
from pbonet.errors import PbonetError
xm.live_on("arm0", domain="d", subsystem="arm")
kind, first, last = sys.argv[1], int(sys.argv[2]), int(sys.argv[3])
folder = os.environ["PBONET_SHM_DIR"]
for seed in range(30):
    writer, reader = tbuf.Writer("x", ("f8", 6)), tbuf.Reader("arm:x")
    writer.value[:] = 7
    writer.write()
    assert reader.read()
    (name,) = [name for name in os.listdir(folder) if name.endswith(".tbuf")]
    size = os.path.getsize(f"{folder}/{name}")
    n = (last or size) - first
    with open(f"{folder}/{name}", "r+b") as file:
        file.seek(first)
        noise = np.random.default_rng(seed).bytes(n)
        file.write(noise if kind == "random" else bytes(n))
    for use in (reader.read, writer.write, reader.read, writer.write, reader.read):
        try:
            use()
        except PbonetError:
            pass
        assert set(reader.value) == {7.0}, reader.value
    writer.unmap(), reader.unmap()
    os.unlink(f"{folder}/{name}")
print("survived")
"""


@pytest.fixture(autouse=True)
def arm(shared_memory):
    xm.live_on("arm0", domain="d", subsystem="arm")
    yield shared_memory
    xm.live_on("local")


@pytest.mark.parametrize("kind", ["random", "zero"])
@pytest.mark.parametrize(("first", "last"), [(0, 2949), (0, 0), (3100, 4000)])
def test_no_access_ends_with_a_signal(arm, kind, first, last):
    done = subprocess.run(
        [sys.executable, "-c", VICTIM, kind, str(first), str(last)],
        env={**os.environ, "PBONET_SHM_DIR": str(arm)},
        capture_output=True,
        text=True,
        check=False,
    )
    assert (done.returncode, done.stdout, done.stderr) == (0, "survived\n", "")


@pytest.mark.parametrize("word", [0, 3, 12, 5 | 1 << 8, 2**64 - 1, (1 << 30) | 1 << 2])
def test_both_ends_say_that_their_memory_was_overwritten(arm, word):
    with tbuf.Writer("x", SIX) as writer, tbuf.Reader("arm:x") as reader:
        writer.write()
        assert reader.read()
        writer.write()
        (path,) = arm.glob("*.tbuf")
        with path.open("r+b") as file:
            file.seek(WORD)
            good = file.read(8)
            assert struct.unpack("<Q", good)[0] >> 8 == 2, "the second record"
            file.seek(WORD)
            file.write(struct.pack("<Q", word))
            file.flush()
            for use in (reader.read, *([writer.write] if word < 1 << 30 else [])):
                with pytest.raises(
                    XmDamagedError, match="memory was overwritten"
                ) as got:
                    use()
                assert "remove the file" in got.value.remedy
            file.seek(WORD)
            file.write(good)
        assert reader.read()
        writer.write()
        assert np.isfinite(reader.value).all()
