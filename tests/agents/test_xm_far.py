"""Semaphores and queues of another machine: two agents, each with its own memory."""

import os
import signal

import pytest
from far_rig import LEASE_MS, UNSEEN, VERB, Cell, RefusedError, Site, traffic
from nodekit import Master, rmod

pytestmark = pytest.mark.timeout(300)
TASK = """
import sys
from pbonet import PortBasedObject, xm


class Porter(PortBasedObject):
    def init(self):
        self.parts = xm.queue("vision0:parts")
        self.done = xm.queue("vision0:done")
        self.turn = xm.semaphore("vision0:turn", initial=0)

    def sync(self):
        self.parts.wait()

    def cycle(self, dt):
        part = self.parts.try_receive()
        if part == b"all":
            for number in range(20):
                self.done.send(bytes([number]), answer=False)
            self.turn.v(answer=False)
            xm.interrupt("vision0:door", 7, answer=False)
        elif part is not None:
            self.done.send(part + b"!" * ("zenoh" in sys.modules))
"""


@pytest.fixture(scope="module")
def cell(tmp_path_factory):
    """Two machines that are linked by zenoh alone."""
    library = tmp_path_factory.mktemp("library")
    (library / "porter.py").write_text(TASK)
    made = Cell(LEASE_MS)
    try:
        made.start(library)
        yield made
    finally:
        made.close()


@pytest.fixture
def hands(cell):
    """Programs: one at home with the resources, two on the other machine."""
    made = [cell.hand(cell.a), cell.hand(cell.b), cell.hand(cell.b)]
    yield made
    for hand in made:
        hand.kill()
        (cell.a if hand is made[0] else cell.b).programs.remove(hand)


def test_the_same_call_here_and_there(hands):
    here, there, other = hands
    there.do("sem = xm.semaphore('vision0:slots', initial=2, maximum=3)")
    here.do("sem = xm.semaphore('slots', maximum=3)")
    assert there.do("sem, sem.name, sem.binary, sem.maximum, sem.value") == (
        "(<Semaphore vision0:slots>, 'vision0:slots', False, 3, 2)"
    )
    assert there.do("[sem.p(), sem.try_p(), sem.try_p()]") == [1, 1, 0]
    assert here.do("sem.value") == "0"
    assert not traffic(here), "what is here does not touch the network"
    assert there.do("sem.p(now() + s // 50)") == "<Taken.TIMED_OUT: 0>"
    there.begin("sem.p(now() + 60 * s)")
    here.wait("sem.waiting", "1")
    here.do("sem.v()")
    assert there.end() == "<Taken.TAKEN: 1>"
    assert there.do("[sem.v(), sem.v(), sem.v(), sem.v()]") == [True, True, True, False]
    with pytest.raises(RefusedError, match="another setting") as caught:
        other.do("xm.semaphore('vision0:slots', maximum=9)")
    assert caught.value.kind == "XmLayoutError"
    with pytest.raises(RefusedError, match="in use"):
        other.do("xm.Semaphore.create('vision0:slots')")
    with pytest.raises(RefusedError, match="no such semaphore") as caught:
        other.do("xm.Semaphore.attach('vision0:slot')")
    assert caught.value.kind == "XmMissingError"
    there.begin("sem.p()") if there.do("sem.p() and sem.p() and sem.p()") else None
    here.wait("sem.waiting", "1")
    here.do("sem.destroy()")
    with pytest.raises(RefusedError, match="it was destroyed"):
        there.end()


def test_waiters_are_served_by_priority_wherever_they_are(hands):
    here, there, other = hands
    here.do("sem = xm.semaphore('turn', initial=0)")
    for hand in (there, other):
        hand.do("sem = xm.semaphore('vision0:turn')")
    there.begin("sem.p(priority=5)")
    here.wait("sem.waiting", "1")
    other.begin("sem.p(priority=7)")
    here.wait("sem.waiting", "2")
    here.do("sem.v()")
    assert other.end() == "<Taken.TAKEN: 1>"
    assert here.do("(sem.waiting, sem.try_p())") == "(1, <Taken.TIMED_OUT: 0>)"
    other.do("sem.v()")
    assert there.end() == "<Taken.TAKEN: 1>"
    here.do("sem.destroy()")


