"""The network interface: a program that knows only zenoh and msgpack steers."""

from __future__ import annotations

import json
import subprocess
import sys
import textwrap
import threading
from concurrent.futures import ThreadPoolExecutor

import msgspec
import pytest
from watching import wait_for

from pbonet.errors import (
    ClaimError,
    DuplicateNameError,
    NoAnswerError,
    NodeError,
    PbonetError,
)
from pbonet.master.configuration.environment import Place
from pbonet.master.console import ask_master, oneshot
from pbonet.master.console.interfaces import Script
from pbonet.master.console.network_interface import Port
from pbonet.xm.net import (
    codec,
    key_expressions,
    messages as m,
    rpc,
    run_folder,
    session,
)

FOREIGN = textwrap.dedent(
    """
    import json, sys, time
    import msgpack, zenoh

    endpoint, domain, port = sys.argv[1:4]
    commands = json.loads(sys.argv[4])
    config = zenoh.Config()
    config.insert_json5("mode", '"client"')
    config.insert_json5("connect/endpoints", json.dumps([endpoint]))
    config.insert_json5("scouting/multicast/enabled", "false")
    config.insert_json5("transport/shared_memory/enabled", "false")
    session = zenoh.open(config)
    token = session.liveliness().declare_token(
        f"pbonet/{domain}/net/{port}/client/onika"
    )
    for number, command in enumerate(commands):
        request = {"v": 1, "id": str(number), "client": "onika", **command}
        key, payload = f"pbonet/{domain}/net/{port}", msgpack.packb(request)
        while not (replies := list(session.get(key, payload=payload, timeout=10))):
            time.sleep(0.05)  # the port was opened a moment ago
        answer = msgpack.unpackb(replies[0].ok.payload.to_bytes())
        print(json.dumps(answer), flush=True)
    if "--hang" in sys.argv:
        time.sleep(60)
    session.close()
    assert "pbonet" not in sys.modules
    """
)


@pytest.fixture
def port(arm):
    told = []
    opened = Port(arm, "chimera", told=told.append)
    opened.told_lines = told
    with opened:
        yield opened


@pytest.fixture
def caller(arm, world):  # noqa: ARG001 - it must stand first
    """Sends one order with the client name given."""
    opened = session.client(world.domain)

    def call(client, command="", args=None, line="", ident=""):
        order = {"v": 1, "id": ident, "client": client, "command": command}
        order |= {"args": args or {}, "line": line}
        return call.raw(msgspec.msgpack.encode(order))

    def raw(payload):
        key = key_expressions.network(world.domain, "chimera")
        replies = wait_for(
            lambda: list(opened.get(key, payload=payload, timeout=10.0)), "a reply"
        )
        return codec.Codec().answer(replies[0].ok.payload.to_bytes())

    call.raw = raw

    call.token = lambda client: opened.liveliness().declare_token(
        key_expressions.network_client(world.domain, "chimera", client)
    )
    yield call
    opened.close()


def foreign(world, *commands, hang=False):
    """Start a program that imports only zenoh and msgpack."""
    return subprocess.Popen(
        [
            sys.executable,
            "-c",
            FOREIGN,
            run_folder.Places(world.domain, "arm0").endpoint,
            world.domain,
            "chimera",
            json.dumps(commands),
            *(["--hang"] if hang else []),
        ],
        stdout=subprocess.PIPE,
        text=True,
    )


def foreign_when_served(world, *commands):
    """Start such a program as soon as the port is there."""

    def start():
        opened = session.client(world.domain)
        wait_for(
            lambda: session.alive(
                opened, key_expressions.network(world.domain, "chimera")
            ),
            "port",
        )
        opened.close()
        client = foreign(world, *commands)
        client.communicate(timeout=100)
        return client

    pool = ThreadPoolExecutor(1)
    future = pool.submit(start)
    pool.shutdown(wait=False)
    return future


def test_foreign_program_assembles_steers_and_hands_back(arm, port, world):
    client = foreign(
        world,
        {"command": "spawn", "args": {"rmod": "puma_pidg", "rtpu": "arm0"}},
        {"line": "spawn jttrace arm1 25"},
        {"line": "on"},
        {"command": "status", "args": {"task": ["jttrace"]}},
        {"command": "on", "args": {"task": ["jttrace"]}},
        {"command": "quit"},
    )
    port.serve(threading.Event())  # control comes back by its quit
    out, _ = client.communicate(timeout=100)
    answers = [json.loads(line) for line in out.splitlines()]
    assert client.returncode == 0
    assert [answer["ok"] for answer in answers] == [True] * 4 + [False, True], answers
    assert answers[2]["result"]["text"] == "jttrace ON"
    fields = answers[3]["result"]["data"]["tasks"][0]["fields"]
    assert (fields["state"], fields["refF"]) == ("ON", 25.0)
    assert answers[4]["error"]["code"] == "STATE"
    assert port.told_lines == ["onika has control", "onika has ended; control is back"]
    assert [member.name for member in arm.model] == ["puma_pidg", "jttrace"]


def test_interface_goes_on_when_the_program_ends(arm, world, capfd):
    """A script hands control over, and has it back for the lines that follow."""
    client = foreign_when_served(world, {"line": "spawn puma_pidg"}, {"line": "quit"})
    script = Script(arm)
    failed = script.run("s", ["network chimera", "spawn jttrace arm1", "on"])
    assert not failed
    assert client.result().returncode == 0
    out, err = capfd.readouterr()
    assert out.splitlines() == ["jttrace OFF", "jttrace ON"]
    assert "port chimera waits for a client" in err
    assert "onika has ended; control is back" in err


