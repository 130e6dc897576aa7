"""Agents reach each other: by a third, over a cut and its healing, in domains."""

from __future__ import annotations

import signal

import pytest
from hostkit import PORT
from nodekit import AGENT, alive
from watching import wait_for

import pbonet
from pbonet.errors import PbonetError, ProtocolError, UnreachableError
from pbonet.versions import LAYERS, Range
from pbonet.xm.net import dialling, messages as m, session
from pbonet.xm.net.rpc import Client


@pytest.fixture(scope="module", autouse=True)
def chain(lab):
    """arm0 on a, arm1 on b, arm2 on c; a and c cannot dial each other."""
    lab.chain()


@pytest.fixture(autouse=True)
def healed(lan):
    """The cable that a test has cut, and did not heal as it failed."""
    yield
    lan.heal("b", "c")


def report(lab, name):
    return lab.client("a").call(name, m.Links(), m.LinkReport)


def test_one_agent_reaches_all(lab):
    every = ["arm0", "arm1", "arm2"]
    wait_for(lambda: lab.seen("a") == lab.seen("c") == every, "all of them")
    hosts = [lab.info(name, "a").host for name in ("arm0", "arm1", "arm2")]
    assert hosts == ["host-a", "host-b", "host-c"]


def test_the_ways_are_measured(lab):
    def measured():
        ways = {way.rtpu: way for way in report(lab, "arm0").ways}
        return not any(way.error for way in ways.values()) and ways

    ways = wait_for(measured, "that all answer in time")
    assert set(ways) == {"arm1", "arm2"}
    assert (ways["arm1"].hops, ways["arm2"].hops) == (1, 2)
    assert ways["arm1"].trip > 0
    assert ways["arm1"].spread == ways["arm1"].trip / 2
    assert abs(ways["arm2"].offset) <= ways["arm2"].spread


def test_a_cut_and_its_healing(lab, lan):
    """Errors and doctor name the machines that don't see each other any more."""
    for one, other in (("arm1", "arm2"), ("arm2", "arm1")):
        wait_for(lambda o=one, p=other: near(lab, o, p), f"the ways from {one}")
    lan.cut("b", "c")
    wait_for(lambda: lab.seen("a") == ["arm0", "arm1"], "the loss of arm2 at a")
    wait_for(lambda: lab.seen("c") == ["arm2"], "the loss of the others at c")
    wait_for(lambda: lab.info("arm1").lost, "the news of it at b")
    wait_for(lambda: len(lab.info("arm2").lost) > 1, "the news of it at c")
    once = Client(lab.session("a"), lab.domain, "once")
    with pytest.raises(UnreachableError) as caught:
        once.call("arm2", m.Hello(), m.AgentInfo)
    text = str(caught.value)
    assert "arm1 of host-b has not seen arm2 of host-c for " in text
    assert "check the network between host-b and host-c" in text
    assert "pbonet agent --name" not in text
    lost = "WARN arm2 of host-c has not seen arm1 of host-b for "
    (line,) = [one for one in doctor(lab, "c") if one.startswith(lost)]
    assert "s, to which it had a link, and with it arm0 of host-a; check " in line
    lan.heal("b", "c")
    lab.wait_reached("arm2", "a")
    lab.wait_reached("arm0", "c")
    wait_for(lambda: not any(lab.info(f"arm{n}").lost for n in range(3)), "no loss")


def near(lab, name, other):
    """Tell whether an agent has found the link of its own to another one."""
    host = lab.agents[name][0]
    got = lab.client(host).call(name, m.Links(), m.LinkReport)
    return [way.hops for way in got.ways if way.rtpu == other] == [1]


def doctor(lab, host):
    return lab.cli(host, "doctor").stdout.splitlines()


