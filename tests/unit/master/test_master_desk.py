"""The command table and the desk: lines and maps become calls."""

from __future__ import annotations

import threading
from types import SimpleNamespace

import pytest

from pbonet.errors import ClaimError, NodeError, StateError, UnknownTaskError
from pbonet.master.console import commands, render
from pbonet.master.console.command_session import Desk, convert, split_name
from pbonet.master.console.commands import COMMANDS, Command, Scope, find
from pbonet.master.console.completion import complete
from pbonet.master.subsystem import status_fields
from pbonet.master.subsystem.argument_text import collector
from pbonet.master.subsystem.command_methods import Calls
from pbonet.pbo import State

THESIS = [
    *("clear", "display", "kill", "module", "network", "off", "on"),
    *("quit", "set", "spawn", "status"),
]


class Picture(dict):
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
        self.picture = Picture(
            pid=SimpleNamespace(
                name="pid",
                state=State.ON,
                info=SimpleNamespace(
                    params=[SimpleNamespace(name="kp"), SimpleNamespace(name="kd")]
                ),
            ),
            traj=SimpleNamespace(name="traj", state=State.OFF, info=None),
        )
        self.fleet = SimpleNamespace(names=["arm0", "arm1"])
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
        getattr(Calls, name) for name in ("on", "off", "kill", "clear", "reinit")
    )
    _signal, wait, help = Calls._signal, Calls.wait, Calls.help

    def __getattr__(self, name):
        def call(*args, **_):
            self.calls.append((name, *args))
            if name in {"get", "set", "display", "events"}:
                return []
            if name == "freq":
                return 100.0
            if name == "reconfig":
                return {}
            if name == "write":
                return None
            if name == "stop":
                return SimpleNamespace(off=["pid"], killed=[])
            return SimpleNamespace(
                state="ON", task="x", rtpu="arm0", module="m", version="1", ref_f=1.0
            )

        return call


@pytest.fixture
def stub():
    return Stub()


@pytest.fixture
def desk(stub):
    return Desk(stub)


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
        ("spawn diff", ("spawn", "diff", None, None)),
        ("spawn diff arm1 40", ("spawn", "diff", "arm1", 40.0)),
        ("freq pid 250", ("freq", "pid", 250.0)),
        ("freq pid", ("freq", "pid", None)),
        ("set pid kp 1 2 3", ("set", "pid", "kp", "1 2 3")),
        ("set pid kp", ("get", "pid", "kp")),
        ("get pid", ("get", "pid", None)),
        ("reconfig pid:off traj:on", ("reconfig", [("pid", "off"), ("traj", "on")])),
        ("display Q_*", ("display", ["Q_*"])),
        ("write T_REF 1 -2.5e-3", ("write", "T_REF", [1.0, -0.0025])),
        ("start home", ("start", "home")),
        ("stop", ("stop",)),
        ("on pid   # a comment", ("control", "pid", "on", "")),
    ],
)
def test_lines_become_calls(desk, stub, line, call):
    if line.startswith("start"):
        stub.start = lambda job, **_: stub.calls.append(("start", job)) or []
    desk.execute(line)
    assert last(stub) == call


def test_last_task_stands_in_and_shows_in_the_prompt(desk, stub):
    assert desk.prompt == "SBS arm<> "
    with pytest.raises(UnknownTaskError, match="no task is named"):
        desk.execute("on")
    desk.execute("off pid")
    assert desk.prompt == "SBS arm<pid> "
    for line, call in (
        ("on", ("control", "pid", "on", "")),
        ("freq 40", ("freq", "pid", 40.0)),
        ("set kp 2", ("set", "pid", "kp", "2")),
        ("get", ("get", "pid", None)),
    ):
        desk.execute(line)
        assert last(stub) == call
    desk.execute("on traj")
    assert desk.default == "traj"


def test_parameter_without_any_task_is_asked_back(desk):
    with pytest.raises(UnknownTaskError) as caught:
        desk.execute("set pidd kp 3")
    assert caught.value.remedy == "did you mean pid?"


