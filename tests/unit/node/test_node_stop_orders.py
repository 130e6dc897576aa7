"""Stop orders that reach RTPUs late: known, repeated, carried out once."""

import contextlib
import itertools
import struct
import threading
import time
from queue import Queue
from types import SimpleNamespace

import msgspec
import numpy as np
import pytest
import zenoh
from watching import wait_for
from xm_rig import agent_info

from pbonet import tbuf, xm
from pbonet.errors import NoAnswerError, PbonetError, UnreachableError
from pbonet.node.agent import link_ends, resource_server, subsystem_links
from pbonet.node.agent.file_server import FileServer
from pbonet.node.agent.peer_latency import Peer, PeerLatencies
from pbonet.node.agent.resource_server import ResourceServer
from pbonet.node.agent.stop_orders import MOST, StopOrders
from pbonet.node.agent.subsystem_links import Links
from pbonet.node.agent.task_gateway import TaskGateway
from pbonet.tbuf import layout
from pbonet.xm.ipc.remote_channel import RemoteChannel
from pbonet.xm.net import (
    codec,
    key_expressions,
    messages as m,
    resource_messages as r,
)


class Agents:
    """Takes repeated orders for other RTPUs."""

    def __init__(self):
        self.orders = Queue()
        self.answers = threading.Semaphore(0)
        self.error = None

    def call(self, rtpu, request, result, *, timeout):  # noqa: ARG002
        self.orders.put((rtpu, request))
        assert self.answers.acquire(timeout=60)
        if self.error is not None:
            raise self.error
        return m.Stopped(off=["ctl"], killed=[])


@pytest.fixture
def agents():
    return Agents()


@pytest.fixture
def notes():
    return Queue()


@pytest.fixture
def orders(agents, notes):
    made = StopOrders("arm0", agents, notes.put)
    yield made
    for _ in range(8):
        agents.answers.release()
    made.stop()


def info(name, *subsystems, stops=(), age=1000.0, machine="", here=()):
    return agent_info(
        name,
        host=f"host-{name}",
        machine=machine or f"boot-{name}",
        here=list(here),
        claims=dict.fromkeys(subsystems, 1),
        rtpu_age=age,
        stops=list(stops),
    )


def stop(subsystem="arm", stop_id="s1"):
    return m.Stop(subsystem=subsystem, stop_id=stop_id)


def test_one_that_was_lost_is_stopped_when_it_is_seen_again(orders, agents, notes):
    orders.met(info("arm1", "arm"))
    orders.lost("arm1")
    orders.add(stop())
    machine = key_expressions.machine("boot-arm1")
    assert orders.refuses("arm", machine)
    assert not orders.refuses("leg", machine)
    assert not orders.refuses("arm", key_expressions.machine("boot-arm2"))
    orders.met(info("arm1", "arm"))
    rtpu, request = agents.orders.get(timeout=60)
    assert (rtpu, request.stop_id, request.subsystem) == ("arm1", "s1", "arm")
    orders.met(info("arm1", "arm"))
    assert agents.orders.empty(), "it is being sent"
    assert orders.refuses("arm", machine), "until it has been carried out"
    agents.answers.release()
    note = notes.get(timeout=60)
    assert note.code == "STOPPED"
    assert "has reached arm1 only now: ctl turned off" in note.text
    assert not orders.refuses("arm", machine)
    orders.met(info("arm1", "arm"))
    assert agents.orders.empty()


def test_one_that_is_lost_after_the_order_is_stopped_later(orders, agents):
    orders.met(info("arm1", "arm"))
    orders.add(stop(""))
    orders.met(info("arm1", "arm"))
    assert agents.orders.empty(), "the master asks it, too"
    assert orders.left() == [], "it is seen, and nothing is kept for the next agent"
    assert orders.due() == {"arm1": [("s1", "")]}, "it may not have the order yet"
    orders.lost("arm1")
    orders.met(info("arm1", "arm"))
    assert agents.orders.get(timeout=60)[0] == "arm1"


