"""Mailbox interrupts on one machine."""

import threading

import pytest

from pbonet import xm
from pbonet.errors import (
    StateError,
    XmMissingError,
    XmNameError,
    XmQueueFullError,
    XmTakenError,
)
from pbonet.xm.ipc import mailboxes, names


@pytest.fixture(autouse=True)
def home(monkeypatch, tmp_path):
    monkeypatch.setenv("PBONET_RUN_DIR", str(tmp_path / "run"))
    monkeypatch.setattr(names, "_home", names.home())
    yield
    mailboxes.forget()


def test_values_come_in_order_and_are_counted():
    came = []
    box = xm.Mailbox("door", came.append)
    for value in (1, -(1 << 63), (1 << 63) - 1):
        xm.interrupt("door", value)
    assert (box.pending, box.sent, box.handled) == (3, 3, 0)
    assert box.wait()
    assert box.serve() == 3
    assert came == [1, -(1 << 63), (1 << 63) - 1]
    assert (box.pending, box.sent, box.handled, box.serve()) == (0, 3, 3, 0)
    box.destroy()


def test_a_full_mailbox_tells_the_sender():
    box = xm.Mailbox(7, depth=1)
    xm.interrupt(7)
    with pytest.raises(XmQueueFullError) as error:
        xm.interrupt("7", 2)
    assert str(error.value) == (
        "local:7: the mailbox is full (got 1 interrupts that were not handled yet); "
        "handle them more often, or install it with a larger depth"
    )
    assert (box.take(), box.take(), box.refused) == (1, None, 1)
    box.destroy()


def test_what_came_while_nobody_was_there_is_handled_later():
    first = xm.Mailbox("door")
    xm.interrupt("door", 4)
    first.close()
    xm.interrupt("door", 5)
    second = xm.Mailbox("door")
    assert [second.take(), second.take()] == [4, 5]
    second.destroy()


def test_a_mailbox_has_one_handler():
    box = xm.Mailbox("door")
    with pytest.raises(XmTakenError, match="already has a handler"):
        xm.Mailbox("door")
    box.destroy()


def test_one_that_was_made_anew_is_found():
    xm.Mailbox("door").close()
    xm.interrupt("door")
    xm.Mailbox("door").destroy()
    box = xm.Mailbox("door")
    xm.interrupt("door", 9)
    assert box.take() == 9
    box.destroy()


def test_a_thread_goes_on_when_the_handler_fails():
    done = threading.Event()

    def handle(value):
        if value == 0:
            raise ValueError("no")
        done.set()

    with xm.Mailbox("door", handle) as box:
        box.start()
        xm.interrupt("door", 0)
        xm.interrupt("door", 1)
        assert done.wait(10)
        assert (box.failed, box.handled) == (1, 2)
    xm.Mailbox("door").destroy()


def test_a_task_has_no_such_thread():
    xm.live_on("arm0", subsystem="arm")
    box = xm.Mailbox("door", print)
    with pytest.raises(StateError, match="wait in sync and call serve in cycle"):
        box.start()
    box.destroy()


@pytest.mark.parametrize("use", ["serve", "start"])
def test_without_a_handler_there_is_take(use):
    box = xm.Mailbox("door")
    with pytest.raises(StateError, match="the mailbox has no handler"):
        getattr(box, use)()
    box.destroy()


def test_what_cannot_be_sent_says_why():
    box = xm.Mailbox("door")
    with pytest.raises(XmMissingError) as error:
        xm.interrupt("dor")
    assert str(error.value) == (
        "local:dor: no mailbox of this name is installed (got local:door); did you "
        "mean local:door?"
    )
    with pytest.raises(ValueError, match="more than 64 bits"):
        xm.interrupt("door", 1 << 63)
    with pytest.raises(XmNameError, match="handled on its own RTPU"):
        xm.Mailbox("arm9:door")
    box.destroy()
