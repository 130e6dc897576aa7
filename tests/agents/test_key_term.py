"""A master whose certificate runs out while its link stands."""

from __future__ import annotations

import pytest
from watching import free_port, wait_for

from pbonet.errors import ConfigFileError, UnreachableError
from pbonet.xm.net import messages as m, pki, session
from pbonet.xm.net.credentials import Role
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
