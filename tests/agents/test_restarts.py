"""Tasks that were lost with their RTPU process or machine come back as RESTART says."""

from __future__ import annotations

import json
import os
import secrets
import signal
import subprocess
import sys

import pytest
import tool_constants
from nodekit import Master, alive, rmod, svar, wait_gone
from watching import wait_for

from pbonet.master.subsystem.subsystem import Subsystem
from pbonet.node.restart import desired_state, task_restarts
from pbonet.xm.net import key_expressions, messages as m, session

ROBOT = "a robot interface never comes ON unasked"


def spawn_all(master):
    """Spawn a task of each kind, all ON."""
    master.spawn("stays", "counts", out="Y0", restart="never")
    master.spawn("off", "counts", out="Y1")
    master.spawn("on", "holds", out="Y2", invar="X", local={"LEVEL": 1}, restart="on")
    master.spawn("robot", "moves", out="Y3", critical=True, restart="on")
    for task in ("stays", "off", "on", "robot"):
        master.on(task)


def kill_rtpu(nodes, name="arm0"):
    """Kill the RTPU process; wait for another one."""
    old = nodes.state(name).pid
    os.kill(old, signal.SIGKILL)
    wait_gone([old])
    nodes.wait_restarted(name, old)


def kill_both(nodes, name="arm0"):
    """Kill agent and RTPU process, as a machine that loses its power."""
    victims = [nodes.processes[name].pid, nodes.state(name).pid]
    for pid in victims:
        os.kill(pid, signal.SIGSTOP)  # neither sees the other's end
    for pid in victims:
        os.kill(pid, signal.SIGKILL)
    nodes.processes[name].wait()
    wait_gone(victims)


def states(master):
    return {name: one.state for name, one in master.status().items()}


def wait_states(master, **wanted):
    wait_for(lambda: states(master) == wanted, f"the states {wanted}")


def reasons(master):
    """Return what `status` says of tasks that are not there, and of those not ON."""
    found = {one.task: one for one in master.status().values() if one.restarted}
    gone = {task for task, one in found.items() if one.state == "NOT-CREATED"}
    texts = {task: one.restarted for task, one in found.items()}
    missing = {task: texts[task] for task in texts if task in gone}
    return missing, {task: texts[task] for task in texts if task not in gone}


def has(nodes, name):
    """Return what the state file of an RTPU says."""
    return json.loads(desired_state.path_of(nodes.domain, name).read_text())


def wait_written(nodes, name, on, subsystem="arm"):
    """Wait until the state file says that these tasks are ON."""

    def written():
        try:
            return has(nodes, name)["subsystems"][subsystem]["on"] == on
        except (OSError, KeyError):
            return False

    wait_for(written, f"{on} in the state file")


def wait_no_token(nodes):
    key = key_expressions.masters(nodes.domain, "arm")
    wait_for(lambda: not session.alive(nodes.session, key), "the token's end")


# -- a killed RTPU process ---


def test_with_a_master_each_task_comes_back_as_it_says(arm, nodes):
    spawn_all(arm)
    kill_rtpu(nodes)
    wait_states(arm, stays="NOT-CREATED", off="OFF", on="ON", robot="OFF")
    missing, there = reasons(arm)
    assert missing.keys() == {"stays"}
    how = "the RTPU process ended: signal SIGKILL (killed), at "
    assert missing["stays"].startswith(how)
    assert missing["stays"].endswith("; not spawned again: RESTART never")
    assert there.keys() == {"off", "robot"}
    assert there["off"].endswith("; spawned again, OFF: RESTART off")
    assert there["robot"].endswith(f"; spawned again, OFF: {ROBOT}")
    arm.wait_event("RESTARTED", "on")  # it is said when the task is ON
    told = {event.task: event.text for event in arm.events("RESTARTED")}
    assert told == there | {"on": told["on"]}
    assert told["on"].endswith("; spawned again, and ON again: RESTART on")
    assert [e.task for e in arm.events("NOT_SPAWNED")] == ["stays"]
    lost = "was lost with its RTPU process (arm0/"
    assert sorted(arm.rtpu_status().illegal) == [
        f"{task} {lost}{task})" for task in ("off", "robot", "stays")
    ]
    # the commands of the master are valid as before, and nothing stands in their way
    assert arm.on("off").state == "ON"
    assert arm.on("robot").state == "ON"
    assert arm.spawn("stays", "counts", out="Y0").state == "OFF"
    assert reasons(arm) == ({}, {})
    wait_for(lambda: arm.rtpu_status().illegal == [], "the flag goes down")


