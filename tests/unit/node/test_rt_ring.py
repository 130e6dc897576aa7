"""The ring of records: order, bound, damage, one consumer."""

from __future__ import annotations

import os
import random
import subprocess
import sys
from pathlib import Path

import pytest

from pbonet.errors import NodeError
from pbonet.node.rt import _rt

ROOT = Path(__file__).parents[3]


@pytest.fixture
def ring(tmp_path, monkeypatch):
    monkeypatch.setenv("PBONET_SHM_DIR", str(tmp_path))
    ring = _rt.Ring.create("sub.task", 4096)
    yield ring
    ring.destroy()
    assert list(tmp_path.iterdir()) == []


def test_records_come_out_in_order_and_whole(ring) -> None:
    pick = random.Random(3)
    sent, got = [], []
    for cycle in range(5000):
        data = pick.randbytes(pick.randrange(200))
        assert ring.put(data, cycle=cycle)
        sent.append((cycle, data))
        if pick.random() < 0.2:
            got += ring.drain(limit=pick.randrange(1, 5))
        if cycle % 7 == 0:
            got += ring.drain()
    got += ring.drain()
    assert [(r.cycle, r.data) for r in got] == sent
    assert ring.lost == 0


def test_a_full_ring_drops_the_new_and_counts_it(ring) -> None:
    kept = 0
    while ring.put(b"x" * 100, cycle=kept):
        kept += 1
    assert not ring.put(b"x" * 100)
    assert ring.lost == 2
    assert [r.cycle for r in ring.drain()] == list(range(kept))
    assert ring.put(b"y")
    assert [r.data for r in ring.drain()] == [b"y"]


def test_a_record_larger_than_the_ring_is_dropped(ring) -> None:
    assert not ring.put(b"x" * 5000)
    assert ring.lost == 1


def test_the_consumer_may_be_another_process(ring) -> None:
    ring.put(b"hello", cycle=7)
    code = (
        "from pbonet.node.rt import _rt; r = _rt.Ring.attach('sub.task');"
        "print([(x.cycle, x.data) for x in r.drain()])"
    )
    out = subprocess.run(
        [sys.executable, "-c", code], cwd=ROOT, check=True, capture_output=True
    )
    assert out.stdout == b"[(7, b'hello')]\n"
    assert ring.drain() == []


def test_there_is_one_consumer(ring) -> None:
    ring.drain()
    other = _rt.Ring.attach("sub.task")
    with pytest.raises(NodeError, match="another process drains this ring"):
        other.drain()
    other.close()


def test_a_ring_that_stands_is_replaced(ring) -> None:
    ring.put(b"old")
    fresh = _rt.Ring.create("sub.task", 1)
    assert fresh.drain() == []
    assert Path(fresh.path).stat().st_mode & 0o777 == 0o600
    fresh.close()


@pytest.mark.usefixtures("ring")
def test_what_is_no_ring_is_refused(tmp_path) -> None:
    with pytest.raises(NodeError, match=r"the ring cannot be opened .*No such file"):
        _rt.Ring.attach("nobody")
    bad = tmp_path / f"pbonet.{os.geteuid()}.bad.ring"
    bad.write_bytes(b"x" * 9000)
    with pytest.raises(
        NodeError, match="the file is not a ring, or is of another version"
    ):
        _rt.Ring.attach("bad")
    bad.unlink()


def test_damage_is_found_and_not_followed(ring) -> None:
    ring.put(b"x" * 16)
    with Path(ring.path).open("r+b") as file:
        raw = file.read()
        at = raw.index(b"x" * 16) - 96
        file.seek(at)
        file.write(b"\xff\xff\xff\x7f")
    with pytest.raises(NodeError, match="the ring is damaged"):
        ring.drain()


def test_a_count_that_only_fits_in_32_bits_is_not_followed(ring) -> None:
    ring.put(b"x" * 16)
    with Path(ring.path).open("r+b") as file:
        at = file.read().index(b"x" * 16) - 96
        file.seek(at + 4)  # how many variables a cycle has taken
        file.write((1 << 28).to_bytes(4, "little"))
    with pytest.raises(NodeError, match="the ring is damaged"):
        ring.drain()


OVERWRITTEN = """
import os, random, sys
from pbonet.errors import NodeError
from pbonet.node.rt import _rt
for seed in range(60):
    ring = _rt.Ring.create("sub.hit", 4096)
    for n in range(3):
        assert ring.put(bytes([n]) * 64)
    size = os.path.getsize(ring.path)
    pick = random.Random(seed)
    n = pick.choice([size, 192, pick.randrange(8, size)])
    with open(ring.path, "r+b") as file:
        file.write(pick.randbytes(n) if sys.argv[1] == "random" else bytes(n))
    for _ in range(100):
        ring.put(b"x" * 64)
        ring.want()
    try:
        assert all(len(record.data) <= 4096 for record in ring.drain())
    except NodeError as error:
        assert "the ring is damaged" in str(error)
    assert len(ring.about) <= size
    ring.destroy()
print("survived")
"""


@pytest.mark.parametrize("kind", ["random", "zero"])
@pytest.mark.usefixtures("ring")
def test_a_ring_that_is_overwritten_ends_no_process(kind) -> None:
    done = subprocess.run(
        [sys.executable, "-c", OVERWRITTEN, kind],
        cwd=ROOT,
        capture_output=True,
        text=True,
        check=False,
    )
    assert (done.returncode, done.stdout, done.stderr) == (0, "survived\n", "")


@pytest.mark.usefixtures("ring")
def test_a_closed_ring_says_so() -> None:
    other = _rt.Ring.attach("sub.task")
    other.close()
    other.close()
    with pytest.raises(NodeError, match="the ring is closed"):
        other.drain()


@pytest.mark.usefixtures("ring")
@pytest.mark.parametrize("name", ["", "a/b", "x" * 101])
def test_names_are_plain(name) -> None:
    with pytest.raises(ValueError, match="is not 1 to 100 characters"):
        _rt.Ring.create(name)


@pytest.mark.usefixtures("ring")
def test_capacity_has_bounds() -> None:
    with pytest.raises(ValueError, match="capacity 0 is not within"):
        _rt.Ring.create("a", 0)
