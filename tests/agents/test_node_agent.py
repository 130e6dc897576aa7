"""The agent as masters see it: claims, names, requests good and bad, events."""

import contextlib
import os
import signal
import socket
import sys
from pathlib import Path

import msgpack
import msgspec
import pytest
from long_limits import LIMIT
from nodekit import CORE, Master, rmod, svar
from watching import free_port, wait_for

from pbonet.errors import (
    ClaimError,
    ConfigError,
    DuplicateNameError,
    ModuleLoadError,
    NodeError,
    ParameterError,
    RealTimeError,
    Severity,
    StateError,
    SvarError,
    SvarLayoutError,
    SvarMissingError,
    SvarOwnerError,
    UnknownTaskError,
    UnknownVariableError,
)
from pbonet.node.agent.agent import Agent
from pbonet.xm.net import (
    codec,
    dialling,
    key_expressions,
    messages as m,
    rpc,
    run_folder,
    session,
)


def raw(nodes, rtpu, payload):
    """Send bytes and return the one answer, decoded by msgpack alone."""
    replies = list(
        nodes.session.get(
            key_expressions.rtpu(nodes.domain, rtpu, "sbs"),
            payload=payload,
            timeout=30.0,
        )
    )
    assert len(replies) == 1
    assert str(replies[0].ok.key_expr) == key_expressions.rtpu(
        nodes.domain, rtpu, "sbs"
    )
    return msgpack.unpackb(replies[0].ok.payload.to_bytes())


def test_hello_says_who_and_where(nodes):
    nodes.agent("arm0")
    info = nodes.client().call("arm0", m.Hello(), m.AgentInfo)
    assert (info.name, info.domain, info.core) == ("arm0", nodes.domain, CORE)
    assert info.pid == os.getpid() != info.rtpu_pid
    assert info.machine == run_folder.machine()
    assert info.backend in {"fifo", "park"}
    assert info.python == sys.version.split()[0]
    assert info.claims == {}
    assert info.here == ["arm0"]


def test_an_agent_says_which_rtpus_live_beside_it(nodes):
    """One whose agent alone was killed lives on for its grace."""
    nodes.agent("arm0")
    victim = nodes.agent_process("arm1")
    client = nodes.client()

    def here():
        return client.call("arm0", m.Hello(), m.AgentInfo).here

    wait_for(lambda: here() == ["arm0", "arm1"], "both")
    pid = nodes.state("arm1").pid
    victim.kill()
    victim.wait()
    assert here() == ["arm0", "arm1"]
    os.kill(pid, signal.SIGKILL)
    wait_for(lambda: here() == ["arm0"], "the end of arm1")
    nodes.agent_process("arm1")  # it cleans up


def test_no_zenoh_in_the_processes_that_control(nodes):
    nodes.agent("arm0")
    master = nodes.master("arm0", "arm")
    task = master.spawn("a", "counts").tid
    for pid in (nodes.state("arm0").pid, nodes.fork_server("arm0"), task):
        assert "zenoh" not in Path(f"/proc/{pid}/maps").read_text()


def test_no_shared_memory_of_zenoh(nodes):
    """Its transport over shared memory would leave files behind a kill."""
    agent = nodes.agent_process("arm0").pid
    assert nodes.session
    for pid in (agent, os.getpid()):
        assert ".zenoh" not in Path(f"/proc/{pid}/maps").read_text()


# -- names ---


def test_second_agent_of_one_name_on_the_machine_is_refused(nodes):
    nodes.agent("arm0")
    with pytest.raises(DuplicateNameError) as caught:
        Agent(nodes.config("arm0")).start()
    assert f"agent arm0, process {os.getpid()}" in str(caught.value)
    assert nodes.client().call("arm0", m.Hello(), m.AgentInfo).name == "arm0"


def test_an_rtpu_process_keeps_its_agent_though_that_one_s_lock_was_removed(nodes):
    first = nodes.agent_process("arm0")
    run_folder.Places(nodes.domain, "arm0").lock.unlink()
    with pytest.raises(DuplicateNameError, match=f"with `kill {first.pid}`"):
        Agent(nodes.config("arm0")).start()
    assert nodes.client().call("arm0", m.Hello(), m.AgentInfo).pid == first.pid
    nodes.forget_session()
    first.terminate()
    assert first.wait(LIMIT) == 0


