"""Folders that are listed only when they have changed."""

from __future__ import annotations

import os
import time

import pytest

from pbonet.xm.ipc.folder_watch import TICK_NS, Changes


class Clock:
    """The monotonic clock, set by the test."""

    now = 0


@pytest.fixture
def clock(monkeypatch):
    monkeypatch.setattr(time, "monotonic_ns", lambda: Clock.now)
    return Clock


def looks(changes):
    return [changes.changed() for _ in range(3)]


def test_until_a_tick_is_over_and_then_no_more(tmp_path, clock):
    changes = Changes(str(tmp_path))
    assert looks(changes) == [True] * 3
    clock.now += TICK_NS + 1
    assert looks(changes) == [True, False, False]


def test_made_and_removed(tmp_path, clock):
    changes = Changes(str(tmp_path))
    looks(changes)
    clock.now += TICK_NS + 1
    looks(changes)
    for change in ((tmp_path / "x").touch, (tmp_path / "x").unlink):
        change()
        os.utime(tmp_path, ns=(0, tmp_path.stat().st_mtime_ns + 1))
        assert looks(changes) == [True] * 3
        clock.now += TICK_NS + 1
        assert looks(changes) == [True, False, False]


def test_what_comes_in_the_same_tick_behind_a_listing(tmp_path, clock):
    changes = Changes(str(tmp_path))
    assert looks(changes) == [True] * 3  # many looked within the tick
    stamp = tmp_path.stat().st_mtime_ns
    (tmp_path / "x").touch()
    os.utime(tmp_path, ns=(0, stamp))  # as if the kernel's clock had not moved on
    clock.now += TICK_NS + 1
    assert looks(changes) == [True, False, False]
