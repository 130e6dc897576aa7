"""Verbs as processes: they come, act, leave, and the tasks go on."""

from __future__ import annotations

import contextlib
import csv
import io
import json
import os
import pty
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest

from pbonet import modules
from pbonet.config import read_job
from pbonet.errors import UnreachableError
from pbonet.master.console.network_interface import Port
from pbonet.master.subsystem.subsystem import Subsystem
from pbonet.xm.net import messages as m

ROOT = Path(__file__).parents[2]


@pytest.fixture
def pbonet(world, agents, puma):
    """Run a verb on the PUMA subsystem; two fake agents are there."""
    agents("arm0", "arm1")

    def run(verb, *words, file=True, stdin=None):
        command = [sys.executable, "-m", "pbonet.cli", verb]
        command += [str(puma if file is True else file)] if file else []
        command += [*map(str, words), "--domain", world.domain]
        return subprocess.run(
            command,
            capture_output=True,
            text=True,
            cwd=ROOT,
            input=stdin,
            timeout=200,
            check=False,
        )

    return run


@pytest.fixture
def standing(pbonet, world, puma):
    """The same with the robot OFF and the trace ON, as a master left them."""
    arm = Subsystem(puma, domain=world.domain).open()
    arm.spawn("puma_pidg", "arm0")
    arm.spawn("jttrace", "arm1")
    arm.control("jttrace", "on")
    arm.detach()
    return pbonet


def test_subsystem_is_assembled_by_verbs_alone(pbonet, agents):
    for words in (
        ("spawn", "puma_pidg", "arm0"),
        ("spawn", "jttrace", "arm1", "25"),
        ("on", "jttrace"),
    ):
        done = pbonet(*words)
        assert (done.returncode, done.stderr) == (0, ""), words
    assert agents["arm1"].tasks["jttrace"].state == "ON"
    table = pbonet("status", "jttrace", "--fields", "rmod,state,refF").stdout
    assert [line.split() for line in table.splitlines()] == [
        ["rmod", "state", "refF"],
        ["jttrace", "ON", "25"],
    ]


def test_status_is_data_with_json(standing):
    data = json.loads(standing("status", "--json").stdout)
    assert {t["task"]: t["fields"]["state"] for t in data["tasks"]} == {
        "puma_pidg": "OFF",
        "jttrace": "ON",
    }
    assert [rtpu["rtpu"] for rtpu in data["rtpus"]] == ["arm0", "arm1"]
    assert data["warnings"] == []


def test_status_names_each_task_of_the_job_that_is_not_there(standing, agents, puma):
    job = puma.with_name("puma.job")
    names = [task.rmod for task in read_job(job).tasks]
    data = json.loads(standing("status", "--json", file=job).stdout)
    missing = {one["task"]: one for one in data["missing"]}
    assert sorted(missing) == sorted({*names} - {"puma_pidg", "jttrace"})
    one = missing["grav_comp"]
    reason = (
        "it was not spawned, or was killed, since the RTPU process was started, 7 s ago"
    )
    assert one["reason"] == reason
    shown = standing("status", file=job).stdout
    assert f"NOT-CREATED> grav_comp on {one['rtpu']}: {reason}" in shown
    agents[one["rtpu"]].close()
    shown = standing("status", file=job).stdout
    assert f"not known, because RTPU {one['rtpu']} does not answer" in shown
    assert "NOT-CREATED" not in standing("status").stdout, "no job is named"


def test_start_refuses_what_is_unsafe_with_strict_and_else_warns(pbonet, agents, puma):
    rmod = puma.with_name("puma_pidg.rmod")
    theirs = Path(modules.__file__).parent / "robot_interfaces" / rmod.name
    rmod.write_text(theirs.read_text().replace("CRITICAL", ""))
    said = "puma_pidg is a robot interface and not CRITICAL"
    job, text = puma.with_name("puma.job"), puma.read_text()
    puma.write_text(text.replace("\n\nRTPU", "\nSTRICT yes\n\nRTPU", 1))
    refused = pbonet("start", file=job)
    assert refused.returncode == 1
    assert said in refused.stderr
    assert "ON" not in {task.state for task in agents["arm0"].tasks.values()}
    puma.write_text(text)
    done = pbonet("start", file=job)
    assert (done.returncode, f"WARNING> {rmod}" in done.stderr) == (0, True), done
    assert said in done.stderr


def test_refusal_has_status_one_and_no_stack(standing):
    done = standing("on", "jttrace")
    assert done.returncode == 1
    assert done.stdout == ""
    assert done.stderr.startswith("pbonet: arm1/jttrace: the signal on is not valid")
    assert "Traceback" not in done.stderr
    data = json.loads(standing("on", "jttrace", "--json").stdout)
    assert data["error"]["code"] == "STATE"