def test_second_agent_of_one_name_elsewhere_is_refused(nodes, monkeypatch):
    """Another runtime folder stands for another machine: only a token tells."""
    there = f"tcp/127.0.0.1:{free_port()}"
    nodes.agent("arm0", listen=(there,))
    other = nodes.folder / "other"
    other.mkdir(mode=0o700)
    monkeypatch.setenv("PBONET_RUN_DIR", str(other))
    monkeypatch.setattr(dialling, "ASK_TIME", LIMIT)
    monkeypatch.setattr(dialling, "LINK_TIME", LIMIT)
    twin = Agent(nodes.config("arm0", connect=(there,)))
    with pytest.raises(DuplicateNameError, match="has an agent arm0 already"):
        twin.start()
    monkeypatch.setenv("PBONET_RUN_DIR", str(nodes.folder))


def test_namesakes_that_meet_later_say_so(nodes, monkeypatch):
    """A hub that comes up last joins two machines, each with an arm0."""
    first, hub = (f"tcp/127.0.0.1:{free_port()}" for _ in range(2))
    nodes.agent("arm0", listen=(first,))
    other = nodes.folder / "other"
    other.mkdir(mode=0o700)
    monkeypatch.setenv("PBONET_RUN_DIR", str(other))
    twin = nodes.agent_process("arm0", wait=False, connect=(hub,))
    wait_for(lambda: nodes.state("arm0"), "the second one's RTPU process")
    monkeypatch.setenv("PBONET_RUN_DIR", str(nodes.folder))
    nodes.agent("hub", listen=(hub,), connect=(first,))

    def said():
        events = nodes.client().call("arm0", m.Events(), list[m.Event])
        return [event for event in events if event.code == "DUPLICATE_NAME"]

    text = wait_for(said, "the event")[0].text
    assert f"process {os.getpid()};" in text or f"process {twin.pid};" in text


def test_silent_connections_keep_nobody_out(nodes, monkeypatch):
    """Zenoh alone keeps a hundred for ten seconds, and refuses all others meanwhile."""
    port = free_port()
    where = f"tcp/127.0.0.1:{port}"
    nodes.agent_process("arm0", listen=(where,))
    other = nodes.folder / "other"
    other.mkdir(mode=0o700)
    monkeypatch.setenv("PBONET_RUN_DIR", str(other))  # else by the Unix socket
    with contextlib.ExitStack() as opened:
        for _ in range(500):
            opened.enter_context(socket.create_connection(("127.0.0.1", port), 5.0))
        made = session.client(nodes.domain, connect=[where], timeout=5.0)
        client = rpc.Client(opened.enter_context(made), nodes.domain, "desk")
        assert client.call("arm0", m.Stop(), m.Stopped).off == []
    monkeypatch.setenv("PBONET_RUN_DIR", str(nodes.folder))


@pytest.mark.parametrize("name", ["", "a/b", "a*", "-a", "x" * 32, "a b"])
def test_names_that_cannot_be_keys_are_refused(nodes, name):
    with pytest.raises(NodeError, match="not a valid name for an RTPU"):
        Agent(nodes.config(name))


def test_listening_beyond_the_machine_needs_insecure(nodes):
    with pytest.raises(NodeError, match="beyond this machine is not protected"):
        Agent(nodes.config("arm0", listen=("tcp/0.0.0.0:0",)))
    with pytest.raises(NodeError, match="this is not an endpoint"):
        Agent(nodes.config("arm0", listen=("carrier-pigeon/1",)))
    Agent(nodes.config("arm0", listen=("tcp/0.0.0.0:0",), insecure=True))


def test_core_that_does_not_exist(nodes):
    with pytest.raises(RealTimeError, match="core 4000 cannot be used"):
        Agent(nodes.config("arm0", core=4000)).start()


# -- requests that are none ---


