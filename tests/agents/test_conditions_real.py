"""PRE and POST asked of a real table before a job is entered or left.

level --LEVEL, TWIN--> echo --MODE-->
"""

from __future__ import annotations

import json
import threading

import pytest
from watching import wait_for

from pbonet import cli
from pbonet.errors import (
    ConditionError,
    PbonetError,
    VerificationError,
)
from pbonet.master.configuration.environment import Place
from pbonet.master.console import oneshot, stop_all
from pbonet.master.console.command_session import CommandSession
from pbonet.master.subsystem.subsystem import Subsystem

VARIABLE = "NAME {}\nTYPE double\nDESC a level\nUNITS m\nNELEM {}\n"
LEVEL = """
    from typing import Annotated as A
    from pbonet import OutVar, Params, PortBasedObject, Vector, param

    class Of(Params):
        value: A[float, param("m", "the level")] = 0.0

    class Level(PortBasedObject[Of]):
        '''A level that is set, twice, and its cycle.'''

        level: A[Vector, OutVar("LEVEL", "2", "m", "level and cycle")]
        twin: A[Vector, OutVar("TWIN", "2", "m", "the same")]

        def cycle(self, dt: float) -> None:
            self.level[:] = self.params.value, self.task.cyclecount
            self.twin[:] = self.level
"""
ECHO = """
    from typing import Annotated as A
    from pbonet import InVar, OutVar, Params, PortBasedObject, Vector

    class Echo(PortBasedObject[Params]):
        '''The level again.'''

        level: A[Vector, InVar("LEVEL", "2", "m", "level")]
        mode: A[float, OutVar("MODE", "1", "m", "level")]

        def cycle(self, dt: float) -> None:
            self.mode = float(self.level[0])
"""
RMOD = (
    "MODULE {}\nDESC a test\nINCONST none\nOUTCONST none\nINVAR {}\nOUTVAR {}\n"
    "TASKTYPE periodic\nFREQ 500\nEOF\n"
)
LOW = "JOB low\nDESC\nSBS l.sbs\nPOST LEVEL[0] > 1\nTASK level\nEOF\n"
HIGH = (
    "JOB high\nDESC\nSBS l.sbs\nPRE  LEVEL[0] < 3 [m]\nPRE  LEVEL[0] == TWIN[0]\n"
    "TASK level\nTASK echo\nEOF\n"
)
WRONG = "JOB wrong\nDESC\nSBS l.sbs\nPRE LEVL[0] < 3\nPOST LEVEL < 3\nTASK level\nEOF\n"


@pytest.fixture
def files(nodes, tmp_path):
    nodes.write_module("level", LEVEL)
    nodes.write_module("echo", ECHO)
    folder = tmp_path / "levels"
    folder.mkdir()
    table = [VARIABLE.format(*v) for v in (("LEVEL", 2), ("TWIN", 2), ("MODE", 1))]
    (folder / "l.svar").write_text("\n".join([*table, "EOF\n"]))
    (folder / "l.sbs").write_text("SUBSYSTEM levels\nSVARFILE l.svar\nRTPU arm0\nEOF\n")
    (folder / "level.rmod").write_text(RMOD.format("level", "none", "LEVEL TWIN"))
    (folder / "echo.rmod").write_text(RMOD.format("echo", "LEVEL", "MODE"))
    for name, text in (("low", LOW), ("high", HIGH), ("wrong", WRONG)):
        (folder / f"{name}.job").write_text(text)
    return folder


@pytest.fixture
def place(nodes):
    nodes.agent_process("arm0")
    return Place(domain=nodes.domain, libraries=(str(nodes.library),))


@pytest.fixture
def arm(files, place):
    with opened(files, place) as subsystem:
        yield subsystem


def opened(files, place, **more):
    return Subsystem(
        files / "l.sbs", domain=place.domain, libraries=place.libraries, **more
    )


def tasks(arm):
    return {status.task: status.state for status in arm.status_all()}


def level(arm, value):
    """Set the level, and wait until the table has it."""
    arm.set("level", "value", value)
    wait_for(lambda: arm.display("LEVEL")[0].values[0] == value, f"level {value}")


def test_a_job_is_left_and_entered_only_when_conditions_hold(arm, files):
    arm.start("low")
    level(arm, 0.5)
    with pytest.raises(ConditionError) as caught:
        arm.switch("high")
    assert caught.value.what.startswith(
        "POST of low does not hold: LEVEL[0] > 1 (seen: 0.5 > 1 m does not hold; "
        "LEVEL = 0.5 "
    )
    assert caught.value.where == f"{files / 'low.job'}:4:6"
    assert tasks(arm) == {"level": "ON"}, "nothing was spawned"
    level(arm, 4.0)
    with pytest.raises(
        ConditionError, match=r"PRE of high does not hold: LEVEL.0. < 3"
    ):
        arm.switch("high")
    with pytest.raises(ConditionError, match="PRE of high"):
        arm.switch("high", dry_run=True)
    level(arm, 2.0)
    assert arm.switch("high", dry_run=True).conditions
    done = arm.switch("high")
    assert [text.split(" (seen")[0] for text in done.conditions] == [
        "POST of low holds: LEVEL[0] > 1",
        "PRE of high holds: LEVEL[0] < 3 [m]",
        "PRE of high holds: LEVEL[0] == TWIN[0]",
    ]
    assert tasks(arm) == {"level": "ON", "echo": "ON"}
    level(arm, 9.0)
    assert arm.switch("high").conditions == [], "it stands already"


