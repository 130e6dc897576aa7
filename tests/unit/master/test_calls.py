"""Every command of the prompt is a call of a program: name, arguments, refusals."""

from __future__ import annotations

import inspect
import threading
from pathlib import Path

import pytest

from pbonet.errors import (
    LogError,
    NoAnswerError,
    PbonetError,
    StateError,
    UnknownTaskError,
    VerificationError,
)
from pbonet.master import Subsystem
from pbonet.master.console import render
from pbonet.master.console.command_session import CommandSession
from pbonet.master.console.commands import COMMANDS, Command, Use
from pbonet.master.console.completion import complete
from pbonet.master.console.follow_events import Follower
from pbonet.master.subsystem import status_fields
from pbonet.master.subsystem.event_filter import EventFilter

EXAMPLES = Path(__file__).parents[3] / "examples"
SERVOING = EXAMPLES / "servoing"
PLACES = {
    inspect.Parameter.POSITIONAL_OR_KEYWORD,
    inspect.Parameter.KEYWORD_ONLY,
}
REFUSED = {
    "check": [{"job": "no_such"}],
    "clear": [{"task": ["nobody"]}, {"task": ["target"]}],
    "display": [{"variable": ["NO_SUCH"]}, {"task": "nobody"}],
    "events": [{"severity": "loud"}],
    "events count": [{"task": ["nobody"]}],
    "freq": [{"task": "nobody"}, {"task": "target", "hz": -1.0}],
    "get": [{"task": "nobody"}, {"task": "puma_pidg", "param": "no_such"}],
    "help": [{"command": "no_such"}],
    "kill": [{"task": ["nobody"]}, {"task": ["target", "qrdiff"], "text": "now"}],
    "library": [{"text": ["no_such"]}, {"class_": "no_such"}, {"out": "NO_SUCH_*"}],
    "network": [{"portname": "no name"}],
    "off": [{"task": ["nobody"]}, {"task": ["damped_ls"]}],
    "on": [{"task": ["target"]}, {"task": ["damped_ls", "qrint"]}],
    "profile": [{"task": ["nobody"]}],
    "profile save": [{"task": ["nobody"]}],
    "reconfig": [
        {"item": [("nobody", "off")]},
        {"item": [("target", "of")]},
        {"item": [("qrint", "on")]},
        {"item": [("damped_ls", "off"), ("target", "off")]},
    ],
    "reinit": [{"task": ["nobody"]}],
    "set": [
        {"task": "puma_pidg", "param": "kp", "value": ["-1"]},
        {"task": "puma_pidg", "param": "no_such", "value": ["1"]},
        {"task": "nobody"},
    ],
    "explain": [{"what": ["nobody"]}, {"what": ["miss"]}, {"what": ["miss", "nobody"]}],
    "sigmask": [{"signal": ["FINISHED"]}, {"signal": ["none"], "task": "nobody"}],
    "sigwait": [
        {"signal": ["FINISHED"]},
        {"task": "nobody"},
        {"timeout": -1.0},
        {"signal": ["FINISH"], "timeout": 0.5},
    ],
    "spawn": [
        {"rmod": "no_such"},
        {"rmod": "target"},
        {"rmod": "gain", "rtpu": "arm7"},
        {"rmod": "gain", "hz": 0.0},
    ],
    "start": [{"job": "no_such"}, {"job": "far"}, {"job": "far", "wait": 0.5}],
    "status": [{"task": ["nobody"]}, {"fields": "no_such"}],
    "status set": [{"field": ["no_such"]}],
    "swap": [
        {"old": "nobody", "new": "qrint"},
        {"old": "target", "new": "qrdiff"},
        {"old": "puma_inv_kin", "new": "damped_ls", "dry_run": True},
    ],
    "switch": [{"job": "no_such"}, {"job": "far"}, {"job": "far", "dry_run": True}],
    "wait": [{"seconds": -1.0}],
    "write": [
        {"variable": "NO_SUCH", "value": [1.0]},
        {"variable": "Q_REF", "value": [0.0] * 6},
    ],
}
"""What each command refuses; `quit` and `stop` refuse nothing."""
FAR = """JOB far
DESC
SBS {}
PRE X_MEZ[3] > 5 [m]
TASK puma_pidg
EOF
"""