def test_without_a_master_the_next_one_finds_them(arm, nodes):
    spawn_all(arm)
    arm.token.undeclare()
    wait_no_token(nodes)
    kill_rtpu(nodes)
    wait_states(arm, stays="NOT-CREATED", off="OFF", on="ON", robot="OFF")
    later = Master(nodes, "arm0", "arm")
    assert later.epoch > arm.epoch
    assert sorted(later.claimed.tasks) == ["off", "on", "robot"]
    assert later.off("on").state == "OFF"


def test_what_was_set_since_the_spawn_is_set_again(arm, nodes):
    settings = {"invar": "X", "local": {"LEVEL": 1}, "restart": "on"}
    arm.spawn("a", "holds", **settings)
    arm.on("a")
    for level in ("2", "3"):
        request = m.Set(task="a", name="LEVEL", value=level)
        arm.ask(request, list[m.ParamValue])
    arm.ask(m.Freq(task="a", hz=125.0), float)
    arm.ask(m.Rank(tasks={"a": (7, 5)}))
    arm.ask(m.Sigmask(task="a", names=["WARNING"]), dict[str, list[str]])
    kill_rtpu(nodes)
    wait_states(arm, a="ON")
    status = arm.status("a")
    assert (status.ref_f, status.crit, status.priority) == (125.0, 7, 5)
    (level, _) = arm.ask(m.Get(task="a"), list[m.ParamValue])
    assert (level.name, level.value) == ("level", 3.0)
    wait_for(lambda: arm.value("Y0").values[0] == 3.0, "the level that was set")
    assert arm.ask(m.Sigmask(), dict[str, list[str]]) == {"a": ["WARNING"]}
    # a task that is killed and spawned anew has nothing of that
    arm.kill("a")
    arm.spawn("a", "holds", **settings)
    kill_rtpu(nodes)
    wait_states(arm, a="OFF")
    assert arm.status("a").ref_f == 200.0
    (level, _) = arm.ask(m.Get(task="a"), list[m.ParamValue])
    assert level.value == 1.0


def test_what_was_off_or_killed_stays_so(arm, nodes):
    for i, task in enumerate(("off", "killed", "in_error")):
        module = "raises_in_cycle" if task == "in_error" else "counts"
        arm.spawn(task, module, out=f"Y{i}", freq=200.0, restart="on")
        arm.on(task)
    arm.off("off")
    arm.kill("killed")
    wait_for(lambda: arm.status("in_error").state == "ERROR", "the error")
    kill_rtpu(nodes)
    wait_states(arm, off="OFF", in_error="OFF")

    def last_words():
        return [text.rpartition("; ")[2] for text in reasons(arm)[1].values()]

    wait_for(lambda: last_words() == ["spawned again, OFF: as before"] * 2, "reasons")
    assert arm.rtpu_status().illegal == [], "nobody misses what was OFF"


def test_a_fallback_stands_by_again(arm, nodes):
    arm.spawn("pid", "counts", restart="on")
    arm.spawn("hold", "counts", restart="on")
    arm.ask(m.Standby(task="hold", original="pid"), m.TaskStatus)
    arm.on("pid")
    kill_rtpu(nodes)
    wait_states(arm, pid="ON", hold="OFF")
    wait_for(lambda: arm.status("hold").stands_by, "the standby")
    os.kill(arm.status("pid").tid, signal.SIGKILL)
    wait_states(arm, hold="ON", pid="NOT-CREATED")
    # what it has become is what comes back
    kill_rtpu(nodes)
    wait_states(arm, hold="ON")


