"""A program that brings the agents it needs, and takes them with it."""

from __future__ import annotations

import os
from pathlib import Path

import pytest
from watching import wait_for

from pbonet.errors import NodeError
from pbonet.master import Subsystem

SBS = "SUBSYSTEM alone\nSVARFILE alone.svar\nRTPU arm7\nEOF\n"
SVAR = "NAME Y\nTYPE double\nDESC a wave\nUNITS none\nNELEM 1\n\nNAME NDOF\nTYPE int\n"
SVAR += "DESC elements\nUNITS none\nNELEM 1\nINIT 1\nEOF\n"


@pytest.fixture
def program(run_dir, tmp_path):  # noqa: ARG001 - the runtime folder of the agents
    (tmp_path / "alone.svar").write_text(SVAR)
    (tmp_path / "alone.sbs").write_text(SBS)
    return Subsystem(tmp_path / "alone.sbs", domain=f"t{os.getpid()}", embed=True)


def test_agents_come_and_go_with_the_program(program):
    with program as alone:
        (child,) = alone._agents.children
        assert child.rtpu == "arm7"
        alone.spawn("constant")
        alone.on("constant")
        wait_for(lambda: alone.status("constant").cycle > 3, "cycles")
        tid = alone.status("constant").tid
    assert child.process.poll() == 0
    assert not Path(f"/proc/{tid}").exists()
    with pytest.raises(NodeError, match="the subsystem is not open"):
        alone.status()


def test_agents_go_when_the_subsystem_cannot_be_opened(program, monkeypatch):
    children = []

    def refuse(*_, **__):
        children.extend(program._agents.children)
        raise NodeError("no")

    monkeypatch.setattr(program, "_open", refuse)
    with pytest.raises(NodeError, match="no"):
        program.open()
    assert [child.process.poll() for child in children] == [0]