MALFORMED = [
    (b"", "not msgpack"),
    (b"\xc1\xc1\xc1", "not msgpack"),
    (b"{}", "not msgpack"),
    (msgpack.packb([1, 2]), "not msgpack"),
    (msgpack.packb({"v": 1, "id": "7"}), "not understood"),
    (msgpack.packb({"v": 1, "id": "7", "op": "dance"}), "not understood"),
    (msgpack.packb({"v": 1, "id": "7", "op": "spawn"}), "not understood"),
    (msgpack.packb({"v": 1, "id": "7", "op": "status", "task": 3}), "understood"),
    (msgpack.packb({"v": 2, "id": "7", "op": "status"}), "another protocol version"),
    (b"\x00" * ((1 << 20) + 1), "too long"),
]


def test_malformed_requests_are_answered(nodes):
    nodes.agent("arm0")
    for payload, text in MALFORMED:
        answer = raw(nodes, "arm0", payload)
        assert answer["ok"] is False, payload[:99]
        assert answer["error"]["code"] == "PROTOCOL"
        assert text in answer["error"]["what"]
    good = raw(nodes, "arm0", msgpack.packb({"v": 1, "id": "8", "op": "hello"}))
    assert good["ok"] is True
    assert good["id"] == "8"


def test_both_versions_are_named(nodes):
    nodes.agent("arm0")
    request = {"v": 99, "id": "7", "op": "status"}
    answer = raw(nodes, "arm0", msgpack.packb(request))
    assert answer["id"] == "7"
    assert answer["error"]["expected"] == "version 1"
    assert answer["error"]["got"] == "version 99"


def test_unknown_fields_are_ignored(nodes):
    nodes.agent("arm0")
    request = {"v": 1, "id": "7", "op": "hello", "colour": "blue"}
    assert raw(nodes, "arm0", msgpack.packb(request))["ok"] is True


def test_repeated_request_is_executed_once(arm, nodes):
    request = m.Spawn(
        id="once", client="me", subsystem="arm", epoch=arm.epoch, task="a",
        rmod=rmod("counts"), rmod_name="a.rmod",
    )  # fmt: skip
    payload = codec.Codec().pack(request)
    first, second = (raw(nodes, "arm0", payload) for _ in range(2))
    assert first["ok"] is True
    assert first == second
    assert len(arm.events("SPAWNED")) == 1
    request.task = "b"
    third = raw(nodes, "arm0", codec.Codec().pack(request))
    assert third["ok"] is False
    assert third["error"]["code"] == "PROTOCOL"
    told = "the id once of client me was used by another request"
    assert third["error"]["what"] == told
    assert third["error"]["expected"] == "the same spawn again, or a new id"
    assert len(arm.events("SPAWNED")) == 1


# -- claims ---


def test_commands_need_a_claim(nodes):
    nodes.agent("arm0")
    client = nodes.client()
    request = m.CloseTable(subsystem="arm")
    with pytest.raises(ClaimError, match="has not claimed the RTPU"):
        client.call("arm0", request, object)
    for harmless in (m.Status(), m.Events(), m.Stop()):
        client.call("arm0", harmless, object)


@pytest.mark.usefixtures("arm")
def test_exclusive_use_is_honoured(nodes):
    with pytest.raises(ClaimError, match="subsystem arm uses the RTPU"):
        Master(nodes, "arm0", "leg")
    with pytest.raises(ClaimError, match="exclusive use by arm"):
        Master(nodes, "arm0", "leg", usage="shared")


def test_shared_use_takes_both_sides(nodes):
    nodes.agent("arm0")
    arm = nodes.master("arm0", "arm", usage="shared")
    leg = nodes.master("arm0", "leg", usage="shared")
    arm.spawn("same", "counts")
    leg.spawn("same", "counts")
    arm.on("same")
    assert arm.status("same").state == "ON"
    assert leg.status("same").state == "OFF"
    with pytest.raises(ClaimError, match="has one scheduler"):
        Master(nodes, "arm0", "eye", usage="shared", scheduler="EDF")
    arm.stop()
    assert leg.status("same").state == "OFF"


def test_second_master_needs_take_over(arm, nodes):
    with pytest.raises(ClaimError, match="has a master already"):
        Master(nodes, "arm0", "arm")
    arm.spawn("a", "counts")
    arm.on("a")
    before = arm.status("a").cycle
    new = Master(nodes, "arm0", "arm", take_over=True)
    assert new.epoch > arm.epoch
    assert new.claimed.tasks == ["a"]
    assert new.claimed.rmods == {"a": rmod("counts")}
    error = arm.refused(ClaimError, arm.off, "a")
    assert f"epoch {new.epoch}" in error.expected
    assert new.status("a").cycle >= before
    assert new.off("a").state == "OFF"


