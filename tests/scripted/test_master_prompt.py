"""The prompt: it stays whatever happens, and one key always stops."""

from __future__ import annotations

import os
import pty
import subprocess
import sys
import threading
import time
from pathlib import Path

import pytest
from prompt_toolkit.history import InMemoryHistory
from prompt_toolkit.input import create_pipe_input
from prompt_toolkit.output import DummyOutput

from pbonet.master.console.prompt import Prompt, summary
from pbonet.master.subsystem.status_fields import Window
from pbonet.xm.net import messages as m

F12 = "\x1b[24~"


@pytest.fixture
def type_in(arm):
    """Give keys to a prompt, wait for its end, return what it printed."""

    def run(*keys, meanwhile=None):
        said: list[str] = []
        with create_pipe_input() as source:
            prompt = Prompt(
                arm,
                source=source,
                screen=DummyOutput(),
                history=InMemoryHistory(),
                say=said.append,
            )
            thread = threading.Thread(target=prompt.run)
            thread.start()
            for text in keys:
                source.send_text(text)
            if meanwhile is not None:
                meanwhile(source)
            thread.join(30)
            assert not thread.is_alive()
        return "\n".join(said)

    return run


def test_commands_are_carried_out_and_the_default_follows(type_in, arm):
    out = type_in(
        "spawn puma_pidg arm0\n", "spawn jttrace arm1\n", "on\n", "off\n", "quit\n"
    )
    assert out.splitlines() == [
        "puma_pidg OFF",
        "jttrace OFF",
        "jttrace ON",
        "jttrace OFF",
    ]
    assert [member.name for member in arm.model] == ["puma_pidg", "jttrace"]


def test_errors_never_lose_the_prompt(type_in):
    out = type_in(
        "nonsense\n",
        "spawn\n",
        "on pid\n",
        "spawn 'x\n",
        "spawn nobody\n",
        "spawn puma_pidg arm0\n",
        "quit\n",
    )
    lines = out.splitlines()
    assert [line.split(">")[0] for line in lines[:5]] == ["ERROR"] * 5
    assert lines[5] == "puma_pidg OFF"


def test_fault_of_ours_does_not_lose_the_prompt_either(type_in, arm, monkeypatch):
    monkeypatch.setattr(arm, "events", lambda *_, **__: 1 / 0)
    out = type_in("events\n", "stop\n", "quit\n")
    assert "ERROR> it failed inside pbonet: ZeroDivisionError" in out
    assert "nothing was ON" in out


def test_warnings_stand_before_the_answer(type_in):
    out = type_in(
        "spawn puma_pidg arm0\n", "spawn grav_comp arm1\n", "on grav_comp\n", "quit\n"
    )
    lines = out.splitlines()
    assert lines[-2].startswith("WARNING> ")
    assert "Q_MEZ" in lines[-2]
    assert lines[-1] == "grav_comp ON"


def test_end_of_input_quits(type_in):
    assert type_in("\x04") == ""


@pytest.mark.parametrize("key", [F12, "\x05"])
def test_one_key_stops_while_a_line_is_typed(type_in, arm, agents, key):
    arm.start("puma")
    out = type_in("half a li", key, "quit\n")
    assert agents["arm0"].tasks == agents["arm1"].tasks == {}
    assert "turned off:" in out


def test_one_key_stops_while_a_command_runs(type_in, arm, agents):
    arm.start("puma")
    agents["arm1"].requests.clear()
    agents["arm1"].slow["control"] = 3.0

    def wait_for(condition):
        deadline = time.monotonic() + 60
        while not condition():
            assert time.monotonic() < deadline
            time.sleep(0.01)

    def press(source):
        wait_for(lambda: any(isinstance(r, m.Control) for r in agents["arm1"].requests))
        source.send_text(F12)
        wait_for(lambda: not (agents["arm0"].tasks or agents["arm1"].tasks))
        source.send_text("quit\n")

    assert "turned off:" in type_in("off jttrace\n", meanwhile=press)


def test_control_c_throws_a_line_away(type_in):
    out = type_in("spawn puma_pidg arm0", "\x03", "quit\n")
    assert out == ""


def test_control_c_takes_control_back_from_the_network(type_in):
    def take_back(source):
        time.sleep(0.3)  # any moment will do; the port waits for ever
        source.send_text("\x03")
        source.send_text("spawn puma_pidg arm0\nquit\n")

    out = type_in("network onika\n", meanwhile=take_back)
    assert out.splitlines()[0] == (
        "port onika waits for a client; Ctrl-C takes control back"
    )
    assert out.splitlines()[-1] == "puma_pidg OFF"


def test_toolbar_counts_states_and_tells_of_the_flag():
    status = m.RtpuStatus(
        rtpu="arm0",
        backend="fifo",
        scheduler="MUF",
        tasks=[],
        util=0.25,  # since the RTPU began: what the bar tells is the load now
        illegal=["equation 2"],
    )
    told = summary([status], [], Window())
    assert told == "no tasks   arm0 fifo 0%   ILLEGAL equation 2"


def test_prompt_on_a_real_terminal(world, agents, puma, tmp_path):
    """The verb on a pseudo-terminal: prompt, command, history, F12, quit."""
    agents("arm0", "arm1")
    master, slave = pty.openpty()
    process = subprocess.Popen(
        [
            sys.executable,
            "-m",
            "pbonet.cli",
            "prompt",
            str(puma),
            "--domain",
            world.domain,
        ],
        stdin=slave,
        stdout=slave,
        stderr=slave,
        close_fds=True,
        env={**os.environ, "PBONET_STATE_DIR": str(tmp_path), "TERM": "xterm"},
        cwd=Path(__file__).parents[2],
    )
    os.close(slave)
    seen = bytearray()

    def wait_for(text):
        deadline = time.monotonic() + 60
        while text not in seen:
            assert time.monotonic() < deadline, seen.decode(errors="replace")
            seen.extend(os.read(master, 4096))
            if b"\x1b[6n" in seen:  # it asks where the cursor is
                seen[:] = seen.replace(b"\x1b[6n", b"")
                os.write(master, b"\x1b[1;1R")

    try:
        wait_for(b"SBS puma<>")
        wait_for(b"STOP")
        os.write(master, b"spawn puma_pidg arm0\r")
        wait_for(b"SBS puma<puma_pidg>")
        assert list(agents["arm0"].tasks) == ["puma_pidg"]
        os.write(master, F12.encode())
        wait_for(b"nothing was ON")
        os.write(master, b"quit\r")
        assert process.wait(30) == 0
    finally:
        process.kill()
        process.wait()
        os.close(master)
    assert "spawn puma_pidg arm0" in (tmp_path / "history").read_text()
    assert agents["arm0"].claims == {}
