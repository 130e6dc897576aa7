"""A machine whose key is stolen: what it may still do, and how it is shut out.

Host a is the computer from which the robots on b and c are commanded: its agent has the
keys of a gateway, theirs those of agents. All are linked with each other.
"""

from __future__ import annotations

import contextlib
import shutil
import signal
import subprocess
import sys

import msgspec
import pytest
from hostfleet import Desk
from hostkit import OWN_PORT, Lab
from tbuf_rig import READER, WRITER, flows
from test_hosts_keys import router
from watching import wait_for

from pbonet.errors import AccessError, PbonetError
from pbonet.xm.net import key_expressions, messages as m, pki, resource_messages as r
from pbonet.xm.net.credentials import CA, FILES, Role
from pbonet.xm.net.rpc import Client

HOSTS = {"a": "desk", "b": "arm1", "c": "arm2"}
RTPU = "RTPU {}\nSCHEDULER MUF\nUSAGE exclusive\nMINFREQ 1\nMAXFREQ 1000\n"
SBS = f"""
SUBSYSTEM two
SVARFILE two.svar
MASTER arm1
{RTPU.format("arm1")}
{RTPU.format("arm2")}
EOF
"""
STOLEN = """
import json, sys, msgspec, zenoh
told = json.loads(sys.argv[1])
link = zenoh.open(zenoh.Config.from_json5(told["config"]))
print("ready", flush=True)
for line in sys.stdin:
    found = {}
    for key in told["keys"]:
        replies = list(link.get(
            key, payload=bytes.fromhex(told["payload"]),
            target=zenoh.QueryTarget.ALL, timeout=1.0,
        ))
        found[key] = [
            msgspec.msgpack.decode(one.ok.payload.to_bytes())
            for one in replies if one.ok
        ]
    print(json.dumps(found), flush=True)
"""
"""A router with a stolen key, which sends one request on several keys."""


@pytest.fixture
def lab(lan, tmp_path):
    """The three hosts, and the authority of their keys."""
    authority = tmp_path / "lab"
    pki.make_authority(authority)
    keys = {}
    for host in HOSTS:
        role = Role.GATEWAY if host == "a" else Role.AGENT
        hosts = [lan[host].address(peer) for peer in "abc" if peer != host]
        keys[host] = pki.issue(authority, role, host, hosts=hosts)
    made = Lab(lan, OWN_PORT, keys=keys)
    made.authority = authority
    try:
        made.start("desk", "a", wait=False)
        made.start("arm1", "b", connect=[made.endpoint("a", "b")], wait=False)
        both = [made.endpoint("a", "c"), made.endpoint("b", "c")]
        made.start("arm2", "c", connect=both, wait=False)
        made.wait_all()
        yield made
    finally:
        lan.heal_all()
        made.close()


@pytest.fixture
def cell(lab):
    """A subsystem of both robots, commanded from a: a task of b, read on c."""
    desk = Desk(lab, "cell", ("arm1", "arm2"), host="a")
    try:
        desk.spawn("arm1", "src", "counts", out="Z0")
        desk.spawn("arm2", "own", "counts", out="Y1")
        desk.on("arm1", "src")
        desk.on("arm2", "own")
        yield desk
    finally:
        desk.close()


def comes(cell):
    """Wait for news of src on c."""
    before = cell.value("arm2", "Z0").cycle
    wait_for(lambda: cell.value("arm2", "Z0").cycle > before, "news of src on c")


def test_robots_take_part_in_all_that_is_no_command(lab, cell):
    comes(cell)
    common = {"name": "arm1:x", "dtype": "f8"}
    writer = lab.program("b", WRITER, home="arm1", period=0.001, **common)
    reader = lab.program("c", READER, home="arm2", **common)
    try:
        flows(reader)
    finally:
        writer.kill()
        reader.kill()
    asks = lab.client("b")  # as an agent asks for its tasks
    token = asks.announce(key_expressions.customer(lab.domain, asks.name))
    made = r.Attach(name="grip", kind="sem", create={"initial": 1})
    grip = asks.call("arm2", made, r.Attached)
    took = asks.call("arm2", r.Take(handle=grip.handle, take="t"), r.Took)
    assert took.code == 1
    asks.call("arm2", r.Detach(handle=grip.handle, destroy=True), type(None))
    token.undeclare()
    wait_for(
        lambda: (
            {
                way.rtpu: way.error
                for way in asks.call("arm1", m.Links(), m.LinkReport).ways
            }
            == {"desk": "", "arm2": ""}
        ),
        "that both answer in time",
    )


