"""Semaphores and queues between processes: who is served first, who dies meanwhile."""

import os
import signal
import threading
import time

import pytest
from svar_rig import Child, wait_for
from xm_rig import LONG, Line, words

from pbonet import xm
from pbonet.errors import XmDestroyedError, XmQueueFullError
from pbonet.xm import Queue, Semaphore, Taken
from pbonet.xm.ipc import names

PRIORITIES = [3, 9, 3, 7, 9]
SERVED = [1, 4, 3, 0, 2]
"""Positions in PRIORITIES: the highest first, equals as they came."""


def soon() -> int:
    return time.monotonic_ns() + LONG


@pytest.fixture
def items():
    made = Semaphore.create("items", initial=0)
    yield made
    made.destroy()


@pytest.fixture
def events():
    made = Queue.create("events", messages=2, blocks=40)
    yield made
    made.destroy()


def test_waiters_of_a_semaphore_by_priority(items):
    line = Line(items)
    for mark, priority in enumerate(PRIORITIES):
        line.join(lambda priority=priority: items.p(soon(), priority=priority), mark)
    assert items.try_p() is Taken.TIMED_OUT
    for count in range(1, 6):
        items.v()
        assert line.after(count) == SERVED[:count]
    assert line.end() == [0] * 5
    assert (items.value, items.waiting) == (0, 0)


def test_receivers_of_a_queue_by_priority(events):
    line = Line(events)
    for mark, priority in enumerate(PRIORITIES):
        line.join(
            lambda priority=priority: events.receive(soon(), priority=priority), mark
        )
    for count in range(1, 6):
        events.send(b"x" * (1500 if count % 2 else 10))
        assert line.after(count) == SERVED[:count]
    assert line.end() == [0] * 5
    assert events.free == (2, 40)


def test_senders_wait_for_room_by_priority(events):
    for _ in range(2):
        events.send(b"first")
    line = Line(events)
    for mark, priority in enumerate(PRIORITIES):
        line.join(
            lambda m=mark, p=priority: events.send(
                bytes([m]), until_ns=soon(), wait_priority=p
            ),
            mark,
        )
    with pytest.raises(XmQueueFullError):
        events.send(b"not before those who wait")
    for count in range(1, 6):
        events.receive()
        assert line.after(count) == SERVED[:count]
    assert [events.receive(), events.receive()] == [bytes([0]), bytes([2])]
    assert line.end() == [0] * 5


def test_a_long_message_is_not_overtaken_for_ever(events):
    for _ in range(2):
        events.send(b"x" * 1000)
    line = Line(events)
    line.join(lambda: events.send(b"l" * 2400, until_ns=soon()), 1)
    line.join(lambda: events.send(b"s", until_ns=soon()), 2)
    events.receive()
    assert line.order == [], "there is room for the short one, but it came second"
    events.receive()
    assert line.end() == [0, 0]
    assert [len(events.receive()) for _ in range(2)] == [2400, 1]


def test_a_tasks_criticality_is_the_priority_of_its_waits(items, monkeypatch):
    monkeypatch.setattr(names, "_home", names.home())
    line = Line(items)
    for mark, criticality in enumerate([1, 5]):
        xm.live_on("local", priority=lambda c=criticality: c)
        line.join(lambda: items.p(soon()), mark)
    xm.live_on("local", priority=lambda: 3)
    line.join(lambda: items.p(soon()), 2)
    for count in range(1, 4):
        items.v()
        assert line.after(count) == [1, 2, 0][:count]
    assert line.end() == [0] * 3


def test_a_killed_waiter_is_cleaned_up_and_its_wakeup_not_lost(items):
    line = Line(items)
    first = line.join(lambda: items.p(soon(), priority=9), 1)
    line.join(lambda: items.p(soon(), priority=1), 2)
    os.kill(first.pid, signal.SIGSTOP)  # so it is called, and takes nothing
    items.v()
    assert (items.value, items.waiting) == (1, 2)
    first.kill(signal.SIGKILL)
    assert line.after(1) == [2]
    assert line.children[1].end() == 0
    assert (items.value, items.waiting) == (0, 0)