def test_a_killed_waiter_takes_no_wake_up_along(hands):
    here, there, other = hands
    here.do("sem = xm.semaphore('turn', initial=0)")
    for hand, priority in ((there, 9), (other, 1)):
        hand.do("sem = xm.semaphore('vision0:turn')")
        hand.begin(f"sem.p(priority={priority})")
    here.wait("sem.waiting", "2")
    there.kill()
    here.wait("sem.waiting", "1")
    here.do("sem.v()")
    assert other.end() == "<Taken.TAKEN: 1>"
    here.do("sem.destroy()")


def test_a_killed_holder_is_told_to_the_next(hands):
    here, there, other = hands
    here.do("grip = xm.semaphore('grip', initial=1, binary=True)")
    for hand in (there, other):
        hand.do("grip = xm.semaphore('vision0:grip')")
    assert there.do("grip.p()") == "<Taken.TAKEN: 1>"
    other.begin("grip.p()")
    here.wait("grip.waiting", "1")
    there.kill()
    assert other.end() == "<Taken.HOLDER_DIED: 2>"
    other.do("grip.v()")
    assert here.do("grip.p()") == "<Taken.TAKEN: 1>", "told to one only"
    here.do("grip.destroy()")


def test_a_cut_cable(cell, hands):
    here, there, other = hands
    here.do("grip = xm.semaphore('grip', initial=1, binary=True)")
    here.do("turn = xm.semaphore('turn', initial=0)")
    there.do("grip = xm.semaphore('vision0:grip')")
    there.do("grip.p()")
    other.do("turn = xm.semaphore('vision0:turn')")
    other.begin("turn.p()")
    here.wait("turn.waiting", "1")
    cell.cable.cut()
    try:
        here.wait("turn.waiting", "0")
        assert here.do("grip.p()") == "<Taken.HOLDER_DIED: 2>"
        with pytest.raises(RefusedError) as caught:
            other.end()
        assert caught.value.kind in UNSEEN
    finally:
        cell.cable.heal()
    cell.wait_both()
    for hand in (there, other):
        hand.wait("xm.alive('vision0')", "True")
    here.do("turn.v()")
    assert other.do("turn.p(now() + 60 * s)") == "<Taken.TAKEN: 1>", "attached anew"
    with pytest.raises(RefusedError, match="no longer knows this client") as caught:
        there.do("grip.v()")
    assert caught.value.kind == "XmLapsedError", "nobody believes to hold it still"
    assert here.do("grip.value") == "0", "who holds it now keeps it"
    for name in ("grip", "turn"):
        here.do(f"{name}.destroy()")


@pytest.mark.parametrize(
    ("policy", "order"),
    [
        ("FIFO", ["b'a'", "b'c'", "b'b'"]),
        ("LIFO", ["b'b'", "b'c'", "b'a'"]),
        ("HPF", ["b'c'", "b'a'", "b'b'"]),
    ],
)
def test_queues_keep_their_policy(hands, policy, order):
    here, there, other = hands
    there.do(f"q = xm.queue('vision0:parts', policy=xm.Policy.{policy}, messages=3)")
    here.do("q = xm.queue('parts')")
    there.do("q.send(b'a', 5)")
    here.do("q.send(b'c', 8)")
    there.do("q.send(b'b', 2)")
    assert there.do("(len(q), q.free, q.policy.name)") == f"(3, (0, 0), '{policy}')"
    with pytest.raises(RefusedError, match="the queue is full"):
        there.do("q.send(b'd')")
    assert there.do("q.send(b'd', full=xm.Full.DROP)") == "False"
    other.do("q = xm.queue('vision0:parts')")
    assert [other.do("q.receive()") for _ in "abc"] == order
    assert other.do("(q.try_receive(), q.dropped)") == "(None, 1)"
    here.do("q.destroy()")


