"""Requests that are delivered in order, without their sender waiting."""

import threading
from queue import Queue

import pytest

from pbonet.errors import UnreachableError
from pbonet.xm.net import deliveries
from pbonet.xm.net.deliveries import ROOM, Deliveries
from pbonet.xm.net.resource_messages import Give


class Agent:
    """Takes requests when it is open; refuses those for a name."""

    def __init__(self):
        self.open = threading.Event()
        self.taken = Queue()

    def call(self, rtpu, request, result, *, timeout):  # noqa: ARG002
        assert self.open.wait(60)
        if request.name == "lost":
            raise UnreachableError("no way there", where=rtpu)
        self.taken.put(request.name)


@pytest.fixture
def agent():
    return Agent()


@pytest.fixture
def reports():
    return Queue()


@pytest.fixture
def sent(agent, reports):
    made = Deliveries(agent, reports.put)
    yield made
    made.end()
    agent.open.set()


def test_the_order_is_kept_and_the_sender_does_not_wait(agent, sent, reports):
    names = [f"n{k}" for k in range(ROOM)]
    for name in names:
        sent.add("arm0", Give(name=name))
    assert agent.taken.empty(), "the agent has not answered yet"
    agent.open.set()
    assert [agent.taken.get(timeout=60) for _ in names] == names
    assert reports.empty()


def test_a_failure_is_reported_and_later_ones_are_delivered(agent, sent, reports):
    agent.open.set()
    sent.add("arm0", Give(name="lost"))
    sent.add("arm0", Give(name="next"))
    assert agent.taken.get(timeout=60) == "next"
    text = reports.get(timeout=60)
    assert text.startswith("a signal or message was not delivered: arm0: no way there")


def test_failures_of_one_time_are_one_report(agent, sent, reports, monkeypatch):
    monkeypatch.setattr(deliveries, "PAUSE", 0.05)
    sent._reported = deliveries.time.monotonic() + 0.5
    agent.open.set()
    for _ in range(5):
        sent.add("arm0", Give(name="lost"))
    assert reports.get(timeout=60).startswith("5 of its signals were not delivered")


def test_more_than_there_is_room_for_are_dropped_and_counted(agent, sent, reports):
    sent.add("arm0", Give(name="first"))
    while sent._queue.qsize():  # until the thread has taken it
        pass
    for k in range(ROOM + 3):
        sent.add("arm0", Give(name=str(k)))
    agent.open.set()
    text = reports.get(timeout=60)
    assert text == (
        f"3 of its signals were not delivered: arm0: more than {ROOM} wait to be "
        "delivered there"
    )
    assert [agent.taken.get(timeout=60) for _ in range(ROOM + 1)][-1] == str(ROOM - 1)
