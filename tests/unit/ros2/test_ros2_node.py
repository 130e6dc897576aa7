"""A node's threads: what waits, what does not, and what outlives a fault."""

from __future__ import annotations

import os
import threading
from concurrent.futures import Future
from queue import Queue
from types import SimpleNamespace

import pytest
import zenoh
from watching import wait_for

from pbonet.config.model import Variable
from pbonet.errors import AccessError, ProtocolError, UnknownTaskError
from pbonet.ros2 import repeated_warnings, ros_node
from pbonet.ros2.message_types import COMMAND, MessageTypes
from pbonet.ros2.publishing import Filling, Outgoing, TablePublisher
from pbonet.ros2.repeated_warnings import Warnings
from pbonet.ros2.ros_node import _SHORT, RosNode
from pbonet.ros2.services import Services
from pbonet.ros2.topics_file import Publish
from pbonet.ros2.wire_format import LONGEST, Attachment, End, Kind, Node, Qos
from pbonet.svar import Table, now_ns

pytest.importorskip("rosbags")
NUMBER = "std_msgs/msg/Float64"


@pytest.fixture(scope="module")
def types():
    return MessageTypes()


class Session:
    """Stands for zenoh: keeps what is declared, for the test to call."""

    def __init__(self):
        self.called = {}
        self.info = SimpleNamespace(zid=lambda: "abc")

    def liveliness(self):
        return self

    def close(self):
        pass

    def declare_token(self, _key):
        return SimpleNamespace(undeclare=lambda: None)

    def declare_subscriber(self, key, handler, **_):
        self.called[key.split("/")[1]] = handler
        return SimpleNamespace(undeclare=lambda: None)

    declare_queryable = declare_subscriber


class Bytes(bytes):
    """Stands for zenoh's bytes."""

    def to_bytes(self):
        return bytes(self)


class Query:
    """Stands for a request of zenoh."""

    def __init__(self, data, gid=bytes(16), parameters=""):
        self.payload, self.parameters = Bytes(data), parameters
        self.attachment = Bytes(Attachment(1, 0, gid).pack())
        self.answers = Queue()

    def __enter__(self):
        return self

    def __exit__(self, *_):
        pass

    def reply(self, *_, **__):
        self.answers.put("")

    def reply_err(self, text):
        self.answers.put(text)


@pytest.fixture
def told():
    return []


@pytest.fixture
def node(types, told, monkeypatch):
    monkeypatch.setattr(ros_node, "direct", lambda call: call)
    made = RosNode(Session(), Node(7, "", "arm"), types, Warnings(told.append))
    made.open()
    yield made
    made.close()
    assert not any(thread.is_alive() for thread in made._threads)


def test_a_message_has_the_time_at_which_it_came_not_at_which_it_is_taken(node) -> None:
    taken, busy = Queue(), threading.Semaphore(0)

    def take(sample, arrived):
        taken.put((sample, arrived))
        assert busy.acquire(timeout=60)

    node.subscribe("speed", NUMBER, Qos(), take, 1000.0)
    comes = node.session.called["arm"]
    first, second, third = (sample_of(size) for size in (_SHORT + 1, 8, 8))
    comes(first)
    assert taken.get(timeout=60)[0] is first
    for sample in (second, third):
        comes(sample)
    until = now_ns()
    busy.release(3)
    sample, arrived = taken.get(timeout=60)
    assert sample is third, "the newest"
    assert arrived <= until, "it came before the first one was done"
    assert taken.empty()


@pytest.mark.parametrize("is_first", [True, False])
@pytest.mark.parametrize(
    ("change", "words"),
    [
        ({"hash": "RIHS01_" + 64 * "0"}, "node /lab/other means another definition"),
        ({"type": "std_msgs/msg/Int8"}, "node /lab/other means std_msgs/msg/Int8"),
    ],
)
def test_another_definition_is_named_whoever_came_first(
    node, told, is_first, change, words
) -> None:
    comes = node.session.called["7"]
    token = foreign("other")._replace(**change).token
    gone = foreign("gone")._replace(**change).token
    comes(token_sample(gone, zenoh.SampleKind.PUT))
    comes(token_sample(gone, zenoh.SampleKind.DELETE))
    if is_first:
        comes(token_sample(token, zenoh.SampleKind.PUT))
    node.subscribe("/speed", NUMBER, Qos(), lambda *_: None, 50.0)
    if not is_first:
        assert told == []
        comes(token_sample(token, zenoh.SampleKind.PUT))
    (text,) = told
    assert words in text


