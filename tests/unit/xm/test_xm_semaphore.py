"""Semaphores: values, limits, refusals, files."""

import os
import signal
import time
from pathlib import Path

import pytest

from pbonet import xm
from pbonet.errors import (
    XmAccessError,
    XmDamagedError,
    XmDestroyedError,
    XmError,
    XmExistsError,
    XmLayoutError,
)
from pbonet.xm import Semaphore, Taken


@pytest.fixture
def grip():
    made = Semaphore.create("grip", binary=True)
    yield made
    made.destroy()


@pytest.fixture
def items():
    made = Semaphore.create("items", initial=2, maximum=3)
    yield made
    made.destroy()


def test_counting(items) -> None:
    assert items.p() is Taken.TAKEN
    assert items.try_p() is Taken.TAKEN
    assert items.value == 0
    assert items.try_p() is Taken.TIMED_OUT
    assert [items.v() for _ in range(4)] == [True, True, True, False]
    assert (items.value, items.maximum, items.binary) == (3, 3, False)
    assert items.holder is None


def test_a_time_limit_is_absolute_and_what_is_over_does_not_wait(items) -> None:
    items.p()
    items.p()
    for until in (time.monotonic_ns() + 5_000_000, time.monotonic_ns(), 1, 0, -1):
        assert items.p(until) is Taken.TIMED_OUT
        assert time.monotonic_ns() >= until
    assert items.waiting == 0


def test_binary_names_its_holder(grip) -> None:
    assert grip.holder is None
    with grip as taken:
        assert taken is Taken.TAKEN
        assert (grip.value, grip.holder) == (0, os.getpid())
        assert grip.try_p() is Taken.TIMED_OUT, "it is not recursive"
    assert (grip.value, grip.holder) == (1, None)
    assert not grip.v()


def test_who_detaches_while_it_holds_has_died_with_it(grip) -> None:
    other = Semaphore.attach("grip")
    other.p()
    other.close()
    assert grip.p() is Taken.HOLDER_DIED
    grip.v()
    assert grip.p() is Taken.TAKEN


def test_both_ends_see_one_value(items) -> None:
    other = xm.semaphore("items")
    other.p()
    assert items.value == 1
    other.close()
    other.close()
    with pytest.raises(XmError, match="it is closed"):
        other.v()


def test_destroyed_is_told(items) -> None:
    other = xm.semaphore("items")
    items.destroy()
    items.destroy()
    with pytest.raises(XmDestroyedError, match="it was destroyed"):
        other.p(0)
    with pytest.raises(XmDestroyedError):
        other.v()
    assert not Path(other.path).exists()
    other.close()


def test_a_signal_whose_handler_raises_ends_the_wait(items) -> None:
    def ring(*_: object) -> None:
        raise KeyError

    old = signal.signal(signal.SIGALRM, ring)
    items.p()
    items.p()
    try:
        signal.setitimer(signal.ITIMER_REAL, 0.02)
        with pytest.raises(KeyError):
            items.p()
    finally:
        signal.signal(signal.SIGALRM, old)
    assert items.waiting == 0
    items.v()
    assert items.value == 1, "the one that was interrupted took nothing"


def test_a_signal_whose_handler_returns_does_not(items) -> None:
    rung = []

    def ring(*_: object) -> None:
        rung.append(1)
        items.v()

    old = signal.signal(signal.SIGALRM, ring)
    items.p()
    items.p()
    try:
        signal.setitimer(signal.ITIMER_REAL, 0.02)
        assert items.p() is Taken.TAKEN
    finally:
        signal.signal(signal.SIGALRM, old)
    assert rung == [1]


def test_other_settings_are_refused(items, grip) -> None:
    with pytest.raises(XmLayoutError, match=r"expected maximum 9, got maximum 3"):
        xm.semaphore("items", initial=0, maximum=9)
    with pytest.raises(XmLayoutError, match=r"expected binary True, got binary False"):
        xm.semaphore("items", binary=True)
    xm.semaphore("items", initial=0).close()
    with pytest.raises(XmExistsError, match="already exists and is in use"):
        Semaphore.create("grip")
    assert (items.value, grip.value) == (2, 1)


def test_what_nobody_uses_is_made_anew() -> None:
    Semaphore.create("left", initial=0).close()
    again = Semaphore.create("left", initial=5)
    assert again.value == 5
    again.destroy()


@pytest.mark.parametrize(
    "settings",
    [
        {"initial": -1},
        {"initial": 2, "maximum": 1},
        {"initial": 0, "maximum": 0},
        {"initial": 2, "binary": True},
        {"initial": 0, "maximum": 3, "binary": True},
        {"maximum": 1 << 31},
    ],
)
def test_settings_have_bounds(settings) -> None:
    with pytest.raises(ValueError, match=r"initial|maximum"):
        Semaphore.create("bad", **settings)


def test_files_of_others_and_damaged_ones_are_refused(items, shared_memory) -> None:
    path = Path(items.path)
    with path.open("r+b") as file:
        file.write(b"x" * 8)
    with pytest.raises(XmDamagedError, match="damaged, or of another kind"):
        Semaphore.attach("items")
    for content in (b"", b"x" * 100):
        bad = shared_memory / path.name.replace("items", "bad")
        bad.write_bytes(content)
        bad.chmod(0o600)
        with pytest.raises(XmDamagedError):
            Semaphore.attach("bad")
        bad.chmod(0o644)
        with pytest.raises(XmAccessError, match="not this user's own"):
            Semaphore.attach("bad")
        bad.unlink()
    bad.symlink_to(path)
    with pytest.raises(XmAccessError, match="a symbolic link"):
        Semaphore.attach("bad")
    bad.unlink()


def test_another_version_is_told(items) -> None:
    with Path(items.path).open("r+b") as file:
        file.seek(8)
        file.write(b"\x63\0\0\0")
    with pytest.raises(
        XmLayoutError, match="version 1 and this C library, got version 99"
    ):
        Semaphore.attach("items")


def test_a_file_is_the_users_own(items) -> None:
    assert Path(items.path).stat().st_mode & 0o777 == 0o600
