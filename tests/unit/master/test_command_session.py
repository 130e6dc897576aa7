"""The command table and the session: lines and maps become calls."""

from __future__ import annotations

import threading
from types import SimpleNamespace

import pytest

from pbonet.errors import ClaimError, NodeError, StateError, UnknownTaskError
from pbonet.master import Subsystem
from pbonet.master.console import commands, render
from pbonet.master.console.command_session import CommandSession, convert, split_name
from pbonet.master.console.commands import COMMANDS, Command, Scope, find
from pbonet.master.console.completion import complete
from pbonet.master.subsystem import status_fields
from pbonet.master.subsystem.argument_text import collector
from pbonet.pbo import State
from pbonet.xm.net.messages import Stopped

THESIS = [
    *("clear", "display", "kill", "module", "network", "off", "on"),
    *("quit", "set", "spawn", "status"),
]


class TaskModel(dict):
    @property
    def names(self):
        return list(self.keys())

    def __iter__(self):
        return iter(self.values())

    def __contains__(self, name):
        return name in self.keys()


class Stub:
    """Records what the actions ask of the subsystem."""

    def __init__(self, watch=False):
        self.name = "arm"
        self.watch = watch
        self.warned = print
        self.calls = []
        self.model = TaskModel(
            pid=SimpleNamespace(
                name="pid",
                state=State.ON,
                info=SimpleNamespace(
                    params=[SimpleNamespace(name="kp"), SimpleNamespace(name="kd")]
                ),
            ),
            traj=SimpleNamespace(name="traj", state=State.OFF, info=None),
        )
        self.clients = SimpleNamespace(names=["arm0", "arm1"])
        table = SimpleNamespace(
            variables=[SimpleNamespace(name=n) for n in ("Q_MEZ", "Q_REF", "T_REF")]
        )
        self.files = SimpleNamespace(
            table=table,
            rmods=lambda: ["pid", "traj", "diff"],
            jobs=lambda: ["home", "teleop"],
            library=SimpleNamespace(modules=lambda: ("diff", "gain")),
        )

    on, off, kill, clear, reinit = (
        getattr(Subsystem, name) for name in ("on", "off", "kill", "clear", "reinit")
    )
    _signal, wait, help = Subsystem._signal, Subsystem.wait, Subsystem.help

    def __getattr__(self, name):
        def call(*args, **named):
            self.calls.append((name, *args, *named.values()))
            if name in {"get", "set", "display", "events"}:
                return []
            if name == "freq":
                return 100.0
            if name == "reconfig":
                return {}
            if name == "write":
                return None
            if name == "stop":
                return Stopped(off=["pid"], killed=[])
            return SimpleNamespace(
                state="ON", task="x", rtpu="arm0", module="m", version="1", ref_f=1.0
            )

        return call


@pytest.fixture
def stub():
    return Stub()


@pytest.fixture
def session(stub):
    return CommandSession(stub)


def last(stub):
    return stub.calls[-1]


def test_the_eleven_commands_of_the_thesis_and_what_the_issue_adds():
    names = {command.name for command in COMMANDS}
    assert set(THESIS) <= names
    assert {"freq", "reconfig", "start", "stop", "check", "help"} <= names


def test_commands_are_documented_and_have_unambiguous_arguments():
    for command in COMMANDS:
        assert command.help.endswith("."), command.name
        names = [arg.name for arg in command.args]
        assert len(names) == len(set(names)), command.name
        plain = [arg for arg in command.args if not arg.option]
        assert not any(arg.many for arg in plain[:-1]), command.name


@pytest.mark.parametrize(
    ("line", "call"),
    [
        ("on pid", ("control", "pid", "on", "")),
        ("on pid text='go home'", ("control", "pid", "on", "go home")),
        ("off pid traj", ("reconfig", [("pid", "off"), ("traj", "off")])),
        ("spawn diff", ("spawn", "diff")),
        ("spawn diff arm1 40", ("spawn", "diff", "arm1", 40.0)),
        ("freq pid 250", ("freq", "pid", 250.0)),
        ("freq pid", ("freq", "pid")),
        ("set pid kp 1 2 3", ("set", "pid", "kp", ["1", "2", "3"])),
        ("set pid kp", ("set", "pid", "kp")),
        ("get pid", ("get", "pid")),
        ("reconfig pid:off traj:on", ("reconfig", [("pid", "off"), ("traj", "on")])),
        ("display Q_*", ("display", ["Q_*"])),
        ("write T_REF 1 -2.5e-3", ("write", "T_REF", [1.0, -0.0025])),
        ("start home", ("start", "home")),
        ("stop", ("stop",)),
        ("on pid   # a comment", ("control", "pid", "on", "")),
    ],
)
def test_lines_become_calls(session, stub, line, call):
    if line.startswith("start"):
        stub.start = lambda job: stub.calls.append(("start", job)) or []
    session.execute(line)
    assert last(stub) == call