def test_a_take_over_is_an_event_for_all_masters_and_a_probe_of_it_is_not(arm, nodes):
    levels = {"LEVEL": 1}
    arm.spawn("c", "holds", out="Y1", invar="Y0", critical=True, local=levels)
    arm.on("c")
    other = Master(nodes, "arm0", "arm", take_over=True, probe=True)
    assert (other.claimed.taken_from, other.claimed.critical) == (arm.name, ["c"])
    assert other.epoch == arm.epoch
    new = Master(nodes, "arm0", "arm", take_over=True)
    event = new.wait_event("TAKEN_OVER", "")
    assert (event.subsystem, event.severity) == ("", Severity.WARNING)
    assert event.text == (
        f"master {new.name} took subsystem arm over from master {arm.name}, which "
        "lives; CRITICAL tasks ON: c"
    )
    assert len(new.events("TAKEN_OVER")) == 1
    assert new.off("c").state == "OFF"


def test_master_that_is_gone_is_replaced(arm, nodes):
    arm.spawn("a", "counts")
    arm.token.undeclare()
    key = key_expressions.masters(nodes.domain, "arm")
    wait_for(lambda: not session.alive(nodes.session, key), "the token's end")
    assert Master(nodes, "arm0", "arm").claimed.tasks == ["a"]


def test_claim_of_a_dead_master_without_tasks_lapses(arm, nodes, shared_memory):
    arm.token.undeclare()
    key = key_expressions.masters(nodes.domain, "arm")
    wait_for(lambda: not session.alive(nodes.session, key), "the token's end")
    leg = nodes.master("arm0", "leg")
    info = leg.client.call("arm0", m.Hello(), m.AgentInfo)
    assert info.claims == {"leg": leg.epoch}
    tables = [path.name for path in shared_memory.glob("*.svar")]
    assert len(tables) == 1
    assert ".leg." in tables[0]


def test_release_is_refused_while_there_are_tasks(arm):
    arm.spawn("a", "counts")
    error = arm.refused(StateError, arm.ask, m.Release())
    assert "tasks a" in error.got
    arm.kill("a")
    arm.ask(m.Release())
    arm.refused(ClaimError, arm.ask, m.CloseTable())


def test_claim_checks_what_it_is_told(nodes):
    nodes.agent("arm0")
    for field in ({"usage": "mine"}, {"scheduler": "FIFO"}, {"minfreq": 0.0}):
        with pytest.raises(ClaimError):
            Master(nodes, "arm0", "arm", **field)


# -- tables ---


def test_table_of_another_layout_is_refused(arm):
    error = arm.refused(SvarLayoutError, arm.open_table, svar(3))
    assert "another layout" in error.what
    arm.open_table()  # the same again is no fault


def test_wrong_table_names_the_place(arm):
    arm.ask(m.CloseTable())
    error = arm.refused(ConfigError, arm.open_table, "AME X\nEOF\n")
    assert error.where.endswith("t.svar:1:1")


def test_table_that_is_not_here(nodes):
    nodes.agent("arm0")
    arm = nodes.master("arm0", "arm", table=False)
    arm.refused(SvarMissingError, arm.spawn, "a", "counts")
    arm.refused(SvarMissingError, arm.value, "X")


def test_table_whose_keeper_is_on_another_machine(nodes, shared_memory):
    """Whoever comes first on a machine makes it, and the last one removes it."""
    nodes.agent("arm0")
    arm = nodes.master("arm0", "arm", table=False)
    arm.open_table(keep=False)
    assert arm.value("X").values == [1.0, 2.0]
    arm.ask(m.CloseTable())
    assert not list(shared_memory.glob("*.svar"))


def test_close_table_needs_its_tasks_gone(arm, shared_memory):
    arm.spawn("a", "counts")
    arm.refused(StateError, arm.ask, m.CloseTable())
    arm.kill("a")
    arm.ask(m.CloseTable())
    assert not list(shared_memory.glob("*.svar"))