def test_receivers_and_senders_wait_across_machines(hands):
    here, there, other = hands
    here.do("q = xm.queue('parts', messages=1, blocks=16, block=1024)")
    for hand in (there, other):
        hand.do("q = xm.queue('vision0:parts')")
    there.begin("q.wait()")
    other.begin("q.receive(priority=3)")
    here.wait("q.waiting", "2")
    here.do("q.send(bytes(range(256)) * 60, 4)")
    assert other.end() == repr(bytes(range(256)) * 60), "a long message"
    there_sees = "(q.last_priority, len(q))"
    assert other.do(there_sees) == "(4, 0)"
    here.do("q.send(b'full')")
    assert there.end() == "True"
    other.begin("q.send(b'next', until_ns=now() + 60 * s)")
    here.wait("q.waiting", "1")
    assert there.do("q.receive()") == "b'full'"
    assert other.end() == "True"
    assert there.do("bytes(b[:q.receive_into(b)]) if (b := bytearray(8)) else 0") == (
        "b'next'"
    )
    with pytest.raises(RefusedError, match="longer than the queue"):
        there.do("q.send(bytes(20_000))")
    with pytest.raises(RefusedError, match="too long to be sent") as caught:
        there.do("q.send(bytes(1 << 20))")
    assert caught.value.kind == "XmTooLongError"
    here.do("q.destroy()")


def test_a_message_that_did_not_arrive_is_put_back(hands):
    """The receiver is stopped before the answer, then killed: nobody acknowledges."""
    here, there, _ = hands
    here.do("q = xm.queue('parts')")
    there.do("q = xm.queue('vision0:parts')")
    there.do("from pbonet.xm.net import resource_messages as r")
    there.do("q._far._settle = lambda *a, **k: None")
    here.do("q.send(b'lost', 6)")
    assert there.do("q.receive()") == "b'lost'"
    assert here.do("len(q)") == "0"
    there.kill()
    here.wait("len(q)", "1")
    assert here.do("q.letter()") == "(b'lost', 6)"
    here.do("q.destroy()")


def test_who_is_there(hands):
    _, there, _ = hands
    assert there.do("[xm.alive('vision0'), xm.alive('arm0'), xm.alive('arm7')]") == [
        True,
        True,
        False,
    ]
    with pytest.raises(
        RefusedError, match="no agent of this name can be reached"
    ) as caught:
        there.do("xm.queue('arm7:parts')")
    assert caught.value.kind == "UnreachableError"
    with pytest.raises(RefusedError, match="memory is shared within a machine only"):
        there.do("xm.segment('vision0:map', 100)")


def test_mailbox_interrupts_from_anywhere(hands):
    here, there, _ = hands
    with pytest.raises(RefusedError, match="no mailbox of this name") as caught:
        there.do("xm.interrupt('vision0:door', 5)")
    assert caught.value.kind == "XmMissingError"
    here.do("came = []; box = xm.Mailbox('door', came.append, depth=2)")
    there.do("[xm.interrupt('vision0:door', value) for value in (-7, 1 << 40)]")
    with pytest.raises(RefusedError, match="the mailbox is full") as caught:
        there.do("xm.interrupt('vision0:door', 3)")
    assert caught.value.kind == "XmQueueFullError"
    assert here.do("(box.pending, box.sent, box.refused)") == "(2, 2, 1)"
    here.do("box.start()")
    here.wait("str(came)", repr(f"[-7, {1 << 40}]"))
    there.do("xm.interrupt('vision0:door', 4)")
    here.wait("came[-1]", "4")
    assert not traffic(here)
    with pytest.raises(RefusedError, match="handled on its own RTPU"):
        there.do("xm.Mailbox('vision0:door')")
    here.do("box.destroy()")


def test_a_desk_without_real_time_takes_part(cell):
    """Section 5.3.2: a program on a machine without an agent, in neither memory."""
    desk = cell.hand(
        cell.b,
        home="",
        PBONET_CONNECT=f"tcp/127.0.0.1:{cell.a.port}",
        PBONET_RUN_DIR=str(cell.b.run / "desk"),
    )
    here = cell.hand(cell.a)
    desk.do("q = xm.queue('vision0:parts')")
    here.do("q = xm.queue('parts')")
    desk.do("q.send(b'from the desk')")
    assert here.do("q.receive()") == "b'from the desk'"
    here.do("q.destroy()")
    for hand, machine in ((desk, cell.b), (here, cell.a)):
        hand.kill()
        machine.programs.remove(hand)