@pytest.mark.parametrize(
    ("line", "message"),
    [
        ("spawn", "spawn: RMOD is missing"),
        ("spawn a b c d", "spawn: HZ is no number: c"),
        ("spawn a b 3 d", "spawn: one word too many: d"),
        ("freq pid fast", "freq: HZ is no number: fast"),
        ("reconfig pid", "reconfig: no TASK:SIGNAL, such as pid:off: pid"),
        ("reconfig", "reconfig: ITEM is missing"),
        ("freq pid nan", "freq: HZ is not finite: nan"),
        ("write Q_REF 1 inf", "write: VALUE is not finite: inf"),
        ("events -5", "events: LAST is below 0: -5"),
        ('on ""', "on: TASK is empty"),
        ("on " + 2000 * "x", "on: TASK has 2000 characters"),
        ("status fields=cycles", "status has no field cycles"),
        ("on 'pid", "the line is not understood"),
    ],
)
def test_wrong_lines_say_what_is_expected(desk, line, message):
    with pytest.raises(StateError) as caught:
        desk.execute(line)
    assert caught.value.what == message
    assert caught.value.expected or caught.value.remedy


def test_unknown_command_names_the_nearest(desk):
    with pytest.raises(NodeError) as caught:
        desk.execute("spwan pid")
    assert caught.value.remedy == "did you mean spawn?"


def test_blank_lines_and_comments_do_nothing(desk, stub):
    assert desk.execute("") is None
    assert desk.execute("  # nothing") is None
    assert stub.calls == []


def test_status_set_is_a_command_of_two_words(desk):
    assert split_name(["status", "set", "miss"])[0].name == "status set"
    assert split_name(["status", "pid"])[0].name == "status"
    desk.execute("status set rmod,miss mezF")
    assert desk.shown == ("rmod", "miss", "mezF")
    desk.execute("status set all")
    assert desk.shown == status_fields.NAMES
    assert desk.execute("status set default").data["shown"] == list(
        status_fields.DEFAULT
    )


def test_maps_give_the_same_calls(desk, stub):
    desk.call("spawn", {"rmod": "diff", "hz": 40})
    assert last(stub) == ("spawn", "diff", None, 40.0)
    desk.call("reconfig", {"item": [["pid", "off"], "traj:on"]})
    assert last(stub) == ("reconfig", [("pid", "off"), ("traj", "on")])
    desk.call("set", {"task": "pid", "param": "kp", "value": [1, 2.5]})
    assert last(stub) == ("set", "pid", "kp", "1 2.5")


@pytest.mark.parametrize(
    ("args", "message"),
    [
        ({"rmod": "a", "where": "b"}, "spawn has no argument where"),
        ({}, "spawn: RMOD is missing"),
        ({"rmod": ["a", "b"]}, "spawn: rmod is one value"),
        ({"rmod": "a", "hz": "x"}, "spawn: HZ is no number: x"),
    ],
)
def test_wrong_maps_are_refused(args, message):
    with pytest.raises(StateError) as caught:
        convert(find("spawn"), args)
    assert caught.value.what == message


def test_watcher_may_look_and_not_change():
    desk = Desk(Stub(watch=True))
    desk.execute("freq pid")
    desk.execute("set pid")
    for line in ("freq pid 3", "set pid kp 1", "on pid", "spawn diff"):
        with pytest.raises(ClaimError, match="open for watching only"):
            desk.execute(line)
    desk.execute("stop")


def test_warnings_come_with_the_reply(desk, stub):
    stub.stop = lambda: collector()("slow") or SimpleNamespace(off=[], killed=["a"])
    reply = desk.execute("stop")
    assert reply.warnings == ["slow"]
    assert render.text("stop", reply.data) == "ended by force: a"
    assert collector() is None


def test_warnings_of_commands_that_overlap_come_with_their_own_reply(stub):
    """A stop comes while another command runs, and ends after it."""
    stopping, started = threading.Event(), threading.Event()

    def start(_, **_wait):
        started.set()
        assert stopping.wait(10)
        collector()("of start")
        return []

    def stop():
        stopping.set()
        starter.join(10)
        collector()("of stop")
        return SimpleNamespace(off=[], killed=[])

    stub.start, stub.stop = start, stop
    replies = []
    starter = threading.Thread(
        target=lambda: replies.append(Desk(stub).execute("start"))
    )
    starter.start()
    assert started.wait(10)
    replies.append(Desk(stub).execute("stop"))
    assert [reply.warnings for reply in replies] == [["of start"], ["of stop"]]