def test_parameters_rate_and_signals(standing, agents):
    task = agents["arm0"].tasks["puma_pidg"]
    assert standing("set", "puma_pidg", "KD", "1", "-2.5").returncode == 0
    assert task.params["KD"] == "1 -2.5"
    assert "KD" in standing("get", "puma_pidg").stdout
    assert standing("freq", "puma_pidg", "250").stdout == "puma_pidg: 250 Hz\n"
    assert task.freq == 250.0
    assert standing("reconfig", "jttrace:off", "jttrace:kill").returncode == 0
    assert "jttrace" not in agents["arm1"].tasks


def test_verb_without_agents_says_so_at_once(run_dir, puma):
    done = subprocess.run(
        [sys.executable, "-m", "pbonet.cli", "status", str(puma), "--domain", "none"],
        capture_output=True,
        text=True,
        cwd=ROOT,
        timeout=200,
        check=False,
    )
    assert done.returncode == 1
    assert done.stderr.startswith(f"pbonet: {run_dir}")
    assert "no agent of domain none runs on this machine" in done.stderr


def test_verb_is_refused_while_a_master_lives_unless_it_takes_over(
    pbonet, world, puma, agents
):
    with Subsystem(puma, domain=world.domain) as arm:
        done = pbonet("spawn", "puma_pidg")
        assert done.returncode == 1
        assert "another master steers the subsystem" in done.stderr
        assert pbonet("status").returncode == 0  # looking is free
        assert pbonet("spawn", "puma_pidg", "--take-over").returncode == 0
        assert list(agents["arm0"].tasks) == ["puma_pidg"]
        arm.detach()


def test_verb_asks_the_master_that_serves_the_port(pbonet, world, puma, agents):
    with Subsystem(puma, domain=world.domain) as arm:
        with Port(arm, arm.name, handover=False):
            assert pbonet("spawn", "puma_pidg").stdout == "puma_pidg OFF\n"
            done = pbonet("spawn", "nobody")
            assert done.returncode == 1
            assert "there is no RMOD nobody" in done.stderr
        assert arm.status("puma_pidg").state == "OFF"
    assert agents["arm0"].tasks == {}


def test_a_verb_steers_what_remains_when_an_rtpu_is_lost(standing, agents):
    agents["arm0"].close()
    assert standing("off", "jttrace").returncode == 0
    done = standing("on", "jttrace")
    assert done.returncode == 0, done.stderr
    assert "WARNING> arm0: no agent of this name can be reached" in done.stderr
    assert agents["arm1"].tasks["jttrace"].state == "ON"
    assert standing("start", "puma").returncode == 1


def test_stop_needs_no_file_and_no_claim(standing, world, puma, agents):
    with Subsystem(puma, domain=world.domain, take_over=True) as arm:
        arm.detach()
    done = standing("stop", file=False)
    assert (done.returncode, done.stdout) == (0, "turned off: jttrace\n")
    assert agents["arm0"].tasks == agents["arm1"].tasks == {}
    assert json.loads(standing("stop", "puma", "--json", file=False).stdout) == {
        "off": [],
        "killed": [],
        "failed": {},
        "rtpus": ["arm0", "arm1"],
        "warnings": [],
    }
    assert standing("stop", puma, file=False).stdout == "nothing was ON\n"
    wrong = standing("stop", "pumas", file=False)
    assert wrong.returncode == 1
    assert "no RTPU knows a subsystem pumas, so nothing was stopped" in wrong.stderr
    assert "did you mean puma?" in wrong.stderr


def test_stop_names_an_rtpu_that_is_not_seen_and_what_was_on_there(standing, agents):
    on = {"puma": ["jttrace"], "leg": ["walk"]}
    agents["arm0"].lost = [m.Lost(rtpu="arm2", host="b", near=True, ago=7.0, on=on)]
    agents["arm1"].lost = [
        m.Lost(rtpu="arm2", host="b", near=True, ago=9.0, on={}),
        m.Lost(rtpu="leg0", host="c", near=True, ago=9.0, on={"leg": []}),
    ]
    done = standing("stop", "puma", file=False)
    assert (done.returncode, done.stdout) == (1, "")
    assert "an RTPU did not confirm the stop" in done.stderr
    assert "on the others was turned off: jttrace" in done.stderr
    assert "may still be ON: arm2: jttrace;" in done.stderr
    assert "arm0 of fakehost has not seen arm2 of b for 7 s" in done.stderr
    assert "stopped by the other agents as soon as they see it again" in done.stderr
    error = json.loads(standing("stop", "--json", file=False).stdout)["error"]
    assert "2 RTPUs did not confirm the stop" in error["what"]
    assert {one["where"] for one in error["parts"]} == {"arm2", "leg0"}


