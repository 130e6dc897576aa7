"""When an agent answers what has changed a table that stands on other machines, too."""

from __future__ import annotations

import contextlib
import os
import threading
import time
from functools import partial
from types import SimpleNamespace
from unittest.mock import MagicMock

import numpy as np
import pytest
import zenoh
from watching import wait_for

from pbonet.config.model import Variable
from pbonet.node.mirror import (
    packet_queue,
    remote_handover,
    table_carrier as mirrors_module,
)
from pbonet.node.mirror.mirrored_table import MirroredTable
from pbonet.node.mirror.sent_value import TAKEN, VALUE
from pbonet.node.mirror.table_carrier import TableCarrier
from pbonet.node.rtpu.tables import table_name
from pbonet.node.wire import ClockOffsets
from pbonet.node.wire.rtpu_messages import OpenTable
from pbonet.svar import Table
from pbonet.svar.mirror import packets
from pbonet.svar.mirror.table_mirror import Mirror


class Network(MagicMock):
    """A session that keeps what is asked; others answer when a test says so."""

    def get(self, _key, handler, payload=None, attachment=None, **_options):
        self.asked, self.question, self.attached = handler, payload, attachment

    def reply(self, data, machine="m2"):
        """Have another machine answer."""
        sample = SimpleNamespace(
            payload=SimpleNamespace(to_bytes=lambda: data),
            key_expr=f"pbonet/d/sbs/arm/svar/sync/{machine}",
        )
        self.asked.callback(SimpleNamespace(ok=sample))

    def answers(self, data):
        """Have another machine answer, and tell that no more answers come."""
        self.reply(data)
        self.asked.drop()


class Asking:
    """A question of another machine, and the answers to it."""

    def __init__(self, packet, attachment=None):
        data = packets.pack(packet)
        self.payload = SimpleNamespace(to_bytes=lambda: data)
        self.attachment = attachment and SimpleNamespace(to_bytes=lambda: attachment)
        self.answers = []

    def __enter__(self):
        return self

    def __exit__(self, *_):
        pass

    def reply(self, _key, data):
        self.answers.append(data)


def turn(mirrors):
    """Do what the carrier's thread has to do."""
    while not mirrors._todo.empty():
        mirrors._todo.get()()


@pytest.fixture
def table():
    variables = [Variable(name="Q", type="double", nelem=3)]
    made = Table.create(table_name("d", "arm"), variables)
    yield made
    made.destroy()


@pytest.fixture
def carrying(request, table):
    """Who carries the table, where no other machine is; and what it has told."""
    told = []
    network = Network()
    mirrors = TableCarrier(network, "d", ClockOffsets(), told.append)
    use = OpenTable(keep=getattr(request, "param", True))
    mirrors.carry({table.name.removeprefix("d."): use})
    turn(mirrors)
    mirrors._carried["arm"].turn(0.0)
    network.asked.drop()  # nobody else
    turn(mirrors)
    yield mirrors, told
    mirrors.carry({})
    turn(mirrors)


def token(kind, machine="m2"):
    return SimpleNamespace(key_expr=f"pbonet/d/sbs/arm/svar/here/{machine}", kind=kind)


def set_before(mirrors, table, machines=("m2",)):
    """Set a variable of which the other machines know that it was set here."""
    carried = mirrors._carried["arm"]
    for machine in machines:
        carried._met(token(zenoh.SampleKind.PUT, machine))
    table.write("Q", [1.0, 2.0, 3.0])
    turn(mirrors)
    return carried


def test_who_is_alone_waits_for_nobody(carrying):
    mirrors, _ = carrying
    carried, done = mirrors._carried["arm"], []
    mirrors.spread("arm", lambda: done.append("alone"), take=False)
    assert done == ["alone"]
    carried._met(token(zenoh.SampleKind.PUT))  # before anything was exchanged with it
    mirrors.spread("arm", lambda: done.append("two"), take=False)
    assert done == ["alone"]
    carried._met(token(zenoh.SampleKind.DELETE))
    mirrors.spread("arm", lambda: done.append("alone again"), take=False)
    assert done == ["alone", "alone again"]


