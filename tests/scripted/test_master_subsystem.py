"""A master against agents without tasks: claims, verification, orders, roll-back."""

from __future__ import annotations

import math
import os
import signal
import threading

import pytest
from watching import states, wait_for

from pbonet.errors import (
    ClaimError,
    ConfigError,
    MethodError,
    ModuleLoadError,
    NodeError,
    ParameterError,
    ReconfigError,
    SeveralError,
    StateError,
    UnknownTaskError,
    UnknownVariableError,
    UnreachableError,
    VerificationError,
)
from pbonet.master.subsystem.subsystem import Subsystem
from pbonet.master.subsystem.unwritten_inputs import UNFED
from pbonet.xm.net import messages as m, rpc

ON = {"puma_pidg": "ON", "grav_comp": "ON", "qrdiff": "ON", "jttrace": "ON"}


@pytest.fixture
def robot(arm):
    """The same with the robot's task OFF, which gives the constants."""
    arm.spawn("puma_pidg", "arm0")
    return arm


def other(arm, world, **kwargs):
    return Subsystem(arm.files.path, domain=world.domain, **kwargs)


# -- opening -------------------------------------------------------------------------


def test_keeper_opens_the_table_before_the_others(arm, world):
    assert arm.sbs.keeper == "arm0"
    assert world.log == [
        ("arm0", "open table keep=True"),
        ("arm1", "open table keep=False"),
    ]


def test_agent_that_is_missing_is_named_and_nothing_stays_claimed(
    world, agents, puma, monkeypatch
):
    """At once: whoever waited for it, would wait for ever here."""
    for name in ("ANSWER_TIME", "_ALONE_TIME", "PROOF_TIME"):
        monkeypatch.setattr(rpc, name, 86_400.0)
    agents("arm0")
    with pytest.raises(UnreachableError, match=r"^arm1: no agent of this name"):
        Subsystem(puma, domain=world.domain).open()
    assert agents["arm0"].claims == {}


def test_no_agent_at_all_is_said_at_once(world, puma):
    with pytest.raises(UnreachableError, match="no agent of domain"):
        Subsystem(puma, domain=world.domain).open()


def test_all_rtpus_that_cannot_be_had_come_as_one_tree(world, agents, puma):
    agents("leg")
    with pytest.raises(SeveralError) as caught:
        Subsystem(puma, domain=world.domain).open()
    lines = str(caught.value).splitlines()
    assert lines[0] == "2 of 2 RTPUs of the subsystem puma cannot be had"
    assert lines[1].startswith("|-- arm0: no agent of this name can be reached")
    assert lines[2].startswith("`-- arm1: no agent of this name can be reached")


def test_second_master_is_refused_while_the_first_lives(arm, world):
    with pytest.raises(SeveralError) as caught:
        other(arm, world).open()
    assert all(isinstance(error, ClaimError) for error in caught.value.errors)
    assert arm.clients.client.name in str(caught.value)


def test_master_that_takes_over_locks_the_former_out(robot, world):
    robot.spawn("jttrace", "arm1")
    with other(robot, world, take_over=True) as successor:
        assert [member.name for member in successor.model] == ["puma_pidg", "jttrace"]
        with pytest.raises(ClaimError, match="another master has taken over"):
            robot.control("jttrace", "on")
        successor.control("jttrace", "on")
        successor.detach()


def test_a_take_over_that_one_rtpu_refuses_takes_none(robot, world, agents):
    robot.spawn("jttrace", "arm1")
    agents["arm1"].claims["leg"] = (1, "another")
    with pytest.raises(ClaimError, match=r"^arm1: the RTPU belongs to another"):
        other(robot, world, take_over=True).open()
    robot.control("puma_pidg", "on")
    robot.control("jttrace", "on")


def test_a_take_over_that_fails_later_releases_nothing_of_the_old_master(
    robot, world, agents
):
    robot.spawn("jttrace", "arm0")
    agents["arm0"].fail["open table", ""] = NodeError("no room", where="arm0")
    with pytest.raises(NodeError, match="no room"):
        other(robot, world, take_over=True).open()
    assert "puma" in agents["arm1"].claims, "though it has no tasks"