def test_loss_of_the_program_hands_control_back(port, world):
    order = {"command": "spawn", "args": {"rmod": "puma_pidg"}}
    client = foreign(world, order, hang=True)
    assert json.loads(client.stdout.readline())["ok"]
    client.kill()
    port.serve(threading.Event())
    assert port.told_lines[-1] == "onika is gone; control is back"
    client.wait()
    client.stdout.close()


@pytest.mark.usefixtures("port")
def test_control_is_one_clients_and_looking_everybodys(caller):
    token = caller.token("one")
    assert caller("one", "spawn", {"rmod": "puma_pidg"}).ok
    refused = caller("two", "spawn", {"rmod": "jttrace"})
    assert refused.error["code"] == ClaimError.code
    assert refused.error["got"] == "one"
    assert caller("two", "status").ok
    nothing = {"off": [], "killed": [], "failed": {}}
    assert caller("two", "stop").result["data"] == nothing
    assert caller("two", "quit").error["code"] == "STATE"
    assert caller("one", "quit").ok
    token.undeclare()


@pytest.mark.usefixtures("port")
def test_client_without_a_token_may_not_take_control(caller):
    answer = caller("ghost", "spawn", {"rmod": "puma_pidg"})
    assert (
        answer.error["what"] == "a client that takes control needs a liveliness token"
    )
    assert answer.error["expected"].endswith("/net/chimera/client/ghost")


@pytest.mark.usefixtures("port")
def test_many_clients_that_look_are_not_all_remembered(caller, port):
    token = caller.token("one")
    assert caller("one", "spawn", {"rmod": "puma_pidg"}).ok
    assert caller("one", "status set", {"field": ["rmod"]}).ok
    for number in range(150):
        assert caller(f"client{number}", "help", {"command": "on"}).ok
    assert len(port._sessions) == 100
    shown = caller("one", "status").result["data"]["fields"]
    assert shown == ["rmod"]  # of the one that has control
    token.undeclare()


@pytest.mark.usefixtures("port")
def test_repeated_order_is_not_carried_out_twice(caller, agents):
    token = caller.token("one")
    order = {"rmod": "puma_pidg"}
    first = caller("one", "spawn", order, ident="7")
    assert caller("one", "spawn", order, ident="7") == first
    spawned = [r for r in agents["arm0"].requests if isinstance(r, m.Spawn)]
    assert len(spawned) == 1
    token.undeclare()


@pytest.mark.parametrize(
    ("payload", "what"),
    [
        (b"\xc1", "the message is not understood"),
        (msgspec.msgpack.encode({"v": 2, "command": "status"}), "another protocol"),
        (msgspec.msgpack.encode({"v": 1}), "neither a command nor a line"),
        (msgspec.msgpack.encode({"v": 1, "line": "spwan x"}), "no command spwan"),
        (msgspec.msgpack.encode({"v": 1, "line": "x" * 2000}), "of 2000 characters"),
        (
            msgspec.msgpack.encode({"v": 1, "command": "on", "client": "*"}),
            "this is not a valid name for a client",
        ),
        (b"", "the message is not understood"),
    ],
)
@pytest.mark.usefixtures("port")
def test_what_is_not_understood_is_answered(caller, payload, what):
    answer = caller.raw(payload)
    assert not answer.ok
    assert what in answer.error["what"]


@pytest.mark.usefixtures("port")
def test_stop_does_not_wait_for_the_command_before_it(caller, agents):
    token = caller.token("one")
    caller("one", "spawn", {"rmod": "puma_pidg"})
    go_on = agents["arm0"].held["control"] = threading.Event()
    slow = threading.Thread(target=caller, args=("one", "on", {"task": ["puma_pidg"]}))
    slow.start()

    def asked():
        return any(isinstance(r, m.Control) for r in agents["arm0"].requests)

    try:
        wait_for(asked, "the slow command")
        assert caller("two", "stop").ok
        assert slow.is_alive()
    finally:
        go_on.set()
        slow.join()
    token.undeclare()


@pytest.mark.usefixtures("port")
def test_port_is_one_masters(arm):
    with pytest.raises(DuplicateNameError, match="the port chimera is taken"):
        Port(arm, "chimera").open()
    with pytest.raises(NodeError, match="not a valid name for a port"):
        Port(arm, "a/b")


def test_port_that_is_closed_answers_no_more(arm, world):
    with Port(arm, "gone"):
        pass
    client = rpc.Client(session.client(world.domain), world.domain, "late")
    with pytest.raises(PbonetError, match="the master has ended"):
        ask_master.ask(client, "gone", "status", {})
    client.close()


@pytest.mark.usefixtures("arm")
def test_a_master_that_takes_no_commands_has_not_ended(world, monkeypatch):
    """Its token is there, as on a machine that is too busy to answer."""
    monkeypatch.setattr(rpc, "ANSWER_TIME", 0.1)
    client = rpc.Client(session.client(world.domain), world.domain, "caller")
    key = key_expressions.network(world.domain, "busy")
    token = client.session.liveliness().declare_token(key)
    with pytest.raises(NoAnswerError, match=r"busy: the master is there, but does not"):
        ask_master.ask(client, "busy", "status", {})
    token.undeclare()
    client.close()


def test_verbs_use_the_port_of_a_living_master(arm, world, puma):
    place = Place(domain=world.domain)
    with pytest.raises(PbonetError, match="another master steers"):
        oneshot.run(puma, "spawn", {"rmod": "puma_pidg"}, place)
    with Port(arm, "puma", handover=False):
        reply = oneshot.run(puma, "spawn", {"rmod": "puma_pidg"}, place)
        assert reply.data["states"] == {"puma_pidg": "OFF"}
    assert arm.status("puma_pidg").state == "OFF"
