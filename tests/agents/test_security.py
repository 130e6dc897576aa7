"""Roles over mutual TLS: who may steer, who may look, who gets nothing.

Two agents, of which the second is connected to the first. Clients have a runtime folder
of their own, so that no Unix socket leads them past the keys.
"""

import contextlib
import http.client
import json
import os
import subprocess
import sys

import fsspec
import pytest
import zenoh
from nodekit import Master, rmod
from watching import free_port, wait_for
from websockets.sync.client import connect

from pbonet.errors import AccessError, UnreachableError
from pbonet.xm.net import (
    codec,
    key_expressions,
    messages as m,
    pki,
    resource_messages as r,
    session,
)
from pbonet.xm.net.credentials import AGENTS, Role
from pbonet.xm.net.rpc import Client

SBS = """
SUBSYSTEM arm
SVARFILE arm.svar
MASTER arm0
RTPU arm0
SCHEDULER MUF
USAGE exclusive
MINFREQ 1
MAXFREQ 1000
EOF
"""


@pytest.fixture
def lab(tmp_path):
    """Return the key folders of a laboratory, and of another one."""
    folders = {}
    for where in ("lab", "other"):
        authority = tmp_path / where
        pki.make_authority(authority)
        for role in Role:
            hosts = ["127.0.0.1"] if role in AGENTS else []
            made = pki.issue(authority, role, role.value, hosts=hosts)
            folders[f"{where} {role.value}"] = made
    return folders


class Cell:
    """Two agents with keys.

    Args:
        nodes: The kit.
        lab: Key folders.
    """

    def __init__(self, nodes, lab):
        self.nodes, self.lab = nodes, lab
        self.near, self.far = (f"tls/127.0.0.1:{free_port()}" for _ in range(2))
        own = {"keys": str(lab["lab gateway"])}
        self.files = nodes.library.parent / "files"
        self.files.mkdir()
        nodes.agent_process("arm0", listen=(self.near,), files=str(self.files), **own)
        nodes.agent_process("arm1", listen=(self.far,), connect=(self.near,), **own)


@pytest.fixture
def cell(nodes, lab, tmp_path, monkeypatch):
    made = Cell(nodes, lab)
    nodes.forget_session()
    elsewhere = tmp_path / "elsewhere"
    elsewhere.mkdir(mode=0o700)
    with monkeypatch.context() as patch:
        patch.setenv("PBONET_RUN_DIR", str(elsewhere))
        made.elsewhere = elsewhere
        yield made


@pytest.fixture
def come(cell):
    """Open sessions with the keys of somebody."""
    opened = []

    def open_session(who, where, limit=30.0):
        made = session.client(
            cell.nodes.domain, connect=[where], key_folder=cell.lab[who], timeout=limit
        )
        opened.append(made)
        return made

    yield open_session
    for one in opened:
        one.close()


@pytest.mark.parametrize("who", ["master", "gateway"])
def test_master_steers_through_the_second_agent(cell, come, who):
    """Also one with a gateway's keys, as a program with agents of its own has them."""
    cell.nodes._session = come(f"lab {who}", cell.far)
    master = cell.nodes.master("arm0", "arm")
    master.spawn("a", "counts")
    assert master.on("a").state == "ON"
    master.wait_cycles("a", 3)
    master.stop()
    cell.nodes._session = None  # `come` closes it


@pytest.mark.parametrize("edge", ["near", "far"])
def test_observer_looks_and_changes_nothing(cell, come, edge):
    boss = Master(_Over(cell, come("lab master", cell.near)), "arm0", "arm")
    boss.open_table()
    boss.spawn("a", "counts")
    boss.on("a")
    watcher = come("lab observer", getattr(cell, edge))
    client = Client(watcher, cell.nodes.domain, "watcher")
    wait_for(lambda: client.rtpus() == ["arm0", "arm1"], "both agents")
    status = client.call("arm0", m.Status(subsystem="arm"), m.RtpuStatus)
    assert [task.state for task in status.tasks] == ["ON"]
    shown = m.Display(subsystem="arm", names=["Y0"])
    assert client.call("arm0", shown, list[m.VarValue])[0].name == "Y0"
    for request in (
        m.Control(task="a", signal="off", subsystem="arm", epoch=boss.epoch),
        m.Stop(subsystem="arm"),
        m.Claim(subsystem="arm", take_over=True),
    ):
        with pytest.raises(AccessError) as caught:
            client.call("arm0", request, object)
        assert "--keys" in caught.value.remedy
    assert boss.status("a").state == "ON"
    boss.stop()


