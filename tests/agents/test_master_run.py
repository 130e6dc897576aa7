"""``pbonet run``: the whole thing from one command, and nothing left behind.

What it records in real time stands in `agents/log/test_run_recorded.py`.
"""

from __future__ import annotations

import contextlib
import io
import json
import os
import signal
import subprocess
import sys
from pathlib import Path

import nodekit
import pytest
from nodekit import wait_gone
from rich.console import Console
from virtual_job import VirtualJob
from watching import processes_of, wait_for

from pbonet import log
from pbonet.master.configuration.environment import Place
from pbonet.master.console import run_job as run_module
from pbonet.master.console.live_screen import Screen
from pbonet.master.subsystem import subsystem_tasks
from pbonet.master.subsystem.embedded_agents import assign_cores
from pbonet.node.restart import desired_state
from pbonet.xm.net import run_folder, session

ROOT = Path(__file__).parents[2]
FEW_FILES = ("sh", "-c", 'ulimit -Sn 32; exec "$0" "$@"')


@pytest.fixture
def run(nodes, puma):
    """Start ``pbonet run`` on the PUMA job; it is ended with the test."""
    started = []

    def start(*words, job=None, under=()):
        file = str(job or puma.with_suffix(".job"))
        command = [*under, sys.executable, "-m", "pbonet.cli", "run", file]
        process = subprocess.Popen(
            [*command, *map(str, words), "--domain", nodes.domain],
            stdout=subprocess.PIPE,
            stderr=subprocess.PIPE,
            text=True,
            cwd=ROOT,
        )
        started.append(process)
        return process

    yield start
    for process in started:
        if process.poll() is None:
            process.kill()
        process.communicate()


@pytest.fixture
def verb(nodes, puma):
    """Run another verb beside it."""

    def call(name, *words, file=True):
        command = [sys.executable, "-m", "pbonet.cli", name]
        command += [str(puma)] if file else []
        return subprocess.run(
            [*command, *words, "--domain", nodes.domain],
            capture_output=True,
            text=True,
            cwd=ROOT,
            timeout=200,
            check=False,
        )

    return call


def until_on(process):
    """Read what it says until the job is ON."""
    for line in process.stdout:
        if " is ON: " in line:
            return
    pytest.fail(process.stderr.read())


def test_neither_a_run_nor_its_agents_need_numpy(run, nodes):
    """They have it in memory only where a value of numpy is asked for."""
    process = run("--record", "off")
    until_on(process)
    found = {
        command: "_multiarray_umath" in Path(f"/proc/{pid}/maps").read_text()
        for pid, command in processes_of("PBONET_RUN_DIR", str(nodes.folder))
    }
    assert any(found.values()), "tasks have it"
    ours = [has for command, has in found.items() if "pbonet.cli" in command]
    assert ours == [False] * 3, found


def left_of(nodes):
    """Return processes of this test beside those of the kit."""
    return [
        command
        for _, command in processes_of("PBONET_RUN_DIR", str(nodes.folder))
        if "pbonet.cli run" not in command
    ]


def test_a_run_shows_what_modules_print_and_what_is_held_back(run, tmp_path):
    (tmp_path / "loud.rmod").write_text(nodekit.rmod("prints_a_lot", freq=100.0))
    (tmp_path / "s.svar").write_text(nodekit.svar(1))
    (tmp_path / "s.sbs").write_text("SUBSYSTEM s\nSVARFILE s.svar\nRTPU c0\nEOF\n")
    job = tmp_path / "j.job"
    job.write_text("JOB j\nDESC d\nSBS s.sbs\nTASK loud\nEOF\n")
    process = run("--record", "off", "--library", nodekit.MISBEHAVING, job=job)
    shown = []
    for line in process.stdout:
        if line.startswith("loud> "):
            shown.append(line)
            if "held back: printed too fast" in line:
                break
    process.send_signal(signal.SIGINT)
    _, err = process.communicate(timeout=200)
    assert process.returncode == 0, err
    assert shown[0] == "loud> hello from init\n"
    assert any(line.startswith("loud> line 0 of cycle 1.") for line in shown)


