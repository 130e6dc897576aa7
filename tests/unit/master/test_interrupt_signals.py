"""The first interrupt ends a command; none ends its undoing."""

from __future__ import annotations

import os
import signal
import sys
import threading
from types import SimpleNamespace

import pytest

from pbonet.master.subsystem.interrupt_signals import InterruptsInTurn


def to_undo(**how):
    return InterruptsInTurn(
        "undoing", "'pbonet stop arm' ends what is left", lambda: "the kill of a", **how
    )


@pytest.fixture(autouse=True)
def usual_handlers():
    """A job of a shell may begin with SIGINT or SIGHUP ignored."""
    usual = {
        signal.SIGINT: signal.default_int_handler,
        signal.SIGTERM: signal.SIG_DFL,
        signal.SIGHUP: signal.SIG_DFL,
    }
    before = {number: signal.signal(number, one) for number, one in usual.items()}
    yield usual
    assert {number: signal.getsignal(number) for number in usual} == usual
    for number, handler in before.items():
        signal.signal(number, handler)


STILL = (
    "still undoing; waits for the kill of a. "
    "Ctrl-\\ ends this at once; 'pbonet stop arm' ends what is left"
)


@pytest.mark.parametrize(
    ("number", "error"),
    [
        (signal.SIGINT, KeyboardInterrupt),
        (signal.SIGTERM, SystemExit),
        (signal.SIGHUP, SystemExit),
    ],
)
def test_the_first_one_ends_the_block_and_further_ones_say_what_is_awaited(
    number, error, capsys
):
    undone = []

    def block():
        with to_undo():
            try:
                os.kill(os.getpid(), number)
            finally:
                os.kill(os.getpid(), signal.SIGINT)
                os.kill(os.getpid(), signal.SIGTERM)
                os.kill(os.getpid(), signal.SIGHUP)
                undone.append(1)

    with pytest.raises(error):
        block()
    assert undone
    said = capsys.readouterr().err.splitlines()
    assert said == ["interrupted: undoing", STILL, STILL, STILL]


def test_none_ends_what_is_undone_for_another_reason(capsys):
    with to_undo() as interrupts:
        interrupts.wait()
        os.kill(os.getpid(), signal.SIGINT)
    with to_undo(first=False):
        os.kill(os.getpid(), signal.SIGINT)
    assert capsys.readouterr().err.splitlines() == [STILL, STILL]


def test_a_closed_pipe_ends_no_undoing(monkeypatch):
    """`| tee` is ended by the same Ctrl-C."""

    def closed(_text):
        raise BrokenPipeError

    monkeypatch.setattr(sys, "stderr", SimpleNamespace(write=closed))
    with to_undo(first=False):
        os.kill(os.getpid(), signal.SIGINT)
    with pytest.raises(KeyboardInterrupt), to_undo():
        os.kill(os.getpid(), signal.SIGINT)


@pytest.mark.parametrize("when", ["installed", "put back"])
def test_one_that_comes_while_handlers_are_exchanged_leaves_none_installed(
    when, monkeypatch
):
    """It counts as one that came before or after the block."""

    def exchanged(number, handler):
        old = signal_signal(number, handler)
        if number == which:
            os.kill(os.getpid(), signal.SIGINT)
        return old

    def block():
        with to_undo():
            entered.append(1)
            monkeypatch.setattr(signal, "signal", exchanged)

    signal_signal, entered = signal.signal, []
    which = signal.SIGINT if when == "installed" else signal.SIGTERM
    if when == "installed":
        monkeypatch.setattr(signal, "signal", exchanged)
    with pytest.raises(KeyboardInterrupt):
        block()
    monkeypatch.undo()
    assert entered == ([] if when == "installed" else [1])


@pytest.mark.parametrize("number", [signal.SIGTERM, signal.SIGHUP])
def test_a_request_to_end_the_process_is_carried_out_after_an_orderly_end(
    number, capsys
):
    """It is sent once, as by `timeout` or systemd; an error of the block is kept."""
    done = []

    def block(error):
        with to_undo(first=False):
            os.kill(os.getpid(), number)
            done.append(1)
            if error is not None:
                raise error

    with pytest.raises(SystemExit) as caught:
        block(None)
    assert caught.value.code == 128 + number
    with pytest.raises(ValueError, match="of the block"):
        block(ValueError("of the block"))
    assert done == [1, 1]
    assert capsys.readouterr().err.splitlines() == [STILL, STILL]


def test_a_closed_terminal_ends_nothing_under_nohup(usual_handlers):
    signal.signal(signal.SIGHUP, signal.SIG_IGN)
    with to_undo():
        os.kill(os.getpid(), signal.SIGHUP)
    assert signal.getsignal(signal.SIGHUP) is signal.SIG_IGN
    signal.signal(signal.SIGHUP, usual_handlers[signal.SIGHUP])


def test_handlers_of_the_program_stay(usual_handlers):
    taken = []
    signal.signal(signal.SIGINT, lambda *_: taken.append(1))
    with to_undo(first=False):
        os.kill(os.getpid(), signal.SIGINT)
    with to_undo(idle=True):
        assert signal.getsignal(signal.SIGTERM) is usual_handlers[signal.SIGTERM]
    assert taken == [1]
    for number, handler in usual_handlers.items():
        signal.signal(number, handler)


def test_another_thread_leaves_handlers_as_they_are(usual_handlers):
    found = []

    def block():
        with to_undo():
            found.append(signal.getsignal(signal.SIGINT))

    thread = threading.Thread(target=block)
    thread.start()
    thread.join()
    assert found == [usual_handlers[signal.SIGINT]]