def test_last_task_stands_in_and_shows_in_the_prompt(session, stub):
    assert session.prompt == "SBS arm<> "
    with pytest.raises(UnknownTaskError, match="no task is named"):
        session.execute("on")
    session.execute("off pid")
    assert session.prompt == "SBS arm<pid> "
    for line, call in (
        ("on", ("control", "pid", "on", "")),
        ("freq 40", ("freq", "pid", 40.0)),
        ("set kp 2", ("set", "pid", "kp", ["2"])),
        ("get", ("get", "pid")),
    ):
        session.execute(line)
        assert last(stub) == call
    session.execute("on traj")
    assert session.default == "traj"


def test_parameter_without_any_task_is_asked_back(session):
    with pytest.raises(UnknownTaskError) as caught:
        session.execute("set pidd kp 3")
    assert caught.value.remedy == "did you mean pid?"


@pytest.mark.parametrize(
    ("line", "message"),
    [
        ("spawn", "spawn: RMOD is missing"),
        ("spawn a b c d", "spawn: HZ is not a number: c"),
        ("spawn a b 3 d", "spawn: one word too many: d"),
        ("freq pid fast", "freq: HZ is not a number: fast"),
        ("reconfig pid", "reconfig: no TASK:SIGNAL, such as pid:off: pid"),
        ("reconfig", "reconfig: ITEM is missing"),
        ("freq pid nan", "freq: HZ is not finite: nan"),
        ("write Q_REF 1 inf", "write: VALUE is not finite: inf"),
        ("events -5", "events: LAST is below 0: -5"),
        ('on ""', "on: TASK is empty"),
        ("on " + 2000 * "x", "on: TASK has 2000 characters"),
        ("status fields=cycles", "status has no field cycles"),
        ("status fields=state, refF", "the columns end with a comma"),
        ("on 'pid", "the line is not understood"),
    ],
)
def test_wrong_lines_say_what_is_expected(session, line, message):
    with pytest.raises(StateError) as caught:
        session.execute(line)
    assert caught.value.what == message
    assert caught.value.expected or caught.value.remedy


def test_unknown_command_names_the_nearest(session):
    with pytest.raises(NodeError) as caught:
        session.execute("spwan pid")
    assert caught.value.remedy == "did you mean spawn?"


def test_blank_lines_and_comments_do_nothing(session, stub):
    assert session.execute("") is None
    assert session.execute("  # nothing") is None
    assert stub.calls == []


def test_status_set_is_a_command_of_two_words(session):
    assert split_name(["status", "set", "miss"])[0].name == "status set"
    assert split_name(["status", "pid"])[0].name == "status"
    session.execute("status set 'rmod, miss' mezF")
    assert session.shown == ("rmod", "miss", "mezF")
    session.execute("status set all")
    assert session.shown == status_fields.NAMES
    assert session.execute("status set default").data["shown"] == list(
        status_fields.DEFAULT
    )


def test_maps_give_the_same_calls(session, stub):
    session.call("spawn", {"rmod": "diff", "hz": 40})
    assert last(stub) == ("spawn", "diff", 40.0)
    session.call("reconfig", {"item": [["pid", "off"], "traj:on"]})
    assert last(stub) == ("reconfig", [("pid", "off"), ("traj", "on")])
    session.call("set", {"task": "pid", "param": "kp", "value": [1, 2.5]})
    assert last(stub) == ("set", "pid", "kp", ["1", "2.5"])


@pytest.mark.parametrize(
    ("args", "message"),
    [
        ({"rmod": "a", "where": "b"}, "spawn has no argument where"),
        ({}, "spawn: RMOD is missing"),
        ({"rmod": ["a", "b"]}, "spawn: rmod is one value"),
        ({"rmod": "a", "hz": "x"}, "spawn: HZ is not a number: x"),
    ],
)
def test_wrong_maps_are_refused(args, message):
    with pytest.raises(StateError) as caught:
        convert(find("spawn"), args)
    assert caught.value.what == message


def test_watcher_may_look_and_not_change():
    session = CommandSession(Stub(watch=True))
    session.execute("freq pid")
    session.execute("set pid")
    for line in ("freq pid 3", "set pid kp 1", "on pid", "spawn diff"):
        with pytest.raises(ClaimError, match="open for reading only"):
            session.execute(line)
    session.execute("stop")


def test_warnings_come_with_the_reply(session, stub):
    stub.stop = lambda: collector()("slow") or Stopped(off=[], killed=["a"])
    reply = session.execute("stop")
    assert reply.warnings == ["slow"]
    assert render.text("stop", reply.data) == "ended by force: a"
    assert collector() is None