def test_stop_names_an_rtpu_once_that_gave_an_error_and_is_not_seen(standing, agents):
    for op in ("stop", "hello"):
        agents["arm1"].fail[op, ""] = UnreachableError("hangs", where="arm1")
    agents["arm0"].lost = [
        m.Lost(rtpu="arm1", host="b", near=True, ago=7.0, on={"puma": ["jttrace"]})
    ]
    done = standing("stop", "puma", file=False)
    assert done.returncode == 1
    assert "an RTPU did not confirm the stop" in done.stderr
    assert "may still be ON: arm1: jttrace;" in done.stderr
    assert "arm1: hangs" in done.stderr


def test_variables_once_again_and_as_csv(standing):
    assert standing("write", "T_GRAV", "1", "2", "3", "4", "5", "-6").returncode == 0
    once = standing("display", "T_GRAV").stdout.splitlines()
    assert once[1].split()[-6:] == ["1", "2", "3", "4", "5", "-6"]
    text = standing("display", "T_GRAV", "NDOF", "--csv", "--count", "3").stdout
    rows = list(csv.reader(io.StringIO(text)))
    assert len(rows) == 4
    assert rows[0][:3] == ["time (s)", "T_GRAV[0] (none)", "T_GRAV[1] (none)"]
    assert [float(cell) for cell in rows[1][1:7]] == [1, 2, 3, 4, 5, -6]
    assert rows[0][-3:] == ["NDOF (none)", "NDOF age (s)", "NDOF writer"]
    lines = standing(
        "display", "--watch", "--json", "--count", "2", "--every", "0.05"
    ).stdout.splitlines()
    assert [len(json.loads(line)["variables"]) for line in lines] == [7, 7]
    done = standing("display", "T_GRAF")
    assert "did you mean T_GRAV?" in done.stderr


def test_status_again_and_again_as_lines_and_as_data(standing):
    text = standing("status", "--count", "2", "--every", "0.05").stdout
    lines = [line.split() for line in text.splitlines()]
    assert [line[2:4] for line in lines] == 2 * [
        ["puma_pidg", "OFF"],
        ["jttrace", "ON"],
    ]
    text = standing(
        "status", "jttrace", "--fields", "state,refF", "--watch", "--count", "1"
    ).stdout
    assert text.split()[2:] == ["jttrace", "state", "ON,", "refF", "50"]
    data = standing(
        "status", "--watch", "--json", "--count", "2", "--every", "0.05"
    ).stdout.splitlines()
    found = [json.loads(line) for line in data]
    assert [[one["task"] for one in line["tasks"]] for line in found] == 2 * [
        ["puma_pidg", "jttrace"]
    ]
    assert found[0]["time"] < found[1]["time"]
    done = standing("status", "no_task", "--watch")
    assert (done.returncode, "no task no_task" in done.stderr) == (1, True)
    done = standing("status", "--watch", "--reset")
    assert (done.returncode, "exclude each other" in done.stderr) == (1, True)


def test_watched_status_renews_itself_until_ctrl_c(standing, world, puma):
    del standing
    words = ["status", str(puma), "--watch", "--domain", world.domain]
    master, side = pty.openpty()
    shown = subprocess.Popen(
        [sys.executable, "-m", "pbonet.cli", *words],
        stdin=side,
        stdout=side,
        stderr=side,
        cwd=ROOT,
        env={**os.environ, "TERM": "xterm", "COLUMNS": "150"},
    )
    os.close(side)
    text = ""
    while text.count("Ctrl-C ends this; the tasks go on") < 2:
        text += os.read(master, 1 << 16).decode()
    assert "jttrace" in text
    shown.send_signal(signal.SIGINT)  # as a terminal does
    with contextlib.suppress(OSError):  # the terminal is closed
        while more := os.read(master, 1 << 16):
            text += more.decode()
    assert shown.wait(60) == 0, text
    os.close(master)
    assert "Traceback" not in text


def test_the_graph_of_the_tasks_that_exist(standing, tmp_path):
    done = standing("graph", "--running", "--svg", tmp_path / "now.svg")
    assert (done.returncode, done.stdout) == (0, f"{tmp_path / 'now.svg'}\n")
    drawn = (tmp_path / "now.svg").read_text("utf-8")
    assert "● ON" in drawn
    assert "○ OFF" in drawn
    data = json.loads(standing("graph", "--running", "--json").stdout)
    assert data["states"] == {"puma_pidg": "OFF", "jttrace": "ON"}
    assert [wire["variable"] for wire in data["wires"]] == ["NDOF", "Q_REF"]