def test_one_that_was_asked_as_its_process_ended_is_stopped_later(orders, agents):
    """Its machine is shut down, say: its tasks come back with the next process."""
    orders.met(info("arm1", "arm"))
    orders.met(msgspec.structs.replace(info("arm1"), rtpu_pid=0))
    assert orders.others("arm") == ["arm1"]
    orders.lost("arm1")
    orders.add(stop())
    assert orders.due() == {"arm1": [("s1", "arm")]}
    orders.met(info("arm1"))
    assert agents.orders.get(timeout=60)[0] == "arm1"
    orders.met(info("arm1", stops=["s1"]))
    orders.add(stop(stop_id="s2"))
    assert "s2" not in str(orders.due()), "its new process has nothing of that"


def test_who_has_stopped_is_left_alone(orders, agents):
    orders.met(info("arm1", "arm"))
    orders.lost("arm1")
    orders.add(stop())
    assert orders.due() == {"arm1": [("s1", "arm")]}
    orders.met(info("arm1", "arm", stops=["s0", "s1"]))
    assert orders.due() == {}
    orders.met(info("arm1", "arm"))
    assert agents.orders.empty()
    assert not orders.refuses("arm", key_expressions.machine("boot-arm1"))


def test_a_process_that_is_new_is_stopped_too(orders, agents):
    """Its agent may have spawned again what was lost with the former one."""
    orders.met(info("arm1", "arm"))
    orders.lost("arm1")
    orders.add(stop())
    orders.met(info("arm1", age=0.0))
    assert agents.orders.get(timeout=60)[0] == "arm1"


def test_what_is_left_is_for_the_next_agent(orders, agents, notes):
    orders.met(info("arm1", "arm"))
    orders.lost("arm1")
    orders.add(stop())
    left = orders.left()
    changes = []
    later = StopOrders("arm0", agents, notes.put, left, lambda: changes.append(1))
    try:
        assert later.left() == left
        assert later.due() == {"arm1": [("s1", "arm")]}
        assert later.refuses("arm", key_expressions.machine("boot-arm1"))
        assert later.parts("arm", "arm1"), "before its first greeting, too"
        assert later.holds_agent("arm1")
        assert not later.parts("leg", "arm1")
        assert not later.parts("arm", "arm2")
        later.met(info("arm1", age=0.0))
        assert agents.orders.get(timeout=60)[0] == "arm1"
        agents.answers.release()
        assert notes.get(timeout=60).code == "STOPPED"
        assert later.left() == []
        assert changes
    finally:
        later.stop()


@pytest.mark.parametrize(
    "request_",
    [stop("leg"), stop(stop_id="")],
    ids=["another subsystem", "an order without an identity"],
)
def test_who_is_not_concerned_is_left_alone(orders, agents, request_):
    orders.met(info("arm1", "arm"))
    orders.lost("arm1")
    orders.add(request_)
    orders.met(info("arm1", "arm", "leg"))
    assert agents.orders.empty()


def test_one_that_has_ended_in_order_is_forgotten(orders, agents):
    orders.met(info("arm1", "arm"))
    orders.add(stop())
    orders.ended("arm1")
    orders.lost("arm1")
    orders.met(info("arm1", "arm"))
    assert agents.orders.empty()


def test_the_end_of_one_that_has_missed_an_order_changes_nothing(orders, agents):
    """A stolen key can announce anybody's end."""
    orders.met(info("arm1", "arm"))
    orders.lost("arm1")
    orders.add(stop())
    orders.ended("arm1")
    assert orders.due() == {"arm1": [("s1", "arm")]}
    assert orders.refuses("arm", key_expressions.machine("boot-arm1"))
    assert orders.parts("arm", "arm1"), "messages, too"
    assert orders.holds_agent("arm1"), "and links"
    assert not orders.parts("leg", "arm1")
    orders.met(info("arm1", "arm"))
    assert agents.orders.get(timeout=60)[0] == "arm1"
    assert orders.parts("arm", "arm1"), "until it has carried it out"
    agents.answers.release()
    wait_for(lambda: not orders.due(), "the order")
    assert not orders.parts("arm", "arm1")