def commands(cell):
    """Return a request of each kind that a thief would make of arm2."""
    mine = {"subsystem": "cell", "epoch": cell.epochs["arm2"]}
    return [
        m.Control(task="own", signal="off", **mine),
        m.Stop(subsystem="cell", stop_id="x"),
        m.Spawn(task="evil", rmod="", rmod_name="evil.rmod", **mine),
        m.Set(task="own", name="x", value="1", **mine),
        m.Write(name="Y1", values=[1.0, 1.0], **mine),
        m.Claim(subsystem="cell", take_over=True),
    ]


def test_a_robots_machine_commands_no_other(lab, cell):
    """It reads of it, and is read and commanded itself."""
    thief = Client(lab.session("b"), lab.domain, cell.name)
    for request in commands(cell):
        with pytest.raises(AccessError, match="dropped on the way") as caught:
            thief.call("arm2", request, object)
        assert "with the keys of a gateway" in caught.value.remedy
    ended = lab.cli("b", "stop")
    assert ended.returncode == 1
    assert "arm2: the agent is there, but your request was dropped" in ended.stderr
    status = thief.call("arm2", m.Status(subsystem="cell"), m.RtpuStatus)
    assert [(one.task, one.state) for one in status.tasks] == [("own", "ON")]
    assert cell.events("arm2", "TAKEN_OVER") == []
    cell.off("arm2", "own")  # the master's command goes through


def test_no_key_expression_leads_past_it(lab, cell):
    """A router with the key of b, linked with c: a stop, by whichever key it may go."""
    base = f"pbonet/{lab.domain}/rtpu"
    keys = [f"{base}/arm2/sbs", f"{base}/arm2/*", f"{base}/*/sbs", f"{base}/arm2/$*s"]
    keys += [f"{base}/*/*", "pbonet/**", "**"]
    keys += [f"{base}/arm2/status", f"{base}/arm2/mail"]
    stop = msgspec.msgpack.encode(m.Stop(id="1", client="thief", stop_id="x"))
    settings = router(lab.endpoint("c", "b"), lab.keys["b"])
    thief = lab.program("b", STOLEN, config=settings, keys=keys, payload=stop.hex())
    try:
        found = wait_for(
            lambda: (now := thief.look())[f"{base}/arm2/mail"] and now, "its link"
        )
    finally:
        thief.kill()
    refused = [f"{base}/arm2/status", f"{base}/arm2/mail"]
    for key, answers in found.items():
        codes = [answer["error"]["code"] for answer in answers]
        assert codes == (["ACCESS"] if key in refused else []), key
    assert cell.status("arm2", "own").state == "ON"


def test_a_stop_is_repeated_by_the_gateway(lab, cell, lan):
    """Though none of its RTPUs has the subsystem; the other robot may not do so."""
    lab.client("a").call("desk", m.Links(), m.LinkReport)  # all have greeted each other
    lan.cut("a", "c")
    lan.cut("b", "c")
    wait_for(lambda: "arm2" not in lab.seen("a"), "the loss of arm2")
    ended = lab.cli("a", "stop", "cell")
    assert ended.returncode == 1
    assert "may still be ON: arm2: own" in ended.stderr
    assert cell.status("arm2", "own").state == "ON"
    lan.heal("b", "c")
    wait_for(lambda: "arm1" in lab.seen("c"), "the way between the robots")
    lan.heal("a", "c")
    wait_for(
        lambda: not cell.look("arm2", m.Status(), m.RtpuStatus).tasks,
        "the end of the task of arm2",
    )
    late = "has reached arm2 only now: own turned off"
    wait_for(lambda: late in str(cell.events("desk", "STOPPED")), "the report")
    assert late not in str(cell.events("arm1", "STOPPED"))


