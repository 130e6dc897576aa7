"""Tables of two machines that tell each other of themselves, without a network."""

from __future__ import annotations

import os

import numpy as np
import pytest

from pbonet.config.model import Variable
from pbonet.errors import SvarOwnerError
from pbonet.svar import Freshness, Table, now_ns
from pbonet.svar.mirror import mirror_outbox, packets, table_mirror
from pbonet.svar.mirror.table_mirror import Mirror

ME = os.getpid()
VARIABLES = [
    Variable(name="Q", type="double", nelem=3, maxage=0.5),
    Variable(name="QD", type="float32", nelem=3),
    Variable(name="MODE", type="int", nelem=1, init=(4,)),
    Variable(name="BLOB", type="struct[5]", nelem=2),
    Variable(name="SLOW", type="double", nelem=1, rate=0.001),
    Variable(name="TENTH", type="double", nelem=1, rate=10.0),
]


class Side:
    """One machine."""

    def __init__(self, name, *, keep, run=1, late=0):
        self.name = name
        self.table = Table.create(name, VARIABLES)
        self.mirror = self.make(run, keep=keep, late=late)
        self.mirror.host = f"host-{name}"

    def make(self, run, *, keep, late=0):
        return Mirror(self.table, self.name, run, keep=keep, late=lambda *_: late)

    def task(self, name, *outvar):
        return self.table.local(name, ME, outvar=outvar)

    def close(self):
        self.mirror.close()
        self.table.destroy()


@pytest.fixture
def sides():
    made = [Side("a", keep=True), Side("b", keep=False)]
    yield made
    for side in made:
        side.close()


def carry(one, *others, full=False):
    """Let one machine tell the others; return the packet."""
    packet = one.mirror.next_packet(full=full)
    if packet is not None:
        for other in others:
            copy = packets.unpack(packets.pack(packet))
            other.mirror.take(copy)
    return packet


def meet(*sides):
    """Let all machines know all."""
    for _ in range(2):
        for one in sides:
            carry(one, *(s for s in sides if s is not one), full=True)


def on(side, name, *outvar, value=1.0):
    task = side.task(name, *outvar)
    for each in outvar:
        task.array(each).view(np.uint8)[:] = 0
    task.array(outvar[0])[:] = value
    assert task.claim() == 0
    return task


def test_a_group_is_whole_and_keeps_its_cycle(sides):
    a, b = sides
    task = on(a, "pid", "Q", "BLOB")
    carry(a, b)
    task.array("Q")[:] = [1, 2, 3]
    task.array("BLOB").view(np.uint8)[:] = np.arange(10)
    task.commit(0, 17)
    carry(a, b)
    assert b.table.read("Q").tolist() == [1, 2, 3]
    assert b.table.read("BLOB").tobytes() == bytes(range(10))
    info = b.table.info("Q")
    assert (info.owner, info.cycle) == ("pid@host-a", 17)


def test_only_what_is_new_is_told(sides):
    a, b = sides
    task = on(a, "pid", "Q")
    meet(a, b)
    assert carry(a, b) is None
    task.commit()
    assert len(carry(a, b).news) == 1


def test_an_age_that_was_passed_on_is_passed_on_elsewhere(sides):
    a, b = sides
    task = on(a, "filter", "QD")
    old = a.table.info("QD").time_ns - 300_000_000
    task.commit(0, 5, own_ns=old)
    carry(a, b)
    info = b.table.info("QD")
    assert (info.cycle, info.age_ns >= 300_000_000) == (5, True)
    reader = b.table.local("reader", ME, invar=["QD"], outvar=["MODE"])
    reader.keep_fresh({b.table.index("QD"): Freshness()})
    reader.copy_in()
    reader.claim()
    assert b.table.info("MODE").time_ns == info.time_ns, "QD has no limit"


def test_the_next_commit_is_awaited_however_old_its_data_are(sides):
    a, b = sides
    task = on(a, "filter", "Q")
    meet(a, b)
    for cycle in range(1, 4):
        task.commit(0, cycle, own_ns=now_ns() - 200_000_000)
        carry(a, b)
    due = a.mirror.due()
    assert due is None or due > -0.05, "nobody polls for what is not due"