def test_only_one_that_is_seen_and_does_not_answer_has_ended():
    heard = []
    listener = SimpleNamespace(ended=heard.append)
    ways = PeerLatencies(SimpleNamespace(), None, listeners=(listener,))
    end = SimpleNamespace(key_expr=key_expressions.rtpu("d", "arm1", "end"))
    ways._on_end(end)
    assert heard == [], "a machine that is cut off cannot announce anything"
    ways._peers["arm1"] = Peer()
    ways._on_end(end)
    assert heard == ["arm1"]
    assert ways._ended.keys() == {"arm1"}


@pytest.mark.parametrize("answers", [True, False])
def test_one_that_answers_after_its_end_is_lost_when_it_is_not_seen(
    monkeypatch, answers
):
    """With the other's key one could hide the loss of a machine."""
    link = SimpleNamespace(info=SimpleNamespace(routers_zid=list))
    ways = PeerLatencies(link, info("arm0"))
    found = info("arm1", "arm")
    monkeypatch.setattr(ways, "_ask", lambda _key: found if answers else "no answer")
    ways._alive = {"arm0", "arm1"}
    ways._peers["arm1"] = Peer()
    ways._peers["arm1"].info = found
    ways._on_end(SimpleNamespace(key_expr=key_expressions.rtpu("d", "arm1", "end")))
    ways._measure("arm0", {"arm1"})
    ways.out_of_sight("arm1")
    assert [one.rtpu for one in ways.lost()] == ["arm1"] * answers


def test_a_machine_is_used_again_when_the_rtpu_that_missed_the_order_has_no_process(
    orders, agents, notes
):
    """Else nothing of its other RTPUs would ever be used again."""
    both, machine = ["arm1", "eye1"], key_expressions.machine("boot")
    orders.met(info("arm1", "arm", machine="boot", here=both))
    orders.met(info("eye1", machine="boot", here=both))
    for name in both:
        orders.lost(name)
    orders.add(stop())
    for here in (both, []):
        orders.met(info("eye1", machine="boot", here=here))
        assert orders.refuses("arm", machine), "arm1 may still be found"
    assert orders.holds_agent("eye1")
    assert not orders.has_ended("arm1")
    orders.met(info("eye1", machine="boot", here=["eye1"]))
    assert orders.has_ended("arm1")
    assert not orders.has_ended("eye1")
    assert not orders.refuses("arm", machine)
    assert not orders.holds(machine)
    assert not orders.holds_agent("eye1")
    assert orders.due() == {"arm1": [("s1", "arm")]}, "for one that starts later"
    orders.met(info("arm1", machine="boot", here=both))
    assert orders.refuses("arm", machine)
    assert agents.orders.get(timeout=60)[0] == "arm1"
    agents.answers.release()
    assert notes.get(timeout=60).code == "STOPPED"
    assert not orders.holds(machine)


def test_an_rtpu_that_its_neighbour_never_knew_is_not_believed_to_have_ended(orders):
    """That one may look into another runtime folder."""
    orders.met(info("arm1", "arm", machine="boot", here=["arm1"]))
    orders.lost("arm1")
    orders.add(stop())
    orders.met(info("eye1", machine="boot", here=["eye1"]))
    assert orders.holds(key_expressions.machine("boot"))


def test_an_order_that_is_due_is_not_forgotten_for_newer_ones(orders):
    orders.met(info("leg1", "leg"))
    orders.met(info("arm1", "arm"))
    orders.lost("leg1")
    orders.add(stop("leg", "first"))
    for n in range(3 * MOST):
        orders.add(stop("arm", f"s{n}"))
        orders.met(info("arm1", "arm", stops=[f"s{n}"]))
    assert orders.due() == {"leg1": [("first", "leg")]}
    assert len(orders._orders) <= MOST + 2


