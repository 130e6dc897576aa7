"""A table and a link between machines over mutual TLS, and a cable that is pulled."""

from __future__ import annotations

import pytest
from hostfleet import Desk
from hostkit import Lab
from tbuf_rig import READER, WRITER, flows
from watching import wait_for

from pbonet.xm import pki
from pbonet.xm.credentials import Role


@pytest.fixture
def lab(lan, tmp_path):
    """Two hosts whose agents have keys of one authority."""
    authority = tmp_path / "lab"
    pki.make_authority(authority)
    keys = {
        host: pki.issue(
            authority, Role.AGENT, f"agent-{host}", hosts=[lan[host].address(peer)]
        )
        for host, peer in (("a", "b"), ("b", "a"))
    }
    lan.heal_all()
    made = Lab(lan, keys=keys)
    try:
        yield made
    finally:
        lan.heal_all()
        made.close()


def test_a_table_and_a_link(lab, lan):
    lab.start("arm0", "a")
    lab.start("arm1", "b", connect=[lab.endpoint("a", "b")])
    lab.wait_all()
    assert lab.info("arm1", "a").dials == [f"tls/{lan['a'].address('b')}:{lab.port}"]
    cell = Desk(lab, "cell", ("arm0", "arm1"), host="b")
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
        assert flows(reader, 30.0)["restarts"] == 0
    finally:
        for program in (writer, reader):
            program.kill()
        cell.close()


def comes(cell):
    """Wait for news of src on the other machine."""
    before = cell.value("arm1", "Z0").cycle
    found = wait_for(
        lambda: (now := cell.value("arm1", "Z0")).cycle > before and now, "news", 20.0
    )
    assert found.writer == "src@host-a"
