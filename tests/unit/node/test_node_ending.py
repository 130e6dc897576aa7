"""The wait for an agent's end."""

from __future__ import annotations

import signal
import threading

import pytest

from pbonet.node.agent.shutdown_event import Ending


@pytest.fixture
def handler():
    """Have SIGUSR2 call a function, and all as before behind the test."""
    before = signal.getsignal(signal.SIGUSR2)
    yield lambda what: signal.signal(signal.SIGUSR2, lambda *_: what())
    signal.signal(signal.SIGUSR2, before)
    signal.set_wakeup_fd(-1)


def test_what_was_set_before():
    ending = Ending()
    ending.set()
    assert ending.wait()
    assert ending.is_set()


def test_it_comes_from_another_thread():
    ending = Ending()
    setter = threading.Thread(target=ending.set)
    setter.start()
    assert ending.wait()
    setter.join()


def test_a_time_limit():
    ending = Ending()
    assert not ending.wait(0.0)
    assert not ending.is_set()


def test_a_signal_that_another_thread_got(handler):
    ending = Ending()
    ending.heed_signals()
    handler(ending.set)
    stay = threading.Event()
    other = threading.Thread(target=stay.wait)
    other.start()
    sender = threading.Thread(
        target=signal.pthread_kill, args=(other.ident, signal.SIGUSR2)
    )
    sender.start()
    assert ending.wait()
    stay.set()
    other.join()
    sender.join()


def test_many_rings_fill_nothing():
    ending = Ending()
    for _ in range(70_000):  # more than a pipe holds
        ending.set()
    assert ending.wait()