def test_critical_tasks_that_are_on_are_taken_over_only_when_confirmed(robot, world):
    asked = []

    def confirm(question):
        asked.append(question)
        return len(asked) > 1

    robot.control("puma_pidg", "on")
    master = robot.clients.client.name
    with pytest.raises(ClaimError) as caught:
        other(robot, world, take_over=True).open()
    assert str(caught.value) == (
        "puma: tasks that are CRITICAL and ON are taken over only when confirmed "
        f"(got arm0: puma_pidg, of master {master}); end that master; or confirm: "
        "with --yes in a script, with Subsystem(..., confirm=...) in a program"
    )
    with pytest.raises(ClaimError, match="only when confirmed"):
        other(robot, world, take_over=True, confirm=confirm).open()
    robot.control("puma_pidg", "off")
    robot.control("puma_pidg", "on")
    with other(robot, world, take_over=True, confirm=confirm) as successor:
        assert (
            asked
            == [
                "CRITICAL tasks are ON and have a master that lives "
                f"(arm0: puma_pidg, of master {master}). Take them over?"
            ]
            * 2
        )
        successor.control("puma_pidg", "off")
        successor.detach()


def test_master_that_comes_after_finds_the_tasks_running(arm, world):
    arm.start("puma")
    arm.detach()
    with other(arm, world) as successor:
        assert states(successor) == ON
        assert successor.model.find("grav_comp").rmod.module == "grav_comp"
        assert successor.model.find("grav_comp").rtpu == "arm1"


def test_exclusive_rtpu_is_refused_to_another_subsystem(arm, world, tmp_path):
    text = arm.files.path.read_text()
    (tmp_path / "leg.sbs").write_text(text.replace("puma\n", "leg\n", 1))
    with pytest.raises(SeveralError, match="belongs to another subsystem"):
        Subsystem(tmp_path / "leg.sbs", domain=world.domain).open()


def test_watcher_needs_no_claim_and_may_not_change(robot, world):
    robot.spawn("jttrace", "arm1")
    with other(robot, world, watch=True) as watcher:
        assert states(watcher) == {"puma_pidg": "OFF", "jttrace": "OFF"}
        with pytest.raises(ClaimError, match="open for reading only"):
            watcher.control("jttrace", "on")
    assert states(robot) == {"puma_pidg": "OFF", "jttrace": "OFF"}


def test_table_that_cannot_be_opened_gives_the_claims_back(world, agents, puma):
    agents("arm0", "arm1")
    agents["arm1"].fail["open table", ""] = NodeError("no room", where="arm1")
    with pytest.raises(NodeError, match="no room"):
        Subsystem(puma, domain=world.domain).open()
    assert agents["arm0"].claims == agents["arm1"].claims == {}


def test_closed_subsystem_says_how_to_open_it(puma):
    with pytest.raises(NodeError, match="the subsystem is not open"):
        Subsystem(puma).status_all()


# -- spawn ---------------------------------------------------------------------------


def test_spawned_task_is_off_where_it_was_put(robot, agents):
    status = robot.spawn("jttrace", "arm1", 25.0)
    assert (status.state, status.rtpu, status.ref_f) == ("OFF", "arm1", 25.0)
    assert list(agents["arm1"].tasks) == ["jttrace"]
    assert "MODULE" in agents["arm1"].tasks["jttrace"].text


def test_unknown_rmod_names_the_nearest(arm):
    with pytest.raises(ConfigError) as caught:
        arm.spawn("jtrace")
    assert caught.value.what == "there is no RMOD jtrace"
    assert caught.value.remedy == "did you mean jttrace?"


def test_unknown_rtpu_names_the_nearest(arm):
    with pytest.raises(NodeError, match="has no RTPU arm3") as caught:
        arm.spawn("jttrace", "arm3")
    assert caught.value.remedy.startswith("did you mean arm")


def test_unknown_module_is_found_by_asking_the_agent(arm, puma):
    (puma.parent / "mine.rmod").write_text(
        "MODULE no_such\nDESC of nobody\nINCONST none\nOUTCONST none\nINVAR none\n"
        "OUTVAR Q_REF\nTASKTYPE periodic\nFREQ 10\nEOF\n"
    )
    with pytest.raises(ModuleLoadError, match="the library has no module no_such"):
        arm.spawn("mine")
    (puma.parent / "no_such.py").touch()
    with pytest.raises(ModuleLoadError) as caught:
        arm.spawn("mine")
    assert caught.value.remedy == (
        f"no_such.py is in {puma.parent}; the agent arm0 needs it, too: "
        f"pbonet agent --name arm0 --library {puma.parent}"
    )