def test_a_later_stop_stands_for_those_before_it(orders):
    """A machine that is away for good does not fill the memory."""
    orders.met(info("arm1", "arm"))
    orders.lost("arm1")
    orders.add(replaced())
    for n in range(3 * MOST):
        orders.add(stop("arm", f"s{n}"))
    orders.add(stop("leg", "other"))
    assert orders.due() == {"arm1": [(f"s{3 * MOST - 1}", "arm")]}
    assert len(orders._orders) <= MOST + 2


def test_what_fails_is_repeated_with_the_next_greeting(orders, agents):
    agents.error = NoAnswerError("nothing", where="arm1")
    orders.met(info("arm1", "arm"))
    orders.lost("arm1")
    orders.add(stop())
    orders.met(info("arm1", "arm"))
    assert agents.orders.get(timeout=60)
    agents.answers.release()
    while agents.orders.empty():
        orders.met(info("arm1", "arm"))
    assert agents.orders.get()[1].stop_id == "s1"


def replaced(stop_id="r1"):
    return m.Replaced(subsystem="arm", stop_id=stop_id, tasks={"arm1": ["ctl"]})


def test_a_task_that_was_replaced_is_turned_off_when_its_rtpu_is_seen(
    orders, agents, notes
):
    """Also one that this agent has never met, and a new process of it."""
    orders.met(info("arm2", "arm"))
    orders.add(replaced())
    machine = key_expressions.machine("boot-arm1")
    assert not orders.holds(machine), "whose machine is not known"
    orders.lost("arm2")
    assert not orders.holds(key_expressions.machine("boot-arm2")), "not concerned"
    orders.met(info("arm1", "arm", age=0.0))
    rtpu, request = agents.orders.get(timeout=60)
    assert (rtpu, request.stop_id, request.tasks) == ("arm1", "r1", {"arm1": ["ctl"]})
    assert request.subsystem == "arm"
    assert orders.holds(machine)
    assert orders.refuses("arm", machine)
    agents.answers.release()
    note = notes.get(timeout=60)
    assert note.text.startswith("the order that others replace ctl, given ")
    assert note.text.endswith("has reached arm1 only now: ctl turned off")
    assert not orders.holds(machine)
    orders.met(info("arm1", "arm"))
    assert agents.orders.empty()


def test_an_rtpu_in_reach_gets_the_order_by_its_master(orders, agents):
    orders.met(info("arm1", "arm"))
    orders.add(replaced())
    assert not orders.holds(key_expressions.machine("boot-arm1"))
    orders.met(info("arm1", "arm"))
    assert agents.orders.empty()
    assert orders.in_reach() == ["arm1"]
    orders.lost("arm1")
    assert orders.in_reach() == []
    orders.met(info("arm1", "arm", stops=["r1"]))
    assert agents.orders.empty(), "it was carried out"


def test_packets_of_such_a_machine_are_not_used():
    from pbonet.node.mirror.mirrored_table import MirroredTable
    from pbonet.svar.mirror import packets

    taken = []
    owner = SimpleNamespace(
        machine="here",
        refuses=lambda subsystem, machine: (subsystem, machine) == ("arm", "there"),
        late=lambda *_: 0,
    )
    table = MirroredTable.__new__(MirroredTable)
    table._owner, table.subsystem = owner, "arm"
    table.mirror = SimpleNamespace(others={}, take=lambda p: taken.append(p) or True)
    for machine in ("there", "elsewhere"):
        packet = packets.Packet(packets.VERSIONS.newest, machine, "h", 1, 1, 1, [])
        table._take(packets.pack(packet))
    assert [packet.machine for packet in taken] == ["elsewhere"]


class Session:
    """Stands for zenoh: keeps what is declared, for the test to call."""

    def __init__(self):
        self.called = {}

    def liveliness(self):
        return self

    def declare_subscriber(self, key, handler, **_):
        self.called[str(key)] = handler
        return SimpleNamespace(undeclare=lambda: None)

    def declare_token(self, _key):
        return SimpleNamespace(undeclare=lambda: None)