def test_warnings_of_commands_that_overlap_come_with_their_own_reply(stub):
    """A stop comes while another command runs, and ends after it."""
    stopping, started = threading.Event(), threading.Event()

    def start():
        started.set()
        assert stopping.wait(10)
        collector()("of start")
        return []

    def stop():
        stopping.set()
        starter.join(10)
        collector()("of stop")
        return Stopped(off=[], killed=[])

    stub.start, stub.stop = start, stop
    replies = []
    starter = threading.Thread(
        target=lambda: replies.append(CommandSession(stub).execute("start"))
    )
    starter.start()
    assert started.wait(10)
    replies.append(CommandSession(stub).execute("stop"))
    assert [reply.warnings for reply in replies] == [["of start"], ["of stop"]]


@pytest.mark.parametrize("seconds", ["-1", "1e30"])
def test_nobody_waits_for_ever_or_backwards(stub, seconds):
    session = CommandSession(stub, hand_over=print)
    with pytest.raises(StateError, match="this is not a valid time limit"):
        session.execute(f"wait {seconds}")


def test_a_client_of_the_network_keeps_nobody_waiting(session):
    with pytest.raises(StateError, match="wait is not available here"):
        session.execute("wait 1")


def test_what_may_be_left_out_can_be_given_by_name(session, stub):
    session.execute("spawn diff hz=40")
    assert last(stub) == ("spawn", "diff", 40.0)
    session.execute("spawn diff rtpu=arm1")
    assert last(stub) == ("spawn", "diff", "arm1")
    session.execute("set pid file task=3")  # all words that are left are the value
    assert last(stub) == ("set", "pid", "file", ["task=3"])


def test_events_shows_as_many_as_wanted(session, stub):
    asked = []
    stub.events = lambda **chosen: asked.append(chosen) or []
    assert session.execute("events 0").data == {"events": []}
    session.execute("events code=WARNING task=pid since=3")
    assert asked[0] == {"last": 0}
    chosen = {"since": "3", "task": "pid", "code": "WARNING"}
    assert asked[1] == {"last": 20, **chosen}


def test_task_that_is_gone_is_no_default(session, stub):
    session.execute("off pid")
    assert session.prompt == "SBS arm<pid> "
    stub.control = lambda *_: (stub.model.pop("pid"), SimpleNamespace(state="x"))[1]
    session.execute("kill")
    assert session.prompt == "SBS arm<> "
    with pytest.raises(UnknownTaskError, match="no task is named"):
        session.execute("on")


def test_quit_ends_the_interface(session):
    assert not session.ended
    session.execute("quit")
    assert session.ended


def test_network_needs_an_interface_that_can_hand_over(session, stub):
    with pytest.raises(StateError, match="network is not available here"):
        session.execute("network onika")
    ports = []
    CommandSession(stub, hand_over=ports.append).execute("network onika")
    assert ports == ["onika"]


def test_help_covers_the_table(session):
    shown = render.text("help", session.execute("help").data)
    for command in COMMANDS:
        assert command.usage in shown
    one = render.text("help", session.execute("help spawn").data)
    assert "spawn RMOD [RTPU] [HZ]" in one
    assert "frequency; that of the .rmod if left out" in one
    assert "  spawn jttrace arm1 25 " in one


def test_scopes_are_used():
    assert {command.scope for command in COMMANDS} == set(Scope)
    assert all(isinstance(command, Command) for command in commands.BY_NAME.values())


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("sp", ["spawn"]),
        ("st", ["start", "status", "stop"]),
        ("spawn ", ["diff", "keep=", "pid", "traj"]),
        ("spawn diff a", ["arm0", "arm1"]),
        ("spawn diff ", ["arm0", "arm1", "hz=", "keep="]),
        ("spawn diff rtpu=", ["rtpu=arm0", "rtpu=arm1"]),
        ("spawn diff rtpu=arm1 ", ["keep="]),
        ("on ", ["text=", "traj"]),  # what is ON already is not offered
        ("off ", ["pid", "text="]),
        ("kill t", ["text=", "traj"]),
        ("set pid ", ["kd", "kp"]),
        ("display Q", ["Q_MEZ", "Q_REF"]),
        ("display task=", ["task=pid", "task=traj"]),
        ("library g", ["gain"]),
        ("library class=k", ["class=kinematics"]),
        ("start ", ["home", "teleop", "wait="]),
        ("status s", ["set"]),
        ("status set maxC mi", ["minC", "minU", "miss"]),
        ("reconfig pid:o", ["pid:off", "pid:on"]),
        ("help sp", ["spawn"]),
        ("nonsense x", []),
    ],
)
def test_completion_offers_what_there_is(session, text, words):
    assert complete(session, text) == words


def test_completion_of_parameters_knows_the_last_task(session):
    session.execute("off pid")
    assert complete(session, "set k") == ["kd", "kp"]