def test_the_age_is_that_of_the_writer(sides):
    a, b = sides
    task = on(a, "pid", "Q")
    old = a.table.info("Q").time_ns - 300_000_000
    task.commit(old, 1)
    carry(a, b)
    assert 300_000_000 <= b.table.info("Q").age_ns <= a.table.info("Q").age_ns + 10**9
    assert b.table.info("Q").time_ns >= old


def test_what_was_late_is_older(sides):
    a, b = sides
    on(a, "pid", "Q")
    b.mirror = b.make(1, keep=False, late=700_000_000)
    carry(a, b)
    assert b.table.info("Q").age_ns >= 700_000_000
    assert b.table.info("Q").stale


def test_of_an_unknown_clock_it_is_old_until_that_is_known(sides):
    a, b = sides
    on(a, "pid", "Q")
    ways = [None, None, 3_000_000]
    b.mirror = Mirror(b.table, "b", 1, keep=False, late=lambda *_: ways.pop(0))
    carry(a, b, full=True)
    assert b.table.info("Q").stale
    assert b.table.info("Q").time_ns == 1
    carry(a, b, full=True)
    assert b.table.info("Q").stale
    carry(a, b, full=True)
    assert not b.table.info("Q").stale
    assert 3_000_000 <= b.table.info("Q").age_ns <= 10**9


def test_newest_first_and_gaps_counted(sides):
    a, b = sides
    task = on(a, "pid", "Q")
    meet(a, b)
    for n in range(5):
        task.array("Q")[:] = n
        task.commit()
    carry(a, b)
    assert b.table.read("Q").tolist() == [4, 4, 4]
    assert b.mirror.others["a"].counts.gaps == 4


def test_an_old_packet_changes_nothing(sides):
    a, b = sides
    task = on(a, "pid", "Q")
    meet(a, b)
    task.array("Q")[:] = 1
    task.commit()
    early = a.mirror.next_packet()
    task.array("Q")[:] = 2
    task.commit()
    carry(a, b)
    b.mirror.take(early)
    assert b.table.read("Q").tolist() == [2, 2, 2]


def test_of_packets_that_come_together_only_the_newest_values_are_left():
    """Groups, machines and their runs are kept apart; 6 after 7 is not written."""

    def packet(*news, machine="a", run=1):
        made = [packets.News(uid, seq, 0, 0, b"") for uid, seq in news]
        return packets.Packet(packets.VERSIONS.newest, machine, "a", run, 0, 0, made)

    last = packets.NUMBERS  # 0 comes next
    received = [
        packet((1, 5), (2, last)),
        packet((1, 7)),
        packet((1, 7), (2, 0)),
        packet((1, 6)),
        packet((1, 2), run=2),
        packet((1, 3), machine="b"),
    ]
    packets.leave_newest(received)
    left = [[(news.uid, news.seq) for news in one.news] for one in received]
    assert left == [[], [(1, 7)], [(1, 7), (2, 0)], [(1, 6)], [(1, 2)], [(1, 3)]]


def test_a_packet_that_repeats_a_value_does_not_take_it_from_the_first_one(sides):
    """Without its value a constant would be in conflict with the equal one here."""
    a, b = sides
    for side in sides:
        task = side.table.local("maker", ME, outconst=["MODE"])
        task.array("MODE")[:] = 6
        task.copy_out_consts()
    b.mirror.next_packet(full=True)
    received = [a.mirror.next_packet(full=True) for _ in range(2)]
    packets.leave_newest(received)
    for packet in received:
        b.mirror.take(packet)
        assert not b.mirror.conflicts()
        assert not b.table.illegal


def test_the_rate_that_variables_declare(sides):
    """Nobody gets more, however often all is told; who comes gets the newest."""
    a, b = sides
    task = on(a, "slow", "SLOW")
    meet(a, b)
    meet(a, b)
    for n in range(3):
        task.array("SLOW")[:] = n
        task.commit()
        assert carry(a, b) is None  # its time comes in a thousand seconds
        meet(a, b)
        carry_to_one(a, b)
    assert b.table.read("SLOW").tolist() == [1]
    c = Side("c", keep=False)
    try:
        carry(c, a, full=True)
        carry(a, b, c)
        carry_to_one(a, c)
        assert c.table.read("SLOW").tolist() == [2]
    finally:
        c.close()