def test_a_revoked_key_opens_nothing_and_the_others_go_on(lab, cell):
    """Behind SIGHUP of the others: links that stand are cut, and no new one is made."""
    before = cell.status("arm1", "src")
    comes(cell)
    wait_for(lambda: lab.seen("c") == ["arm1", "arm2", "desk"], "all of them")
    theirs = (lab.keys["c"] / CA).read_bytes()
    written = pki.revoke(lab.authority, "c")
    assert lab.keys["b"] / CA in written
    (lab.keys["c"] / CA).write_bytes(theirs)  # it is stolen, and keeps the old one
    all_of_them = "all of them, as until then nothing changes"
    wait_for(lambda: lab.seen("c") == ["arm1", "arm2", "desk"], all_of_them)
    zids = {name: lab.info(name).zid for name in ("desk", "arm1")}
    for name in zids:
        host, process = lab.agents[name]
        process.send_signal(signal.SIGHUP)
        wait_for(lambda n=name, h=host: anew(lab, n, h) not in {None, zids[n]}, name)
    wait_for(lambda: lab.seen("a") == ["arm1", "desk"], "the robots without c")
    wait_for(lambda: lab.seen("b") == ["arm1", "desk"], "the robots without c")
    wait_for(lambda: lab.seen("c") == ["arm2"], "c alone")
    after = cell.status("arm1", "src")
    assert (after.state, after.tid) == ("ON", before.tid)
    assert after.cycle > before.cycle
    cell.off("arm1", "src")  # a commands as before
    for host in "ab":
        settings = router(lab.endpoint(host, "c"), lab.keys["c"])
        keys = [f"pbonet/{lab.domain}/rtpu/{HOSTS[host]}/status"]
        hello = msgspec.msgpack.encode(m.Hello(id="1")).hex()
        thief = lab.program("c", STOLEN, config=settings, keys=keys, payload=hello)
        try:
            assert [thief.look() for _ in range(2)] == [{keys[0]: []}] * 2
        finally:
            thief.kill()
    refused = "it refuses the certificate of these keys"
    wait_for(lambda: refused in str(told(lab)), "that c says so")
    hosts = pki.read(lab.keys["c"]).hosts
    again = lab.authority / "c-new"
    pki.issue(lab.authority, Role.AGENT, "c", hosts=hosts, folder=again)
    for name in FILES:
        shutil.copy(again / name, lab.keys["c"] / name)
    lab.agents["arm2"][1].send_signal(signal.SIGHUP)
    lab.wait_all()


PROGRAM = """
import sys
from pbonet import Subsystem
with Subsystem(sys.argv[1], domain=sys.argv[2]) as cell:
    cell.stop()
"""


def test_a_programs_stop_is_also_given_to_the_gateway(lab, tmp_path):
    (tmp_path / "two.sbs").write_text(SBS)
    (tmp_path / "two.svar").write_text(
        "NAME Y\nTYPE double\nDESC d\nUNITS none\nNELEM 1\nEOF\n"
    )
    words = sys.executable, "-c", PROGRAM, str(tmp_path / "two.sbs"), lab.domain
    subprocess.run(
        lab.lan["a"].command(*words), env=lab.environment("a"), check=True, cwd=tmp_path
    )
    orders = [lab.info(name).stops for name in ("desk", "arm1", "arm2")]
    assert orders[0]
    assert orders[0] == orders[1] == orders[2]


def anew(lab, name, host):
    """Return the identity of an agent's session, once it answers."""
    with contextlib.suppress(PbonetError):
        return lab.info(name, host).zid
    lab.forget_session(host)
    return None


def told(lab):
    """Return what the agent of c tells of keys."""
    found = lab.client("c").call("arm2", m.Events(), list[m.Event])
    return [event.text for event in found if event.code == "KEYS_REFUSED"]
