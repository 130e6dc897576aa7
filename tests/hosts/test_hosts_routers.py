"""Agents as clients of two routers: one is killed, both are, an agent between is.

The routers are on hosts b and c. Host a, from which commands come, has the RTPUs desk
and arm0, host b has arm1; all links between machines are mutual TLS.
"""

from __future__ import annotations

import subprocess

import pytest
from hostfleet import Desk
from hostkit import OWN_PORT, Lab
from watching import wait_for

from pbonet.xm.net import messages as m, pki
from pbonet.xm.net.credentials import Role

SEEN = ["arm0", "arm1", "desk"]


@pytest.fixture(scope="module")
def keys(lan, tmp_path_factory):
    """Key folders by holder."""
    authority = tmp_path_factory.mktemp("lab")
    pki.make_authority(authority)

    def issue(role, name, host=""):
        hosts = [lan[host].address(peer) for peer in "abc" if host and peer != host]
        return pki.issue(authority, role, name, hosts=hosts)

    return {
        "a": issue(Role.GATEWAY, "desk", "a"),
        "b": issue(Role.AGENT, "arm1", "b"),
        "router b": issue(Role.GATEWAY, "router-b", "b"),
        "router c": issue(Role.GATEWAY, "router-c", "c"),
        "anna": issue(Role.MASTER, "anna"),
        "screen": issue(Role.OBSERVER, "screen"),
    }


@pytest.fixture(scope="module")
def lab(lan, lease, keys):
    made = Lab(lan, OWN_PORT, keys=keys, lease_ms=lease)
    try:
        start_routers(made, keys)
        for name, host in (("desk", "a"), ("arm0", "a"), ("arm1", "b")):
            start_agent(made, name, host)
        made.wait_all()
        yield made
    finally:
        lan.heal_all()
        made.close()


def start_routers(lab, keys):
    """Start those that do not run; that on b connects to that on c."""
    for host in sorted({"b", "c"} - lab.routers.keys(), reverse=True):
        connect = [lab.endpoint("c", "b")] if host == "b" else []
        lab.start_router(host, connect=connect, keys=keys[f"router {host}"])


def start_agent(lab, name, host):
    lab.start(name, host, listen=(), routers=routers(lab, host))


def routers(lab, host):
    """Return the routers as an agent of a host names them: first that on c."""
    return [lab.endpoint("c", host), lab.endpoint("b", "a")]


@pytest.fixture
def cell(lab, lan, keys):
    """A subsystem of RTPUs on two machines: a task of arm0 is read on arm1.

    What a test has killed, and did not start again as it failed, is started first.
    """
    lan.heal_all()
    start_routers(lab, keys)
    if "desk" not in lab.agents:
        lab.forget_session("a")
        start_agent(lab, "desk", "a")
    wait_for(lambda: lab.seen("b") == SEEN == lab.seen("a"), "all of them")
    desk = Desk(lab, "cell", ("arm0", "arm1"), host="a")
    try:
        desk.spawn("arm0", "src", "counts", out="Z0")
        desk.spawn("arm1", "own", "counts", out="Y1")
        desk.on("arm0", "src")
        desk.on("arm1", "own")
        comes(desk)
        yield desk
    finally:
        desk.close()


def comes(cell):
    """Wait for news of src on b."""
    before = cell.value("arm1", "Z0").cycle
    wait_for(lambda: cell.value("arm1", "Z0").cycle > before, "news of src on b")


def tasks_run(cell):
    """Make sure that a command arrives, and that no task was turned off meanwhile."""
    cell.ask("arm1", m.Freq(task="own", hz=50.0))
    for rtpu, task in (("arm0", "src"), ("arm1", "own")):
        assert cell.status(rtpu, task).state == "ON"


def links(lan, host):
    """Return the number of connections from a host to routers."""
    port = f":{OWN_PORT:04X} 01 "  # of the other side, and established
    files = ("/proc/net/tcp", "/proc/net/tcp6")
    command = lan[host].command("cat", *files)
    shown = subprocess.run(command, capture_output=True, text=True, check=True)
    return sum(port in line for line in shown.stdout.splitlines())


def test_a_machine_has_one_link(lab, lan):
    assert lab.info("arm0").dials == routers(lab, "a")
    assert links(lan, "a") == 1


@pytest.mark.parametrize("host", ["c", "b"])
def test_a_router_is_killed_and_control_goes_on(lab, keys, cell, host):
    lab.kill_router(host)
    comes(cell)
    tasks_run(cell)
    wait_for(lambda: lab.seen("b") == SEEN == lab.seen("a"), "all of them")
    start_routers(lab, keys)
    comes(cell)
    tasks_run(cell)


def test_a_silent_router_is_replaced(lab, lan, cell):
    """Its cables transmit nothing, and everything considers them intact."""
    for peer in "ab":
        lan.mute("c", peer)
    comes(cell)
    tasks_run(cell)
    for peer in "ab":
        lan.heal("c", peer)
    wait_for(lambda: lab.seen("b") == SEEN == lab.seen("a"), "all of them")


def test_without_a_router_a_machine_sees_its_own(lab, keys, cell):
    """Nothing stops there; it is as a pulled cable for the others."""
    for host in "bc":
        lab.kill_router(host)
    wait_for(lambda: lab.seen("a") == ["arm0", "desk"], "the loss of b at a")
    wait_for(lambda: lab.seen("b") == ["arm1"], "the loss of a at b")
    assert cell.status("arm0", "src").state == "ON"
    lab.start("late", "a", listen=())  # joins those of its machine
    lab.stop("late")
    start_routers(lab, keys)
    wait_for(lambda: lab.seen("b") == SEEN == lab.seen("a"), "all of them")
    comes(cell)
    tasks_run(cell)


def test_the_agent_with_the_link_is_killed(lab, cell):
    """desk came first on its machine, so arm0 goes by it; and by itself afterwards."""
    lab.kill("desk")
    comes(cell)
    wait_for(lambda: lab.seen("b") == ["arm0", "arm1"], "arm0 at b")
    assert cell.status("arm0", "src").state == "ON"
    start_agent(lab, "desk", "a")
    lab.forget_session("a")
    wait_for(lambda: lab.seen("b") == SEEN == lab.seen("a"), "all of them")
    comes(cell)


def test_roles_are_judged_by_the_router(lab, keys, cell):
    """A robot and an observer look at others by it, and command none."""
    where = ("--connect", lab.endpoint("b", "c"))
    for holder in ("screen", "b", "anna"):
        own = (*where, "--keys", str(keys[holder]))
        shown = lab.cli("c", "fleet", *own)
        assert all(name in shown.stdout for name in SEEN), shown
        tasks_run(cell)
        stopped = lab.cli("c", "stop", *own)
        assert ("dropped on the way" in stopped.stderr) == (holder != "anna"), stopped
        assert bool(stopped.returncode) == (holder != "anna")
    assert not cell.look("arm1", m.Status(), m.RtpuStatus).tasks
