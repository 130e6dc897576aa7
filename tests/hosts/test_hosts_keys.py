"""Machines over mutual TLS: a table, a link, a cable that is pulled, and wrong keys."""

from __future__ import annotations

import json
import subprocess
import sys
import time

import pytest
from hostfleet import Desk
from hostkit import Lab
from tbuf_rig import READER, WRITER, flows
from watching import wait_for

from pbonet.xm.net import key_expressions as names, messages as m, pki
from pbonet.xm.net.credentials import CA, CERT, KEY, Role

STRANGER = """
import json, sys, zenoh
from pbonet.xm.net import key_expressions as keys, session
told = json.loads(sys.argv[1])
link, domain = zenoh.open(zenoh.Config.from_json5(told["config"])), told["domain"]
token = link.liveliness().declare_token(keys.rtpu(domain, "fake", "alive"))
asked = []
queryable = link.declare_queryable(keys.rtpu(domain, "fake", "sbs"), asked.append)
print("ready", flush=True)
for line in sys.stdin:
    steer = link.get(keys.rtpu(domain, "arm0", "sbs"), timeout=0.5)
    print(json.dumps({
        "names": session.rtpus(link, domain), "links": len(link.info.links()),
        "answers": len(list(steer)), "asked": len(asked),
    }), flush=True)
"""
"""A router that says nothing of its keys itself: it shows an agent, and asks others."""


SILENT = """
import select, socket, sys
where = sys.argv[1], int(sys.argv[2])
poll, there = select.poll(), {}
def connect():
    made = socket.create_connection(where)
    there[made.fileno()] = made
    poll.register(made, select.POLLIN)
for _ in range(500):
    connect()
print("ready", flush=True)
while True:
    for number, _ in poll.poll():
        poll.unregister(number)
        there.pop(number).close()  # the other side has closed it
        connect()
"""
"""Always 500 connections that say nothing."""


@pytest.fixture(scope="module")
def folders(lan, tmp_path_factory):
    """Key folders of two laboratories, by what is the matter with them."""
    made = {}
    for where in ("lab", "other"):
        authority = tmp_path_factory.mktemp(where)
        pki.make_authority(authority)

        def issue(role, name, where=where, authority=authority, **more):
            made[f"{where} {name}"] = pki.issue(authority, role, name, **more)

        for host, peers in (("a", "bc"), ("b", "ac"), ("c", "ab")):
            hosts = [lan[host].address(peer) for peer in peers]
            issue(Role.GATEWAY if host == "a" else Role.AGENT, host, hosts=hosts)
        issue(Role.OBSERVER, "observer")
        issue(Role.AGENT, "old", hosts=[lan["c"].address("a")], days=-0.01)
    return made


@pytest.fixture(scope="module")
def lab(lan, folders):
    """Hosts a and b, whose agents have keys of one authority."""
    made = Lab(lan, keys={host: folders[f"lab {host}"] for host in "abc"})
    try:
        made.start("arm0", "a")
        made.start("arm1", "b", connect=[made.endpoint("a", "b")])
        made.wait_all()
        yield made
    finally:
        lan.heal_all()
        made.close()


def test_a_table_and_a_link(lab, lan):
    assert lab.info("arm1", "a").dials == [f"tls/{lan['a'].address('b')}:{lab.port}"]
    cell = Desk(lab, "cell", ("arm0", "arm1"), host="a")
    cell.spawn("arm0", "src", "counts", out="Z0")
    cell.on("arm0", "src")
    common = {"name": "arm0:x", "dtype": "f8"}
    writer = lab.program("a", WRITER, home="arm0", period=0.001, **common)
    reader = lab.program("b", READER, home="arm1", **common)
    try:
        comes(cell)
        flows(reader)
        lan.mute("a", "b")
        wait_for(lambda: cell.value("arm1", "Z0").stale, "a stale variable")
        wait_for(lambda: reader.look()["age"] > 0.5, "an old record")
        assert writer.process.poll() is None
        lan.heal("a", "b")
        comes(cell)
        assert flows(reader)["restarts"] == 0
    finally:
        for program in (writer, reader):
            program.kill()
        cell.close()


