"""A module signals a task of another RTPU of its machine (Stewart 1994, 8.2.1)."""

from __future__ import annotations

import contextlib

import pytest
from nodekit import CORE, rmod, svar
from watching import wait_for

from pbonet.analysis.schedule import Mode
from pbonet.master.subsystem import Subsystem
from pbonet.node.rt import CoreTable

MODULE = """
    from pathlib import Path
    from typing import Annotated as A

    from pbonet import Answer, OutVar, Params, PortBasedObject, Vector, param


    class When(Params):
        file: A[str, param("none", "it fails when this is there")]


    class Breaks(PortBasedObject[When]):
        '''Fails when told, and turns others off then.'''

        y: A[Vector, OutVar("Y", "2", "none", "nothing")]

        def cycle(self, dt: float) -> None:
            if Path(self.params.file).exists():
                raise ValueError("it breaks")

        def error(self, error: Exception) -> Answer:
            for task in ("b", "nobody"):
                self.task.control(task, "off")
            return Answer.ERROR
"""


def _mode(task):
    """Return the mode of a task in the core table; None: it is not there."""
    with contextlib.closing(CoreTable(CORE, member=False)) as core:
        slots = [core.snapshot(i) for i in core.slots()]
    return next((one.mode for one in slots if one.task == f"t/{task}"), None)


@pytest.fixture
def arm(nodes, tmp_path):
    """Return what opens a subsystem of two RTPUs on this machine."""
    nodes.write_module("breaks", MODULE)
    rtpus = "RTPU arm0\nRTPU arm1\n"
    (tmp_path / "t.sbs").write_text(f"SUBSYSTEM t\nSVARFILE t.svar\n{rtpus}EOF\n")
    (tmp_path / "t.svar").write_text(svar())
    breaks = rmod("breaks", "Y0", 50.0, local={"FILE": tmp_path / "now"})
    (tmp_path / "a.rmod").write_text(breaks)
    (tmp_path / "b.rmod").write_text(rmod("counts", "Y1", 50.0))

    def opened():
        libraries = nodes.config("arm0").libraries
        return Subsystem(tmp_path / "t.sbs", domain=nodes.domain, libraries=libraries)

    return opened


def test_it_is_obeyed_without_master_and_agents(nodes, arm, tmp_path):
    nodes.agent_processes("arm0", "arm1")
    with arm() as master:
        master.spawn("a", "arm0")
        master.spawn("b", "arm1")
        master.on(["a", "b"])
        master.detach()
    nodes.forget_session()
    for process in nodes.processes.values():
        process.kill()
        process.wait()
    (tmp_path / "now").touch()
    wait_for(lambda: _mode("b") is Mode.OFF, "b is turned off")
    nodes.agent_processes("arm0", "arm1")
    with arm() as master:
        states = {one.task: one.state for one in master.status_all()}
        assert states == {"a": "ERROR", "b": "OFF"}
        events = [one for one in master.events(100) if one.rtpu == "arm1"]
        codes = [(one.task, one.code, one.text) for one in events]
        back = next(i for i, one in enumerate(codes) if one[1] == "AGENT_BACK")
        assert ("b", "STATE", "turned off") in codes[:back]
        wait_for(lambda: master.events(code="SIGNAL_FAILED"), "a refusal")
        (refusal,) = master.events(code="SIGNAL_FAILED")
        assert refusal.task == "a"
        assert "off to nobody was refused: " in refusal.text
        assert "no RTPU of this machine has task nobody" in refusal.text
        assert "asked: arm0, arm1" in refusal.text