def test_an_agent_that_was_stopped_is_seen_again(lab):
    """Also where zenoh's routers tell its neighbours nothing (decision 0194)."""
    wait_for(lambda: near(lab, "arm0", "arm1"), "the measured ways")
    process = lab.agents["arm1"][1]
    process.send_signal(signal.SIGSTOP)
    try:
        wait_for(lambda: lab.seen("a") == ["arm0"], "the loss of the others at a")
        wait_for(lambda: lab.seen("c") == ["arm2"], "the loss of the others at c")
    finally:
        process.send_signal(signal.SIGCONT)
    for host in "ac":
        for name in ("arm0", "arm1", "arm2"):
            lab.wait_seen(name, host)
            lab.wait_reached(name, host)
    wait_for(
        lambda: not any(line.startswith("FAIL") for line in doctor(lab, "a")), "all"
    )


def test_a_second_way_is_taken_when_the_first_is_cut(lab, lan):
    """arm2 dials a as well when it is started anew; then the cable b - c is pulled."""
    lab.stop("arm2")
    lan.heal("a", "c")
    both = [lab.endpoint("b", "c"), lab.endpoint("a", "c")]
    lab.start("arm2", "c", connect=both)
    lab.wait_reached("arm2", "a")
    lan.cut("b", "c")
    wait_for(lambda: lab.seen("b") == ["arm0", "arm1", "arm2"], "arm2 by way of a")
    assert lab.wait_reached("arm2", "b").host == "host-c"
    lan.heal("b", "c")
    lan.cut("a", "c")
    assert lab.wait_reached("arm2", "a").host == "host-c"


def test_agents_that_dial_each_other_have_one_link(own_lab):
    """Started at once, both dial; one takes it back, or zenoh's routers stall."""
    own_lab.start("x", "a", connect=[own_lab.endpoint("b", "a")], wait=False)
    own_lab.start("y", "b", connect=[own_lab.endpoint("a", "b")], wait=False)
    own_lab.wait_all()
    own_lab.wait_reached("x", "b")
    for name in ("x", "y"):
        got = own_lab.client("a").call(name, m.Links(), m.LinkReport)
        assert not got.double
        assert [way.hops for way in got.ways] == [1]


def test_who_comes_later_does_not_dial_back(own_lab):
    own_lab.start("x", "a", connect=[own_lab.endpoint("b", "a")])
    own_lab.start("y", "b", connect=[own_lab.endpoint("a", "b")])
    own_lab.wait_reached("x", "b")
    assert own_lab.info("x", "a").dials == [own_lab.endpoint("b", "a")]
    assert own_lab.info("y", "b").dials == []


def test_ipv6(own_lab):
    own_lab.start("x", "a")
    own_lab.start("y", "b", connect=[own_lab.endpoint("a", "b", six=True)])
    assert own_lab.wait_reached("x", "b").host == "host-a"


def test_domains_are_apart(lab, own_lab):
    """Another laboratory's agent dials into this one, and neither sees the other."""
    own_lab.start("arm0", "b", listen=[], connect=[lab.endpoint("a", "b")])
    assert own_lab.seen("b") == ["arm0"]
    wait_for(lambda: lab.seen("a") == ["arm0", "arm1", "arm2"], "all of them")
    assert lab.info("arm0", "a").host == "host-a"


def test_multicast_finds_the_domain(own_lab):
    """Nobody is named; agents that ask for it find each other, others are not found."""
    own_lab.start("x", "a", multicast=True)
    own_lab.start("y", "b", multicast=True)
    own_lab.start("z", "c")
    own_lab.wait_reached("x", "b")
    assert own_lab.seen("c") == ["z"]
    wait_for(lambda: own_lab.seen("b") == ["x", "y"], "both")


def test_a_second_agent_of_a_name_is_refused(lab):
    """The name is looked for in the whole domain, also behind other agents."""
    words = ("--listen", f"tcp/[::]:{PORT + 1}", "--insecure", "--name", "arm0")
    got = lab.cli("c", "agent", *words, "--connect", lab.endpoint("b", "c"))
    assert got.returncode == 1
    assert f"domain {lab.domain} has an agent arm0 already" in got.stderr
    assert "choose another name, or stop that agent" in got.stderr


