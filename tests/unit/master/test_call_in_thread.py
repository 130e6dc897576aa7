"""A call in a thread: what Ctrl-C kept from beginning is over."""

from __future__ import annotations

import threading

import pytest

from pbonet.master.subsystem.call_in_thread import InThread


def test_it_is_over_at_its_end_or_if_it_has_not_begun():
    go_on = threading.Event()
    call = InThread(lambda: go_on.wait(60))
    assert call.done(0.01), "else a kill of its tasks would go on for ever"
    call.begin()
    assert not call.done(0.01)
    go_on.set()
    assert call.done(60)
    assert call.result() is True


def test_its_error_is_raised_where_it_is_waited_for():
    call = InThread(lambda: 1 // 0)
    call.begin()
    with pytest.raises(ZeroDivisionError):
        call.result()