def test_another_master_asks_the_job_that_stands(arm, files, place):
    arm.start("low")
    level(arm, 0.5)
    with (
        opened(files, place, watch=True) as looker,
        pytest.raises(ConditionError, match="POST of low does not hold"),
    ):
        looker.switch("high", dry_run=True)
    arm.detach()

    def verb(name, **args):
        return oneshot.run(files / "l.sbs", name, args, place)

    with pytest.raises(ConditionError, match="POST of low does not hold"):
        verb("switch", job="high")
    verb("set", task="level", param="value", value="2")
    reply = verb("switch", job="high", wait="20s")
    assert "POST of low holds" in reply.data["conditions"][0]
    verb("start", job="low")
    stop_all.stop("levels", domain=place.domain)
    with opened(files, place) as after:  # a stop has ended the job, and its POST
        after.write("LEVEL", [0.0, 0.0])
        after.write("TWIN", [0.0, 0.0])
        assert len(after.switch("high").conditions) == 2


def test_it_waits_as_long_as_it_may(arm):
    arm.start("low")
    level(arm, 0.5)
    with pytest.raises(ConditionError, match=r"expected them to hold within 0.05 s"):
        CommandSession(arm).execute("switch high wait=50ms")
    waiting = threading.Thread(target=level, args=(arm, 2.0))
    waiting.start()  # other commands go on while this one waits
    try:
        done = arm.switch("high", wait=60.0)
    finally:
        waiting.join()
    assert done.states["echo"] == "ON"


@pytest.mark.parametrize("elsewhere", [False, True])
def test_a_stop_ends_the_waiting(arm, elsewhere, monkeypatch):
    """Else what stands still after the stop may be what the condition waits for."""
    begun, pause = threading.Event(), arm.clock.wait

    def waits(*given):
        begun.set()
        return pause(*given)

    monkeypatch.setattr(arm.clock, "wait", waits)
    arm.start("low")
    level(arm, 0.5)
    begun.clear()
    caught = []

    def wait():
        try:
            arm.switch("high", wait=600.0)
        except PbonetError as error:
            caught.append(str(error))

    waiting = threading.Thread(target=wait)
    waiting.start()
    assert begun.wait(60)
    if elsewhere:
        stop_all.stop(arm.name, domain=arm.domain)
    else:
        arm.stop()
    waiting.join(60)
    assert not waiting.is_alive()
    # It may come just when the condition is asked for the last time.
    assert any("stop arrived during the wait" in one or "was stopped" in one
               for one in caught), caught  # fmt: skip
    assert tasks(arm) == {}


def test_a_start_asks_its_pre(arm, files):
    (files / "high.job").write_text(HIGH.replace("< 3 [m]", "> 3 [m]"))
    with pytest.raises(ConditionError, match=r"0 > 3 m does not hold; LEVEL = 0 0 m"):
        arm.start("high")
    assert tasks(arm) == {}
    arm.write("LEVEL", [5.0, 0.0])
    with pytest.raises(ConditionError, match=r"5 == 0 m does not hold"):
        arm.start("high")
    arm.write("TWIN", [5.0, 0.0])
    arm.start("high", wait=60.0)
    assert tasks(arm) == {"level": "ON", "echo": "ON"}


def test_conditions_that_the_table_cannot_answer_are_refused_at_once(
    arm, files, capsys
):
    for give in (arm.start, arm.switch, arm.check):
        with pytest.raises(VerificationError, match="2 faults") as caught:
            give("wrong")
        assert "wrong.job:4:5: a condition names LEVL" in str(caught.value)
        assert "wrong.job:5:6: several numbers cannot be compared" in str(caught.value)
    assert tasks(arm) == {}
    assert CommandSession(arm).execute("check wrong").data["legal"] is False
    with pytest.raises(SystemExit):
        cli.main(["check", str(files / "wrong.job"), "--json"])
    errors = json.loads(capsys.readouterr().out)
    assert "did you mean LEVEL" in json.dumps(errors)


def test_values_are_of_one_instant(arm):
    arm.start("low")
    for _ in range(200):
        one, other = arm.display(["LEVEL", "TWIN"])
        assert one.whole
        assert one.values == other.values
