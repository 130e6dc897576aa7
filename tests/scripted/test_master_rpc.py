"""The request layer: what it says when an agent is missing, silent, slow or refuses."""

from __future__ import annotations

import os
import subprocess
import sys
import threading
from types import NoneType

import pytest

from pbonet.errors import (
    NoAnswerError,
    ProtocolError,
    SeveralError,
    StateError,
    UnknownTaskError,
    UnreachableError,
)
from pbonet.xm.net import messages as m, rpc, session


@pytest.fixture
def client(world, agents):
    agents("arm0", "arm1", apart=True)
    opened = session.client(world.domain)
    yield rpc.Client(opened, world.domain, "tester")
    opened.close()


def test_request_is_answered_with_its_typed_result(client):
    info = client.call("arm0", m.Hello(), m.AgentInfo)
    assert (info.name, info.domain) == ("arm0", client.domain)


def test_agents_are_listed_by_their_tokens(client):
    assert client.rtpus() == ["arm0", "arm1"]


TOLD = """
import sys, threading
from watching import wait_for
from pbonet.xm.net import rpc, session

own, counts = threading.local(), []

def told():
    own.count = getattr(own, "count", 0) + 1
    counts.append((threading.get_ident(), own.count))

one, other = (session.client(sys.argv[1]) for _ in "ab")
key = f"{sys.argv[1]}/test/told"
heard = rpc.Client(one, sys.argv[1], "told").subscribe(key, told)
wait_for(lambda: other.put(key, b"") or len(counts) > 11, "twelve calls")
heard.undeclare()
other.close()
one.close()
for thread in {ident for ident, _ in counts}:
    found = [count for ident, count in counts if ident == thread]
    assert found == list(range(1, len(found) + 1)), found
"""
"""What is a thread's own stands from call to call, and is not made anew.

In a process of its own: in one, no more than 64 threads stay known in all.
"""


@pytest.mark.usefixtures("client")
def test_threads_that_zenoh_started_stay_known_to_python(world):
    paths = os.pathsep.join(sys.path)
    done = subprocess.run(
        [sys.executable, "-c", TOLD, world.domain],
        env={**os.environ, "PYTHONPATH": paths},
        capture_output=True,
        text=True,
        check=False,
    )
    assert (done.returncode, done.stderr) == (0, "")


def test_missing_agent_is_named_with_those_that_are_there(client):
    with pytest.raises(UnreachableError) as caught:
        client.call("amr0", m.Hello(), m.AgentInfo)
    assert str(caught.value) == (
        "amr0: no agent of this name can be reached (got RTPUs of the domain "
        f"{client.domain} that can be reached: arm0, arm1); did you mean arm0? else "
        f"start it with 'pbonet agent --name amr0 --domain {client.domain}'"
    )
    with pytest.raises(UnreachableError) as caught:
        client.call("arm2", m.Hello(), m.AgentInfo)
    assert caught.value.remedy.startswith("start it with")  # it is no misspelt arm1


def test_silent_agent_is_there_but_does_not_answer(client, agents):
    agents["arm1"].silent = True
    with pytest.raises(NoAnswerError, match=r"did not answer within 0\.3 s") as caught:
        client.call("arm1", m.Hello(), m.AgentInfo, timeout=0.3)
    assert caught.value.where == "arm1"


@pytest.mark.parametrize("timeout", [2.0, 3600.0])
def test_agent_that_gives_no_sign_of_life_is_found_out(client, agents, timeout):
    agents["arm1"].silent = True
    with pytest.raises(NoAnswerError) as caught:
        client.call("arm1", m.Status(), m.RtpuStatus, timeout=timeout)
    assert str(caught.value) == (
        "arm1: the agent is registered but does not respond (expected an answer within "
        "1.1 s); if its machine is busy, wait and try again; else see its output; if "
        "it hangs, end it with 'kill -9' and start it again: its tasks continue "
        "meanwhile, for its grace"
    )


def test_what_is_sent_again_while_it_is_carried_out_is_done_once(
    client, agents, monkeypatch
):
    """As by an agent; else a test would see a signal twice on a machine that stalls."""
    monkeypatch.setattr(rpc, "ASK_TIME", 0.1)
    agents["arm0"].slow["claim"] = 0.5
    client.call("arm0", m.Claim(subsystem="arm"), m.Claimed)
    ids = [one.id for one in agents["arm0"].requests if isinstance(one, m.Claim)]
    assert len(ids) == 1


def test_silent_agent_is_not_asked_again_at_once_but_for_a_stop(
    client, agents, monkeypatch
):
    monkeypatch.setattr(rpc, "_SILENCE_TIME", 3600.0)
    agents["arm1"].silent = True
    with pytest.raises(NoAnswerError, match="does not respond"):
        client.call("arm1", m.Status(), m.RtpuStatus)
    asked = len(agents["arm1"].kept)
    with pytest.raises(NoAnswerError, match="does not respond"):
        client.call("arm1", m.Status(), m.RtpuStatus)
    assert len(agents["arm1"].kept) == asked
    agents["arm1"].silent = False
    assert client.call("arm1", m.Stop(), m.Stopped) == m.Stopped(off=[], killed=[])
    monkeypatch.setattr(rpc, "_SILENCE_TIME", 0.0)
    assert client.call("arm1", m.Hello(), m.AgentInfo).name == "arm1"


