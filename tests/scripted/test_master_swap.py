"""Swap and switch against agents without tasks: what is computed, refused, told."""

from __future__ import annotations

import json

import pytest
from watching import states

from pbonet import cli
from pbonet.errors import (
    ClaimError,
    ConfigError,
    MethodError,
    ReconfigError,
    SeveralError,
    StateError,
    UnknownTaskError,
    UnreachableError,
    VerificationError,
)
from pbonet.master.configuration.environment import Place
from pbonet.master.console import oneshot, render
from pbonet.master.console.command_session import CommandSession
from pbonet.master.console.network_interface import Port
from pbonet.master.subsystem.subsystem import Subsystem

ON = {"puma_pidg": "ON", "grav_comp": "ON", "qrdiff": "ON", "jttrace": "ON"}
OTHER_JOB = """
JOB   follow
DESC  follows another trace
SBS   puma.sbs
TASK  puma_pidg  arm0
TASK  grav_comp  arm1
TASK  trace2     arm1
TASK  qrdiff2    arm0
EOF
"""


@pytest.fixture
def files(puma):
    """The example's files with a second trace and a second differentiator."""
    from pbonet.config.library import Library

    library = Library([])
    for name in ("jttrace", "qrdiff", "grav_comp"):
        text = library.find_rmod(name).read_text()
        other = {"jttrace": "trace2", "qrdiff": "qrdiff2", "grav_comp": "grav2"}[name]
        (puma.parent / f"{other}.rmod").write_text(text)
    (puma.parent / "follow.job").write_text(OTHER_JOB)
    return puma


@pytest.fixture
def arm(world, agents, files):
    """The job of the example, ON; warnings are in ``arm.heard``."""
    agents("arm0", "arm1")
    subsystem = Subsystem(files, domain=world.domain)
    subsystem.heard = []
    subsystem.warned = subsystem.heard.append
    subsystem.open()
    subsystem.start("puma")
    world.log.clear()
    yield subsystem
    subsystem.detach()


def steps(world):
    """Return what the agents did to tasks."""
    known = {"spawn", "on", "off", "kill"}
    return [text for _, text in world.log if text.split()[0] in known]


# -- swap ----------------------------------------------------------------------------


def test_swap_spawns_first_and_keeps_the_old_one(arm, world, agents):
    done = arm.swap("jttrace", "trace2")
    assert steps(world) == ["spawn trace2", "off jttrace", "on trace2"]
    assert states(arm) == {**ON, "jttrace": "OFF", "trace2": "ON"}
    assert done.spawns == {"trace2": "arm1"}  # beside the old one
    assert done.items == [("jttrace", "off"), ("trace2", "on")]
    assert set(done.stays) == {"puma_pidg", "grav_comp", "qrdiff"}
    assert done.kills == []
    assert done.states == {"jttrace": "OFF", "trace2": "ON"}
    assert agents["arm0"].flags == []
    world.log.clear()
    arm.swap("trace2", "jttrace")
    assert steps(world) == ["off trace2", "on jttrace"]
    assert arm.heard == []


def test_swap_is_one_message_on_one_rtpu_and_two_on_two(arm, world, agents):
    def lists():
        return [
            (name, request.items, request.handover)
            for name, agent in agents.items()
            for request in agent.requests
            if hasattr(request, "items")
        ]

    arm.swap(["jttrace", "qrdiff"], ["trace2", "qrdiff2"])
    ((name, items, _),) = lists()
    assert name == "arm1"
    assert items == [
        ("jttrace", "off"),
        ("trace2", "on"),
        ("qrdiff", "off"),
        ("qrdiff2", "on"),
    ]
    for agent in agents.values():
        agent.requests.clear()
    arm.swap("grav_comp", "grav2", rtpu="arm0")
    assert sorted(lists()) == [
        ("arm0", [("grav2", "on")], {"grav_comp": ["T_GRAV"]}),
        ("arm1", [("grav_comp", "off")], {"grav_comp": ["T_GRAV"]}),
    ]
    assert steps(world)[-2:] == ["off grav_comp", "on grav2"]