def test_rmod_beside_the_sbs_file_wins_over_the_library(robot, puma, agents):
    library = robot.files.library.find_rmod("qrdiff").read_text()
    beside = library.replace("FREQ", "#\nFREQ").replace("100", "77")
    (puma.parent / "qrdiff.rmod").write_text(beside)
    assert robot.spawn("qrdiff", "arm1").ref_f == robot.files.rmod("qrdiff").record.freq
    assert agents["arm1"].tasks["qrdiff"].text == beside


def test_task_is_not_spawned_twice(robot):
    robot.spawn("jttrace")
    for state, remedy in (("on", "'on jttrace' turns it on"), ("off", "'off jttrace'")):
        with pytest.raises(StateError, match="a task jttrace already") as caught:
            robot.spawn("jttrace")
        assert caught.value.remedy.startswith(remedy)
        robot.control("jttrace", state)


@pytest.mark.parametrize("name", ["../x", "a*b", "x" * 5000, "a\0b", ""])
def test_rmod_of_a_name_that_no_task_can_have_is_refused(arm, name):
    with pytest.raises(NodeError, match="this is not a valid name for a task"):
        arm.spawn(name)


@pytest.mark.parametrize("name", ["", "/", ".", "x" * 5000, "a\0b"])
def test_job_of_a_name_that_no_file_can_have_is_refused(arm, name):
    with pytest.raises(ConfigError):
        arm.start(name)


def test_constants_must_have_their_producer_first(arm):
    with pytest.raises(VerificationError) as caught:
        arm.spawn("grav_comp")
    assert "NDOF" in str(caught.value)
    assert "puma_pidg" in str(caught.value)


def test_rank_follows_the_data_flow(arm, agents):
    arm.start("puma")
    tasks = agents["arm0"].tasks | agents["arm1"].tasks
    priority = {name: task.priority for name, task in tasks.items()}
    assert sorted(priority.values()) == [1, 2, 3, 4]
    assert priority["jttrace"] > priority["qrdiff"] > 0
    assert priority["puma_pidg"] > priority["grav_comp"]


# -- signals -------------------------------------------------------------------------


def test_loop_is_built_by_hand_with_a_warning_and_the_flag(robot, agents):
    robot.spawn("grav_comp", "arm1")
    robot.heard.clear()
    robot.control("grav_comp", "on")
    (text,) = [text for text in robot.heard if "Q_MEZ" in text]
    assert text.endswith("turn puma_pidg on")
    assert agents["arm0"].flags == [f"{UNFED}Q_MEZ for grav_comp"]
    robot.control("grav_comp", "off")
    assert agents["arm0"].flags == []
    for name in ("qrdiff", "jttrace"):
        robot.spawn(name, "arm1")
    for name in ("jttrace", "qrdiff", "grav_comp", "puma_pidg"):
        robot.control(name, "on")
    assert agents["arm0"].flags == []


def test_off_and_kill_are_never_refused_and_raise_the_flag(arm, agents):
    arm.start("puma")
    arm.heard.clear()
    arm.control("grav_comp", "off")
    assert agents["arm0"].flags == [f"{UNFED}T_GRAV for puma_pidg"]
    assert len(arm.heard) == 1
    assert "writes T_GRAV, which puma_pidg reads" in arm.heard[0]
    arm.control("grav_comp", "kill")
    assert len(arm.heard) == 2  # the remedy is another
    assert "in the library, grav_comp and gravity do" in arm.heard[1]
    assert "grav_comp" not in states(arm)
    arm.reconfig([("jttrace", "off"), ("jttrace", "kill")])
    arm.spawn("jttrace", "arm1")
    assert arm.stop().off != []
    assert arm.task_set.model.killed == {"grav_comp"}  # by order, and not back