def test_a_log_that_virtual_time_does_not_give_is_refused():
    """Else an option would do nothing."""
    job = SERVOING / "inverse.job"
    for mode in (None, "off"):
        assert not Subsystem(job, virtual=True, record=mode).recordings.wanted
    with pytest.raises(StateError, match="a program in virtual time writes no log"):
        Subsystem(job, virtual=True, record="outputs")
    with pytest.raises(LogError, match="this is not a recording mode"):
        Subsystem(job, record="everything")


@pytest.fixture
def arm(tmp_path):
    """The servoing example in virtual time, ON, with two controllers that stand by."""
    job = tmp_path / "far.job"
    with Subsystem(SERVOING / "inverse.job", virtual=True) as subsystem:
        job.write_text(FAR.format(SERVOING / "servoing.sbs"))
        subsystem.files.jobs_of_test = job
        subsystem.start()
        for rmod in ("damped_ls", "qrint"):
            subsystem.spawn(rmod, "arm1")
        subsystem.wait(0.1)
        yield subsystem


def test_events_of_a_task_that_never_was_are_refused(arm):
    with pytest.raises(UnknownTaskError, match=r"no task qrin .*did you mean qrint"):
        arm.events(task="qrin")
    follower = Follower(arm, EventFilter(task="qrin"))
    assert follower.take() == []
    assert "no task qrin " in follower.doubt


def test_events_of_a_task_that_has_ended_are_still_there(arm):
    arm.kill("qrint")
    assert arm.events(task="qrint", code="STATE")[-1].text == "killed"
    assert arm.events(task="qrint", code="FORCED") == []
    follower = Follower(arm, EventFilter(task="qrint"))
    assert follower.take()
    assert follower.doubt == ""


def call_of(subsystem, command):
    name = "library" if command.name == "module" else command.name
    return getattr(subsystem, name.replace(" ", "_"))


@pytest.mark.parametrize("command", COMMANDS, ids=lambda command: command.name)
def test_command_has_a_call_with_its_arguments(command: Command) -> None:
    call = call_of(Subsystem, command)
    found = dict(list(inspect.signature(call).parameters.items())[1:])
    assert list(found) == [arg.name for arg in command.args]
    for arg in command.args:
        parameter = found[arg.name]
        needed = parameter.default is inspect.Parameter.empty
        assert needed is (arg.need or arg.last), "a program has no task used last"
        assert parameter.kind in PLACES
        if arg.use is not Use.NAMED:
            assert parameter.kind is inspect.Parameter.POSITIONAL_OR_KEYWORD
    assert inspect.getdoc(call)


def test_every_command_that_can_be_refused_is_tried():
    names = {one.name for one in COMMANDS}
    assert set(REFUSED) == names - {"quit", "stop", "module"}, "module is library"


@pytest.mark.parametrize("command", COMMANDS, ids=lambda command: command.name)
def test_call_refuses_in_the_words_of_the_command(arm, command):
    desk = CommandSession(arm, hand_over=arm.network)
    for wanted in REFUSED.get(command.name, []):
        given = dict(wanted)
        if given.get("job") == "far":
            given["job"] = str(arm.files.jobs_of_test)
        with pytest.raises(PbonetError) as refused:
            call_of(arm, command)(**given)
        if command.name == "check":  # there an illegal job is an answer
            told = PbonetError.from_wire(desk.call("check", given).data["error"])
        else:
            with pytest.raises(PbonetError) as caught:
                desk.call(command.name, given)
            told = caught.value
        assert type(told) is type(refused.value)
        assert str(told) == str(refused.value)


