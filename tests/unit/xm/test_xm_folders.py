"""Folders that are listed only when they have changed."""

from __future__ import annotations

import os
import threading
import time

import pytest

from pbonet.xm.ipc.folder_watch import TICK_NS, Changes, Waiting


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


@pytest.fixture
def waiting(tmp_path):
    waiting = Waiting(str(tmp_path))
    yield waiting
    waiting.close()


class TestWaiting:
    """Each wait would last for ever if what ends it went unseen."""

    def test_a_file_that_is_made_or_removed_ends_the_wait(self, waiting, tmp_path):
        assert waiting.hears
        (tmp_path / "one").touch()
        waiting.wait(None)
        (tmp_path / "one").rename(tmp_path / "two")
        waiting.wait(None)
        (tmp_path / "two").unlink()
        waiting.wait(None)

    def test_a_hard_link_ends_the_wait(self, waiting, tmp_path):
        (tmp_path / "one").touch()
        waiting.wait(None)
        (tmp_path / "two").hardlink_to(tmp_path / "one")
        waiting.wait(None)

    def test_another_thread_ends_the_wait(self, waiting):
        thread = threading.Thread(target=waiting.wait, args=[None])
        thread.start()
        waiting.wake()
        thread.join()

    def test_nothing_is_left_of_what_ended_it(self, waiting, tmp_path):
        (tmp_path / "one").touch()
        waiting.wake()
        waiting.wait(None)
        before = time.monotonic()
        waiting.wait(0.02)
        assert time.monotonic() - before >= 0.02

    def test_without_the_kernel_s_help_it_says_so(self, tmp_path):
        waiting = Waiting(str(tmp_path / "missing"))
        assert not waiting.hears
        waiting.wake()
        waiting.wait(None)
        waiting.close()