@pytest.mark.parametrize("which", [signal.SIGINT, signal.SIGTERM])
def test_interrupt_turns_everything_off_in_order(run, nodes, which):
    process = run()
    until_on(process)
    process.send_signal(which)
    out, err = process.communicate(timeout=200)
    assert process.returncode == 0, err
    assert "interrupted" in out
    assert left_of(nodes) == []


def stop_parts(nodes):
    """Stop all processes of a run but its master and its tasks."""
    for pid, command in processes_of("PBONET_RUN_DIR", str(nodes.folder)):
        if "recorder_process" in command or "--name arm" in command:
            os.kill(pid, signal.SIGSTOP)
    for rtpu in ("arm0", "arm1"):
        os.kill(nodes.fork_server(rtpu), signal.SIGSTOP)
        os.kill(nodes.state(rtpu).pid, signal.SIGSTOP)


def test_stopped_processes_end_in_order_and_finish_their_logs(run, nodes, tmp_path):
    process = run("--runs", tmp_path / "runs")
    until_on(process)
    stop_parts(nodes)
    process.send_signal(signal.SIGINT)
    out, err = process.communicate(timeout=200)
    assert process.returncode == 0, out + err
    assert left_of(nodes) == []
    for file in (tmp_path / "runs").rglob("*.mcap"):
        assert log.Log(file).check() == []


def test_stopped_processes_end_with_a_master_that_was_killed(run, nodes, shared_memory):
    process = run()
    until_on(process)
    stop_parts(nodes)
    process.kill()
    wait_for(lambda: left_of(nodes) == [], "the end of all processes")
    wait_for(lambda: not list(shared_memory.iterdir()), "the end of all tables")


@pytest.mark.parametrize(
    ("ended", "stopped"),
    [("cli run", ["--name arm"]), ("--name arm1", ["recorder_process"])],
)
def test_what_is_stopped_behind_the_end_of_its_parent_ends(run, nodes, ended, stopped):
    """The kernel has continued it at that end, and no process does a second time."""
    process = run()
    until_on(process)
    there = processes_of("PBONET_RUN_DIR", str(nodes.folder))
    dead = [pid for pid, command in there if ended in command]
    parents = {pid: parent_of(pid) for pid, _ in there}
    for pid in dead:
        os.kill(pid, signal.SIGKILL)
    wait_gone(dead)
    for pid, command in there:
        if any(word in command for word in stopped):
            with contextlib.suppress(OSError):  # it has ended
                if parents[pid] in dead:
                    timers = Path(f"/proc/{pid}/timers")
                    wait_for(timers.read_text, "its notice of the end of its parent")
                os.kill(pid, signal.SIGSTOP)
    process.communicate()
    wait_for(lambda: left_of(nodes) == [], "the end of all processes")


def test_a_run_whose_own_agent_was_killed_ends_and_says_so(run, nodes, shared_memory):
    """And its recorder is stopped at that time; it is continued then, and ends."""
    process = run()
    until_on(process)
    running = processes_of("PBONET_RUN_DIR", str(nodes.folder))
    agent = next(pid for pid, command in running if "--name arm1" in command)
    recorder = next(
        pid
        for pid, command in running
        if "recorder_process" in command and parent_of(pid) == agent
    )
    os.kill(agent, signal.SIGSTOP)  # so that it does not continue the recorder
    os.kill(recorder, signal.SIGSTOP)
    os.kill(agent, signal.SIGKILL)
    out, err = process.communicate(timeout=200)
    assert process.returncode == 1, err
    assert "the agent of arm1 has ended: SIGKILL" in out
    wait_for(lambda: not left_of(nodes), "the end of the RTPU process")
    assert list(shared_memory.iterdir()) == []


def parent_of(pid):
    return int(Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()[1])