def test_two_agents_of_a_name_that_meet_are_reported(own_lab, lan):
    """A link comes up between two that control something already."""
    lan.cut("a", "b")
    process = own_lab.start("x", "a", connect=[own_lab.endpoint("b", "a")])
    own_lab.agents.pop("x")
    try:
        own_lab.start("x", "b")
        lan.heal("a", "b")
        event = wait_for(lambda: _events(own_lab, "DUPLICATE_NAME"), "the report")[0]
        assert "another agent x runs on host-" in event.text
    finally:
        process.terminate()
        process.wait(20.0)


def _events(lab, code):
    try:
        got = lab.client("b").call("x", m.Events(), list[m.Event])
    except PbonetError:
        return []
    return [event for event in got if event.code == code]


def test_an_old_version_is_told(lab, monkeypatch):
    """Both numbers, and what to do."""
    monkeypatch.setitem(LAYERS, "commands", Range(0, 0))
    with pytest.raises(ProtocolError) as caught:
        lab.client("c").call("arm0", m.Status(), m.RtpuStatus)
    text = str(caught.value)
    assert "another protocol version" in text
    assert caught.value.where == "arm0"
    assert "version 1" in text
    assert "version 0" in text
    assert "run the same pbonet version on every machine" in text


TELLS = """from types import SimpleNamespace as Namespace
from pbonet.node.agent import agent"""


def test_doctor_tells_agents_of_other_versions(lab):
    """One of an older release, and one that speaks another protocol."""
    older = f"{TELLS}\nagent.pbonet = Namespace(__version__='0.0.1')\n{AGENT}"
    newer = f"""from pbonet.versions import LAYERS, Range
LAYERS["commands"] = Range(2, 2)
{AGENT}"""
    for name, code in (("older", older), ("newer", newer)):
        lab.start(name, "b", listen=(), wait=False, code=code)
    try:
        lab.wait_all()
        got = lab.cli("a", "doctor")
    finally:
        for name in ("older", "newer"):
            lab.stop(name)
    lines = got.stdout.splitlines()
    (old,) = [line for line in lines if "older runs pbonet 0.0.1" in line]
    said = "FAIL no common version of commands: this program, "
    (new,) = [line for line in lines if line.startswith(said)]
    assert old.startswith("WARN")
    assert f"this is {pbonet.__version__}" in old
    assert "version 1; newer of host-b version 2; between them only hello" in new
    for line in (old, new):
        assert "run the same" in line


def test_nothing_beyond_the_machine_without_being_told(own_lab):
    got = own_lab.cli("a", "agent", "--name", "x", "--listen", f"tcp/[::]:{PORT}")
    assert got.returncode == 1
    assert "listening beyond this machine is not protected" in got.stderr


def test_a_master_by_an_endpoint(lab):
    """A tool on host c, by the endpoint of the agent on b, sees host a's."""
    got = lab.cli("c", "doctor", "--connect", lab.endpoint("b", "c"))
    for pair in ("arm0 - arm1", "arm0 - arm2", "arm1 - arm2"):
        assert f"{pair}: " in got.stdout
    assert "clocks " in got.stdout


def test_is_mine_knows_the_machines_addresses():
    assert dialling.is_mine("tcp/127.0.0.1:7447", ["tcp/[::]:7447"])
    assert dialling.is_mine("tcp/localhost:7447", ["tcp/0.0.0.0:7447"])
    assert not dialling.is_mine("tcp/127.0.0.1:7448", ["tcp/[::]:7447"])
    assert not dialling.is_mine("tcp/192.0.2.1:7447", ["tcp/[::]:7447"])
    assert not dialling.is_mine("udp/127.0.0.1:7447", ["tcp/[::]:7447"])


def test_a_dead_endpoint_is_no_fault(own_lab):
    """An agent starts while what it is to be linked to is not there."""
    dead = "tcp/10.77.1.2:9"
    process = own_lab.start("x", "a", connect=[dead])
    assert own_lab.info("x").dials == [dead]
    assert alive(process.pid)
    assert session.rtpus(own_lab.session("a"), own_lab.domain) == ["x"]