def test_second_writer_is_refused_naming_both_and_a_remedy(robot, puma):
    text = robot.files.library.find_rmod("jttrace").read_text()
    (puma.parent / "second.rmod").write_text(text)
    robot.spawn("jttrace", "arm1")
    robot.spawn("second", "arm1")
    robot.control("jttrace", "on")
    with pytest.raises(VerificationError) as caught:
        robot.control("second", "on")
    message = str(caught.value)
    assert "Q_REF" in message
    assert "jttrace" in message
    assert "second" in message
    assert caught.value.remedy
    assert states(robot)["second"] == "OFF"


def test_signal_that_is_invalid_in_the_state_comes_back(robot):
    robot.spawn("jttrace", "arm1")
    with pytest.raises(StateError, match="clear is not valid in the state OFF"):
        robot.control("jttrace", "clear")


def test_unknown_task_and_signal_name_the_nearest(robot):
    robot.spawn("jttrace", "arm1")
    with pytest.raises(UnknownTaskError) as caught:
        robot.control("jttrac", "on")
    assert caught.value.remedy == "did you mean jttrace?"
    with pytest.raises(StateError, match="there is no signal onn"):
        robot.control("jttrace", "onn")


def test_reconfiguration_is_judged_by_its_end(arm, agents, puma):
    text = arm.files.library.find_rmod("jttrace").read_text()
    (puma.parent / "second.rmod").write_text(text)
    arm.start("puma")
    arm.spawn("second", "arm1")
    arm.reconfig([("jttrace", "off"), ("second", "on")])
    assert states(arm)["second"] == "ON"
    assert agents["arm0"].flags == []
    with pytest.raises(VerificationError):
        arm.reconfig([("jttrace", "on")])


def test_reconfiguration_that_fails_says_what_was_done(arm, agents):
    arm.start("puma")
    agents["arm1"].fail["off", "qrdiff"] = MethodError("off raised", where="x")
    with pytest.raises(ReconfigError) as caught:
        arm.reconfig([("puma_pidg", "off"), ("qrdiff", "off"), ("jttrace", "off")])
    assert caught.value.done == 1
    assert caught.value.rest == (("qrdiff", "off"), ("jttrace", "off"))
    assert isinstance(caught.value.__cause__, MethodError)
    assert str(caught.value) == (
        "arm1/x: item 2 of 3, off qrdiff: off raised; "
        "done: off puma_pidg; not sent: off jttrace"
    )
    assert states(arm)["puma_pidg"] == "OFF"


# -- the whole -----------------------------------------------------------------------


def test_start_spawns_in_the_order_of_constants_then_turns_on(arm, world):
    statuses = arm.start("puma")
    assert {status.task: status.state for status in statuses} == ON
    steps = [text for _, text in world.log if text.split()[0] in {"spawn", "on"}]
    assert steps.index("spawn puma_pidg") < steps.index("spawn grav_comp")
    assert steps.index("spawn puma_pidg") < steps.index("spawn qrdiff")
    assert steps[4] == "on jttrace"
    assert steps[-1] == "on puma_pidg"  # CRITICAL, so last


def test_start_is_rolled_back_when_a_task_does_not_turn_on(arm, agents, world):
    agents["arm0"].fail["on", "puma_pidg"] = MethodError("no arm", where="x")
    with pytest.raises(MethodError, match="no arm"):
        arm.start("puma")
    assert states(arm) == {}
    offs = [text for _, text in world.log if text.startswith("off ")]
    assert offs == ["off grav_comp", "off qrdiff", "off jttrace"]


@pytest.fixture
def ctrl_c_is_heeded():
    """A shell's job in the background begins with SIGINT ignored."""
    before = signal.signal(signal.SIGINT, signal.default_int_handler)
    yield
    signal.signal(signal.SIGINT, before)