def test_a_task_that_cannot_be_spawned_is_told_and_keeps_no_other_away(
    arm, nodes, monkeypatch
):
    monkeypatch.setattr(task_restarts, "TURN", 0.05)
    path = nodes.write_module(
        "goes_away",
        """
        from typing import Annotated as A

        from pbonet import OutVar, PortBasedObject, Vector


        class GoesAway(PortBasedObject):
            y: A[Vector, OutVar("Y", "2", "none", "nothing")]

            def cycle(self, dt: float) -> None:
                pass
        """,
    )
    arm.spawn("a", "goes_away", out="Y0", restart="on")
    arm.spawn("b", "counts", out="Y1", restart="on")
    arm.on("a")
    arm.on("b")
    path.unlink()
    kill_rtpu(nodes)
    wait_for(lambda: states(arm).get("b") == "ON", "the other one to be ON again")
    wait_for(lambda: arm.events("NOT_SPAWNED", "a"), "that it is given up")
    missing, _ = reasons(arm)
    assert "; not spawned again: " in missing["a"]
    assert "goes_away" in missing["a"]


def test_it_is_given_up_after_too_many_losses(nodes, monkeypatch):
    from pbonet.node.agent import agent as its

    monkeypatch.setattr(its, "RESTARTS", 1)
    agent, other = nodes.agent("arm0"), nodes.agent("arm1")
    arm = nodes.master("arm0", "arm")
    arm.spawn("a", "counts", restart="on")
    arm.on("a")
    kill_rtpu(nodes)
    wait_states(arm, a="ON")
    wait_written(nodes, "arm0", ["a"])
    wait_for(lambda: other.ways().ways, "the other one to know it")
    old = nodes.state("arm0").pid
    os.kill(old, signal.SIGKILL)
    assert agent.wait(60.0)
    assert "was lost 2 times" in agent.reason
    agent.stop()
    assert not desired_state.path_of(nodes.domain, "arm0").exists()
    lost = wait_for(lambda: other.info().lost, "the loss, which is no orderly end")
    assert [one.rtpu for one in lost] == ["arm0"]


# -- a stop ---


def test_nothing_comes_back_after_a_stop(arm, nodes):
    spawn_all(arm)
    arm.stop()
    kill_rtpu(nodes)
    agent = nodes.agents["arm0"]
    for run in agent._again._runs:
        run.thread.join()
    assert states(arm) == {}
    assert reasons(arm) == ({}, {})
    assert not desired_state.path_of(nodes.domain, "arm0").exists()
    arm.spawn("new", "counts", restart="on")  # a stop forbids no new start
    arm.on("new")
    kill_rtpu(nodes)
    wait_states(arm, new="ON")


def test_a_stop_while_they_come_back_ends_that(arm, nodes, tmp_path):
    """One is in its `init` when the stop comes, and another one waits behind it."""
    begun, go_on = tmp_path / "begun", tmp_path / "go_on"
    nodes.write_module(
        "waits_in_init",
        f"""
        import time
        from pathlib import Path
        from typing import Annotated as A

        from pbonet import OutVar, PortBasedObject, Vector


        class WaitsInInit(PortBasedObject):
            y: A[Vector, OutVar("Y", "2", "none", "nothing")]

            def init(self) -> None:
                Path("{begun}").touch()
                while not Path("{go_on}").exists():
                    time.sleep(0.005)

            def cycle(self, dt: float) -> None:
                pass
        """,
    )
    go_on.touch()
    arm.spawn("first", "waits_in_init", out="Y0", restart="on")
    arm.spawn("second", "counts", out="Y1", restart="on")
    arm.on("first")
    arm.on("second")
    go_on.unlink()
    begun.unlink()
    old = nodes.state("arm0").pid
    os.kill(old, signal.SIGKILL)
    wait_for(begun.exists, "the init of the first one")
    arm.stop(limit=2.0)
    go_on.touch()
    for run in nodes.agents["arm0"]._again._runs:
        run.thread.join()
    assert states(arm) == {}
    events = arm.events("STATE", "second")
    assert not [one for one in events if one.state == "ON"][1:], "it was ON only before"


# -- a machine that was restarted ---


