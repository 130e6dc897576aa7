"""Looks at an RTPU: what zenoh's thread answers, and whom one that waits holds up."""

from __future__ import annotations

import os
import threading
from types import SimpleNamespace

import pytest
from watching import wait_for

from pbonet import tbuf
from pbonet.node.agent import shared_memory_status, zenoh_server
from pbonet.node.agent.shared_memory_status import FEW, SharedMemoryStatus
from pbonet.node.rt import _rt
from pbonet.node.rtpu.rtpu_snapshot import SnapshotChanges
from pbonet.node.wire.rtpu_messages import RtpuInfo
from pbonet.xm.ipc import names
from pbonet.xm.net import key_expressions, messages as m
from pbonet.xm.net.codec import Codec

INFO = RtpuInfo(pid=1, core=1, version="", backend="", limits=[], claims={})


def parsed(data):
    return Codec().answer(data)


def error_of(data):
    answer = parsed(data)
    return "" if answer.ok else answer.error["what"]


@pytest.fixture
def seen(shared_memory):
    """An overview of an RTPU process that has told nothing yet."""
    core = _rt.CoreTable(1)
    found = SharedMemoryStatus("d", "arm0", pytest.fail, lambda _: None)
    found.informed(INFO)
    yield found
    found.let_go()
    core.close()
    (shared_memory / f"pbonet.{os.geteuid()}.core1").unlink(missing_ok=True)


@pytest.fixture
def home():
    with names.living_on("arm0", domain="d", subsystem="arm"):
        yield


def test_news_of_a_process_that_has_ended_are_not_waited_for(seen, monkeypatch):
    seen.let_go()
    monkeypatch.setattr(SharedMemoryStatus, "_more", lambda *_: pytest.fail("it waits"))
    for request in (m.Status(), m.Profile()):
        assert "is being started again" in error_of(seen.answer(request))


def test_whoever_waits_hears_that_the_process_has_ended(seen, monkeypatch):
    monkeypatch.setattr(shared_memory_status, "NEWS_TIME", 3600.0)
    waits = threading.Event()
    more = SharedMemoryStatus._more

    def wait(self, told):
        waits.set()
        return more(self, told)

    monkeypatch.setattr(SharedMemoryStatus, "_more", wait)
    answers = []
    look = threading.Thread(
        target=lambda: answers.append(seen.answer(m.Status())), daemon=True
    )
    look.start()
    assert waits.wait(10.0)
    seen.let_go()
    wait_for(lambda: answers, "the answer")
    look.join()
    assert "is being started again" in error_of(answers[0])


@pytest.mark.usefixtures("home")
def test_zenohs_thread_neither_waits_nor_looks_at_many_links(seen, monkeypatch):
    monkeypatch.setattr(SharedMemoryStatus, "_more", lambda *_: pytest.fail("it waits"))
    assert seen.at_once(m.Status()) is None, "nothing is known yet"
    seen.learn(SnapshotChanges(tasks=[]))
    links = [tbuf.Writer(f"x{n}", "f8") for n in range(FEW)]
    monkeypatch.setattr(
        SharedMemoryStatus, "_read_slots", lambda _: pytest.fail("it looks again")
    )
    assert parsed(seen.at_once(m.Status())).ok
    links.append(tbuf.Writer("more", "f8"))
    assert seen.at_once(m.Status()) is None
    for link in links:
        link.close()
    assert parsed(seen.at_once(m.Status())).ok


class Query:
    """A query whose answer is kept."""

    def __init__(self, request, leaf):
        self.key_expr = key_expressions.rtpu("d", "arm0", leaf)
        self.payload = SimpleNamespace(to_bytes=lambda: Codec().pack(request))
        self.answers = []

    def reply(self, _key, data):
        self.answers.append(data)

    def __enter__(self):
        return self

    def __exit__(self, *exc):
        pass


def test_a_look_that_waits_holds_up_no_command():
    go, answered, forwarded = threading.Event(), [], []

    def answer(request):
        assert go.wait(10.0), "nothing else is carried out while it waits"
        answered.append(request)
        return b"seen"

    node = SimpleNamespace(
        forward=lambda *told: forwarded.append(told),
        stop_ordered=lambda _: None,
        warned=lambda data: data,
    )
    one = zenoh_server.Server(
        *(None, "d", "arm0"),
        node=node,
        mail=None,
        overview=SimpleNamespace(answer=answer),
        book=None,
    )
    look = Query(m.Status(), "status")
    try:
        one._take(look)
        one._take(Query(m.Stop(subsystem="arm"), "sbs"))
        assert (len(forwarded), answered) == (1, [])
        go.set()
        wait_for(lambda: look.answers == [b"seen"], "the look's answer")
        one._pending.clear()
    finally:
        go.set()
        one.stop()