@pytest.fixture
def porter(cell):
    """A master of a task on the arm that fetches from vision0 and brings there."""
    site = Site(cell.b)
    master = Master(site, "arm0", "arm")
    master.open_table()
    text = rmod("porter", out="").replace("periodic", "synchronous")
    master.spawn("porter", "porter", text=text)
    master.on("porter")
    yield master
    master.stop()
    site.session.close()


def test_a_task_waits_for_another_machine(hands, porter):
    """It asks by its agent, without the network; commands and kills end its waits."""
    here, _, _ = hands
    here.do("parts, done = xm.queue('parts'), xm.queue('done')")
    for part in ("b'one'", "b'two'"):
        here.do(f"parts.send({part})")
        assert here.do("done.receive(now() + 60 * s)") == part
    here.wait("parts.waiting", "1")
    porter.off("porter")
    here.wait("parts.waiting", "0")
    here.do("parts.send(b'three')")
    porter.on("porter")
    assert here.do("done.receive(now() + 60 * s)") == "b'three'"
    here.wait("parts.waiting", "1")
    os.kill(porter.status("porter").tid, signal.SIGKILL)
    here.wait("parts.waiting", "0")
    here.do("turn = xm.semaphore('turn', initial=0)")
    for name in ("parts", "done", "turn"):
        here.do(f"{name}.destroy()")


def test_a_task_signals_another_machine_without_waiting(hands, porter):
    here, _, _ = hands
    here.do("parts, done = xm.queue('parts'), xm.queue('done')")
    here.do("turn = xm.semaphore('turn', initial=0)")
    here.do("came = []; box = xm.Mailbox('door', came.append)")
    here.do("parts.send(b'all')")
    here.wait("(box.pending, len(done), turn.value)", "(1, 20, 1)")
    assert here.do("b''.join(done.receive(0) for _ in range(20))") == repr(
        bytes(range(20))
    ), "in their order"
    assert here.do("box.take()") == "7"
    here.do("done.destroy()")
    here.do("box.destroy()")
    here.do("parts.send(b'all')")
    here.wait("turn.value", "2")
    text = porter.wait_event("NOT_DELIVERED").text
    assert "vision0:done: there is no such queue" in text
    for name in ("parts", "turn"):
        here.do(f"{name}.destroy()")


def test_verbs_use_resources_of_another_machine(hands):
    here, _, verbs = hands
    verbs.do(VERB)
    here.do("box = xm.Mailbox('bell')")
    assert verbs.do("verb('sem', 'new', 'vision0:go', '--initial', '0')")[0] == 0
    assert verbs.do("verb('queue', 'new', 'vision0:work')")[0] == 0
    assert verbs.do("verb('sem', 'put', 'vision0:go')")[1]["value"] == 1
    assert verbs.do("verb('queue', 'put', 'vision0:work', 'a part')")[0] == 0
    assert verbs.do("verb('mailbox', 'put', 'vision0:bell', '9')")[0] == 0
    assert here.do("box.take()") == "9"
    listed = {
        kind: verbs.do(f"verb({kind!r}, 'ls')")[1]["resources"]
        for kind in ("sem", "queue", "mailbox")
    }
    values = {(one["name"], one["value"]) for many in listed.values() for one in many}
    assert values == {("vision0:go", 1), ("vision0:work", 1), ("vision0:bell", 0)}
    status, data = verbs.do("verb('queue', 'get', 'vision0:work')")
    assert (status, data["messages"][0]["text"]) == (0, "a part")
    assert verbs.do("verb('sem', 'get', 'vision0:go')")[0] == 0
    assert verbs.do("verb('sem', 'get', 'vision0:go')")[0] == 1
    for kind, name in (("sem", "go"), ("queue", "work"), ("mailbox", "bell")):
        assert verbs.do(f"verb({kind!r}, 'rm', 'vision0:{name}')")[0] == 0
    assert verbs.do("verb('queue', 'ls', 'vision0')")[1]["resources"] == []