def test_slow_operation_of_a_living_agent_is_waited_for(client, agents):
    agents["arm0"].slow["status"] = 2.5
    answer = client.call("arm0", m.Status(), m.RtpuStatus, timeout=10.0)
    assert answer.rtpu == "arm0"


def test_agent_that_dies_with_the_request_is_unreachable(client, agents):
    agents["arm1"].silent = True
    killer = threading.Timer(0.3, agents["arm1"].session.close)
    killer.start()
    with pytest.raises(UnreachableError, match="no agent of this name"):
        client.call("arm1", m.Status(), m.RtpuStatus, timeout=5.0)
    killer.join()


def test_loss_of_the_agent_we_are_connected_to_is_outlived(client, agents):
    agents["arm0"].close()  # the first endpoint, so the one we use
    assert client.call("arm1", m.Hello(), m.AgentInfo).name == "arm1"
    with pytest.raises(UnreachableError, match="can be reached: arm1"):
        client.call("arm0", m.Hello(), m.AgentInfo)


def test_nobody_left_is_said_within_the_time(world, agents):
    agents("arm0")
    client = rpc.Client(session.client(world.domain), world.domain, "tester")
    agents["arm0"].close()
    with pytest.raises(UnreachableError, match="can be reached: none"):
        client.call("arm0", m.Hello(), m.AgentInfo)
    client.close()


def test_refusal_keeps_its_class_and_says_where(client):
    with pytest.raises(UnknownTaskError) as caught:
        client.call("arm0", m.Status(task="pid"), m.RtpuStatus)
    assert caught.value.where == "arm0/pid"


@pytest.mark.parametrize(
    ("place", "told"),
    [
        ("/lib/broken.py:5", "arm0:/lib/broken.py:5"),
        ("/lib/arm01.svar", "arm0:/lib/arm01.svar"),
    ],
)
def test_the_place_of_a_refusal_begins_with_its_rtpu(client, agents, place, told):
    agents["arm0"].fail["status", ""] = StateError("not now", where=place)
    with pytest.raises(StateError) as caught:
        client.call("arm0", m.Status(task=""), m.RtpuStatus)
    assert caught.value.where == told


def test_a_session_that_cannot_be_opened_names_no_source_file(world):
    with pytest.raises(UnreachableError) as caught:
        session.client(world.domain, connect=["tcp/127.0.0.1:1"], timeout=0.1)
    assert caught.value.where == "tcp/127.0.0.1:1"
    assert caught.value.got == "from 127.0.0.1: Connection refused"


def test_refusal_without_a_place_gets_the_name_of_the_rtpu(client, agents):
    agents["arm0"].fail["status", ""] = StateError("not now")
    with pytest.raises(StateError, match=r"^arm0: not now$"):
        client.call("arm0", m.Status(task=""), m.RtpuStatus)


def test_result_of_another_type_is_a_protocol_error(client):
    with pytest.raises(ProtocolError, match="not of the operation's type"):
        client.call("arm0", m.Hello(), m.Claimed)


def test_warnings_of_an_answer_reach_the_caller(client, agents, monkeypatch):
    heard = []
    client.warned = lambda rtpu, text: heard.append((rtpu, text))

    def answer(data):
        request = agents["arm0"].codec.request(data)
        return agents["arm0"].codec.pack(
            m.Answer(id=request.id, ok=True, warnings=["nearly full"])
        )

    monkeypatch.setattr(agents["arm0"], "answer", answer)
    client.call("arm0", m.Hello(), NoneType)
    assert heard == [("arm0", "nearly full")]


def test_several_agents_are_asked_at_once_and_errors_are_kept_apart(client):
    results, errors = client.call_all(
        {name: m.Hello() for name in ("arm0", "arm1", "leg")}, m.AgentInfo
    )
    assert sorted(results) == ["arm0", "arm1"]
    assert [error.where for error in errors] == ["leg"]
    rpc.raise_all("nothing failed", [])
    with pytest.raises(UnreachableError):
        rpc.raise_all("one failed", errors)
    with pytest.raises(SeveralError) as caught:
        rpc.raise_all("2 RTPUs failed", [*errors, NoAnswerError("slow", where="arm1")])
    assert str(caught.value).splitlines()[0] == "2 RTPUs failed"
    assert str(caught.value).splitlines()[-1] == "`-- arm1: slow"
    assert isinstance(caught.value.__cause__, ExceptionGroup)


def test_closed_session_is_an_error_of_ours(client):
    client.session.close()
    with pytest.raises(UnreachableError, match="connection to the agents is closed"):
        client.call("arm0", m.Hello(), m.AgentInfo)
