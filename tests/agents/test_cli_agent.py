"""``pbonet agent`` and ``pbonet doctor`` as processes."""

from __future__ import annotations

import json
import os
import signal
import subprocess
import sys
from pathlib import Path

import pytest
from watching import wait_for

from pbonet.analysis.schedule.records import Probe
from pbonet.master.tools import doctor
from pbonet.xm.net import run_folder, session

ROOT = Path(__file__).parents[2]
CORE = str(max(os.sched_getaffinity(0)))


@pytest.fixture
def pbonet(nodes):
    """Run a verb in the domain of the kit."""

    def run(*words):
        return subprocess.run(
            [sys.executable, "-m", "pbonet.cli", *words, "--domain", nodes.domain],
            capture_output=True,
            text=True,
            cwd=ROOT,
            timeout=200,
            check=False,
        )

    return run


@pytest.fixture
def agent(nodes):
    """Start ``pbonet agent`` and wait until it can be reached."""
    started = []

    def start(name, *words):
        process = subprocess.Popen(
            [sys.executable, "-m", "pbonet.cli", "agent", "--name", name, *words],
            cwd=ROOT,
            env={**os.environ, "PBONET_DOMAIN": nodes.domain},
            stderr=subprocess.PIPE,
            text=True,
        )
        started.append(process)
        nodes.wait_agent(name, process)
        return process

    yield start
    nodes.forget_session()
    for process in started:
        if process.poll() is None:
            process.terminate()
        process.communicate(timeout=100)


def test_agent_answers_until_it_is_told_to_end(agent, pbonet):
    process = agent("arm0", "--core", CORE, "--verbose")
    shown = pbonet("doctor", "--json")
    found = json.loads(shown.stdout)
    assert shown.returncode == 0
    assert any(one["what"].startswith(f"arm0: core {CORE} of ") for one in found)
    process.send_signal(signal.SIGINT)
    _, err = process.communicate(timeout=100)
    assert process.returncode == 0
    assert "started RTPU process" in err


def test_second_agent_of_a_name_is_refused_without_a_stack(agent, pbonet):
    agent("arm0", "--core", CORE)
    second = pbonet("agent", "--name", "arm0")
    assert second.returncode == 1
    assert "the name is taken on this machine" in second.stderr
    assert "Traceback" not in second.stderr


def test_agent_takes_its_machine_from_a_file(agent, nodes, tmp_path):
    (tmp_path / "agent.toml").write_text(
        f'name = "other"\ncore = {CORE}\nlibraries = ["{tmp_path}"]\n'
    )
    agent("arm0", "--config", str(tmp_path / "agent.toml"))
    assert session.rtpus(nodes.session, nodes.domain) == ["arm0"]


@pytest.mark.parametrize("by", ["option", "environment"])
def test_agent_says_which_folders_of_modules_are_not_there(
    agent, tmp_path, monkeypatch, by
):
    gone = tmp_path / "gone"
    words = ("--library", str(gone), "--library", str(tmp_path))
    if by == "environment":
        monkeypatch.setenv("PBONET_LIBRARY", f"{gone}:{tmp_path}")
        words = ()
    process = agent("arm0", *words)
    process.send_signal(signal.SIGINT)
    _, err = process.communicate(timeout=100)
    assert f"arm0: there is no folder {gone}, named as a library" in err
    assert err.count("no folder") == 1


def test_agent_without_a_name_or_with_a_wrong_file_says_so(pbonet, tmp_path):
    nameless = pbonet("agent")
    assert nameless.returncode == 1
    assert "an agent needs a name" in nameless.stderr
    (tmp_path / "agent.toml").write_text("nmae = 'arm0'\n")
    wrong = pbonet("agent", "--config", str(tmp_path / "agent.toml"))
    assert wrong.returncode == 1
    assert "did you mean name?" in wrong.stderr


def test_agent_whose_parent_is_gone_does_not_begin(pbonet, nodes):
    done = pbonet("agent", "--name", "arm0", "--with-parent", "1")
    assert done.returncode == 0
    assert run_folder.live_agents(nodes.domain) == []