def carry_to_one(one, other):
    """Let one machine answer another one that asks."""
    other.mirror.take(one.mirror.next_packet(full=True, machine=other.name))


def test_what_a_task_ends_with_waits_for_no_turn(sides):
    a, b = sides
    task = on(a, "slow", "SLOW")
    meet(a, b)
    task.array("SLOW")[:] = 9
    task.commit()
    task.release()
    carry(a, b)
    assert b.table.read("SLOW").tolist() == [9]
    assert b.table.info("SLOW").owner is None


def test_a_rate_is_kept_on_the_average(sides, monkeypatch):
    """Looks that come late cost no turn, and bring none."""
    a, b = sides
    now = 10**12
    monkeypatch.setattr(mirror_outbox, "now_ns", lambda: now)
    monkeypatch.setattr(table_mirror, "now_ns", lambda: now)
    task = on(a, "often", "TENTH")
    meet(a, b)
    meet(a, b)
    before, seconds = b.mirror.others["a"].counts.commits, 20
    for step in range(seconds * 200):
        now += 5_000_000 + (step * 7_919 % 1_000_003)
        task.commit(now, step)
        carry(a, b, full=step % 100 == 0)
    took = (now - 10**12) * 1e-9
    commits = b.mirror.others["a"].counts.commits - before
    assert 10 * took - 2 <= commits <= 10 * took + 1


def test_what_one_is_told_is_still_new_to_the_others(sides):
    a, b = sides
    task = on(a, "pid", "Q")
    meet(a, b)
    task.array("Q")[:] = 3
    task.commit()
    a.mirror.next_packet(full=True, machine="c")
    carry(a, b)
    assert b.table.read("Q").tolist() == [3, 3, 3]
    task.release()
    a.mirror.next_packet(full=True, machine="c")
    carry(a, b)
    assert b.table.info("Q").owner is None


def test_a_second_owner_is_refused_and_a_swap_is_taken(sides):
    a, b = sides
    one = on(a, "one", "Q", value=1.0)
    meet(a, b)
    two = b.task("two", "Q")
    with pytest.raises(SvarOwnerError, match="owner one@host-a"):
        two.claim()
    one.release()
    carry(a, b)
    assert b.table.info("Q").owner is None
    assert b.table.read("Q").tolist() == [1, 1, 1]
    two.array("Q")[:] = 2.0
    two.claim()
    carry(b, a)
    assert a.table.info("Q").owner == "two@host-b"
    assert a.table.read("Q").tolist() == [2, 2, 2]
    assert not a.mirror.conflicts()


def test_what_an_operator_sets(sides):
    a, b = sides
    meet(a, b)
    a.table.write("MODE", [9])
    carry(a, b)
    assert b.table.read("MODE").tolist() == [9]
    a.table.write("MODE", [10])
    carry(a, b)
    assert b.table.read("MODE").tolist() == [10]
    assert carry(b, a, full=True).full.groups == []


def test_what_an_operator_sets_again_is_news_and_no_new_state(sides):
    a, b = sides
    a.table.write("MODE", [9])
    meet(a, b)
    a.table.write("MODE", [10])
    packet = carry(a, b)
    assert packet.full is None
    assert b.table.read("MODE").tolist() == [10]
    assert carry(a, b) is None, "once"
    a.table.write("SLOW", [1.5])
    assert carry(a, b).full is not None, "set for the first time: one group more"
    assert b.table.read("SLOW").tolist() == [1.5]
    a.table.write("MODE", [11])
    a.table.write("QD", [1, 2, 3])
    assert carry(a, b).full is not None
    assert b.table.read("MODE").tolist() == [11]
    assert b.table.read("QD").tolist() == [1, 2, 3]