def test_tasks_on_both_sides_of_a_swap_stay(arm, world):
    done = arm.swap(["jttrace", "qrdiff"], ["qrdiff", "trace2"])
    assert steps(world) == ["spawn trace2", "off jttrace", "on trace2"]
    assert "qrdiff" in done.stays


def test_dry_run_says_and_does_nothing(arm, world):
    done = arm.swap("jttrace", "trace2", dry_run=True)
    assert done.items == [("jttrace", "off"), ("trace2", "on")]
    assert (done.spawns, done.states) == ({"trace2": "arm1"}, {})
    assert steps(world) == []
    with Subsystem(arm.files.path, domain=world.domain, watch=True) as watcher:
        reply = CommandSession(watcher).execute("switch follow dry_run=yes")
        with pytest.raises(ClaimError):
            CommandSession(watcher).execute("switch follow")
    assert reply.data["kills"] == ["qrdiff", "jttrace"]
    assert steps(world) == []
    with pytest.raises(VerificationError, match="T_GRAV"):
        arm.swap("grav_comp", "trace2", dry_run=True)


def test_swap_that_would_be_illegal_does_nothing(arm, world):
    with pytest.raises(VerificationError) as caught:
        arm.swap("grav_comp", "trace2")
    text = str(caught.value)
    assert "no task that is ON writes T_GRAV, which puma_pidg" in text
    assert "turn grav_comp on" in text
    assert "jttrace and trace2 both write Q_REF" in text
    assert steps(world) == []
    assert states(arm) == ON


def test_swap_with_a_wrong_name_does_nothing(arm, world):
    with pytest.raises(UnknownTaskError, match="did you mean jttrace"):
        arm.swap("jttrase", "trace2")
    with pytest.raises(ConfigError, match="there is no RMOD trace3"):
        arm.swap("jttrace", "trace3")
    with pytest.raises(VerificationError, match="no task is named"):
        arm.swap("jttrace", [])
    arm.swap("jttrace", "trace2")
    with pytest.raises(StateError, match="is on another RTPU"):
        arm.swap("trace2", "jttrace", rtpu="arm0")
    assert steps(world) == ["spawn trace2", "off jttrace", "on trace2"]


def test_spawn_that_fails_leaves_everything_as_it_was(arm, world, agents):
    agents["arm1"].fail["spawn", "qrdiff2"] = MethodError("init raised", where="x")
    with pytest.raises(MethodError, match="init raised"):
        arm.swap(["jttrace", "qrdiff"], ["trace2", "qrdiff2"])
    assert states(arm) == ON
    assert steps(world) == ["spawn trace2", "kill trace2"]
    agents["arm1"].fail["kill", "trace2"] = MethodError("kill raised", where="x")
    with pytest.raises(SeveralError, match="the change was not begun, and not all"):
        arm.swap(["jttrace", "qrdiff"], ["trace2", "qrdiff2"])


def test_swap_again_does_what_is_left(arm, world, agents):
    agents["arm1"].fail["on", "trace2"] = MethodError("on raised", where="x")
    with pytest.raises(ReconfigError) as caught:
        arm.swap(["jttrace", "qrdiff"], ["trace2", "qrdiff2"])
    assert str(caught.value) == (
        "arm1/x: item 2 of 4, on trace2: on raised; "
        "done: off jttrace; not sent: off qrdiff, on qrdiff2"
    )
    assert agents["arm0"].flags != []  # no task writes Q_REF now
    agents["arm1"].fail.clear()
    world.log.clear()
    done = arm.swap(["jttrace", "qrdiff"], ["trace2", "qrdiff2"])
    assert steps(world) == ["on trace2", "off qrdiff", "on qrdiff2"]
    assert done.spawns == {}
    world.log.clear()
    assert arm.swap(["jttrace", "qrdiff"], ["trace2", "qrdiff2"]).items == []
    assert steps(world) == []