class Answers(Queue):
    """The answers of a server of resources to requests of a task on arm1."""

    def ask(self, server, subsystem="arm", task="arm1-7-0a"):
        request = r.Put(name="parts", data=b"go", client=task, subsystem=subsystem)
        request.id = str(next(self.ids))
        server.take(request, self.put)
        answer = codec.Codec().answer(self.get(timeout=60))
        return answer.result if answer.ok else PbonetError.from_wire(answer.error)

    ids = itertools.count()


def test_messages_of_such_a_machine_are_refused(orders, monkeypatch):
    """A message is acted on: a server has a cycle for each one."""
    monkeypatch.setattr(resource_server, "direct", lambda call: call)
    xm.live_on("arm0", domain="d", subsystem="arm")
    files = FileServer(None, "arm0")
    server = ResourceServer(Session(), "d", "arm0", files, orders.parts)
    answers = Answers()
    try:
        with contextlib.closing(xm.queue("parts")) as queue:
            orders.met(info("arm1", "arm", "leg"))
            orders.met(info("arm2", "arm"))
            assert answers.ask(server) is True
            assert queue.try_receive() == b"go"
            orders.lost("arm1")
            orders.add(stop())
            assert isinstance(refused := answers.ask(server), UnreachableError)
            assert "arm1: it missed a stop of the subsystem" in str(refused)
            assert len(queue) == 0
            assert answers.ask(server, "leg") is True, "that was not stopped"
            assert answers.ask(server, task="arm2-7-0a") is True
            assert answers.ask(server, "", "p12-0a") is True, "a program"
            orders.met(info("arm1", "arm", stops=["s1"]))
            assert answers.ask(server) is True
            queue.destroy()
    finally:
        server.stop()
        xm.live_on("local")


def test_a_wait_for_such_a_machine_ends(orders, monkeypatch):
    """What it waits for is for the tasks that are there now."""
    monkeypatch.setattr(resource_server, "direct", lambda call: call)
    xm.live_on("arm0", domain="d", subsystem="arm")
    zenoh_ = Session()
    files = FileServer(None, "arm0")
    server = ResourceServer(zenoh_, "d", "arm0", files, orders.parts)
    answers = Queue()
    one = {"client": "arm1-7-0a", "subsystem": "arm"}
    pack = codec.Codec()
    try:
        orders.met(info("arm1", "arm"))
        token = key_expressions.customer("d", "arm1-7-0a")
        came = SimpleNamespace(key_expr=token, kind=zenoh.SampleKind.PUT)
        zenoh_.called[key_expressions.customer("d", "*")](came)
        new = {"initial": 0}
        made = r.Attach(name="turn", kind="sem", create=new, id="1", **one)
        assert not server.is_used()
        server.take(made, answers.put)
        handle = pack.answer(answers.get(timeout=60)).result["handle"]
        wait = r.Take(handle=handle, take="t", wait=1e6, id="2", **one)
        server.take(wait, answers.put)
        with contextlib.closing(xm.semaphore("turn")) as turn:
            wait_for(lambda: turn.waiting == 1, "the wait")
            orders.lost("arm1")
            orders.add(stop())
            answer = pack.answer(answers.get(timeout=60))
            assert not answer.ok or answer.result["code"] == 0
            turn.v()
            assert turn.value == 1
            assert server.is_used(), "the agent keeps its link: else the token goes"
            gone = SimpleNamespace(key_expr=token, kind=zenoh.SampleKind.DELETE)
            zenoh_.called[key_expressions.customer("d", "*")](gone)
            wait_for(lambda: not server.is_used(), "the end of its use")
            turn.destroy()
    finally:
        server.stop()
        xm.live_on("local")