def test_agent_and_rtpu_process_are_killed_and_started_anew(nodes):
    nodes.agent_process("arm0")
    arm = nodes.master("arm0", "arm")
    spawn_all(arm)
    wait_written(nodes, "arm0", ["stays", "off", "on", "robot"])
    arm.ask(m.Set(task="on", name="LEVEL", value="4"), list[m.ParamValue])
    wait_for(lambda: '"LEVEL"' in json.dumps(has(nodes, "arm0")), "what was set")
    kill_both(nodes)
    nodes.forget_session()
    nodes.agent_process("arm0")
    again = nodes.master("arm0", "arm")
    wait_states(again, stays="NOT-CREATED", off="OFF", on="ON", robot="OFF")
    (level, _) = again.ask(m.Get(task="on"), list[m.ParamValue])
    assert level.value == 4.0
    missing, there = reasons(again)
    how = "the agent and the RTPU process had ended; "
    assert missing == {"stays": f"{how}not spawned again: RESTART never"}
    assert there == {
        "off": f"{how}spawned again, OFF: RESTART off",
        "robot": f"{how}spawned again, OFF: {ROBOT}",
    }


def test_an_agent_that_ends_in_order_leaves_neither_file_nor_folder(nodes):
    nodes.agent_process("arm0")
    arm = nodes.master("arm0", "arm")
    arm.spawn("a", "counts")
    arm.on("a")
    wait_written(nodes, "arm0", ["a"])
    process = nodes.processes["arm0"]
    process.terminate()
    assert process.wait(60) == 0
    assert not desired_state.path_of(nodes.domain, "arm0").parent.exists()


def test_a_stop_before_that_stays_in_force(nodes):
    nodes.agent_process("arm0")
    arm = nodes.master("arm0", "arm")
    arm.spawn("a", "counts", restart="on")
    arm.on("a")
    wait_written(nodes, "arm0", ["a"])
    arm.stop()  # when it is answered, the file is written
    kill_both(nodes)
    nodes.forget_session()
    nodes.agent_process("arm0")
    again = nodes.master("arm0", "arm")
    assert again.claimed.tasks == []
    assert states(again) == {}
    assert again.events("RESTARTED") == []


@pytest.fixture
def two(nodes):
    """A keeper arm0 and an arm1, both with a task that comes ON again."""
    nodes.agent_processes("arm0", "arm1")
    keeper = nodes.master("arm0", "arm")
    other = nodes.master("arm1", "arm", table=False)
    claim = m.Claim(svar=svar(), svar_name="t.svar", keeper="arm0")
    other.claimed = other.ask(claim, m.Claimed)
    for i, master in enumerate((keeper, other)):
        master.spawn(f"t{i}", "counts", out=f"Y{i}", restart="on")
        master.on(f"t{i}")
        wait_written(nodes, master.rtpu, [f"t{i}"])
    return keeper, other


def test_a_stop_that_one_has_missed_is_in_force_there(two, nodes):
    """The others know of it, and the new RTPU process has carried out nothing."""
    keeper, _ = two
    wait_for(
        lambda: (
            has(nodes, "arm0")["subsystems"]["arm"]["others"] == ["arm1"]
            or keeper.ask(m.Rank(tasks={"t0": (None, secrets.randbelow(100))}))
        ),
        "that arm0 knows of arm1",
    )
    kill_both(nodes, "arm1")
    nodes.forget_session()
    keeper = Master(nodes, "arm0", "arm")
    stop = m.Stop(subsystem="arm", stop_id=secrets.token_hex(8))
    keeper.ask(stop, m.Stopped)
    assert has(nodes, "arm0")["orders"][0]["due"] == ["arm1"]
    # not even a restart of the one that knows of it makes it forgotten
    kill_both(nodes, "arm0")
    nodes.forget_session()
    nodes.agent_process("arm0")
    nodes.agent_process("arm1")
    again = nodes.master("arm1", "arm", table=False)
    assert again.claimed.tasks == []
    (event,) = again.events("NOT_SPAWNED")
    assert "arm was stopped while this RTPU was away" in event.text
    wait_for(
        lambda: not desired_state.path_of(nodes.domain, "arm0").exists(),
        "that arm0 has seen that the order was carried out",
    )
    assert again.events("STATE") == [], "nothing was turned on"


@pytest.mark.usefixtures("two")
def test_a_machine_turns_nothing_on_before_the_keeper_answers(nodes):
    kill_both(nodes, "arm1")
    kill_both(nodes, "arm0")
    nodes.forget_session()
    nodes.agent_process("arm1")
    other = Watcher(nodes, "arm1")
    wait_states(other, t1="OFF")
    wait_for(
        lambda: (
            reasons(other)[1]
            .get("t1", "")
            .endswith("; spawned again, comes ON when the keeper arm0 answers")
        ),
        "the reason",
    )
    nodes.agent_process("arm0")
    wait_states(other, t1="ON")
    assert reasons(other) == ({}, {})