@pytest.mark.parametrize("edge", ["near", "far"])
def test_resources_and_files_are_a_masters_and_observers_read(cell, come, edge):
    where, domain = getattr(cell, edge), cell.nodes.domain
    made = r.Attach(name="grip", kind="sem", create={"initial": 1})
    boss, watcher = (
        Client(come(f"lab {who}", where), domain, who) for who in ("master", "observer")
    )
    tokens = [
        one.announce(key_expressions.customer(domain, one.name))
        for one in (boss, watcher)
    ]
    grip = boss.call("arm0", made, r.Attached)
    assert boss.call("arm0", r.Take(handle=grip.handle, take="t"), r.Took).code == 1
    for request in (
        r.Attach(name="grip", kind="sem"),
        r.Give(handle=grip.handle),
        r.Interrupt(name="door"),
    ):
        with pytest.raises(AccessError):
            watcher.call("arm0", request, object)
    boss.call("arm0", r.Detach(handle=grip.handle, destroy=True), type(None))
    places = [
        fsspec.filesystem(
            "pbonet",
            domain=domain,
            connect=where,
            keys=str(cell.lab[f"lab {who}"]),
            skip_instance_cache=True,
        )
        for who in ("master", "observer")
    ]
    places[0].pipe_file("arm0/a.txt", b"seen")
    assert places[1].cat_file("arm0/a.txt") == b"seen"
    assert places[1].ls("arm0", detail=False) == ["arm0/a.txt"]
    with pytest.raises(AccessError):
        places[1].pipe_file("arm0/a.txt", b"changed")
    with pytest.raises(AccessError):
        places[1].rm_file("arm0/a.txt")
    assert [path.read_bytes() for path in cell.files.iterdir()] == [b"seen"]
    for place in places:
        place.close()
    assert len(tokens) == 2


@pytest.mark.own_limits
def test_files_are_closed_to_keys_of_another_authority(cell):
    with pytest.raises(UnreachableError):
        fsspec.filesystem(
            "pbonet",
            domain=cell.nodes.domain,
            connect=cell.near,
            keys=str(cell.lab["other master"]),
        )


@pytest.mark.parametrize("edge", ["near", "far"])
def test_an_agents_key_reads_and_serves_and_commands_nothing(cell, come, edge):
    domain = cell.nodes.domain
    boss = Master(_Over(cell, come("lab master", cell.near)), "arm0", "arm")
    boss.open_table()
    boss.spawn("a", "counts")
    boss.on("a")
    link = come("lab agent", getattr(cell, edge))
    thief = Client(link, domain, boss.name)  # who claims to be the master
    status = thief.call("arm0", m.Status(subsystem="arm"), m.RtpuStatus)
    assert [task.state for task in status.tasks] == ["ON"]
    for request in (
        m.Control(task="a", signal="off", subsystem="arm", epoch=boss.epoch),
        m.Stop(subsystem="arm", stop_id="x"),
        m.Claim(subsystem="arm", take_over=True),
        m.Spawn(task="b", rmod=rmod("counts"), rmod_name="b", epoch=boss.epoch),
        m.Set(task="a", name="x", value="1", subsystem="arm", epoch=boss.epoch),
        m.Write(name="Y1", values=[1.0, 1.0], subsystem="arm", epoch=boss.epoch),
    ):
        with pytest.raises(AccessError, match="dropped on the way"):
            thief.call("arm0", request, object)
    assert boss.status("a").state == "ON"
    pack = codec.Codec().pack

    def answer(query):
        asked = codec.Codec().request(query.payload.to_bytes())
        query.reply(query.key_expr, pack(m.Answer(id=asked.id, ok=True, result=[])))

    key = key_expressions.rtpu(domain, "eye0", "sbs")
    alive = key_expressions.rtpu(domain, "eye0", "alive")
    shown = [
        link.declare_queryable(key, answer),
        link.liveliness().declare_token(alive),
    ]
    wait_for(lambda: "eye0" in boss.client.rtpus(), "the agent with the key")
    assert boss.client.call("eye0", m.Stop(), list) == []
    assert len(shown) == 2
    boss.stop()


def test_observer_cannot_steer_on_the_key_for_looking(cell, come):
    """Access control lets the request through; the agent looks at what it asks."""
    watcher = come("lab observer", cell.near)
    asked = codec.Codec().pack(m.Stop(id="1", client="w"))
    key = key_expressions.rtpu(cell.nodes.domain, "arm0", "status")
    replies = list(watcher.get(key, payload=asked, timeout=30.0))
    answer = codec.Codec().answer(replies[0].ok.payload.to_bytes())
    assert (answer.ok, answer.error["code"]) == (False, "ACCESS")


def test_observer_cannot_speak_for_others(cell, come):
    """Neither as a master's token, nor as an agent that answers or tells of events."""
    domain = cell.nodes.domain
    heard = []
    boss = come("lab master", cell.near)
    boss.declare_subscriber(
        key_expressions.all_rtpus(domain, "event"),
        zenoh.handlers.Callback(heard.append),
    )
    watcher = come("lab observer", cell.near)
    alive = key_expressions.rtpu(domain, "fake", "alive")
    serves = key_expressions.rtpu(domain, "fake", "sbs")
    shown = [
        watcher.liveliness().declare_token(alive),
        watcher.declare_queryable(serves, heard.append),
    ]
    watcher.put(key_expressions.rtpu(domain, "arm0", "event"), b"false alarm")
    boss.put(key_expressions.rtpu(domain, "arm0", "event"), b"from the master")
    wait_for(lambda: heard, "the master's own event")
    assert [one.payload.to_bytes() for one in heard] == [b"from the master"]
    both = ["arm0", "arm1"]
    wait_for(lambda: session.rtpus(boss, domain) == both, "both agents, no other")
    assert not list(boss.get(serves, timeout=1.0))
    assert len(shown) == 2