def test_the_flag_goes_up_without_the_keepers_machine(carrying, table, monkeypatch):
    mirrors, notes = carrying
    clock, silence = [time.monotonic()], {"arm9": 100.0}
    monkeypatch.setattr(time, "monotonic", lambda: clock[0])
    mirrors.silence = silence.__getitem__
    mirrors.carry({"arm": OpenTable(keep=False, keeper="arm9", alone=2.0)})
    turn(mirrors)
    carried = mirrors._carried["arm"]

    def after(seconds):
        clock[0] += seconds
        carried.turn(clock[0])
        return [one.cause for one in table.illegal]

    assert after(1.95) == [], "2 s since it is the keeper have not passed"
    assert carried.next == pytest.approx(clock[0] + 0.05)
    cause = "no sign of life from RTPU arm9 for 2 s (ALONE)"
    assert after(0.05) == after(1.0) == [cause]
    silence["arm9"] = 0.1
    assert after(0.2) == []
    silence["arm9"] = 2.0
    assert after(1.9) == [cause]
    mirrors.carry({"arm": OpenTable(keep=False, keeper="arm9", alone=0.0)})
    turn(mirrors)
    assert after(0.2) == [], "ALONE never"
    texts = [f"arm: {cause}", f"arm: no longer: {cause}"] * 2
    assert [one.text for one in notes] == texts
    assert [one.code for one in notes] == ["ILLEGAL", "LEGAL"] * 2


def test_packets_of_another_version_raise_the_flag(carrying, table):
    mirrors, _ = carrying
    packet = packets.Packet(packets.VERSIONS.newest + 1, "m2", "two", 1, 0, 0, [])
    assert mirrors._carried["arm"]._take(packets.pack(packet)) == ""
    assert mirrors._carried["arm"]._take(b"\x91") == ""
    (cause,) = table.illegal
    assert cause.cause.startswith("the table of host two is of version")


def test_who_ends_a_table_is_answered_behind_its_carrier(carrying):
    """Who is answered may make another table of that name, and finds none left."""
    mirrors, _ = carrying
    held = []
    mirrors.carry({})
    mirrors.spread("arm", lambda: held.append("arm" in mirrors._carried))
    assert not held, "it is attached as long as its thread has not let go"
    turn(mirrors)
    assert held == [False]


@pytest.mark.usefixtures("table")
def test_who_has_been_answered_is_not_alone_before_that_is_taken(monkeypatch):
    found = []
    monkeypatch.setattr(MirroredTable, "_take", lambda one, *_: found.append(one.alone))
    network = Network()
    mirrors = TableCarrier(network, "d", ClockOffsets())
    try:
        mirrors.carry({"arm": OpenTable(keep=True)})
        turn(mirrors)
        carried = mirrors._carried["arm"]
        carried.turn(0.0)
        network.answers(b"state")
        assert not carried.alone
        turn(mirrors)
        assert found == [False]
    finally:
        mirrors.carry({})
        turn(mirrors)


def test_who_is_alone_still_looks_at_what_the_lost_ones_owned(carrying, monkeypatch):
    """A writer that takes a lost machine's place ends what the flag says of it."""
    looks = []
    monkeypatch.setattr(Mirror, "next_packet", lambda *_, **how: looks.append(how))
    mirrors, _ = carrying
    carried = mirrors._carried["arm"]
    mirrors.spread("arm", lambda: None, take=False)
    turn(mirrors)
    assert carried.next == 0.0, "its turn comes at once"
    carried.turn(1.0)
    assert looks == [{"full": True}]


def test_a_value_that_is_set_alone_wakes_nobody_and_is_looked_at_once(
    carrying, monkeypatch
):
    looks, done = [], []
    monkeypatch.setattr(Mirror, "next_packet", lambda *_, **how: looks.append(how))
    mirrors, _ = carrying
    carried = mirrors._carried["arm"]
    for n in range(3):
        mirrors.spread("arm", lambda n=n: done.append(n), value="Q")
    assert done == [0, 1, 2]
    assert mirrors._todo.empty()
    assert not looks
    carried.turn(1.0)
    carried.turn(2.0)
    assert looks == [{"full": True}], "one look for all of them"
    carried._met(token(zenoh.SampleKind.PUT))
    mirrors.spread("arm", lambda: done.append("two"), value="Q")
    assert done == [0, 1, 2], "whoever is there is told first"


def test_how_late_a_call_comes_is_known_when_that_machines_clock_is(
    carrying, monkeypatch
):
    """Before, nobody can tell, and no call is taken for one in time."""
    mirrors, _ = carrying
    made = []
    monkeypatch.setattr(remote_handover, "make", lambda *how: made.append(how))
    sent = time.monotonic_ns()  # an hour ago, by a clock that is an hour ahead
    known = packets.VERSIONS.newest
    packet = packets.Packet(known, "m2", "two", 1, 0, sent, [], calls=[b"c"])
    mirrors._carried["arm"]._take(packets.pack(packet))
    mirrors.measured("m2", sent, sent, sent + 3_600_000_000_000)
    mirrors._carried["arm"]._take(packets.pack(packet))
    (of, call, unknown), (_, _, late_ns) = made
    assert (of, call, unknown) == (mirrors._carried["arm"].table, b"c", None)
    assert late_ns >= 3_600_000_000_000