def test_a_part_of_a_group_that_another_took(sides):
    a, b = sides
    both = on(a, "both", "Q", "QD", value=1.0)
    meet(a, b)
    both.release()
    on(a, "half", "Q", value=5.0)
    carry(a, b)
    assert b.table.info("Q").owner == "half@host-a"
    assert b.table.read("Q").tolist() == [5, 5, 5]
    assert b.table.info("QD").owner is None


def test_a_machine_out_of_sight(sides):
    a, b = sides
    on(a, "pid", "Q", value=3.0)
    meet(a, b)
    b.mirror.lose("a")
    assert b.table.info("Q").owner is None
    assert b.table.read("Q").tolist() == [3, 3, 3]
    (cause,) = b.table.illegal
    assert cause.cause == "host host-a is unreachable; no task writes Q"
    on(b, "standby", "Q", value=4.0)
    b.mirror.next_packet()
    assert not b.table.illegal


@pytest.mark.parametrize("losses", [1, 2])
def test_the_flag_stays_up_for_news_that_come_after_the_loss(sides, losses):
    """They had waited in a queue, and do not say what its tasks write."""
    a, b = sides
    task = on(a, "pid", "Q")
    meet(a, b)
    b.mirror.lose("a")
    for _ in range(losses):
        task.commit()
        assert carry(a, b).full is None
        b.mirror.lose("a")
    (cause,) = b.table.illegal
    assert cause.cause == "host host-a is unreachable; no task writes Q"
    meet(a, b)
    assert not b.table.illegal


def test_it_comes_back(sides):
    a, b = sides
    task = on(a, "pid", "Q")
    meet(a, b)
    b.mirror.lose("a")
    task.array("Q")[:] = 8
    task.commit()
    meet(a, b)
    assert b.table.read("Q").tolist() == [8, 8, 8]
    assert b.table.info("Q").owner == "pid@host-a"
    assert not b.table.illegal


def test_a_split_in_which_both_claim(sides):
    a, b = sides
    third = Side("c", keep=False)
    on(a, "one", "Q", value=1.0)
    meet(a, b, third)
    b.mirror.lose("a")
    two = on(b, "two", "Q", value=2.0)
    meet(a, b, third)
    for side in (a, b, third):
        assert side.mirror.conflicts() == ["Q"]
        assert "Q is written on two machines" in {c.cause for c in side.table.illegal}
    assert third.table.info("Q").owner is None
    assert a.table.info("Q").owner == "one"
    assert b.table.info("Q").owner == "two"
    two.release()
    meet(a, b, third)
    for side in (a, b, third):
        assert not side.mirror.conflicts()
        assert not side.table.illegal
    assert b.table.info("Q").owner == third.table.info("Q").owner == "one@host-a"
    third.close()


def test_equal_constants_on_two_machines(sides):
    a, b = sides
    for side in sides:
        task = side.table.local("maker", ME, outconst=["MODE"])
        task.array("MODE")[:] = 6
        task.copy_out_consts()
    meet(a, b)
    assert not a.mirror.conflicts()
    assert not b.mirror.conflicts()
    assert not a.table.illegal


def test_the_flag_is_told_and_taken_back(sides):
    a, b = sides
    meet(a, b)
    a.table.raise_illegal("hand off", "arm0/guard")
    carry(a, b)
    (cause,) = b.table.illegal
    assert (cause.cause, cause.raiser, cause.machine) == (
        "hand off",
        "arm0/guard",
        "host-a",
    )
    carry(b, a, full=True)
    assert len(a.table.illegal) == 1  # it is not told back
    a.table.clear_illegal("arm0/guard")
    carry(a, b)
    assert not b.table.illegal


def test_a_carrier_that_was_started_anew(sides):
    a, b = sides
    task = on(a, "pid", "Q")
    meet(a, b)
    a.mirror.close()
    a.mirror = a.make(2, keep=True)
    task.array("Q")[:] = 5
    task.commit()
    meet(a, b)
    assert b.table.read("Q").tolist() == [5, 5, 5]
    assert not a.mirror.conflicts()


def test_news_of_an_unknown_state_are_asked_for(sides):
    a, b = sides
    on(a, "pid", "Q")
    packet = a.mirror.next_packet(full=True)
    packet.full = None
    assert not b.mirror.take(packet)


