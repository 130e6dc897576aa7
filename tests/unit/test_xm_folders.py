"""Folders that are listed only when they have changed."""

from __future__ import annotations

import os

import pytest

from pbonet.xm.folders import Changes


@pytest.fixture
def changes(tmp_path):
    made = Changes(str(tmp_path))
    assert made.look()
    return made


def test_once_more_and_then_no_more(changes):
    assert changes.look()
    assert not changes.look()
    assert not changes.look()


def test_made_and_removed(changes, tmp_path):
    changes.look()
    for change in ((tmp_path / "x").touch, (tmp_path / "x").unlink):
        change()
        os.utime(tmp_path, ns=(0, tmp_path.stat().st_mtime_ns + 1))
        assert changes.look()
        assert changes.look()
        assert not changes.look()


def test_what_comes_in_the_same_tick_behind_a_listing(changes, tmp_path):
    stamp = tmp_path.stat().st_mtime_ns
    (tmp_path / "x").touch()
    os.utime(tmp_path, ns=(0, stamp))  # as if the clock had not moved on
    assert changes.look()