@pytest.mark.parametrize("seconds", ["-1", "1e30"])
def test_nobody_waits_for_ever_or_backwards(stub, seconds):
    desk = Desk(stub, hand_over=print)
    with pytest.raises(StateError, match="this is no time limit"):
        desk.execute(f"wait {seconds}")


def test_a_client_of_the_network_keeps_nobody_waiting(desk):
    with pytest.raises(StateError, match="wait makes no sense here"):
        desk.execute("wait 1")


def test_what_may_be_left_out_can_be_given_by_name(desk, stub):
    desk.execute("spawn diff hz=40")
    assert last(stub) == ("spawn", "diff", None, 40.0)
    desk.execute("spawn diff rtpu=arm1")
    assert last(stub) == ("spawn", "diff", "arm1", None)
    desk.execute("set pid file task=3")  # all words that are left are the value
    assert last(stub) == ("set", "pid", "file", "task=3")


def test_events_shows_as_many_as_wanted(desk, stub):
    asked = []
    stub.events = lambda *last, **chosen: asked.append((*last, chosen)) or []
    assert desk.execute("events 0").data == {"events": []}
    desk.execute("events code=WARNING task=pid since=3")
    none = {"since": 0, "task": None, "code": None, "severity": None}
    assert asked[0] == (0, none)
    assert asked[1] == (20, none | {"since": 3, "task": "pid", "code": "WARNING"})


def test_task_that_is_gone_is_no_default(desk, stub):
    desk.execute("off pid")
    assert desk.prompt == "SBS arm<pid> "
    stub.control = lambda *_: (stub.picture.pop("pid"), SimpleNamespace(state="x"))[1]
    desk.execute("kill")
    assert desk.prompt == "SBS arm<> "
    with pytest.raises(UnknownTaskError, match="no task is named"):
        desk.execute("on")


def test_quit_ends_the_interface(desk):
    assert not desk.ended
    desk.execute("quit")
    assert desk.ended


def test_network_needs_an_interface_that_can_hand_over(desk, stub):
    with pytest.raises(StateError, match="network makes no sense here"):
        desk.execute("network onika")
    ports = []
    Desk(stub, hand_over=ports.append).execute("network onika")
    assert ports == ["onika"]


def test_help_covers_the_table(desk):
    shown = render.text("help", desk.execute("help").data)
    for command in COMMANDS:
        assert command.usage in shown
    one = render.text("help", desk.execute("help spawn").data)
    assert "spawn RMOD [RTPU] [HZ]" in one
    assert "frequency in place of the .rmod's" in one
    assert "  spawn jttrace arm1 25 " in one


def test_scopes_are_used():
    assert {command.scope for command in COMMANDS} == set(Scope)
    assert all(isinstance(command, Command) for command in commands.BY_NAME.values())


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("sp", ["spawn"]),
        ("st", ["start", "status", "stop"]),
        ("spawn ", ["diff", "pid", "traj"]),
        ("spawn diff a", ["arm0", "arm1"]),
        ("spawn diff ", ["arm0", "arm1", "hz="]),
        ("spawn diff rtpu=", ["rtpu=arm0", "rtpu=arm1"]),
        ("spawn diff rtpu=arm1 ", []),
        ("on ", ["text=", "traj"]),  # what is ON already is not offered
        ("off ", ["pid", "text="]),
        ("kill t", ["text=", "traj"]),
        ("set pid ", ["kd", "kp"]),
        ("display Q", ["Q_MEZ", "Q_REF"]),
        ("display task=", ["task=pid", "task=traj"]),
        ("module g", ["gain"]),
        ("start ", ["home", "teleop", "wait="]),
        ("status s", ["set"]),
        ("status set maxC mi", ["minC", "minU", "miss"]),
        ("reconfig pid:o", ["pid:off", "pid:on"]),
        ("help sp", ["spawn"]),
        ("nonsense x", []),
    ],
)
def test_completion_offers_what_there_is(desk, text, words):
    assert complete(desk, text) == words


def test_completion_of_parameters_knows_the_last_task(desk):
    desk.execute("off pid")
    assert complete(desk, "set k") == ["kd", "kp"]