def test_others_with_ever_new_names_cannot_fill_the_memory(node, monkeypatch) -> None:
    monkeypatch.setattr(ros_node, "_KEPT", 3)
    for number in range(9):
        token = foreign(f"other{number}").token
        node.session.called["7"](token_sample(token, zenoh.SampleKind.PUT))
    assert len(node._others) == 3


def test_others_with_endless_names_are_not_kept(node) -> None:
    comes = node.session.called["7"]
    for name in ("x" * 10_000, "\u00e9"):
        comes(token_sample(foreign(name).token, zenoh.SampleKind.PUT))
    assert not node._others
    longest = foreign("x" * 255)._replace(name=f"/{'y' * 254}")
    comes(token_sample(longest.token, zenoh.SampleKind.PUT))
    assert list(node._others) == [longest.token]


def foreign(name):
    """Return a publisher of another node."""
    whose = Node(7, "xyz", name, "/lab")
    return End(whose, 3, Kind.PUBLISHER, "/speed", NUMBER, MessageTypes().hash(NUMBER))


def token_sample(token, kind):
    return SimpleNamespace(key_expr=token, kind=kind)


def sample_of(size):
    return SimpleNamespace(payload=bytes(size))


def test_a_short_message_is_taken_in_the_thread_that_brings_it(
    node, monkeypatch
) -> None:
    taken, times = Queue(), [1_000_000_000]
    monkeypatch.setattr(ros_node, "now_ns", lambda: times[-1])

    def take(sample, _arrived):
        taken.put((sample, threading.current_thread()))

    node.subscribe("speed", NUMBER, Qos(), take, 50.0)
    comes = node.session.called["arm"]
    first, second, third = (sample_of(8) for _ in range(3))
    comes(first)
    assert taken.get_nowait() == (first, threading.current_thread())
    comes(second)
    comes(third)
    assert taken.empty(), "not more often than max_hz"
    times.append(times[-1] + 20_000_000)
    sample, thread = taken.get(timeout=60)
    assert sample is third
    assert thread is not threading.current_thread()
    assert taken.empty()


def test_a_message_that_fails_holds_up_no_other(node, told) -> None:
    taken = Queue()

    def take(sample, _arrived):
        taken.put(sample)
        raise RuntimeError("no way")

    node.subscribe("speed", NUMBER, Qos(), take, 1e6)
    comes = node.session.called["arm"]
    for size in (1, _SHORT + 1, 2, 3):
        comes(sample_of(size))
        assert len(taken.get(timeout=60).payload) == size
    assert told == ["/arm/speed: it failed inside pbonet: no way"]


@pytest.fixture
def ask(node, types):
    def send(service, data=None, gid=bytes(16)):
        request = types.new(f"{COMMAND}_Request")
        query = Query(data or types.encode(f"{COMMAND}_Request", request), gid)
        node.session.called[service](query)
        return query.answers

    return send


def test_a_stop_waits_for_no_other_service(node, types, ask) -> None:
    """Also when so many requests wait that others are refused."""
    begun, goes_on = threading.Semaphore(0), threading.Semaphore(0)

    def slow(_):
        begun.release()
        assert goes_on.acquire(timeout=60)
        return types.new(f"{COMMAND}_Response")

    node.serve("/slow", COMMAND, slow)
    stops = lambda _: types.new(f"{COMMAND}_Response")  # noqa: E731
    node.serve("/stop", COMMAND, stops, node.queue("stops"))
    waiting = [ask("slow")]
    assert begun.acquire(timeout=60)
    waiting += [ask("slow") for _ in range(ros_node._WAITING)]
    assert "too many requests" in ask("slow").get(timeout=60)
    assert ask("stop").get(timeout=60) == ""
    assert waiting[0].empty()
    goes_on.release(len(waiting))
    assert {one.get(timeout=60) for one in waiting} == {""}


