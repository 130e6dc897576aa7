"""`pbonet explain` about real tasks."""

from __future__ import annotations

import pytest
from nodekit import rmod, svar
from watching import wait_for

from pbonet.master import diagnosis
from pbonet.master.configuration import Place
from pbonet.master.subsystem import Subsystem


@pytest.fixture
def arm(nodes, tmp_path):
    """A subsystem with a task that fails in its first cycle."""
    nodes.agent_processes("arm0")
    (tmp_path / "t.sbs").write_text("SUBSYSTEM t\nSVARFILE t.svar\nRTPU arm0\nEOF\n")
    (tmp_path / "t.svar").write_text(svar())
    (tmp_path / "first.rmod").write_text(rmod("raises_in_cycle", "Y0"))
    with Subsystem(
        tmp_path / "t.sbs",
        domain=nodes.domain,
        libraries=nodes.config("arm0").libraries,
        warned=lambda _: None,
    ) as opened:
        yield opened


def test_a_task_that_failed(nodes, arm, tmp_path):
    place = Place(domain=nodes.domain, libraries=arm.files.library.folders)
    arm.spawn("first")

    def asked(*words):
        return diagnosis.text(diagnosis.answer(tmp_path / "t.sbs", words, place))

    assert "do: turn it on" in asked("first")
    arm.on("first")
    wait_for(lambda: arm.status("first").state == "ERROR", "the task fails")
    text = asked("first")
    assert "task first on arm0 is ERROR" in text
    assert "METHOD of arm0/first" in text
    assert "do: 'clear first' brings it out of ERROR" in text
    arm.clear("first")
    assert "STATE of arm0/first" in asked("first")
    arm.stop()