def test_an_exchange_of_states_measures_the_other_clock(carrying):
    """So that no value that came with it counts as old for longer than necessary."""
    mirrors, _ = carrying
    ahead = 3_600_000_000_000
    carried = mirrors._carried["arm"]
    carried._exchange(done=int)
    sent = time.monotonic_ns() + ahead
    packet = packets.Packet(packets.VERSIONS.newest, "m2", "two", 1, 0, sent, [])
    assert mirrors.late("m2", sent) is None
    mirrors.session.answers(packets.pack(packet))
    turn(mirrors)
    clock = mirrors._clocks.clock("m2", time.monotonic_ns())
    assert abs(clock.ahead_ns - ahead) <= clock.error_ns


def test_packets_that_come_too_fast_are_told_of(carrying):
    mirrors, told = carrying
    payload = SimpleNamespace(to_bytes=lambda: b"no packet")
    sample = SimpleNamespace(key_expr="pbonet/d/sbs/arm/svar/news/m2", payload=payload)
    carried = mirrors._carried["arm"]
    for _ in range(packet_queue.WAITING + 7):
        carried._on_packet(sample)
    turn(mirrors)
    (note,) = told
    assert note.code == "TABLE_BEHIND"
    assert "7 packets for the table of arm" in note.text
    assert carried.incoming.lost == {"m2": 7}


def test_old_values_that_waited_are_not_written_one_after_the_other(carrying, table):
    """After an interruption they come together, and with them the first new one."""
    mirrors, _ = carrying
    carried = mirrors._carried["arm"]
    there = Table.create("there", [Variable(name="Q", type="double", nelem=3)])
    other = Mirror(there, "m2", 1, keep=False)
    task = there.local("pid", os.getpid(), outvar=["Q"])

    def put(*, full=False):
        data = packets.pack(other.next_packet(full=full))
        payload = SimpleNamespace(to_bytes=lambda: data)
        key = "pbonet/d/sbs/arm/svar/news/m2"
        carried._on_packet(SimpleNamespace(key_expr=key, payload=payload))

    try:
        task.claim()
        put(full=True)
        turn(mirrors)
        counts = carried.mirror.others["m2"].counts
        before = counts.commits
        for n in range(100):
            task.array("Q")[:] = n
            task.commit()
            put(full=n == 50)
        turn(mirrors)
        assert table.read("Q").tolist() == [99.0] * 3
        assert (counts.commits - before, counts.gaps) == (1, 99)
    finally:
        task.close()
        other.close()
        there.destroy()


def test_a_packet_that_cannot_be_read_keeps_none_of_the_others_out(carrying):
    mirrors, _ = carrying
    carried = mirrors._carried["arm"]
    known = packets.VERSIONS.newest
    good = packets.pack(packets.Packet(known, "m2", "two", 1, 0, 0, []))
    fields = good[0] & 15
    deep = bytes([0x90 | fields + 1]) + good[1:] + b"\x91" * 200_000 + b"\xc0"
    for data in (deep, b"", b"\xff", good):
        payload = SimpleNamespace(to_bytes=partial(bytes, data))
        key = "pbonet/d/sbs/arm/svar/news/m2"
        carried._on_packet(SimpleNamespace(key_expr=key, payload=payload))
    turn(mirrors)
    assert set(carried.mirror.others) == {"m2"}


def test_packets_that_come_together_count_in_their_order(carrying, table):
    """A machine that restarts with another version: its last packet is not read."""
    mirrors, _ = carrying
    carried = mirrors._carried["arm"]
    known = packets.VERSIONS.newest
    read = packets.Packet(known, "m2", "two", 1, 0, 0, [])
    other = packets.Packet(known + 1, "m2", "two", 2, 0, 0, [])
    for packet in (read, other):
        payload = SimpleNamespace(to_bytes=partial(packets.pack, packet))
        key = "pbonet/d/sbs/arm/svar/news/m2"
        carried._on_packet(SimpleNamespace(key_expr=key, payload=payload))
    turn(mirrors)
    (cause,) = table.illegal
    assert f"is of version {known + 1}" in cause.cause