def test_the_rest_of_a_list_can_be_sent(arm, agents):
    agents["arm1"].fail["on", "trace2"] = MethodError("on raised", where="x")
    with pytest.raises(ReconfigError) as caught:
        arm.swap(["jttrace", "qrdiff"], ["trace2", "qrdiff2"])
    agents["arm1"].fail.clear()
    arm.reconfig(caught.value.rest)
    assert states(arm) == {
        **ON,
        "jttrace": "OFF",
        "qrdiff": "OFF",
        "trace2": "ON",
        "qrdiff2": "ON",
    }


def test_an_agent_that_is_silent_is_told_from_one_that_refused(arm, agents):
    arm.spawn("trace2", "arm1")
    slow = agents["arm1"]
    original = slow.do_reconfig

    def carried_out_but_never_answered(request):
        original(request)
        raise UnreachableError("gone")

    slow.do_reconfig = carried_out_but_never_answered
    with pytest.raises(ReconfigError) as caught:
        arm.swap("jttrace", "trace2")
    assert "sent, and not known whether done: off jttrace, on trace2" in str(
        caught.value
    )
    assert caught.value.done == 0
    assert isinstance(caught.value.__cause__, UnreachableError)


def test_the_items_of_a_list_may_be_lists_themselves(arm, world):
    """As JSON has them; constants that a task gives are looked for by its item."""
    assert arm.reconfig([["puma_pidg", "reinit"]]) == {"puma_pidg": "ON"}
    assert ("arm0", "reinit puma_pidg") in world.log


# -- switch --------------------------------------------------------------------------


def test_switch_keeps_what_both_have_and_kills_the_rest(arm, world):
    done = arm.switch("follow")
    assert steps(world) == [
        "spawn trace2",
        "spawn qrdiff2",
        "off jttrace",
        "on trace2",
        "off qrdiff",
        "on qrdiff2",
        "kill qrdiff",
        "kill jttrace",
    ]
    after = {"puma_pidg": "ON", "grav_comp": "ON", "trace2": "ON", "qrdiff2": "ON"}
    assert states(arm) == after
    assert done.stays == ["puma_pidg", "grav_comp"]
    assert done.spawns == {"trace2": "arm1", "qrdiff2": "arm0"}
    world.log.clear()
    assert arm.switch("follow").items == []
    arm.switch("puma")
    assert states(arm) == ON


def test_switch_leaves_what_stands_by(arm):
    arm.spawn("grav2", "arm0")
    arm.switch("follow")
    assert states(arm)["grav2"] == "OFF"


def test_switch_from_nothing_is_a_start(arm, world):
    for task in ("puma_pidg", "qrdiff", "jttrace", "grav_comp"):
        arm.control(task, "kill")
    world.log.clear()
    arm.switch("puma")
    assert states(arm) == ON
    assert steps(world)[-1] == "on puma_pidg"  # CRITICAL, so last


def test_switch_to_less_is_refused_when_it_is_illegal(arm, files, world):
    text = OTHER_JOB.replace("TASK  grav_comp  arm1\n", "").replace("follow", "less")
    (files.parent / "less.job").write_text(text)
    with pytest.raises(VerificationError, match="T_GRAV"):
        arm.switch("less")
    text = text.replace("TASK  trace2     arm1\n", "")
    less = text.replace("TASK  qrdiff2    arm0\n", "TASK  grav_comp  arm1\n")
    (files.parent / "less.job").write_text(less)
    with pytest.raises(VerificationError, match="Q_REF"):
        arm.switch("less")  # nothing is turned on, and yet
    assert steps(world) == []


def test_switch_refuses_a_namesake(arm, files, world):
    (files.parent / "follow.job").write_text(
        OTHER_JOB.replace("grav_comp  arm1", "grav_comp  arm1 FREQ 100")
    )
    with pytest.raises(StateError, match="'freq grav_comp 100' first"):
        arm.switch("follow")
    (files.parent / "follow.job").write_text(
        OTHER_JOB.replace("grav_comp  arm1", "grav_comp  arm0")
    )
    with pytest.raises(StateError, match="is in the way"):
        arm.switch("follow")
    assert steps(world) == []