def test_a_task_here_uses_nothing_of_such_a_machine(orders, tmp_path):
    """By way of its agent, as tasks reach other machines."""
    orders.met(info("arm1", "arm"))
    orders.lost("arm1")
    orders.add(stop())
    path, notes = tmp_path / "post", []
    link = Session()
    gate = TaskGateway(link, "d", "arm0", path, notes.append, parts=orders.parts)
    channel = RemoteChannel(str(path), "arm0", "arm")
    try:
        with pytest.raises(UnreachableError, match="it missed a stop"):
            channel.call("arm1", r.Look(handle=1), r.Seen)
        channel.deliver("arm1", r.Give(name="turn"))
        wait_for(lambda: notes, "the report")
        assert notes[0].code == "NOT_DELIVERED"
        assert "it missed a stop" in notes[0].text
    finally:
        channel.close()
        gate.stop()


def test_a_gateway_ends_though_its_socket_was_removed(tmp_path):
    """As programs do that tidy up temporary folders."""
    path = tmp_path / "post"
    gate = TaskGateway(Session(), "d", "arm0", path, print)
    path.unlink()
    ending = threading.Thread(target=gate.stop, daemon=True)
    ending.start()
    wait_for(lambda: not ending.is_alive(), "its end")


def test_what_a_wait_took_of_such_a_machine_is_given_back(orders, tmp_path):
    """The stop came while the task here waited; the answer came after it."""
    orders.met(info("arm1", "arm"))
    path, posted = tmp_path / "post", Queue()

    def call(*_, timeout):  # noqa: ARG001
        orders.lost("arm1")
        orders.add(stop())
        return r.Took(code=1)

    gate = TaskGateway(Session(), "d", "arm0", path, print, parts=orders.parts)
    gate._client = SimpleNamespace(
        call=call,
        post=lambda rtpu, request: posted.put((rtpu, request)),
        announce=Session().declare_token,
    )
    channel = RemoteChannel(str(path), "arm0", "arm")
    try:
        with pytest.raises(UnreachableError, match="it missed a stop"):
            channel.call("arm1", r.Take(handle=1, take="t", wait=1e6), r.Took)
        channel.post("arm1", r.Settle(take="t", keep=False))
        rtpu, request = posted.get(timeout=60)
        assert (rtpu, request.take, request.keep) == ("arm1", "t", False)
    finally:
        channel.close()
        gate.stop()


def test_records_of_such_a_machine_are_not_used(orders, agents, notes, monkeypatch):
    """A link comes from a machine that has missed a stop: nothing of it is read."""
    far, link = "arm1", "arm:x"
    for module in (link_ends, subsystem_links):
        monkeypatch.setattr(module, "direct", lambda call: call)
    orders.met(info(far, "arm"))
    zenoh_ = Session()
    xm.live_on("arm0", domain="d", subsystem="leg")
    nothing = lambda _: None  # noqa: E731
    links = Links(zenoh_, "d", "arm0", nothing, nothing, refuses=orders.holds_agent)
    try:
        with tbuf.Reader(link, "f8") as reader:
            source = key_expressions.link("d", link, "source", far, "arm0")
            token = SimpleNamespace(key_expr=source, kind=zenoh.SampleKind.PUT)
            links._on_token(token)
            data = key_expressions.link("d", link, "data", far, "arm0")
            wait_for(lambda: data in zenoh_.called, "the receiver")

            def arrives(number):
                zenoh_.called[data](sample(number))
                return reader.read() and float(reader.value)

            assert arrives(1) == 1.0
            orders.lost(far)
            orders.add(stop())
            assert arrives(2) is False
            orders.met(info(far, "arm"))
            assert arrives(3) is False, "it has not carried the stop out yet"
            agents.answers.release()
            assert notes.get(timeout=60).code == "STOPPED"
            assert arrives(4) == 4.0
    finally:
        links.stop()
        xm.live_on("local")


def sample(number):
    """Return a record as the other machine's agent sends it."""
    dtype = np.dtype("f8")
    text, data = layout.describe(dtype), np.array(number, dtype).tobytes()
    head = struct.pack(
        "<4sHHQQqq", b"pbTB", 1, len(text), number, 7, time.monotonic_ns(), 0
    )
    return SimpleNamespace(payload=SimpleNamespace(to_bytes=lambda: head + text + data))