def test_of_all_commands_stop_alone_is_at_once() -> None:
    served = {}
    node = SimpleNamespace(
        types=None,
        queue=lambda name: name,
        serve=lambda name, _kind, _answer, requests=None: served.update({
            name: requests
        }),
    )
    services = Services.__new__(Services)
    services._node = node
    services.open()
    assert {name for name, queue in served.items() if queue} == {"stop"}


def test_a_request_that_fails_is_answered(node, ask, told) -> None:
    """The one that asks would wait until its time is over."""

    def fails(_):
        raise ZeroDivisionError("no way")

    node.serve("/fails", COMMAND, fails)
    assert ask("fails").get(timeout=60) == "/fails failed: no way"
    wait_for(lambda: told, "the warning")
    assert told == ["/fails: it failed inside pbonet: no way"]


@pytest.mark.parametrize("about", [{"data": bytes(LONGEST + 1)}, {"parameters": "x"}])
def test_a_request_that_is_too_long_does_not_even_wait(node, types, about) -> None:
    """Requests that wait are bounded by their number, so each of them must be short."""
    goes_on = threading.Semaphore(0)

    def slow(_):
        assert goes_on.acquire(timeout=60)
        return types.new(f"{COMMAND}_Response")

    node.serve("/slow", COMMAND, slow)
    data = types.encode(f"{COMMAND}_Request", types.new(f"{COMMAND}_Request"))
    first, long = Query(data), Query(**{"data": data} | about)
    long.parameters *= LONGEST
    node.session.called["slow"](first)
    node.session.called["slow"](long)
    refusal = long.answers.get_nowait()
    assert "a message is too long, and was not read" in refusal
    assert first.answers.empty()
    goes_on.release()
    assert first.answers.get(timeout=60) == ""


def test_an_answer_may_come_later(node, types, ask) -> None:
    later: Future[object] = Future()
    node.serve("/later", COMMAND, lambda _: later)
    node.serve("/now", COMMAND, lambda _: types.new(f"{COMMAND}_Response"))
    waits = ask("later")
    assert ask("now").get(timeout=60) == "", "it holds up no other"
    assert waits.empty()
    later.set_result(types.new(f"{COMMAND}_Response"))
    assert waits.get(timeout=60) == ""


def test_a_client_that_waits_for_many_answers_keeps_no_other_from_asking(
    node, types, ask
) -> None:
    later = [Future() for _ in range(3 * ros_node._LATER)]
    given = iter(later)
    node.serve("/later", COMMAND, lambda _: next(given))
    node.serve("/now", COMMAND, lambda _: types.new(f"{COMMAND}_Response"))
    greedy = [ask("later") for _ in range(2 * ros_node._LATER)]
    for one in greedy[ros_node._LATER :]:
        assert "8 requests of this client wait" in one.get(timeout=60)
    other = ask("later", gid=b"o" * 16)
    assert ask("now").get(timeout=60) == ""
    assert other.empty()
    for one in later[: ros_node._LATER + 1]:
        one.set_result(types.new(f"{COMMAND}_Response"))
    for one in (*greedy[: ros_node._LATER], other):
        assert one.get(timeout=60) == ""
    again = ask("later")
    assert ask("now").get(timeout=60) == ""
    assert again.empty(), "it may ask again"
    assert node._later._waits.keys() == {"/later"}
    assert node._later._waits["/later"].keys() == {bytes(16)}


