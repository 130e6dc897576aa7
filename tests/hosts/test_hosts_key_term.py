"""Certificates whose time is over while links stand, and others in their place."""

from __future__ import annotations

import contextlib
import shutil
import signal

import pytest
from hostfleet import Desk
from hostkit import OWN_PORT, PORT, Lab
from watching import wait_for

from pbonet.errors import PbonetError
from pbonet.xm.net import messages as m, pki
from pbonet.xm.net.credentials import FILES, Role

GRACE = 30.0
"""An agent that starts again may end its links slowly; its tasks wait for it."""

SHORT = 30.0 / 86400
"""Days of a certificate that runs out in a test: some seconds behind the start."""


class Keys:
    """A laboratory whose keys are made anew."""

    def __init__(self, lan, folder):
        self.lan = lan
        self.folder = folder
        self.found("lab")

    def found(self, name):
        """Make the authority of all keys from now on."""
        self.authority = self.folder / name
        pki.make_authority(self.authority)

    def agent(self, host, into, **more):
        """Make the keys of a host's agent, and put them into a folder."""
        hosts = [self.lan[host].address(peer) for peer in "abc" if peer != host]
        made = pki.issue(self.authority, Role.GATEWAY, host, hosts=hosts, **more)
        into.mkdir(mode=0o700, exist_ok=True)
        for name in FILES:
            shutil.copy(made / name, into / name)
        shutil.rmtree(made)


@pytest.fixture
def keys(lan, tmp_path):
    return Keys(lan, tmp_path)


@pytest.fixture
def labs(lan, tmp_path):
    """Two laboratories on the same hosts, each with key folders of its own."""
    with contextlib.ExitStack() as after:
        made = []
        for port in (PORT, OWN_PORT):
            folders = tmp_path / str(port)
            folders.mkdir()
            made.append(Lab(lan, port, keys={host: folders / host for host in "abc"}))
            after.callback(made[-1].close)
        after.callback(lan.heal_all)
        yield made


@pytest.fixture
def lab(labs):
    return labs[0]


def comes(cell):
    """Wait for news of src on the other machine."""
    before = cell.value("arm1", "Z0").cycle
    wait_for(lambda: cell.value("arm1", "Z0").cycle > before, "news of src")


def told(lab, name, code="KEYS_EXPIRE"):
    """Return what an agent has told of its keys, asked on its own machine."""
    host = lab.agents[name][0]
    found = lab.client(host).call(name, m.Events(), list[m.Event])
    return [event.text for event in found if event.code == code]


WHOSE = {"a": "arm0", "b": "arm1"}


def test_keys_that_run_out_are_a_pulled_cable_until_others_are_there(labs, keys):
    """Whichever side's they are: the other hears no more, tasks go on, and it heals."""
    sides = list(zip(labs, WHOSE, strict=True))
    cells = [begin(lab, keys, short) for lab, short in sides]
    for cell, (_, short) in zip(cells, sides, strict=True):
        runs_out(cell, WHOSE[short])
    for cell, (_, short) in zip(cells, sides, strict=True):
        goes_on(cell, keys, short)
        cell.close()


def begin(lab, keys, short):
    """Start two agents, one of them with keys for a short time, and a task."""
    for host in "ab":
        more = {"days": SHORT} if host == short else {}
        keys.agent(host, lab.keys[host], **more)
    lab.start("arm0", "a", grace=GRACE)
    lab.start("arm1", "b", connect=[lab.endpoint("a", "b")], grace=GRACE)
    lab.wait_all()
    cell = Desk(lab, "cell", ("arm0", "arm1"), host="b")
    cell.spawn("arm0", "src", "counts", out="Z0")
    cell.on("arm0", "src")
    comes(cell)
    return cell


