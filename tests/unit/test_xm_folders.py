"""Folders that are listed only when they have changed."""

from __future__ import annotations

import os
import time

import pytest

from pbonet.xm.folders import TICK_NS, Changes


@pytest.fixture
def folder(tmp_path):
    before(tmp_path, 10 * TICK_NS)
    return tmp_path


def before(folder, ns):
    """Have the folder's last change be so long ago."""
    stamp = time.time_ns() - ns
    os.utime(folder, ns=(0, stamp))


def test_once_and_then_no_more(folder):
    changes = Changes(str(folder))
    assert [changes.look() for _ in range(3)] == [True, False, False]


def test_made_and_removed(folder):
    changes = Changes(str(folder))
    changes.look()
    for n, change in enumerate(((folder / "x").touch, (folder / "x").unlink)):
        change()
        before(folder, (9 - n) * TICK_NS)
        assert [changes.look() for _ in range(3)] == [True, False, False]


def test_what_comes_in_the_same_tick_behind_a_listing(folder, monkeypatch):
    changes = Changes(str(folder))
    changes.look()
    before(folder, 0)
    stamp = folder.stat().st_mtime_ns
    now = stamp
    monkeypatch.setattr(time, "time_ns", lambda: now)
    for _ in range(5):  # as if many looked within the tick
        assert changes.look()
    (folder / "x").touch()
    os.utime(folder, ns=(0, stamp))  # as if the clock had not moved on
    now += 2 * TICK_NS
    assert [changes.look() for _ in range(3)] == [True, False, False]
