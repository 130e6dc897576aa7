"""What ends the sleep of who carries a table to other machines, and what does not."""

from __future__ import annotations

import ctypes
import os
import threading

import pytest

from pbonet.config.model import Variable
from pbonet.svar import Table
from pbonet.svar._svar import Watch, now_ns
from pbonet.svar.mirror import packets
from pbonet.svar.mirror.table_mirror import Mirror

ME = os.getpid()
SOON, EVER = 1, 1 << 62


@pytest.fixture
def table():
    made = Table.create(
        "t",
        [
            Variable(name="Q", type="double", nelem=3),
            Variable(name="R", type="double", nelem=1),
        ],
    )
    yield made
    made.destroy()


@pytest.fixture
def mirror(table):
    made = Mirror(table, "here", 1, keep=True)
    made.next_packet(full=True)
    yield made
    made.close()


@pytest.fixture
def task(table):
    return table.local("sine", ME, outvar=["Q"])


def moved(mirror):
    """Tell whether there is something that was not heeded."""
    watch = Watch()
    mirror.watch(watch)
    return watch.sleep(SOON, SOON)


def heed(mirror):
    """Tell whether something had moved; heed it."""
    found = moved(mirror)
    mirror.next_packet()
    return found


def test_ownership_that_changes(mirror, task):
    assert not moved(mirror)
    task.claim()
    assert heed(mirror)
    assert not moved(mirror)
    task.release()
    assert heed(mirror)
    assert not moved(mirror)


def test_the_flag(mirror, table):
    table.raise_illegal("no sensor", "who")
    assert heed(mirror)
    assert not moved(mirror)
    table.clear_illegal("who")
    assert heed(mirror)
    assert not moved(mirror)


def test_a_commit_that_was_not_expected(mirror, task):
    task.claim()
    mirror.next_packet()
    assert not moved(mirror)
    task.commit(now_ns(), 1)
    assert heed(mirror)
    assert not moved(mirror)


def test_a_group_that_could_not_be_sent_yet(mirror, task):
    task.claim()
    mirror._outbox.update(mirror._epochs)
    assert heed(mirror)
    assert not moved(mirror)


def test_what_an_operator_sets(mirror, table):
    table.write("R", [1.0])
    assert heed(mirror)
    table.write("R", [2.0])
    assert heed(mirror)
    assert not moved(mirror)


def test_a_commit_that_is_expected_is_left_to_its_time(mirror, task):
    task.claim()
    mirror.next_packet()
    for cycle in range(1, 4):
        task.commit(now_ns(), cycle)
        mirror.next_packet()
    assert mirror.due() is not None
    task.commit(now_ns(), 4)
    assert not moved(mirror)


def test_what_comes_from_another_machine_is_no_news(mirror, table):
    other = Table.create("u", table.variables)
    there = Mirror(other, "there", 1, keep=False)
    other_task = other.local("far", ME, outvar=["R"])
    other_task.claim()
    mirror.take(packets.unpack(packets.pack(there.next_packet(full=True))))
    mirror.next_packet()
    other_task.commit(now_ns(), 1)
    mirror.take(packets.unpack(packets.pack(there.next_packet())))
    assert not moved(mirror)
    there.close()
    other.destroy()


def test_a_ring_from_another_thread_ends_the_sleep():
    watch = Watch()
    sleeper = threading.Thread(target=watch.sleep, args=(EVER, EVER))
    sleeper.start()
    watch.ring()
    sleeper.join()


def test_a_ring_before_the_sleep_is_not_lost():
    watch = Watch()
    watch.ring()
    assert not watch.sleep(EVER, EVER)


def test_what_is_not_heeded_does_not_keep_awake(mirror, task):
    watch = Watch()
    mirror.watch(watch)
    task.claim()
    assert watch.sleep(EVER, EVER)
    assert not watch.sleep(SOON, EVER)  # it looks again a pause later


def test_rings_do_not_keep_it_from_looking(mirror, task):
    watch = Watch()
    mirror.watch(watch)
    watch.sleep(SOON, 1000)
    task.claim()
    rings = 0
    watch.ring()
    while not watch.sleep(EVER, 1000):
        watch.ring()
        rings += 1
        assert rings < 1_000_000


@pytest.mark.parametrize(("pause_ns", "slack_ns"), [(20_000, 1), (1_000_000, None)])
def test_short_sleeps_end_without_slack(pause_ns, slack_ns) -> None:
    """Linux would end each of them up to 50 us late; longer ones stay as they are."""
    get_timer_slack, found = 30, []

    def sleeps() -> None:
        prctl = ctypes.CDLL(None).prctl
        before = prctl(get_timer_slack, 0, 0, 0, 0)
        Watch().sleep(now_ns() + 50_000, pause_ns)
        found.extend((before, prctl(get_timer_slack, 0, 0, 0, 0)))

    thread = threading.Thread(target=sleeps)
    thread.start()
    thread.join()
    before, after = found
    assert after == (before if slack_ns is None else slack_ns)