def runs_out(cell, whose):
    """Wait until an agent's keys have expired, as it had said they would."""
    lab = cell.lab
    assert "the keys expire in " in told(lab, whose)[0]
    wait_for(lambda: "host-a is unreachable" in cell.illegal("arm1"), "flag")
    over = wait_for(lambda: told(lab, whose)[1:], "what is wrong")[0]
    assert "the keys have expired: no other machine can be reached" in over
    assert f"restart the agent with `kill -HUP {lab.info(whose).pid}`" in over
    for host, own in (("a", "arm0"), ("b", "arm1")):
        wait_for(lambda h=host, n=own: lab.seen(h) == [n], f"{own} alone on {host}")


def goes_on(cell, keys, short):
    """Give an agent other keys: it restarts, and its task has gone on meanwhile."""
    lab = cell.lab
    before = cell.status("arm0", "src")
    assert before.state == "ON"
    keys.agent(short, lab.keys[short])
    lab.agents[WHOSE[short]][1].send_signal(signal.SIGHUP)
    lab.wait_all()
    comes(cell)
    after = cell.status("arm0", "src")
    assert (after.state, after.tid) == ("ON", before.tid)
    assert after.cycle > before.cycle
    wait_for(lambda: not cell.illegal("arm1"), "no flag")


def test_keys_that_are_no_good_are_not_taken(lab, keys):
    """An agent that is to start anew looks at them first, and stays what it is."""
    keys.agent("a", lab.keys["a"])
    process = lab.start("arm0", "a")
    before = lab.info("arm0").zid
    kept = {name: (lab.keys["a"] / name).read_bytes() for name in FILES}
    keys.agent("a", lab.keys["a"], days=-0.01)
    process.send_signal(signal.SIGHUP)
    (text,) = wait_for(lambda: told(lab, "arm0", "NOT_RESTARTED"), "the refusal")
    assert "the certificate has expired" in text
    assert lab.info("arm0").zid == before
    for name, data in kept.items():
        (lab.keys["a"] / name).write_bytes(data)
    process.send_signal(signal.SIGHUP)
    wait_for(lambda: is_another(lab, before), "another session")
    assert process.poll() is None


def test_another_authority_in_place_of_the_old(lab, keys):
    """Who has keys of the old one gets no link, and is told what to do, until then."""
    for host in "ab":
        keys.agent(host, lab.keys[host])
    old = pki.issue(keys.authority, Role.MASTER, "anna")
    lab.start("arm0", "a", grace=GRACE)
    lab.start("arm1", "b", connect=[lab.endpoint("a", "b")], grace=GRACE)
    lab.wait_all()
    keys.found("new")
    before = lab.info("arm0").zid
    keys.agent("a", lab.keys["a"])
    lab.agents["arm0"][1].send_signal(signal.SIGHUP)
    wait_for(lambda: is_another(lab, before), "another session")
    (text,) = wait_for(lambda: told(lab, "arm1", "KEYS_REFUSED"), "what is wrong")
    where, why = lab.endpoint("a", "b"), "was not signed by the authority of these keys"
    assert text.startswith(f"no link to {where}: its certificate {why}; ")
    assert f"kill -HUP {lab.info('arm1').pid}" in text
    for host, own in (("a", "arm0"), ("b", "arm1")):
        wait_for(lambda h=host, n=own: lab.seen(h) == [n], f"{own} alone on {host}")
    there = lab.endpoint("a", "c")
    asked = lab.cli("c", "doctor", "--connect", there, "--keys", str(old))
    assert asked.returncode == 1
    assert f"FAIL {there}: no agent of domain " in asked.stdout
    assert "Were both sides' keys made by one authority" in asked.stdout
    keys.agent("b", lab.keys["b"])
    lab.agents["arm1"][1].send_signal(signal.SIGHUP)
    lab.wait_all()


def is_another(lab, before):
    """Tell whether arm0 has been started anew."""
    lab.forget_session("a")
    with contextlib.suppress(PbonetError):
        return lab.info("arm0").zid != before
    return False