@pytest.mark.parametrize("how", ["the machine is shut down", "hangup"])
def test_a_stop_while_an_agent_restarts_in_order_reaches_it(nodes, how):
    """It announces no end: its tasks come back, or are ON all the time."""
    nodes.agent("arm0")
    first = nodes.agent("arm1")
    keeper = nodes.master("arm0", "arm")
    other = nodes.master("arm1", "arm", table=False)
    other.ask(m.Claim(svar=svar(), svar_name="t.svar", keeper="arm0"), m.Claimed)
    other.spawn("t1", "counts", out="Y1", restart="on")
    other.on("t1")
    wait_written(nodes, "arm1", ["t1"])
    stops = nodes.agents["arm0"]._stops
    wait_for(lambda: stops.others("arm") == ["arm1"], "that arm0 knows of arm1")
    process = first._link._process  # of the RTPU process, which goes on after a hangup
    if how == "hangup":
        first.abandon()
    else:
        first.stop(keep=True)
    (lost,) = wait_for(lambda: nodes.agents["arm0"].info().lost, "the loss of arm1")
    assert lost.rtpu == "arm1"
    stop = m.Stop(subsystem="arm", stop_id=secrets.token_hex(8))
    keeper.ask(stop, m.Stopped)
    again = nodes.agent("arm1")
    wait_for(lambda: stop.stop_id in again.info().stops, "that it is carried out")
    assert states(Watcher(nodes, "arm1")) == {}
    for run in again._again._runs:
        run.thread.join()
    assert states(Watcher(nodes, "arm1")) == {}
    again.stop()
    process.wait(60)


@pytest.mark.usefixtures("two")
def test_a_task_that_is_on_elsewhere_now_stays_off(nodes):
    """A master has moved it while its machine was away."""
    kill_both(nodes, "arm1")
    nodes.forget_session()
    keeper = Master(nodes, "arm0", "arm")
    keeper.spawn("t1", "counts", out="Y1")
    keeper.on("t1")
    keeper.token.undeclare()
    wait_no_token(nodes)
    nodes.agent_process("arm1")
    other = Watcher(nodes, "arm1")
    wait_for(
        lambda: (
            reasons(other)[1]
            .get("t1", "")
            .endswith("; spawned again, OFF: it is ON on arm0")
        ),
        "the reason",
    )
    assert states(other) == {"t1": "OFF"}
    assert keeper.status("t1").state == "ON"


@pytest.mark.usefixtures("two")
def test_a_master_that_starts_something_else_keeps_waiting_tasks_off(nodes):
    """Its claim of the keeper is not what the task waited for."""
    kill_both(nodes, "arm1")
    kill_both(nodes, "arm0")
    desired_state.path_of(nodes.domain, "arm0").unlink()  # it has ended in order
    nodes.forget_session()
    nodes.agent_process("arm1")
    other = Watcher(nodes, "arm1")
    wait_for(lambda: "the keeper" in reasons(other)[1].get("t1", ""), "that it waits")
    nodes.agent_process("arm0")
    master = nodes.master("arm0", "arm")
    wait_for(
        lambda: reasons(other)[1].get("t1", "").endswith(task_restarts.CALLED_OFF),
        "the reason",
    )
    assert states(other) == {"t1": "OFF"}
    assert states(master) == {}


def test_another_subsystem_that_has_the_rtpu_keeps_it(nodes):
    nodes.agent_process("arm0")
    arm = nodes.master("arm0", "arm")
    arm.spawn("a", "counts", restart="on")
    arm.on("a")
    wait_written(nodes, "arm0", ["a"])
    path = desired_state.path_of(nodes.domain, "arm0")
    before = path.read_bytes()
    arm.stop()
    arm.ask(m.Release())
    leg = nodes.master("arm0", "leg")
    leg.spawn("walks", "counts", restart="on")
    leg.on("walks")
    wait_written(nodes, "arm0", ["walks"], "leg")
    kill_both(nodes)
    # as if the end of arm had been missed
    both = json.loads(before)
    both["subsystems"] = has(nodes, "arm0")["subsystems"] | both["subsystems"]
    path.write_text(json.dumps(both))
    nodes.forget_session()
    nodes.agent_process("arm0")
    leg = nodes.master("arm0", "leg", table=False)
    wait_states(leg, walks="ON")
    events = leg.client.call("arm0", m.Events(), list[m.Event])
    (event,) = [one for one in events if one.code == "NOT_SPAWNED"]
    assert (event.subsystem, event.task) == ("arm", "a")
    assert "subsystem leg uses the RTPU" in event.text