def test_a_killed_receiver_that_was_called_lets_the_next_have_it(events):
    line = Line(events)
    first = line.join(lambda: events.receive(soon(), priority=9), 1)
    line.join(lambda: events.receive(soon(), priority=1), 2)
    os.kill(first.pid, signal.SIGSTOP)
    events.send(b"x")
    assert events.try_receive() is None, "it is promised"
    first.kill(signal.SIGKILL)
    assert line.after(1) == [2]
    assert line.children[1].end() == 0


def test_waiters_that_are_killed_all_at_once(items):
    line = Line(items)
    doomed = [line.join(lambda: items.p(soon(), priority=9), n) for n in range(5)]
    line.join(lambda: items.p(soon(), priority=1), 9)
    for child in doomed:
        os.kill(child.pid, signal.SIGSTOP)
    items.v()
    for child in doomed:
        child.kill(signal.SIGKILL)
    assert line.after(1) == [9]
    assert line.children[-1].end() == 0


def test_a_killed_holder_is_told_to_who_waits_and_to_no_other():
    grip = Semaphore.create("grip", binary=True)
    line = Line(grip)
    told = words(3)

    def hold() -> None:
        grip.p()
        told[0] = 1
        signal.pause()

    holder = Child(hold)
    wait_for(lambda: told[0], "it to hold")
    assert grip.holder == holder.pid

    def take(n: int) -> bool:
        told[n] = grip.p(soon(), priority=3 - n)
        assert grip.holder == os.getpid()
        return grip.v()

    line.join(lambda: take(1), 1)
    line.join(lambda: take(2), 2)
    holder.kill(signal.SIGKILL)
    assert line.end() == [0, 0]
    assert told.tolist() == [1, Taken.HOLDER_DIED, Taken.TAKEN]
    grip.destroy()


def test_who_waits_for_what_is_destroyed_hears_it(items, events):
    def expect(wait) -> bool:
        try:
            wait()
        except XmDestroyedError:
            return True
        return False

    of_items, of_events = Line(items), Line(events)
    of_items.join(lambda: expect(items.p), 1)
    of_events.join(lambda: expect(events.receive), 2)
    items.destroy()
    events.destroy()
    assert of_items.after(1) == [1]
    assert of_events.after(1) == [2]
    assert of_items.end() + of_events.end() == [0, 0]


def test_threads_of_one_process_wait_too(events):
    got = []
    threads = [
        threading.Thread(target=lambda: got.append(events.receive(soon())))
        for _ in range(4)
    ]
    for thread in threads:
        thread.start()
    wait_for(lambda: events.waiting == 4, "all to wait")
    for n in range(4):
        events.send(bytes([n]), until_ns=soon())
    for thread in threads:
        thread.join(20)
    assert sorted(got) == [bytes([n]) for n in range(4)]


def test_a_line_has_an_end(items):
    threads = [threading.Thread(target=items.p, args=(soon(),)) for _ in range(128)]
    for thread in threads:
        thread.start()
    wait_for(lambda: items.waiting == 128, "all to wait")
    with pytest.raises(OSError, match="at most 128 processes and 128 waiting threads"):
        items.p(soon())
    for _ in threads:
        assert items.v()
    for thread in threads:
        thread.join(20)
    assert items.value == 0


def test_nobody_is_forgotten_between_two_processes_at_full_speed():
    """Ping and pong, and a queue beside them, with a kill of nobody."""
    ping, pong = (Semaphore.create(n, initial=0) for n in ("ping", "pong"))
    queue = Queue.create("numbers", messages=3, blocks=60)

    def other() -> None:
        for n in range(2000):
            assert ping.p(soon())
            size = 4 + n % 2000
            queue.send(n.to_bytes(4, "little") + bytes(size), until_ns=soon())
            assert pong.v()

    child = Child(other)
    for n in range(2000):
        assert ping.v()
        message = queue.receive(soon())
        assert int.from_bytes(message[:4], "little") == n
        assert pong.p(soon())
    assert child.end() == 0
    for shared in (ping, pong, queue):
        shared.destroy()


def test_a_stopped_process_does_not_keep_v_from_returning(items):
    """Whatever it was doing when it was stopped: V takes no lock that it waits for."""
    line = Line(items)
    stopped = line.join(lambda: items.p(soon()), 1)
    os.kill(stopped.pid, signal.SIGSTOP)
    for count in range(1, 1000):
        assert items.v()
        assert items.value == count
    os.kill(stopped.pid, signal.SIGCONT)
    assert line.after(1) == [1]
    assert line.end() == [0]