def test_script_from_standard_input(pbonet, agents):
    text = "# two tasks\nspawn puma_pidg arm0\n\nspawn jttrace arm1\non\nwait 0.01\n"
    done = pbonet("prompt", "--leave", stdin=text)
    assert done.returncode == 0
    assert done.stdout.splitlines() == ["puma_pidg OFF", "jttrace OFF", "jttrace ON"]
    assert agents["arm1"].tasks["jttrace"].state == "ON"


def test_script_may_begin_with_a_byte_order_mark_and_end_lines_like_windows(
    pbonet, tmp_path
):
    script = tmp_path / "arm.cmd"
    script.write_bytes(b"\xef\xbb\xbfspawn puma_pidg arm0\r\nstatus fields=state\r\n")
    done = pbonet("prompt", "--script", script)
    assert (done.returncode, done.stderr) == (0, "")
    assert done.stdout.split() == ["puma_pidg", "OFF", "state", "OFF"]


def test_script_that_is_no_text_is_refused(pbonet, tmp_path, agents):
    script = tmp_path / "arm.cmd"
    script.write_bytes(b"\xff\xfe\x00")
    done = pbonet("prompt", "--script", script)
    assert f"{script}: the script cannot be read" in done.stderr
    assert "write it as UTF-8 text" in done.stderr
    assert agents["arm0"].requests == []
    done = pbonet("prompt", stdin="foo")
    assert "standard input:1: ERROR> there is no command foo" in done.stderr


def test_script_stops_at_the_first_error_and_finishes(pbonet, agents, tmp_path):
    script = tmp_path / "arm.cmd"
    script.write_text("spawn puma_pidg arm0\nspawn nobody\nspawn jttrace arm1\n")
    done = pbonet("prompt", "--script", script)
    assert done.returncode == 1
    assert f"{script}:2: ERROR> there is no RMOD nobody" in done.stderr
    assert done.stdout == "puma_pidg OFF\n"
    assert agents["arm0"].tasks == agents["arm0"].claims == {}
    going = pbonet("prompt", "--script", script, "--keep-going", "--json")
    assert going.returncode == 1
    replies = [json.loads(line) for line in going.stdout.splitlines()]
    assert [reply.get("command") for reply in replies] == ["spawn", None, "spawn"]
    assert replies[1]["place"] == f"{script}:2"


def test_script_that_is_missing_is_said_before_anything_is_done(pbonet, agents):
    done = pbonet("prompt", "--script", "no/such/file")
    assert done.returncode == 1
    assert "no/such/file: the script cannot be read" in done.stderr
    assert agents["arm0"].requests == []


def test_modules_and_events_are_listed(pbonet):
    assert "puma_pidg" in pbonet("library").stdout
    out = pbonet("library", "diff").stdout
    assert "parameters" in out
    assert "RMODs     diff qmdiff qrdiff" in out
    assert pbonet("events").stdout == "no events\n"
    done = pbonet("events", "--code", "WARNIGN")
    assert (done.returncode, done.stdout) == (0, "no events\n")
    told = "WARNING> no event has the code WARNIGN; did you mean WARNING?\n"
    assert done.stderr == told
    done = pbonet("events", "--task", "NOSUCH")
    assert (done.returncode, done.stdout) == (1, "")
    assert "the subsystem has no task NOSUCH" in done.stderr
    with_data = json.loads(pbonet("events", "--code", "WARNIGN", "--json").stdout)
    assert with_data["warnings"] == [told.removeprefix("WARNING> ").strip()]


@pytest.mark.usefixtures("standing")
def test_looking_verb_ends_when_its_reader_does(world, puma):
    """``pbonet display --csv | head`` does not hang or complain."""
    words = ["display", str(puma), "--csv", "--every", "0.01"]
    shown = subprocess.Popen(
        [sys.executable, "-m", "pbonet.cli", *words, "--domain", world.domain],
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
        cwd=ROOT,
    )
    assert shown.stdout.readline().startswith("time (s)")
    shown.stdout.close()
    deadline = time.monotonic() + 60
    while shown.poll() is None:
        assert time.monotonic() < deadline
        time.sleep(0.02)
    assert "Traceback" not in shown.stderr.read()
    shown.stderr.close()


@pytest.mark.usefixtures("standing")
def test_events_end_with_their_reader_though_nothing_happens(world, puma):
    words = ["events", str(puma), "--follow", "--domain", world.domain]
    shown = subprocess.Popen(
        [sys.executable, "-m", "pbonet.cli", *words],
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
        cwd=ROOT,
    )
    shown.stdout.close()
    assert shown.wait(60) == 1
    assert shown.stderr.read() == ""
    shown.stderr.close()