def test_calls_do_what_the_commands_do(arm):
    assert arm.off(["target"]) == {"target": "OFF"}
    assert arm.reconfig([("target", "on")]) == {"target": "ON"}
    assert arm.on(("damped_ls",)) == {"damped_ls": "ON"}
    assert arm.kill("damped_ls") == {"damped_ls": "NOT-CREATED"}
    assert arm.status("qrint").state == "OFF"
    assert [one.task for one in arm.status(["qrint", "target"])] == ["target", "qrint"]
    (row,) = arm.status("target", fields="cycle,state")
    assert row.fields == {"cycle": 0, "state": "ON"}
    assert arm.wait(0.2)
    (row,) = arm.status("target", fields="cycle")
    assert row.fields == {"cycle": 5}, "since the last look of this program"
    assert arm.status_set("refF") == ("refF",)
    assert arm.status("target", fields=())[0].fields == {"refF": 25.0}
    assert arm.status_set("default") == status_fields.DEFAULT
    assert arm.freq("target", 50.0) == 50.0
    assert arm.set("puma_pidg", "kd", [9, 8, 7, 6, 5, 4])[0].value == [9, 8, 7, 6, 5, 4]
    assert arm.get("puma_pidg", "kd") == arm.set("puma_pidg", "kd")
    assert [one.name for one in arm.display("Q_*")] == ["Q_REF", "Q_MEZ"]
    assert {one.name for one in arm.display(writer="target")} == {"X_DES", "X^_DES"}
    assert arm.write("Q^_CMD", [0.5] * 6).values == [0.5] * 6
    assert [one.name for one in arm.library("gain")] == ["gain"]
    assert arm.events(1, task="target", code="STATE")[0].text == "turned on"
    counts = arm.events_count("target")
    told = {"rtpu": "arm1", "task": "target"}
    assert counts == [
        told | {"code": "FREQ", "count": 1},
        told | {"code": "SPAWNED", "count": 1},
        told | {"code": "STATE", "count": 3},
    ]
    found = arm.explain("puma_inv_kin")
    assert (found.kind, found.what) == ("task", "task puma_inv_kin on arm1 is ON")
    assert [one.name for one in arm.help("on")] == ["on"]
    assert len(arm.help()) == len(COMMANDS)


def test_causes_are_the_same_in_a_program_and_at_the_prompt(arm):
    """In virtual time nothing passes while it is asked."""
    before = arm.clock.now()
    arm.off("target")
    desk = CommandSession(arm)
    for line in ("", "X_DES", "miss puma_pidg", "start", "arm0"):
        found = arm.explain(line)
        reply = desk.execute(f"explain {line}")
        assert render.text("explain", reply.data) == str(found)
        assert found.unknown == ()
    text = str(arm.explain())
    assert "because equation 2: no task writes X_DES" in text
    assert "task target on arm1 is OFF" in text
    assert "do: turn it on again, by `swap` if another task writes" in text
    assert arm.clock.now() == before
    assert {"flag", "miss", "arm0", "target", "X_DES"} <= {*complete(desk, "explain ")}


def test_a_program_waits_for_signals_in_virtual_time(arm):
    with pytest.raises(NoAnswerError, match=r"no signal FINISH within 0.5 s"):
        arm.sigwait("FINISH", timeout=0.5)
    arm.sigmask("WARNING", "target")
    assert arm.sigmask() == {"target": ["WARNING"]}


def test_wait_ends_with_a_stop(arm):
    arm.off("puma_inv_kin")  # nothing is due for so long as nobody cares
    stopping = threading.Timer(0.05, arm.stop)
    stopping.start()
    assert not arm.wait(1e6)
    stopping.join()


def test_quit_ends_the_subsystem(arm):
    arm.quit()
    with pytest.raises(PbonetError, match="the subsystem is not open"):
        arm.status()


def test_virtual_time_passes_only_where_the_program_waits(arm):
    begin = arm.clock.now()
    assert arm.status("puma_pidg").cycle == 50
    arm.status_all()
    assert arm.clock.now() == begin
    arm.wait(1.0)
    assert arm.status("puma_pidg").cycle == 550
    assert len(arm.simulation.recording.arrays("puma_pidg")["cycle"]) == 550


def test_background_tasks_are_refused_in_virtual_time(arm, tmp_path):
    folder = tmp_path / "more"
    folder.mkdir()
    text = (SERVOING / "target.rmod").read_text()
    text = text.replace("periodic", "background").replace("FREQ      25", "")
    (folder / "idle.rmod").write_text(text)
    arm.files._folders.append(folder)
    with pytest.raises((PbonetError, StateError, VerificationError)):
        arm.spawn("idle")