def test_one_measurement_of_the_ways_is_for_all_who_wait_for_one():
    """Many that ask hold up no claim, and don't pile up."""
    go, begun, forwarded = threading.Event(), [], []

    def ways():
        begun.append(len(begun))
        assert go.wait(10.0), "claims wait for reports"
        return m.LinkReport(rtpu="arm0")

    node = SimpleNamespace(ways=ways, forward=lambda *told: forwarded.append(told))
    one = zenoh_server.Server(
        *(None, "d", "arm0"),
        node=node,
        mail=None,
        overview=None,
        book=None,
    )
    one._claim = lambda *told: forwarded.append(told)
    asked = [Query(m.Links(id=f"{n}"), "status") for n in range(100)]
    try:
        one._take(asked[0])
        wait_for(lambda: begun, "the first measurement")
        for query in asked[1:]:
            one._take(query)
        one._take(Query(m.Claim(), "sbs"))
        wait_for(lambda: forwarded, "the claim")
        go.set()
        wait_for(lambda: all(query.answers for query in asked), "all answers")
        assert begun == [0, 1]
        ids = [parsed(query.answers[0]).id for query in asked]
        assert ids == [f"{n}" for n in range(100)]
    finally:
        go.set()
        one.stop()


def test_a_report_of_the_last_round_trips_waits_for_no_measurement():
    go, kinds = threading.Event(), []

    def ways(*, measure=True):
        kinds.append(measure)
        assert not measure or go.wait(10.0)
        return m.LinkReport(rtpu="arm0")

    one = zenoh_server.Server(
        *(None, "d", "arm0"),
        node=SimpleNamespace(ways=ways),
        mail=None,
        overview=None,
        book=None,
    )
    slow, quick = (Query(m.Links(measure=each), "status") for each in (True, False))
    try:
        one._take(slow)
        wait_for(lambda: kinds, "the measurement")
        one._take(quick)
        wait_for(lambda: quick.answers, "the report of the last round trips")
        assert (kinds, slow.answers) == ([True, False], [])
    finally:
        go.set()
        one.stop()


def test_a_write_overtakes_no_write_that_waits():
    """The first one could not be carried out at once; the master has sent on."""
    done = []
    free = []

    def at_once(request):
        if not free:
            return None
        return answer(request)

    def answer(request):
        done.append(request.values)
        return b"done"

    one = zenoh_server.Server(
        *(None, "d", "arm0"),
        node=SimpleNamespace(spread=lambda _, end, **__: end()),
        mail=None,
        overview=SimpleNamespace(answer=answer, write_at_once=at_once),
        book=SimpleNamespace(noted=lambda *_: True),
    )

    def write(value):
        one._arrive(Query(m.Write(name="Q", values=[value], id=f"{value}"), "sbs"))

    write(1.0)
    free.append(True)
    write(2.0)
    one._thread.start()
    wait_for(lambda: len(done) == 2, "both writes")
    wait_for(lambda: not one._behind, "the end of what waited")
    write(3.0)
    try:
        assert done == [[1.0], [2.0], [3.0]]
    finally:
        one.stop()


def test_a_command_that_is_repeated_stands_on_record_once():
    """Who hears nothing for a while asks again, under the same id."""
    booked, forwarded, kept = [], [], []
    one = zenoh_server.Server(
        *(None, "d", "arm0"),
        node=SimpleNamespace(
            forward=lambda n, *_: forwarded.append(n),
            spread=lambda _, done, **__: done(),
            stop_ordered=lambda _: None,
            done=lambda request, data: kept.append((request.id, data)),
            warned=lambda data: data,
        ),
        mail=None,
        overview=None,
        book=SimpleNamespace(commanded=lambda request, *_: booked.append(request.id)),
    )
    asked = [
        Query(m.Stop(subsystem="arm", client="m", id=number), "sbs")
        for number in ("1", "1", "2", "", "")
    ]
    try:
        for query in asked:
            one._take(query)
        for n in forwarded:
            one.answer(n, b"stopped")
    finally:
        one.stop()
    assert [query.answers for query in asked] == [[b"stopped"]] * 5
    assert booked == ["1", "2", "", ""]
    assert kept == [(number, b"stopped") for number in booked]