def test_kill_that_fails_says_that_the_rest_is_done(arm, agents):
    agents["arm1"].fail["kill", "qrdiff"] = MethodError("kill raised", where="x")
    with pytest.raises(ReconfigError) as caught:
        arm.switch("follow")
    assert str(caught.value) == (
        "arm1/x: item 5 of 6, kill qrdiff: kill raised; done: off jttrace, on trace2, "
        "off qrdiff, on qrdiff2; not sent: kill jttrace"
    )


def test_nobody_is_killed_for_tasks_of_which_an_rtpu_does_not_tell(arm, agents, world):
    silent = agents["arm0"]
    original = silent.do_reconfig

    def tells_no_more(request):
        silent.fail["status", None] = UnreachableError("gone")
        return original(request)

    silent.do_reconfig = tells_no_more
    with pytest.raises(ReconfigError, match="item 5 of 6, kill qrdiff: gone") as caught:
        arm.switch("follow")
    assert caught.value.rest == (("qrdiff", "kill"), ("jttrace", "kill"))
    assert not [text for text in steps(world) if "kill" in text]
    assert arm.heard == []
    silent.fail.clear()
    silent.do_reconfig = original
    arm.reconfig(caught.value.rest)
    assert set(states(arm)) == {"puma_pidg", "grav_comp", "trace2", "qrdiff2"}


# -- commands ------------------------------------------------------------------------


def test_commands_at_the_prompt(arm):
    desk = CommandSession(arm)
    reply = desk.execute("swap jttrace,grav_comp trace2,grav2 rtpu=arm1")
    assert reply.data["states"]["trace2"] == "ON"
    assert desk.default == "grav2"
    reply = desk.call("switch", {"job": "follow", "dry_run": True})
    assert (reply.data["kills"], reply.data["states"]) == (["qrdiff", "grav2"], {})
    told, *steps = render.text("switch", reply.data).splitlines()
    assert told.startswith("POST of teleop holds: max(abs(Q^_MEZ)) < 0.1 [rad/s] (")
    assert steps == [
        "spawn qrdiff2 on arm0",
        "off qrdiff",
        "on qrdiff2",
        "off grav2",
        "on grav_comp",
        "kill qrdiff",
        "kill grav2",
        "stays ON: puma_pidg, trace2",
    ]
    for line in (
        "switch",
        "swap jttrace",
        "swap , trace2",
        "switch follow dry_run=perhaps",
    ):
        with pytest.raises((StateError, ConfigError, VerificationError)):
            desk.execute(line)
    assert json.dumps(reply.data)


def test_verbs_name_the_job_by_its_file(arm, files, world, capsys):
    def verb(*words):
        with pytest.raises(SystemExit) as caught:
            cli.main([*map(str, words), "--domain", world.domain])
        told = capsys.readouterr()
        return caught.value.code or 0, told.out or told.err

    job = files.parent / "follow.job"
    status, text = verb("switch", job, "--dry-run")
    assert (status, text.splitlines()[-1]) == (0, "stays ON: puma_pidg, grav_comp")
    assert steps(world) == []
    status, text = verb("switch", job)
    assert status == 1
    assert "another master steers the subsystem" in text
    arm.detach()
    status, text = verb("switch", job)
    assert (status, text.splitlines()[-2]) == (0, "stays ON: puma_pidg, grav_comp")
    assert "on trace2" in steps(world)
    status, text = verb("swap", files, "trace2", "jttrace", "--json")
    assert (status, json.loads(text)["states"]["jttrace"]) == (0, "ON")


def test_a_verb_asks_the_master_that_lives_for_the_job_it_names(arm, files, world):
    with Port(arm, arm.name, handover=False):
        place = Place(domain=world.domain)
        args = {"job": None, "dry_run": False}
        reply = oneshot.run(files.parent / "follow.job", "switch", args, place)
    assert reply.data["kills"] == ["qrdiff", "jttrace"]
    assert "trace2" in states(arm)