@pytest.mark.usefixtures("ctrl_c_is_heeded")
def test_start_that_ctrl_c_ends_leaves_no_task_that_was_being_created(
    arm, agents, capsys
):
    """Its request is done after that; a kill of the task comes too early once.

    A second Ctrl-C meanwhile shows what is waited for.
    """
    held = agents["arm1"].held["spawn"] = threading.Event()

    def asked(kind):
        return [one for one in agents["arm1"].requests if isinstance(one, kind)]

    def shown():
        text.append(capsys.readouterr().err)
        return "".join(text).partition("still undoing what was begun; waits for ")[2]

    text: list[str] = []

    def interrupt():
        wait_for(lambda: asked(m.Spawn), "a task is being created")
        os.kill(os.getpid(), signal.SIGINT)
        wait_for(lambda: asked(m.Control), "it is killed")
        os.kill(os.getpid(), signal.SIGINT)
        wait_for(lambda: "\n" in shown(), "the second one is answered")
        held.set()

    pressing = threading.Thread(target=interrupt)
    pressing.start()
    with pytest.raises(KeyboardInterrupt):
        arm.start("puma")
    pressing.join()
    assert shown().startswith("the kill of ")
    assert asked(m.Spawn)
    assert {name: list(one.tasks) for name, one in agents.items()} == {
        "arm0": [],
        "arm1": [],
    }
    arm.start("puma")


def test_start_that_is_illegal_does_nothing(arm, puma, world):
    job = puma.parent / "puma.job"
    job.write_text(job.read_text().replace("TASK  grav_comp  arm1\n", ""))
    job.write_text(job.read_text().replace(" puma_pidg grav_comp\n", " puma_pidg\n"))
    with pytest.raises(VerificationError) as caught:
        arm.start("puma")
    assert "T_GRAV" in str(caught.value)
    assert "grav_comp" in str(caught.value)  # the library has who writes it
    assert not any(text.startswith("spawn") for _, text in world.log)
    with pytest.raises(VerificationError):
        arm.check("puma")


def test_start_is_repeatable(arm):
    arm.start("puma")
    assert {status.task for status in arm.start("puma")} == set(ON)


def test_job_of_another_subsystem_is_refused(arm, tmp_path, puma):
    (tmp_path / "other").mkdir()
    job = tmp_path / "other" / "x.job"
    job.write_text((puma.parent / "puma.job").read_text())
    with pytest.raises(ConfigError, match="the job is of another subsystem"):
        arm.start(job)


def test_finish_turns_off_as_the_job_states_and_leaves_nothing(world, agents, puma):
    agents("arm0", "arm1")
    with Subsystem(puma.with_suffix(".job"), domain=world.domain) as arm:
        arm.start()
        world.log.clear()
    offs = [text for _, text in world.log if text.startswith("off ")]
    assert offs == ["off jttrace", "off qrdiff", "off puma_pidg", "off grav_comp"]
    assert [text for _, text in world.log[-4:]] == [
        "close_table",
        "close_table",
        "release",
        "release",
    ]
    assert world.log[-3][0] == "arm0"  # the keeper closes last
    assert agents["arm0"].tasks == agents["arm1"].tasks == {}
    assert agents["arm0"].claims == agents["arm1"].claims == {}


def test_stop_reaches_the_others_when_one_agent_is_gone(arm, agents):
    arm.start("puma")
    agents["arm1"].close()
    with pytest.raises(SeveralError) as caught:
        arm.stop()
    assert caught.value.what == (
        "an RTPU did not confirm the stop; on the others was turned off: puma_pidg; "
        "may still be ON: arm1: grav_comp qrdiff jttrace"
    )
    assert [error.where for error in caught.value.errors] == ["arm1"]
    assert agents["arm0"].tasks == {}


def test_lost_rtpu_keeps_nobody_from_looking_and_turning_off(arm, agents):
    arm.start("puma")
    agents["arm0"].close()
    arm.heard.clear()
    assert {status.rtpu for status in arm.status_all()} == {"arm1"}
    assert any(text.startswith("arm0: no agent of this name") for text in arm.heard)
    assert "puma_pidg" in arm.model  # as it was last seen
    assert arm.control("jttrace", "off").state == "OFF"
    arm.reconfig([("qrdiff", "off"), ("qrdiff", "kill")])