def test_clients_with_ever_new_identities_cannot_fill_the_memory(
    node, types, ask
) -> None:
    """And what keeps nobody waiting, such as a stop, is answered none the less."""
    given = [Future() for _ in range(ros_node._LATER_OF_ALL + 1)]
    later = iter(given)
    node.serve("/later", COMMAND, lambda _: next(later))
    node.serve("/now", COMMAND, lambda _: types.new(f"{COMMAND}_Response"))
    waits = []
    for k in range(ros_node._LATER_OF_ALL):
        waits.append(ask("later", gid=k.to_bytes(16, "big")))
        assert ask("now", gid=k.to_bytes(16, "big")).get(timeout=60) == ""
    refused = ask("later", gid=b"o" * 16)
    assert "256 requests wait already" in refused.get(timeout=60)
    for one in given[:-1]:
        one.set_result(types.new(f"{COMMAND}_Response"))
    assert [one.get(timeout=60) for one in waits] == [""] * len(waits)
    assert not node._later._waits["/later"]
    last = ask("later", gid=b"o" * 16)
    given[-1].set_result(types.new(f"{COMMAND}_Response"))
    assert last.get(timeout=60) == ""


def test_warnings_with_ever_new_names_are_bounded(told, monkeypatch) -> None:
    times = [0.0]
    monkeypatch.setattr(repeated_warnings.time, "monotonic", lambda: times[-1])
    warnings, more = Warnings(told.append), []
    warnings.also(more.append)
    for k in range(2000):
        warnings.warn("/follow", f"there is no joint {k}")
    assert len(told) == len(more) == 50
    times.append(10.0)
    warnings.warn("/follow", "there is no joint 0")
    assert (
        told[50:]
        == more[50:]
        == ["/follow: there is no joint 0 (1950 other warnings were left out)"]
    )


def test_a_warning_is_one_short_line_whatever_a_node_sends(told) -> None:
    warnings = Warnings(told.append)
    warnings.warn("/a", "no joint \x1b[2J\n\udcff\0", f" (got {'x' * 10**6})")
    assert told[0].startswith("/a: no joint ?[2J??? (got xxx")
    assert len(told[0]) < 1100
    warnings.warn("/a", "y" * 10**6)
    assert len(told[1]) < 1100
    assert max(map(len, warnings._shown)) < 1100, "nor is more kept"


class Params:
    """Stands for the parameters of two tasks."""

    def __init__(self, types):
        self.made = Services.__new__(Services)
        self.made._types, self.made.call = types, self.call
        self.types, self.set = types, []

    def call(self, name, **args):
        if name == "status":
            return SimpleNamespace(data={"tasks": [{"task": "pid"}, {"task": "arm"}]})
        if name == "set":
            if args["param"] != "kp":
                raise AccessError("this bridge only shows it")
            self.set.append(args)
            return None
        about = {"doc": "stiffness", "unit": "N/m", "bounds": ">= 0"}
        values = {"pid": {"kp": 2.5, "name": "x"}, "arm": {"joints": (1, 2)}}
        if args["task"] not in values:
            raise UnknownTaskError("no such task")
        found = values[args["task"]].items()
        params = [{"name": k, "value": v, **about} for k, v in found]
        return SimpleNamespace(data={"params": params})

    def request(self, name, **fields):
        made = self.types.new(f"rcl_interfaces/srv/{name}_Request")
        for key, value in fields.items():
            setattr(made, key, value)
        return made

    def parameter(self, name, **value):
        made = self.types.new("rcl_interfaces/msg/Parameter")
        made.name = name
        for key, one in value.items():
            setattr(made.value, key, one)
        return made


def test_parameters_are_listed_and_described(types) -> None:
    params = Params(types)
    services = params.made
    found = services._list(params.request("ListParameters")).result
    assert found.names == ["pid.kp", "pid.name", "arm.joints"]
    assert found.prefixes == ["pid", "arm"]
    some = services._list(params.request("ListParameters", prefixes=["arm"])).result
    assert some.names == ["arm.joints"]
    names = ["pid.kp", "arm.joints", "pid.nothing", "nobody.kp"]
    kinds = services._get_types(params.request("GetParameterTypes", names=names))
    assert kinds.types.tolist() == [3, 7, 0, 0]
    about = services._describe(params.request("DescribeParameters", names=names))
    first, *_, last = about.descriptors
    assert (first.name, first.type) == ("pid.kp", 3)
    assert first.description == "stiffness [N/m]"
    assert first.additional_constraints == ">= 0"
    assert (last.name, last.type, last.description) == ("nobody.kp", 0, "")