def test_display_and_write(arm):
    value = arm.value("X")
    assert (value.values, value.writer, value.age) == ([1.0, 2.0], None, None)
    arm.ask(m.Write(name="X", values=[3.0, 4.0]))
    value = arm.value("X")
    assert value.values == [3.0, 4.0]
    assert value.age is not None
    error = arm.refused(UnknownVariableError, arm.value, "XX")
    assert "did you mean X?" in error.remedy
    arm.spawn("a", "counts", out="Y1")
    arm.on("a")
    arm.refused(SvarOwnerError, arm.ask, m.Write(name="Y1", values=[0.0, 0.0]))
    assert arm.value("Y1").writer == "a"


def test_two_rtpus_share_the_table(nodes, shared_memory):
    nodes.agent("arm0")
    nodes.agent("arm1", core=min(os.sched_getaffinity(0)))
    nodes.wait_agent("arm1")
    keeper = nodes.master("arm0", "arm")
    other = nodes.master("arm1", "arm", table=False)
    other.open_table(keep=False)
    other.spawn("a", "counts", out="Y1")
    other.on("a")
    other.wait_cycles("a", 5)
    assert keeper.value("Y1").values[0] > 0
    error = other.refused(SvarError, other.ask, m.Write(name="X", values=[0, 0]))
    assert "does not keep the table" in str(error)
    assert len(list(shared_memory.glob("*.svar"))) == 1


# -- the rest ---


def test_flag_of_the_master(arm):
    up = arm.ask(m.Flag(cause="equation 2", up=True))
    assert up == ["equation 2 (master)"]
    assert arm.rtpu_status().illegal == up
    assert arm.ask(m.Flag(cause="equation 2", up=False)) == []


def test_modules_are_described_in_a_process_of_their_own(arm):
    info = arm.ask(m.Modules(name="counts"), list[dict])[0]
    assert info["name"] == "counts"
    assert info["params"][0]["name"] == "diary"
    error = arm.refused(ModuleLoadError, arm.ask, m.Modules(name="dies_on_import"))
    assert "ended the process: exit code 5" in str(error)
    error = arm.refused(ModuleLoadError, arm.ask, m.Modules(name="count"))
    assert "did you mean counts?" in str(error)


def test_events_are_numbered_kept_and_published(arm, nodes):
    heard = []
    nodes.session.declare_subscriber(
        key_expressions.rtpu(nodes.domain, "arm0", "event"),
        lambda sample: heard.append(
            msgspec.msgpack.decode(sample.payload.to_bytes(), type=m.Event)
        ),
    )
    arm.spawn("a", "counts")
    arm.on("a")
    wait_for(lambda: [e for e in heard if e.code == "STATE"], "the published event")
    told = list(heard)
    kept = arm.events()
    assert [event.n for event in kept] == list(range(1, len(kept) + 1))
    assert all(event in kept for event in told)
    later = arm.ask(m.Events(since=kept[-1].n), list[m.Event])
    assert later[0] == kept[-1]


def test_unknown_task_names_the_nearest(arm):
    arm.spawn("elbow", "counts")
    for do in (arm.on, arm.off, arm.kill, arm.status):
        error = arm.refused(UnknownTaskError, do, "elbo")
        assert error.remedy == "did you mean elbow?"


def test_rank_checks_its_range(arm):
    arm.spawn("a", "counts")
    arm.ask(m.Rank(tasks={"a": (40, 3)}))
    status = arm.status("a")
    assert (status.crit, status.priority) == (40, 3)
    arm.ask(m.Rank(tasks={"a": (None, 4)}))
    assert (arm.status("a").crit, arm.status("a").priority) == (5, 4)
    for wrong in ((63, 0), (0, 0), (5, -1), (5, 70000)):
        arm.refused(ParameterError, arm.ask, m.Rank(tasks={"a": wrong}))
    # A master may not know yet that one has died.
    os.kill(arm.spawn("b", "counts", out="Y1").tid, signal.SIGKILL)
    wait_for(lambda: arm.status("b").state == "NOT-CREATED", "its death")
    arm.ask(m.Rank(tasks={"b": (7, 1), "a": (41, 2)}))
    assert (arm.status("a").crit, arm.status("a").priority) == (41, 2)
    arm.refused(UnknownTaskError, arm.ask, m.Rank(tasks={"nobody": (7, 1)}))