@pytest.mark.parametrize("text", [b"{", b"\xff\x00", b"[]", b'{"machine": 1}'])
def test_a_damaged_file_is_told_and_loses_nothing_else(nodes, text):
    path = desired_state.path_of(nodes.domain, "arm0")
    path.parent.mkdir(parents=True)
    path.write_bytes(text)
    nodes.agent("arm0")
    arm = nodes.master("arm0", "arm")
    (event,) = arm.events("STATE_UNREADABLE")
    assert str(path) in event.text
    assert "no task is spawned again" in event.text
    assert path.with_suffix(".bad").read_bytes() == text
    arm.spawn("a", "counts", restart="on")
    arm.on("a")
    wait_written(nodes, "arm0", ["a"])
    kill_rtpu(nodes)
    wait_states(arm, a="ON")


def test_a_folder_that_cannot_be_written_is_told_once(nodes, state_dir):
    state_dir.write_text("no folder")
    nodes.agent("arm0")
    arm = nodes.master("arm0", "arm")
    arm.spawn("a", "counts", restart="on")
    arm.on("a")
    event = arm.wait_event("STATE_NOT_KEPT")
    assert str(state_dir) in event.text
    arm.off("a")
    arm.on("a")
    assert len(arm.events("STATE_NOT_KEPT")) == 1
    kill_rtpu(nodes)  # this does not need the file
    wait_states(arm, a="ON")


@pytest.mark.parametrize(
    ("said", "kept"), [("stopping", True), ("running", False), (None, False)]
)
def test_an_orderly_end_forgets_unless_the_machine_is_shut_down(
    nodes, tmp_path, monkeypatch, said, kept
):
    if said is not None:
        monkeypatch.setenv("NOTIFY_SOCKET", str(tmp_path / "nobody"))
        program = tmp_path / "bin" / "systemctl"
        program.parent.mkdir()
        program.write_text(f"#!/bin/sh\n[ $1 = is-system-running ] && echo {said}\n")
        program.chmod(0o755)
        monkeypatch.setenv("PATH", f"{program.parent}:{os.environ['PATH']}")
    process = nodes.agent_process("arm0")
    arm = nodes.master("arm0", "arm")
    arm.spawn("a", "counts", restart="on")
    arm.on("a")
    wait_written(nodes, "arm0", ["a"])
    process.send_signal(signal.SIGTERM)
    assert process.wait(60) == 0
    nodes.forget_session()
    assert desired_state.path_of(nodes.domain, "arm0").exists() == kept
    nodes.agent_process("arm0")
    again = nodes.master("arm0", "arm")
    wait_states(again, **({"a": "ON"} if kept else {}))


def test_the_next_agent_of_a_killed_one_knows_it_too(nodes):
    """The RTPU process lives on; it is killed only when it has another agent."""
    nodes.agent_process("arm0")
    arm = nodes.master("arm0", "arm")
    for i, task in enumerate(("a", "b")):
        arm.spawn(task, "counts", out=f"Y{i}", restart="on")
        arm.on(task)
    wait_written(nodes, "arm0", ["a", "b"])
    tid = arm.status("a").tid
    nodes.processes["arm0"].kill()
    nodes.processes["arm0"].wait()
    nodes.forget_session()
    nodes.agent_process("arm0")
    again = Master(nodes, "arm0", "arm")
    assert again.status("a").tid == tid
    assert alive(tid)
    again.kill("b")
    kill_rtpu(nodes)
    wait_states(again, a="ON")


# -- jobs, constants, and what is shown ---


JOB = """
JOB  arm
DESC a task of each kind
SBS  t.sbs
TASK stays arm0 RESTART never
TASK off   arm0
TASK on    arm0 FALLBACK spare RESTART on
EOF
"""