def comes(cell):
    """Wait for news of src on the other machine."""
    before = cell.value("arm1", "Z0").cycle
    found = wait_for(
        lambda: (now := cell.value("arm1", "Z0")).cycle > before and now, "news"
    )
    assert found.writer == "src@host-a"


def test_silent_connections_keep_no_agent_out(lab, lan):
    """An agent comes meanwhile, and is stopped; decision 0249 says what fails here."""
    where = lan["a"].address("c"), str(lab.port)
    command = lan["c"].command(sys.executable, "-c", SILENT, *where)
    with subprocess.Popen(command, stdout=subprocess.PIPE, text=True) as silent:
        try:
            assert silent.stdout.readline() == "ready\n"
            lab.start("arm2", "c", connect=[lab.endpoint("a", "c")])
            lab.wait_seen("arm2", "a")
            cell = Desk(lab, "far", ("arm2",), host="a")
            cell.spawn("arm2", "src", "counts", out="Z0")
            cell.on("arm2", "src")
            stopped = cell.ask("arm2", m.Stop(), m.Stopped)
            assert stopped.off == ["src"]
            cell.close()
            assert silent.poll() is None
            lab.stop("arm2")
        finally:
            silent.kill()


@pytest.mark.parametrize(
    ("keys", "said"),
    [
        ("lab old", "the certificate has expired"),
        ("lab observer", "for another role (expected agent or gateway, got observer)"),
    ],
)
def test_an_agent_says_what_is_wrong_with_its_keys(lab, folders, keys, said):
    words = ("agent", "--name", "arm2", "--connect", lab.endpoint("a", "c"))
    got = lab.cli("c", *words, "--keys", str(folders[keys]))
    assert got.returncode == 1
    assert said in got.stderr
    assert str(folders[keys]) in got.stderr


def test_an_agent_of_another_authority_stays_alone(lab, folders):
    """It dials, and is dialled, and neither sees the other."""
    lab.keys["c"] = folders["other c"]
    try:
        both = [lab.endpoint("a", "c"), lab.endpoint("b", "c")]
        lab.start("arm2", "c", connect=both)
        refused(lab, "c", ["arm2"])
    finally:
        lab.stop("arm2")
        lab.keys["c"] = folders["lab c"]


def refused(lab, host, own):
    """Make sure that a host sees its own agents alone, and is not seen."""
    begin = time.monotonic()
    while time.monotonic() < begin + 1.0:  # it dials again and again
        assert set(lab.seen(host)) <= set(own)
        assert set(lab.seen("a")) <= {"arm0", "arm1"}
    wait_for(lambda: lab.seen(host) == own, "its own agents")


@pytest.mark.parametrize("keys", ["lab old", "lab observer", "other c"])
def test_a_router_whose_keys_are_no_agents(lab, folders, keys):
    """An observer's sees names, what it passes on is dropped; others get no link."""
    settings = router(lab.endpoint("a", "c"), folders[keys])
    stranger = lab.program("c", STRANGER, config=settings)
    try:
        if keys == "lab observer":
            wait_for(lambda: "arm1" in stranger.look()["names"], "its link")
        for _ in range(3):
            found = stranger.look()
            assert {*lab.seen("a"), *lab.seen("b")} <= {"arm0", "arm1"}
            assert found["answers"] == 0
            if keys != "lab observer":
                assert found["names"] == ["fake"]
                assert not found["links"]
        fake = names.rtpu(lab.domain, "fake", "sbs")
        assert not list(lab.session("a").get(fake, timeout=0.5))
        assert stranger.look()["asked"] == 0
    finally:
        stranger.kill()


def router(endpoint, folder):
    """Return zenoh's settings of a router that uses a key folder."""
    ca, cert, key = (str(folder / name) for name in (CA, CERT, KEY))
    return json.dumps({
        "mode": "router",
        "connect": {"endpoints": [endpoint], "exit_on_failure": False},
        "scouting": {"multicast": {"enabled": False}},
        "transport": {
            "shared_memory": {"enabled": False},
            "link": {
                "tls": {
                    "root_ca_certificate": ca,
                    "enable_mtls": True,
                    "connect_certificate": cert,
                    "connect_private_key": key,
                }
            },
        },
    })