def test_what_others_ask_is_bounded(carrying):
    mirrors, _ = carrying
    queries = [MagicMock(payload=None) for _ in range(mirrors_module.ASKED + 1)]
    for query in queries:
        mirrors._carried["arm"]._asked(query)
    assert [q.drop.called for q in queries] == [False] * mirrors_module.ASKED + [True]


@pytest.mark.parametrize("take", [False, True])
def test_who_waits_for_other_machines_is_answered_when_the_agent_leaves(carrying, take):
    """Once, also where these answer at last; be it asked, or still to be asked."""
    mirrors, _ = carrying
    mirrors._carried["arm"]._met(token(zenoh.SampleKind.PUT))
    network, done = mirrors.session, []
    mirrors.spread("arm", lambda: done.append("asked"), take=take)
    turn(mirrors)
    mirrors.spread("arm", lambda: done.append("to be asked"), take=take)
    assert done == []
    mirrors.stop()
    assert done == ["asked", "to be asked"]
    network.asked.drop()
    turn(mirrors)
    mirrors.spread("arm", lambda: done.append("late"), take=take)
    assert done == ["asked", "to be asked", "late"]


@pytest.mark.parametrize(
    ("take", "in_order"), [(True, [b"state", "done"]), (False, ["done", b"state"])]
)
@pytest.mark.usefixtures("table")
def test_a_table_is_open_when_the_others_states_are_taken(monkeypatch, take, in_order):
    """The carrier's thread comes late; only who opens a table waits for it."""
    happened, threads = [], []
    monkeypatch.setattr(
        MirroredTable, "_take", lambda _, data, *_a: happened.append(data)
    )

    def done():
        threads.append(threading.current_thread().name)
        happened.append("done")

    network = Network()
    mirrors = TableCarrier(network, "d", ClockOffsets())
    try:
        mirrors.carry({"arm": OpenTable(keep=True)})
        mirrors.spread("arm", done, take=take)
        turn(mirrors)
        network.answers(b"state")
        if not take:
            wait_for(lambda: happened == ["done"], "the word that all have it")
            assert threads == ["pbonet told_0"]  # zenoh's may hold its routes
        turn(mirrors)
        assert happened == in_order
    finally:
        mirrors.carry({})
        turn(mirrors)


def test_a_value_is_sent_by_itself_and_known_when_every_machine_has_taken_it(
    carrying, table
):
    mirrors, _ = carrying
    set_before(mirrors, table, ["m2", "m3"])
    network, done = mirrors.session, []
    table.write("Q", [4.0, 5.0, 6.0])
    mirrors.spread("arm", lambda: done.append("known"), value="Q")
    assert mirrors._todo.empty(), "no thread is woken"
    packet = packets.unpack(network.question)
    assert (packet.full, len(packet.news)) == (None, 1)
    assert np.frombuffer(packet.news[0].data).tolist() == [4.0, 5.0, 6.0]
    network.reply(TAKEN, "m2")
    network.reply(TAKEN, "m2")
    assert done == []
    network.reply(TAKEN, "m3")
    assert done == ["known"]
    network.asked.drop()
    assert mirrors._todo.empty()
    assert mirrors._carried["arm"].mirror.next_packet() is None, "it was sent"


def test_a_machine_that_does_not_know_the_value_is_sent_the_whole_state(
    carrying, table
):
    mirrors, _ = carrying
    set_before(mirrors, table, ["m2", "m3"])
    network, done = mirrors.session, []
    mirrors.spread("arm", lambda: done.append("known"), value="Q")
    network.reply(b"", "m2")
    network.reply(TAKEN, "m3")
    network.asked.drop()
    assert done == []
    turn(mirrors)
    assert packets.unpack(network.question).full is not None
    assert done == []
    network.asked.drop()
    wait_for(lambda: done == ["known"], "the word that all have it")


def test_who_is_silent_about_a_value_is_waited_for_until_the_end(carrying, table):
    mirrors, _ = carrying
    set_before(mirrors, table, ["m2", "m3"])
    network, done = mirrors.session, []

    def known():
        done.append(threading.current_thread().name)

    mirrors.spread("arm", known, value="Q")
    network.reply(TAKEN, "m2")
    network.asked.callback(SimpleNamespace(ok=None))
    assert done == []
    network.asked.drop()
    wait_for(lambda: done == ["pbonet told_0"], "the word that all have it")
    assert mirrors._todo.empty(), "and nothing is sent again"