class Watcher:
    """Asks one RTPU, and claims nothing."""

    def __init__(self, nodes, rtpu="arm0"):
        self._client, self._rtpu = nodes.client(), rtpu

    def status(self):
        got = self._client.call(self._rtpu, m.Status(), m.RtpuStatus)
        return {one.task: one for one in got.tasks}


@pytest.fixture
def job(nodes, tmp_path):
    """A job that runs on arm0: a function for verbs of the command line."""
    nodes.agent("arm0")
    (tmp_path / "t.sbs").write_text("SUBSYSTEM arm\nSVARFILE t.svar\nRTPU arm0\nEOF\n")
    (tmp_path / "t.svar").write_text(svar())
    path = tmp_path / "arm.job"
    path.write_text(JOB)
    for i, name in enumerate(("stays", "off", "on")):
        (tmp_path / f"{name}.rmod").write_text(rmod("counts", f"Y{i}"))
    (tmp_path / "spare.rmod").write_text(rmod("counts", "Y2"))

    def verb(*words, file=path):
        command = [sys.executable, "-m", "pbonet.cli", words[0], str(file), *words[1:]]
        done = subprocess.run(
            [*command, "--domain", nodes.domain],
            capture_output=True,
            text=True,
            timeout=200,
            check=False,
        )
        assert done.returncode == 0, done.stderr
        return done.stdout, done.stderr

    verb("start")
    return verb


def test_status_says_why_each_task_of_a_job_is_not_there_or_not_on(job, nodes):
    kill_rtpu(nodes)
    watcher = Watcher(nodes)
    wait_states(watcher, stays="NOT-CREATED", off="OFF", on="ON", spare="OFF")
    shown, _ = job("status")
    how = "the RTPU process ended: signal SIGKILL (killed), at "
    assert f"RESTART> stays: {how}" in shown
    (row,) = [line for line in shown.splitlines() if line.startswith("stays ")]
    assert "NOT-CREATED" in row
    assert "not spawned again: RESTART never" in shown
    assert f"RESTART> off: {how}" in shown
    assert "; spawned again, OFF: RESTART off" in shown
    assert "RESTART> on:" not in shown
    data = json.loads(job("status", "--json")[0])
    assert data["missing"] == []
    restarted = {one["task"]: one["restarted"] for one in data["tasks"]}
    assert {task for task, text in restarted.items() if text} == {
        "stays",
        "off",
        "spare",
    }
    # a start completes it
    job("start")
    assert states(watcher) == {"stays": "ON", "off": "ON", "on": "ON", "spare": "OFF"}
    shown, _ = job("status")
    assert "RESTART> off" not in shown
    assert "NOT-CREATED" not in shown


def test_another_restart_of_a_task_that_is_there_is_told(job, tmp_path):
    path = tmp_path / "other.job"
    path.write_text(JOB.replace("TASK off   arm0", "TASK off   arm0 RESTART on"))
    _, said = job("start", file=path)
    text = "off keeps RESTART off, with which it was spawned; for RESTART on kill it"
    assert f"{text} first" in said


def test_a_task_waits_for_its_constants(nodes, tmp_path):
    folder = tmp_path / "tools"
    tool_constants.write(folder, nodes.library)
    nodes.agent("arm0")
    tools = Subsystem(
        folder / "tools.sbs",
        domain=nodes.domain,
        libraries=[nodes.library],
        record="off",
        warned=lambda _: None,
    ).open()
    try:
        with tools._changing() as task_set:
            for name, restart in (
                ("grip", "never"),
                ("weigh", "off"),
                ("hold", "on"),
            ):
                member = task_set.plan(tools.files.rmod(name), None, None)
                member.restart = restart
                task_set.create(member)
        tools.on(["grip", "weigh", "hold"])
        kill_rtpu(nodes)

        def missing():
            return {one.task: one.restarted for one in tools.status()}

        wait_for(lambda: "has a value" in missing().get("hold", ""), "the reason")
        assert missing()["weigh"].endswith("; spawned again when MASS has a value")
        assert "WEIGHT" in missing()["hold"]
        assert "BIAS" not in missing()["hold"], "the file gives it a value"
        tools.spawn("grip")
        wait_states(Watcher(nodes), grip="OFF", weigh="OFF", hold="ON")
    finally:
        tools.finish()