def test_what_remains_can_be_steered_when_an_rtpu_is_lost(arm, agents):
    """It is judged by those that answer, and each command says who is missing."""
    arm.start("puma")
    agents["arm0"].close()
    arm.heard.clear()
    arm.off("jttrace")
    assert arm.on("jttrace") == {"jttrace": "ON"}
    missing = "judged without arm0, where puma_pidg was seen last: "
    assert any(text.startswith(missing) for text in arm.heard)
    arm.reconfig([("qrdiff", "off"), ("qrdiff", "kill")])
    arm.heard.clear()
    assert arm.spawn("qrdiff", "arm1").state == "OFF"
    assert any(text.startswith(missing) for text in arm.heard)
    assert arm.reconfig([("jttrace", "off"), ("qrdiff", "on")]) == {
        "jttrace": "OFF",
        "qrdiff": "ON",
    }
    arm.swap("qrdiff", "jttrace")
    assert agents["arm1"].tasks["jttrace"].state == "ON"
    with pytest.raises(UnreachableError, match="arm0"):
        arm.on("puma_pidg")
    with pytest.raises(UnreachableError, match="arm0"):
        arm.start("puma")
    assert "jttrace" in {one.task for one in arm.status_all()}


def test_stop_lets_the_flag_down(arm, agents):
    arm.spawn("puma_pidg", "arm0")
    arm.control("puma_pidg", "on")
    (cause,) = agents["arm0"].flags
    assert cause.startswith(UNFED)
    assert "T_GRAV for puma_pidg" in cause
    arm.stop()
    assert agents["arm0"].flags == []


def test_stop_ends_a_start_that_is_under_way(arm, agents):
    import threading

    go_on = agents["arm1"].held["spawn"] = threading.Event()
    failed = []

    def start():
        try:
            arm.start("puma")
        except StateError as error:
            failed.append(error.what)

    thread = threading.Thread(target=start)
    thread.start()
    wait_for(lambda: agents["arm0"].tasks, "the first task")
    arm.stop()
    go_on.set()
    thread.join()
    assert failed == ["the start was abandoned because of a stop"]
    assert agents["arm0"].tasks == agents["arm1"].tasks == {}


# -- parameters, rates, variables ------------------------------------------------------


def test_parameters_are_shown_and_set(robot):
    assert "KP" in {param.name for param in robot.get("puma_pidg")}
    assert robot.set("puma_pidg", "KD", [1.0, 2])[0].value == "1.0 2"
    assert [param.value for param in robot.get("puma_pidg", "KD")] == ["1.0 2"]


def test_rate_is_read_set_and_refused_beyond_the_core(arm, puma):
    text = arm.files.library.find_rmod("puma_pidg").read_text()
    heavy = text.replace("\nLOCAL", "\nMAXC 0.001\n\nLOCAL")
    (puma.parent / "heavy.rmod").write_text(heavy)
    arm.spawn("heavy", "arm0", 400.0)
    assert arm.freq("heavy") == 400.0
    assert arm.freq("heavy", 500.0) == 500.0
    arm.control("heavy", "on")
    with pytest.raises(VerificationError, match="arm0") as caught:
        arm.freq("heavy", 999.0)
    assert caught.value.remedy
    for hz in (0.0, -1.0, math.nan, math.inf):
        with pytest.raises(ParameterError, match="no task can run at this frequency"):
            arm.freq("heavy", hz)
        with pytest.raises(ParameterError, match="no task can run at this frequency"):
            arm.spawn("jttrace", None, hz)
    assert arm.freq("heavy") == 500.0


def test_variables_are_shown_and_written(arm):
    assert arm.write("T_GRAV", [1, 2, 3, 4, 5, 6]).values == [1, 2, 3, 4, 5, 6]
    assert [value.name for value in arm.display(["T_GRAV", "NDOF"])]
    with pytest.raises(UnknownVariableError) as caught:
        arm.display(["T_GRAF"])
    assert caught.value.remedy == "did you mean T_GRAV?"


def test_status_of_a_task_and_of_none(robot):
    robot.spawn("jttrace", "arm1")
    assert robot.status("jttrace").rtpu == "arm1"
    with pytest.raises(UnknownTaskError):
        robot.status("pid")


def test_modules_of_all_rtpus_are_told_once(arm):
    names = [one.name for one in arm.library()]
    assert "puma_pidg" in names
    assert len(names) == len(set(names))
    (diff,) = arm.library("diff")
    assert diff.info.ports
    assert diff.rmods == ("diff", "qmdiff", "qrdiff")
    with pytest.raises(ModuleLoadError):
        arm.library("no_such")
