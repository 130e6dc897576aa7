"""Shared memory segments: made, found, counted, destroyed, refused."""

import os
import signal
import subprocess
import sys

import numpy as np
import pytest
from watching import wait_for

from pbonet import xm
from pbonet.errors import (
    UnreachableError,
    XmDamagedError,
    XmDestroyedError,
    XmError,
    XmExistsError,
    XmFullError,
    XmLayoutError,
    XmMissingError,
)
from pbonet.xm import Segment
from pbonet.xm.ipc import segments as module

CHILD = """
from pbonet import xm
segment = xm.segment("local:map")
segment.array("i8", 4)[:] += 1
print("ready", flush=True)
input()
"""


@pytest.fixture
def segment():
    made = xm.segment("map", 4096)
    yield made
    made.destroy()


def child():
    process = subprocess.Popen(
        [sys.executable, "-c", CHILD],
        stdin=subprocess.PIPE,
        stdout=subprocess.PIPE,
        text=True,
    )
    assert process.stdout.readline() == "ready\n"
    return process


def test_processes_share_it_and_are_counted(segment):
    mine = segment.array("i8", 4)
    mine[:] = 1, 2, 3, 4
    assert segment.attached == 1
    one, two = child(), child()
    assert mine.tolist() == [3, 4, 5, 6]
    assert segment.attached == 3
    two.send_signal(signal.SIGKILL)
    wait_for(lambda: segment.attached == 2, "the killed one to count no more")
    one.communicate("\n")
    two.communicate()
    assert segment.attached == 1


def test_arrays_stand_side_by_side(segment):
    pose = np.dtype([("x", "f8", (3,)), ("n", "i4")])
    one, two = segment.array(pose), segment.array("f4", (2, 3), offset=64)
    one["x"], two[1, 2] = (1, 2, 3), 5
    with Segment.attach("map") as other:
        assert other.array(pose)["x"].tolist() == [1, 2, 3]
        assert other.array("f4", 6, 64)[5] == 5
        assert other.memory.nbytes == other.size == 4096
        assert other.attached == 2


def test_what_does_not_fit_is_refused(segment):
    for shape, offset in ((513, 0), (1, 4095), (1, -1)):
        with pytest.raises(XmLayoutError, match="does not fit"):
            segment.array("f8", shape, offset)
    with pytest.raises(XmLayoutError, match="another setting"):
        xm.segment("map", 100)
    with pytest.raises(ValueError, match="at least one byte"):
        Segment.create("none", 0)


def test_it_stands_until_it_is_destroyed(segment, shared_memory):
    segment.array("u1", 1)[0] = 7
    segment.close()
    with xm.segment("map") as again:
        assert again.array("u1", 1)[0] == 7, "although nobody was attached"
        other = Segment.attach("map")
        with pytest.raises(XmExistsError):
            Segment.create("map", 10)
        again.destroy()
        with pytest.raises(XmDestroyedError, match="create it again"):
            other.array("u1", 1)
        with pytest.raises(XmError, match="closed"):
            again.array("u1", 1)
        other.close()
    assert list(shared_memory.iterdir()) == []
    with pytest.raises(XmMissingError, match=r"create it; xm.segment\(name, size\)"):
        xm.segment("map")


def test_an_array_outlives_its_segment(segment):
    kept = segment.array("i8", 2)
    segment.destroy()
    kept[:] = 5
    assert kept.tolist() == [5, 5]


def test_one_that_was_left_is_replaced_or_swept(shared_memory):
    Segment.create("map", 10).close()
    with Segment.create("map", 20) as second:
        assert second.size == 20
    assert xm.sweep("local") == ["map.shm"]
    assert list(shared_memory.iterdir()) == []


def test_memory_of_another_machine_is_refused_with_the_remedy():
    with pytest.raises(UnreachableError) as refused:
        xm.segment("vision0:map", 10)
    assert str(refused.value) == (
        "vision0:map: RTPU vision0 is not on this machine (expected an RTPU that runs "
        "here, in domain default, got none); memory is shared within a machine only; "
        "to another one use a link (pbonet.tbuf), or a variable of the table"
    )


@pytest.mark.parametrize(
    ("offset", "data", "kind"),
    [
        (0, b"x", XmDamagedError),
        (16, b"\1", XmDamagedError),
        (8, b"\7", XmLayoutError),
    ],
)
def test_files_that_are_no_segment(segment, shared_memory, offset, data, kind):
    (path,) = shared_memory.iterdir()
    assert path.stat().st_mode & 0o777 == 0o600
    with path.open("r+b") as file:
        file.seek(offset)
        file.write(data)
    with pytest.raises(kind):
        Segment.attach("map")
    os.truncate(path, 4096 + 64)
    segment.destroy()


def test_no_more_than_there_are_places(segment, monkeypatch):
    monkeypatch.setattr(module, "MEMBERS", 1)
    with pytest.raises(XmFullError, match="too many"):
        Segment.attach("map")
    assert segment.attached == 1
