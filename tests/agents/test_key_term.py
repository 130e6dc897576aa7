"""A master whose certificate runs out, or is revoked, while its link stands."""

from __future__ import annotations

import contextlib
import signal

import pytest
from watching import free_port, wait_for

from pbonet.errors import ConfigFileError, PbonetError, UnreachableError
from pbonet.xm.net import messages as m, pki, session
from pbonet.xm.net.credentials import CA, Role
from pbonet.xm.net.rpc import Client

SHORT = 6.0 / 86400
"""Days."""


def test_its_link_is_closed_and_nothing_is_answered_any_more(
    nodes, tmp_path, monkeypatch
):
    lab = tmp_path / "lab"
    pki.make_authority(lab)
    where = f"tls/127.0.0.1:{free_port()}"
    own = pki.issue(lab, Role.AGENT, "arm0", hosts=["127.0.0.1"])
    nodes.agent_process("arm0", listen=(where,), keys=str(own))
    elsewhere = tmp_path / "elsewhere"
    elsewhere.mkdir(mode=0o700)
    monkeypatch.setenv("PBONET_RUN_DIR", str(elsewhere))
    keys = pki.issue(lab, Role.MASTER, "anna", days=SHORT)
    monkeypatch.setenv("PBONET_KEYS", str(keys))
    with session.client(nodes.domain, connect=[where]) as link:
        anna = Client(link, nodes.domain, "anna")
        assert anna.call("arm0", m.Hello(), m.AgentInfo).name == "arm0"
        wait_for(lambda: not list(link.info.links()), "the end of its link")
        with pytest.raises(UnreachableError, match="the certificate has expired"):
            anna.call("arm0", m.Stop(), m.Stopped)
        assert session.rtpus(link, nodes.domain) == []
    with pytest.raises(ConfigFileError, match="the certificate has expired"):
        session.client(nodes.domain, connect=[where], key_folder=keys)


def test_a_revoked_one_is_shut_out_when_the_agent_reads_its_keys_again(
    nodes, tmp_path, monkeypatch
):
    """Its link is cut and no new one made; another master and the task go on."""
    lab = tmp_path / "lab"
    pki.make_authority(lab)
    where = f"tls/127.0.0.1:{free_port()}"
    own = pki.issue(lab, Role.AGENT, "arm0", hosts=["127.0.0.1"])
    anna, bert = (pki.issue(lab, Role.MASTER, name) for name in ("anna", "bert"))
    process = nodes.agent_process("arm0", listen=(where,), keys=str(own))
    master = nodes.master("arm0", "arm")
    master.spawn("a", "counts")
    before = master.on("a")
    elsewhere = tmp_path / "elsewhere"
    elsewhere.mkdir(mode=0o700)
    monkeypatch.setenv("PBONET_RUN_DIR", str(elsewhere))

    def client(keys, limit=1.0):
        link = session.client(
            nodes.domain, connect=[where], key_folder=keys, timeout=limit
        )
        return Client(link, nodes.domain, keys.name)

    with contextlib.ExitStack() as after:
        lost = client(anna)
        after.callback(lost.close)
        assert lost.call("arm0", m.Hello(), m.AgentInfo).name == "arm0"
        kept = (anna / CA).read_bytes()
        pki.revoke(lab, "anna")
        (anna / CA).write_bytes(kept)
        zid = lost.call("arm0", m.Hello(), m.AgentInfo).zid

        def restarted():
            with contextlib.suppress(PbonetError):
                other = client(bert)
                try:
                    return other.call("arm0", m.Hello(), m.AgentInfo).zid != zid
                finally:
                    other.close()

        process.send_signal(signal.SIGHUP)
        wait_for(restarted, "the agent with its keys read again")
        with pytest.raises(UnreachableError, match="no agent"):
            lost.call("arm0", m.Stop(), m.Stopped)
        with pytest.raises(UnreachableError, match="not revoked"):
            client(anna)
        good = client(bert, 30.0)
        after.callback(good.close)
        (task,) = good.call("arm0", m.Status(), m.RtpuStatus).tasks
        assert (task.state, task.tid) == ("ON", before.tid)
        assert good.call("arm0", m.Stop(), m.Stopped).off == ["a"]
    (anna / CA).write_bytes((lab / CA).read_bytes())
    with pytest.raises(ConfigFileError, match="the certificate has been revoked"):
        client(anna)