@pytest.mark.parametrize("why", ["first", "busy", "owned since"])
def test_the_state_is_sent_where_a_value_is_not_enough(carrying, table, why):
    mirrors, _ = carrying
    carried = set_before(mirrors, table)
    if why == "first":
        carried._met(token(zenoh.SampleKind.PUT))
        carried.mirror._outbox.groups.clear()
    elif why == "owned since":
        task = table.local("pid", os.getpid(), outvar=["Q"])
        task.claim()
        task.close()
    network = mirrors.session
    network.question = None
    with mirrors._working if why == "busy" else contextlib.nullcontext():
        mirrors.spread("arm", lambda: None, value="Q")
    assert network.question is None
    turn(mirrors)
    assert packets.unpack(network.question).full is not None


@pytest.mark.parametrize("carrying", [False], ids=["not the keeper"], indirect=True)
def test_a_value_is_taken_at_once_unless_the_carrier_is_busy(carrying, table):
    mirrors, _ = carrying
    carried = mirrors._carried["arm"]
    there = Table.create("there", [Variable(name="Q", type="double", nelem=3)])
    other = Mirror(there, "m2", 1, keep=True)
    try:
        there.write("Q", [1.0, 2.0, 3.0])
        ask = Asking(other.next_packet(full=True))
        carried._asked(ask)
        turn(mirrors)
        assert packets.unpack(ask.answers[0]).full is not None

        there.write("Q", [4.0, 5.0, 6.0])
        ask = Asking(other.value_packet("Q"), VALUE)
        carried._asked(ask)
        assert ask.answers == [TAKEN]
        assert mirrors._todo.empty()
        assert table.read("Q").tolist() == [4.0, 5.0, 6.0]

        there.write("Q", [7.0, 8.0, 9.0])
        ask = Asking(other.value_packet("Q"), VALUE)
        with mirrors._working:
            carried._asked(ask)
        assert ask.answers == []
        turn(mirrors)
        assert ask.answers == [TAKEN]
        assert table.read("Q").tolist() == [7.0, 8.0, 9.0]

        task = table.local("pid", os.getpid(), outvar=["Q"])
        task.claim()
        there.write("Q", [1.0, 1.0, 1.0])
        ask = Asking(other.value_packet("Q"), VALUE)
        carried._asked(ask)
        assert ask.answers == [b""], "a task has it"
        task.close()

        carried.lose("m2")
        ask = Asking(other.value_packet("Q"), VALUE)
        carried._asked(ask)
        assert ask.answers == [b""], "its state is not known"
    finally:
        other.close()
        there.destroy()


def test_a_value_whose_table_was_closed_meanwhile_is_answered(carrying, table):
    mirrors, _ = carrying
    carried = set_before(mirrors, table)
    network, done = mirrors.session, []
    mirrors.spread("arm", lambda: done.append("known"), value="Q")
    network.reply(b"")
    mirrors.carry({})
    turn(mirrors)
    network.asked.drop()
    turn(mirrors)
    assert done == ["known"]
    assert carried.mirror is None, "a table that was closed is not carried again"


def test_a_value_whose_state_cannot_be_sent_is_answered(carrying, table, monkeypatch):
    mirrors, _ = carrying
    set_before(mirrors, table)
    network, done = mirrors.session, []
    mirrors.spread("arm", lambda: done.append("known"), value="Q")
    network.reply(b"")
    network.asked.drop()
    fails = MagicMock(side_effect=RuntimeError("broken"))
    monkeypatch.setattr(MirroredTable, "_exchange", fails)
    with pytest.raises(RuntimeError, match="broken"):
        turn(mirrors)
    assert done == ["known"]


def test_a_variable_that_does_not_exist_is_no_fault_of_the_transfer(
    carrying, table, caplog
):
    mirrors, _ = carrying
    set_before(mirrors, table)
    mirrors.spread("arm", lambda: None, value="NO_SUCH")
    turn(mirrors)
    assert packets.unpack(mirrors.session.question).full is not None
    assert not caplog.records


def test_a_machine_that_was_heard_is_waited_for_before_its_token_comes(carrying, table):
    mirrors, _ = carrying
    carried = set_before(mirrors, table)
    network, done = mirrors.session, []
    there = Table.create("there", [Variable(name="Q", type="double", nelem=3)])
    other = Mirror(there, "m3", 1, keep=False)
    try:
        carried.incoming.put("m3", packets.pack(other.next_packet(full=True)))
        turn(mirrors)
        mirrors.spread("arm", lambda: done.append("known"), value="Q")
        network.reply(TAKEN, "m2")
        assert done == []
        network.reply(TAKEN, "m3")
        assert done == ["known"]
    finally:
        other.close()
        there.destroy()