def has_a_log(pid):
    files = [one.resolve() for one in Path(f"/proc/{pid}/fd").iterdir()]
    return any(one.suffix == ".mcap" and one.stat().st_size for one in files)


def test_a_strict_run_whose_recorder_was_killed_says_what_is_missing(run, nodes):
    process = run("--strict")
    until_on(process)
    recorder = next(
        pid
        for pid, command in processes_of("PBONET_RUN_DIR", str(nodes.folder))
        if "recorder_process" in command
    )
    wait_for(lambda: has_a_log(recorder), "what a killed recorder cannot finish")
    os.kill(recorder, signal.SIGKILL)
    wait_gone([recorder])
    process.send_signal(signal.SIGINT)
    out, err = process.communicate(timeout=200)
    last = (out + err).splitlines()[-1]
    assert process.returncode == 3, out + err
    assert "exit status 3 (--strict): not recorded: " in last
    assert left_of(nodes) == []


def test_a_low_limit_of_open_files_is_raised(run):
    process = run("--record", "off", "--seconds", "0.2", under=FEW_FILES)
    _, err = process.communicate(timeout=200)
    assert process.returncode == 0, err


def test_interrupt_during_the_start_undoes_it(run, nodes):
    process = run()
    for line in process.stdout:
        if line.startswith("arm1 has no agent: started one"):
            break
    process.send_signal(signal.SIGINT)
    process.communicate(timeout=200)
    assert left_of(nodes) == []


def test_run_waits_for_agents_that_come_later(run, nodes):
    process = run("--wait", "40", "--record", "off")
    assert process.stdout.readline() == "waiting for arm0 and arm1, at most 40 s\n"
    nodes.agent_process("arm1")
    assert process.stdout.readline() == "waiting for arm0, at most 40 s\n"
    nodes.agent_process("arm0")
    until_on(process)
    process.send_signal(signal.SIGINT)
    _, err = process.communicate(timeout=200)
    assert process.returncode == 0, err


def test_run_waits_no_longer_than_it_is_told_and_ends_at_ctrl_c(run, nodes):
    process = run("--wait", "0")
    _, err = process.communicate(timeout=200)
    assert process.returncode == 1
    assert "no agent for arm0 and arm1" in err
    assert "start 'pbonet agent --name arm0'" in err
    process = run("--wait", "1000")
    assert "waiting for arm0 and arm1" in process.stdout.readline()
    process.send_signal(signal.SIGINT)
    _, err = process.communicate(timeout=200)
    assert process.returncode == 1
    assert "the wait for arm0 and arm1 was interrupted" in err
    assert left_of(nodes) == []


def test_killed_run_takes_its_agents_with_it(run, nodes, shared_memory):
    process = run()
    until_on(process)
    assert left_of(nodes)
    process.kill()
    process.communicate()
    wait_for(lambda: not left_of(nodes), "the end of the embedded agents")
    assert list(shared_memory.iterdir()) == []


def test_verbs_steer_a_run_and_stop_ends_it(run, verb):
    process = run("--strict")
    until_on(process)
    done = verb("set", "puma_pidg", "kd", "200", "190", "60", "12", "11", "12")
    assert done.returncode == 0, done.stderr
    assert "200 190 60" in verb("get", "puma_pidg", "kd").stdout
    assert verb("off", "grav_comp").returncode == 0
    data = json.loads(verb("status", "--json").stdout)
    state = {task["task"]: task["fields"]["state"] for task in data["tasks"]}
    assert state["grav_comp"] == "OFF"
    assert any(rtpu["illegal"] for rtpu in data["rtpus"])
    assert verb("on", "grav_comp").returncode == 0
    done = verb("stop", "puma", file=False)
    assert done.returncode == 0
    assert "puma_pidg" in done.stdout
    out, err = process.communicate(timeout=200)
    assert process.returncode in {4, 5}, out + err  # 4: the machine stood still, too
    assert "stopped from elsewhere" in out
    assert out.rstrip().endswith("ended its tasks before the end")