def test_doctor_tells_of_a_killed_rtpu_and_cleans_up(nodes, pbonet, agent):
    process = agent("arm0", "--core", CORE, "--grace", "60")
    state = nodes.state("arm0")
    process.kill()
    os.kill(state.pid, signal.SIGKILL)
    process.wait()
    wait_for(lambda: not state.alive, "the end of the RTPU process")
    shown = pbonet("doctor")
    assert (
        f"RTPU arm0 of domain {nodes.domain} was killed and left files" in shown.stdout
    )
    assert pbonet("doctor", "--clean").returncode == 0
    again = pbonet("doctor")
    assert "was killed" not in again.stdout
    assert "no process uses" not in again.stdout
    run_folder.Places(nodes.domain, "arm0").remove(
        *(nodes.folder / nodes.domain).glob("arm0.*")
    )


def test_doctor_finds_shared_memory_that_nobody_uses(shared_memory):
    stale = shared_memory / f"pbonet.{os.getuid()}.old.svar"
    stale.write_bytes(b"x")
    (shared_memory / "pbonet.99999.other.svar").write_bytes(b"x")
    assert doctor.abandoned() == [stale]
    assert doctor.clean() == [stale.name]
    (shared_memory / "pbonet.99999.other.svar").unlink()


def test_doctor_removes_nothing_that_a_process_with_more_rights_may_use(
    shared_memory, monkeypatch
):
    """The kernel hides what a process has mapped that has a capability, say."""
    own = shared_memory / f"pbonet.{os.getuid()}.core1"
    own.write_bytes(b"x")
    read = Path.read_text

    def hidden(path, *args, **how):
        if path == Path("/proc", str(os.getpid()), "maps"):
            raise PermissionError(path)
        return read(path, *args, **how)

    with monkeypatch.context() as patch:
        patch.setattr(Path, "read_text", hidden)
        assert not doctor.clean()
    with monkeypatch.context() as patch:  # hidepid: it is not even seen
        patch.setattr(os, "access", lambda path, _: path != "/proc/1/status")
        assert not doctor.clean()
    assert doctor.abandoned() == [own]
    own.unlink()


def probe(**changes):
    values = {
        "backend": "fifo",
        "fifo": True,
        "errno": 0,
        "reasons": [],
        "rtprio_limit": -1,
        "cap_sys_nice": True,
        "cgroup_rt_runtime_us": None,
        "rt_runtime_us": 950_000,
        "rt_period_us": 1_000_000,
        "memlock_limit": -1,
        "lock_memory": True,
        "cores": [0, 1],
        "share": 0.95,
        "share_reason": "kernel.sched_rt_runtime_us",
        "preempt": "PREEMPT_RT",
    }
    return Probe(**{**values, **changes})


def test_doctor_says_what_rights_are_lacking():
    found = list(doctor.rights(probe()))
    assert {one.level for one in found} == {doctor.Level.PASS}
    found = list(
        doctor.rights(probe(fifo=False, reasons=["no right"], lock_memory=False))
    )
    assert [str(one.level) for one in found] == ["WARN", "WARN", "WARN", "PASS"]
    assert str(found[1]) == "WARN no right"
    assert all(one.what for one in found)


def test_doctor_fails_without_shared_memory(monkeypatch, tmp_path):
    monkeypatch.setenv("PBONET_SHM_DIR", str(tmp_path / "none"))
    assert next(doctor.memory()).level is doctor.Level.FAIL
    monkeypatch.setenv("PBONET_SHM_DIR", str(tmp_path))
    monkeypatch.setattr(doctor, "_LEAST_SHM", 1 << 62)
    assert next(doctor.memory()).level is doctor.Level.FAIL


def test_doctor_warns_when_no_core_is_left(nodes, pbonet):
    for core in sorted(os.sched_getaffinity(0)):
        nodes.agent(f"rtpu{core}", core=core)
    assert "none is left for housekeeping" in pbonet("doctor").stdout
