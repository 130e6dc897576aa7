"""A master is killed amid a reconfiguration: agents finish their part, and say so."""

from __future__ import annotations

import subprocess
import sys

import pytest
from nodekit import rmod, svar
from watching import causes, states, wait_for

from pbonet.errors import ClaimError
from pbonet.master.subsystem.subsystem import Subsystem

MASTER = """
import sys
from pbonet.master.subsystem import Subsystem
folder, domain, new, rtpu, how, *libraries = sys.argv[1:]
arm = Subsystem(folder, domain=domain, libraries=libraries, record="off").open()
for task, where in (("stays", "arm0"), ("old", "arm0"), (new, rtpu)):
    arm.spawn(task, where)
arm.reconfig([("stays", "on"), ("old", "on")])
if how == "swap":
    arm.swap("old", new)
else:  # a list in which no heir can stand by beforehand
    arm.reconfig([("old", "off"), (new, "reinit"), (new, "on")])
print("the swap was not interrupted")
"""


def free(arm):
    """Open a subsystem if no other master has it; return it then."""
    try:
        return arm.open()
    except ClaimError:
        return None


@pytest.fixture
def killed(nodes, tmp_path):
    """Return a function that kills a master amid its swap from old@arm0 to a task."""
    begun, go_on = tmp_path / "begun", tmp_path / "go_on"
    (tmp_path / "t.sbs").write_text(
        "SUBSYSTEM t\nSVARFILE t.svar\nRTPU arm0\nRTPU arm1\nEOF\n"
    )
    (tmp_path / "t.svar").write_text(svar())
    for name, text in {
        "stays": rmod("counts", out="Y1"),
        "new": rmod("counts", out="Y0"),
        "old": rmod("waits_in_off", local={"BEGUN": begun, "GO_ON": go_on}),
    }.items():
        (tmp_path / f"{name}.rmod").write_text(text)
    libraries = [str(path) for path in nodes.config("arm0").libraries]
    opened: list[Subsystem] = []

    def kill(rtpu, how="swap"):
        nodes.agent_processes("arm0", "arm1")
        words = [str(tmp_path / "t.sbs"), nodes.domain, "new", rtpu, how]
        words = [sys.executable, "-c", MASTER, *words, *libraries]
        master = subprocess.Popen(words)
        wait_for(begun.exists, "the beginning of off")
        master.kill()
        master.wait()
        go_on.touch()
        arm = Subsystem(
            tmp_path / "t.sbs",
            domain=nodes.domain,
            libraries=libraries,
            warned=lambda _text: None,
            record="off",
        )
        opened.append(wait_for(lambda: free(arm), "the end of the master's claim"))
        return arm

    yield kill
    for arm in opened:
        arm.finish()


@pytest.mark.parametrize("rtpu", ["arm0", "arm1"])
def test_an_exchange_is_finished_without_the_master(killed, rtpu):
    """On one RTPU, and across two of a machine."""
    arm = killed(rtpu)
    wait_for(lambda: states(arm)["new"] == "ON", "the end of the list")
    assert states(arm) == {"stays": "ON", "old": "OFF", "new": "ON"}
    assert arm.display(["Y0"])[0].writer == "new"
    wait_for(lambda: not causes(arm), "a legal configuration")
    said = {(e.task, e.code, e.text) for e in arm.events()}
    assert ("old", "STATE", "turned off") in said
    assert ("new", "ENGAGED", "in place of old") in said
    assert arm.swap("old", "new").items == [], "nothing is left to be done"


def test_the_part_that_was_never_sent_is_said_and_the_flag_is_up(killed):
    arm = killed("arm1", "list")
    left = "off old is done, and no task took over Y0"
    wait_for(lambda: any(left in cause for cause in causes(arm)), "the flag")
    assert states(arm) == {"stays": "ON", "old": "OFF", "new": "OFF"}
    assert any(left in e.text for e in arm.events() if e.code == "ILLEGAL")
    assert arm.swap("old", "new").items == [("new", "on")], "what is left"
    wait_for(lambda: not causes(arm), "a legal configuration")
    assert arm.swap("new", "old").items == [("new", "off"), ("old", "on")]
    assert not causes(arm)