@pytest.mark.parametrize("who", ["other agent", "other master"])
def test_keys_of_another_authority_open_nothing(cell, come, who):
    with pytest.raises(UnreachableError) as caught:
        come(who, cell.near, 0.5)
    assert "one authority" in caught.value.remedy


def test_stranger_without_keys_gets_nothing(cell):
    for protocol in ("tls", "tcp"):
        config = zenoh.Config()
        config.insert_json5("mode", '"client"')
        config.insert_json5("scouting/multicast/enabled", "false")
        config.insert_json5("transport/shared_memory/enabled", "false")
        where = cell.near.replace("tls", protocol)
        config.insert_json5("connect/endpoints", json.dumps([where]))
        with pytest.raises(zenoh.ZError):
            zenoh.open(config)


def test_agent_of_another_authority_stays_alone(cell, nodes):
    """Its session keeps trying; it sees nobody and nobody sees it."""
    nodes.agent_process(
        "eye0",
        wait=False,
        connect=(cell.near,),
        keys=str(cell.lab["other agent"]),
    )

    def alone():
        try:
            with session.client(nodes.domain) as its_own:
                return session.rtpus(its_own, nodes.domain) == ["eye0"]
        except UnreachableError:  # it starts up
            return False

    wait_for(alone, "the agent eye0 by itself")
    with session.client(
        nodes.domain, connect=[cell.near], key_folder=cell.lab["lab master"]
    ) as ours:
        both = ["arm0", "arm1"]
        wait_for(lambda: session.rtpus(ours, nodes.domain) == both, "both agents")


def test_observers_verbs(cell, tmp_path):
    (tmp_path / "arm.sbs").write_text(SBS)
    (tmp_path / "arm.svar").write_text(
        "NAME Y0\nTYPE double\nDESC d\nUNITS none\nNELEM 2\nEOF\n"
    )
    (tmp_path / "a.rmod").write_text(rmod("counts"))

    def pbonet(who, *words):
        return subprocess.run(
            [
                *(sys.executable, "-m", "pbonet.cli", *words),
                *("--keys", cell.lab[who], "--connect", cell.far),
                *("--domain", cell.nodes.domain),
            ],
            capture_output=True,
            text=True,
            cwd=tmp_path,
            env={**os.environ, "PBONET_RUN_DIR": str(cell.elsewhere)},
            check=False,
        )

    done = pbonet("lab observer", "status", "arm.sbs")
    assert done.returncode == 0, done.stderr
    done = pbonet("lab observer", "off", "arm.sbs", "a")
    assert done.returncode == 1
    assert "dropped on the way" in done.stderr
    done = pbonet("lab observer", "stop")
    assert done.returncode == 1
    assert "dropped on the way" in done.stderr
    _page_of_an_observer(cell, tmp_path)
    done = pbonet("lab master", "stop")
    assert done.returncode == 0, done.stderr


def _page_of_an_observer(cell, folder):
    """With an observer's keys the page's server has no link with which to steer."""
    words = ["web", "arm.sbs", "--port", "0", "--json", "--connect", cell.far]
    words += ["--keys", str(cell.lab["lab observer"]), "--domain", cell.nodes.domain]
    server = subprocess.Popen(
        [sys.executable, "-m", "pbonet.cli", *words],
        stdout=subprocess.PIPE,
        text=True,
        cwd=folder,
        env={**os.environ, "PBONET_RUN_DIR": str(cell.elsewhere)},
    )
    try:
        links = json.loads(server.stdout.readline())
        assert links.keys() == {"observer"}
        url, _, token = links["observer"].partition("/?")
        asking = http.client.HTTPConnection(url.removeprefix("http://"))
        with contextlib.closing(asking):
            asking.request("GET", f"/?{token}")
            cookie = asking.getresponse().getheader("set-cookie").partition(";")[0]
        with connect(
            url.replace("http", "ws") + "/ws",
            origin=url,
            additional_headers={"Cookie": cookie},
        ) as page:

            def wait(kind, good=lambda _: True):
                while True:
                    message = json.loads(page.recv(timeout=60))
                    if message["kind"] == kind and good(message):
                        return message

            assert wait("hello")["role"] == "observer"
            assert (
                wait("status", lambda one: one["rtpus"])["rtpus"][0]["rtpu"] == "arm0"
            )
            for number, request in enumerate((
                {"do": "line", "line": "off a"},
                {"do": "stop"},
            )):
                page.send(json.dumps({"id": number, **request}))
                told = wait("answer", lambda one, n=number: one["id"] == n)
                assert not told["ok"]
                assert "this page is an observer's" in told["text"]
    finally:
        server.terminate()
        server.communicate(timeout=60)


class _Over:
    """What a kit's master needs of a kit, over another session."""

    def __init__(self, cell, opened):
        self.session, self.domain = opened, cell.nodes.domain