def test_agent_that_is_there_is_used_and_stays(run, nodes):
    nodes.agent_process("arm1")
    process = run("--seconds", "0.5")
    out, err = process.communicate(timeout=200)
    assert process.returncode == 0, err
    assert "arm0 has no agent" in out
    assert "arm1 has no agent" not in out
    wait_for(
        lambda: session.rtpus(nodes.session, nodes.domain) == ["arm1"], "arm1 alone"
    )


def test_without_embedding_a_missing_rtpu_is_an_error(run):
    process = run("--no-embed", "--seconds", "1")
    _, err = process.communicate(timeout=200)
    assert process.returncode == 1
    assert "no agent of domain" in err
    assert "Traceback" not in err


def test_illegal_job_is_refused_and_nothing_is_left(run, nodes, puma):
    job = puma.with_suffix(".job")
    text = job.read_text().replace("TASK  grav_comp  arm1\n", "")
    job.write_text(text.replace(" puma_pidg grav_comp\n", " puma_pidg\n"))
    process = run("--seconds", "1")
    _, err = process.communicate(timeout=200)
    assert process.returncode == 1
    assert "T_GRAV" in err
    assert "grav_comp" in err
    assert "Traceback" not in err
    assert left_of(nodes) == []


def test_job_that_fails_in_init_is_rolled_back(run, nodes, puma):
    library = ROOT / "tests" / "misbehaving"
    (puma.parent / "bad.rmod").write_text(
        "MODULE raises_in_init\nDESC bad\nSVARALIAS Y=T_GRAV\nINCONST none\n"
        "OUTCONST none\nINVAR none\nOUTVAR Y\nTASKTYPE periodic\nFREQ 50\nEOF\n"
    )
    job = puma.with_suffix(".job")
    job.write_text(job.read_text().replace("grav_comp", "bad"))
    process = run("--seconds", "1", "--library", library)
    _, err = process.communicate(timeout=200)
    assert process.returncode == 1
    assert "init" in err
    assert left_of(nodes) == []


def test_an_error_in_the_very_first_cycle_is_told(run, nodes, puma):
    """Though the job is not said to be ON yet."""
    nodes.write_module(
        "fails",
        """
        from typing import Annotated as A

        from pbonet import OutVar, PortBasedObject, Vector


        class Fails(PortBasedObject):
            '''Raises in its first cycle.'''

            y: A[Vector, OutVar("T_GRAV", "6", "N*m", "nothing")]

            def cycle(self, dt: float) -> None:
                raise ValueError("not even one cycle works")
        """,
    )
    folder = puma.parent
    (folder / "fails.rmod").write_text(
        "MODULE fails\nDESC fails\nINCONST none\nOUTCONST none\nINVAR none\n"
        "OUTVAR T_GRAV\nTASKTYPE periodic\nFREQ 100\nEOF\n"
    )
    job = folder / "fails.job"
    job.write_text(f"JOB fails\nDESC fails\nSBS {puma.name}\nTASK fails arm0\nEOF\n")
    process = run("--library", nodes.library, "--seconds", 1, job=job)
    said, _ = process.communicate(timeout=200)
    told = [line for line in said.splitlines() if " METHOD " in line]
    assert len(told) == 1, said
    assert "arm0/fails" in told[0]
    assert "not even one cycle works; it is ERROR" in told[0]