def test_one_parameter_is_set_at_once_and_several_are_not(types) -> None:
    params = Params(types)

    def set_at_once(*given):
        request = params.request("SetParametersAtomically", parameters=list(given))
        return params.made._set_at_once(request).result

    kp = params.parameter("pid.kp", type=3, double_value=4.5)
    assert set_at_once(kp).successful
    assert params.set == [{"task": "pid", "param": "kp", "value": ["4.5"]}]
    both = set_at_once(kp, kp)
    assert not both.successful
    assert "one by one" in both.reason
    refused = set_at_once(params.parameter("pid.name", type=4, string_value="y"))
    assert (refused.successful, refused.reason) == (False, "this bridge only shows it")
    assert len(params.set) == 1


def test_the_next_commit_is_expected_when_it_comes() -> None:
    """After a pause, too, and after some that come in one go."""
    publisher = TablePublisher("d.arm", "", [], Warnings(print))
    period, now, jitter = 2_000_000, 10**12, (0, 90_000, -40_000, 150_000, -70_000)

    def commits(count):
        nonlocal now
        for k in range(count):
            now += period
            publisher._measure(now + jitter[k % 5], 1)

    def is_expected():
        late = now + period - publisher._last_ns - publisher._period_ns
        return abs(late) < 0.1 * period

    commits(40)
    assert is_expected()
    now += 30 * period
    publisher._measure(now + 900_000, 30)
    commits(20)
    assert is_expected()
    for _ in range(7):
        publisher._measure(now, 1)
    commits(20)
    assert is_expected()
    now += 10**9
    publisher._measure(now, 1)
    assert publisher._period_ns == 0, "nothing is expected after a long pause"
    commits(20)
    assert is_expected()
    period = 50_000_000
    commits(20)
    assert is_expected(), "of a slower task"
    for _ in range(8):  # until it is expected, two are seen in one go
        now += 2_000_000
        publisher._measure(now, 2)
    period = 1_000_000
    commits(20)
    assert is_expected(), "of a faster one"


def test_a_number_that_does_not_fit_stops_no_other_topic(types) -> None:
    variables = [Variable(name="A", type="double")]
    about = Publish(topic="A", type="std_msgs/msg/UInt8", fields={"data": "A"})
    filling = Filling(types, about, {"A": variables[0]}, "here")
    put = SimpleNamespace(put=None, end=SimpleNamespace(name="/A"))
    topic = Outgoing(filling, put, 1000.0, Warnings(print))
    table = Table.create("d.arm", variables)
    try:
        local = table.local("one", os.getpid(), outvar=["A"])
        local.claim()
        topic.attach(table)
        local.array("A")[:] = 300.0
        local.commit()
        with pytest.raises(ProtocolError, match="does not fit"):
            topic.turn(now_ns())
        topic.prepare()
    finally:
        table.destroy()


def test_a_topic_that_cannot_be_published_stops_no_other(types, told) -> None:
    variables = [Variable(name=name, type="double") for name in ("A", "B")]
    got = Queue()

    def broken(*_):
        raise RuntimeError("no session")

    puts = {"A": broken, "B": lambda _, stamp: got.put(stamp)}
    warnings = Warnings(told.append)
    outgoing = [
        Outgoing(
            Filling(
                types,
                Publish(topic=name, type=NUMBER, fields={"data": name}),
                {one.name: one for one in variables},
                "here",
            ),
            SimpleNamespace(put=put, end=SimpleNamespace(name=f"/{name}")),
            1000.0,
            warnings,
        )
        for name, put in puts.items()
    ]
    table = Table.create("d.arm", variables)
    local = table.local("one", os.getpid(), outvar=["A", "B"])
    local.claim()
    publisher = TablePublisher("d.arm", Table.layout_of(variables), outgoing, warnings)
    publisher.start()
    try:
        for value in range(1, 4):
            for name in puts:
                local.array(name)[:] = value
            local.commit()
            assert got.get(timeout=60)
        assert "/A: it failed inside pbonet: no session" in told
    finally:
        publisher.stop()
        table.destroy()