def test_what_is_no_packet():
    assert packets.unpack(b"") is None
    assert packets.unpack(b"\x91\xa1\xff") is None  # text that is no UTF-8
    assert packets.unpack(b"\x93\x01\x02\x03") is None
    other = packets.Packet(packets.VERSIONS.newest + 1, "a", "host-a", 1, 0, 0, [])
    assert packets.unpack(packets.pack(other)) is None
    assert packets.other_version(packets.pack(other)).host == "host-a"
    assert packets.other_version(b"") is None
    assert packets.other_version(b"\x93\x01\x02\x03") is None


def test_a_machine_with_packets_of_another_version_raises_the_flag(sides):
    a, b = sides

    def causes():
        return [one.cause for one in b.table.illegal]

    text = (
        f"the table of host host-a is of version {packets.VERSIONS.newest + 1}, here "
        f"{packets.VERSIONS}: no values are exchanged"
    )
    head = packets.Head(packets.VERSIONS.newest + 1, "a", "host-a")
    for _ in range(2):
        b.mirror.refuse(head)
        assert causes() == [text]
    b.mirror.miss(60.0)
    assert causes() == [text]
    carry(a, b, full=True)
    assert causes() == [], "it runs this version now"
    b.mirror.refuse(head)
    b.mirror.miss(0.0)
    assert causes() == [], "it is gone"


def test_a_value_that_was_set_is_sent_by_itself(sides):
    a, b = sides
    meet(a, b)
    a.table.write("MODE", [7])
    assert a.mirror.value_packet("MODE") is None, "nobody knows that it was set here"
    carry(a, b)
    for value in (8, 9):
        a.table.write("MODE", [value])
        packet = a.mirror.value_packet("MODE")
        assert (packet.full, len(packet.news)) == (None, 1)
        assert b.mirror.take(packets.unpack(packets.pack(packet)))
        assert b.table.read("MODE").tolist() == [value]
        assert carry(a, b) is None, "it was sent to all"
    assert a.mirror.due() is None, "an operator's next value is not expected"


def test_a_value_whose_rate_is_limited_is_not_sent_before_its_time(sides):
    a, b = sides
    a.table.write("SLOW", [1.0])
    meet(a, b)
    a.table.write("SLOW", [2.0])
    assert a.mirror.value_packet("SLOW") is None


def test_a_value_that_a_task_has_owned_since_is_sent_with_the_state(sides):
    a, b = sides
    a.table.write("MODE", [7])
    meet(a, b)
    task = on(a, "pid", "MODE")
    task.release()
    task.close()
    a.table.write("MODE", [8])
    assert a.mirror.value_packet("MODE") is None
    assert carry(a, b).full is not None
    assert b.table.read("MODE").tolist() == [8]


def test_a_value_that_a_claim_here_forbids_is_not_taken(sides):
    a, b = sides
    a.table.write("MODE", [7])
    meet(a, b)
    task = on(b, "pid", "MODE", value=3)

    def taken():
        packet = packets.unpack(packets.pack(a.mirror.value_packet("MODE")))
        return b.mirror.take(packet) and b.mirror.has(packet)

    a.table.write("MODE", [8])
    assert not taken(), "a task owns it"
    b.mirror.next_packet()
    task.release()
    task.close()
    a.table.write("MODE", [9])
    assert not taken(), "its claim is on its way"
    meet(a, b)
    assert [side.table.read("MODE").tolist() for side in sides] == [[3], [3]]
    a.table.write("MODE", [10])
    assert a.mirror.value_packet("MODE") is None
    meet(a, b)
    assert [side.table.read("MODE").tolist() for side in sides] == [[10], [10]]


def test_a_value_set_right_after_a_claim_that_is_over_is_newer(sides):
    a, b = sides
    a.table.write("MODE", [7])
    meet(a, b)
    task = on(b, "pid", "MODE", value=3)
    task.release()
    task.close()
    carry(b, a)
    a.table.write("MODE", [8])  # before anything is sent from here
    meet(a, b)
    assert [side.table.read("MODE").tolist() for side in sides] == [[8], [8]]