def test_a_task_that_never_ends_its_first_cycle_has_failed(
    nodes, tmp_path, monkeypatch, capsys
):
    """It is ended by force, which the run tells; no task is in ERROR."""
    hung, begun = tmp_path / "hung.rmod", tmp_path / "begun"
    whole = run_module.Run._watch
    hung.write_text(nodekit.rmod("hangs_at_once", local={"BEGUN": begun}))
    (tmp_path / "s.svar").write_text(nodekit.svar(1))
    (tmp_path / "s.sbs").write_text("SUBSYSTEM s\nSVARFILE s.svar\nRTPU c0\nEOF\n")
    job = tmp_path / "j.job"
    job.write_text("JOB j\nDESC d\nSBS s.sbs\nTASK hung\nEOF\n")

    def watch(*given):
        wait_for(begun.exists, "that the first cycle begins")
        monkeypatch.setattr(subsystem_tasks, "CONTROL_TIME", 0.5)
        monkeypatch.setattr(subsystem_tasks, "STOP_TIME", 0.5)
        return whole(*given)

    monkeypatch.setattr(run_module.Run, "_watch", watch)
    place = Place(domain=nodes.domain, libraries=(str(nodekit.MISBEHAVING),))
    outcome = run_module.run(job, place, seconds=0.0, record="off")
    assert [(one.state, one.error) for one in outcome.tasks] == [("ON", "")]
    assert outcome.status == 1
    assert outcome.faults == [
        "c0/hung: the task hung hung and was terminated by force (expected 'off' "
        "between "
        "two of its cycles, got a method of module hangs_at_once that does not "
        "return); see what its cycle() or its off() waits for"
    ]
    assert f"ERROR> {outcome.faults[0]}" in capsys.readouterr().out
    assert left_of(nodes) == []


def test_run_in_virtual_time_needs_no_agents(run, nodes):
    process = run("--sim", "--seconds", "0.2")
    out, _ = process.communicate(timeout=200)
    assert process.returncode == 0
    assert "virtual time" in out
    assert run_folder.live_agents(nodes.domain) == []


def test_first_core_is_left_to_housekeeping():
    assert assign_cores(["a", "b"], [0, 1]) == {"a": 1, "b": 1}
    assert assign_cores(["a", "b", "c"], {2, 0, 1}) == {"a": 1, "b": 2, "c": 1}
    assert assign_cores(["a", "b"], [3]) == {"a": 3, "b": 3}
    assert assign_cores([], [0]) == {}


def test_live_table_shows_every_task(puma):
    """The view of a terminal, drawn into a file."""
    simulation = VirtualJob(puma.with_suffix(".job"))
    simulation.start()
    out = io.StringIO()
    with Screen(Console(file=out, width=150, force_terminal=True)) as screen:
        screen.say("begun [not a tag]")
        for _ in range(3):
            simulation.wait(0.1)
            screen.show(0.1, simulation.rtpu_status(), [])
        screen.show(0.4, [], [])
    simulation.stop()
    text = out.getvalue()
    assert "begun [not a tag]" in text
    for task in ("puma_pidg", "grav_comp", "qrdiff", "jttrace"):
        assert task in text
    assert "Ctrl-C turns everything off" in text


def test_a_killed_rtpu_process_of_a_run_has_its_tasks_again(run, nodes, verb):
    """They are OFF, as the job says nothing else; the run goes on, and tells why."""
    process = run("--record", "off")
    until_on(process)
    os.kill(nodes.state("arm1").pid, signal.SIGKILL)

    def shown():
        return verb("status").stdout

    again = "spawned again, OFF: RESTART off"
    wait_for(lambda: shown().count(again) == 3, "all tasks are there again")
    for task in ("grav_comp", "qrdiff", "jttrace"):
        assert verb("on", task).returncode == 0
    assert "RESTART> " not in shown()
    process.send_signal(signal.SIGINT)
    out, err = process.communicate(timeout=200)
    assert "interrupted" in out, err
    assert left_of(nodes) == []
    assert not desired_state.path_of(nodes.domain, "arm1").parent.exists()


def test_a_run_that_ends_while_an_rtpu_process_starts_again_has_failed(run, nodes):
    process = run("--record", "off")
    until_on(process)
    os.kill(nodes.state("arm1").pid, signal.SIGKILL)
    process.send_signal(signal.SIGINT)  # at once: it starts again within a second
    out, err = process.communicate(timeout=200)
    assert process.returncode == 1, out
    assert "ERROR> " in out + err
    causes = "arm1 gave no status", "SIGKILL", "the RTPU process has ended"
    assert any(one in out + err for one in causes)
