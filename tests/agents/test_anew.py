"""What SIGHUP does to an agent: it restarts, or ends with its terminal."""

from __future__ import annotations

import contextlib
import os
import pty
import signal
import subprocess
import sys
from subprocess import DEVNULL

import pytest
from nodekit import CORE, MISBEHAVING
from watching import wait_for

from pbonet.errors import PbonetError, XmAccessError
from pbonet.xm.net import file_messages as f, messages as m

NO_GOOD = {
    "nmae = 'arm0'\n": "agent.toml:1:1: unknown key 'nmae'",
    "name = 'arm1'\n": "an RTPU that keeps running keeps its name (expected name arm0",
}
"""Configurations, and what is said of each."""


class Program:
    """`pbonet agent` with a configuration in a file."""

    def __init__(self, nodes, folder):
        self.nodes = nodes
        self.file = folder / "agent.toml"

    def configure(self, **more):
        config = {"name": "arm0", "domain": self.nodes.domain, "grace": 3.0, **more}
        lines = [f"{key} = {value!r}" for key, value in config.items()]
        lines += [f"core = {CORE}", f"libraries = [{str(MISBEHAVING)!r}]", ""]
        self.file.write_text("\n".join(lines))

    def start(self, *before, **more):
        words = (sys.executable, "-m", "pbonet.cli", "agent", "-v", "--config")
        process = subprocess.Popen([*before, *words, self.file], **more)
        self.nodes.processes["arm0"] = process
        self.nodes.wait_agent("arm0", process)
        return process

    def zid(self):
        """Return the identity of the agent's session, once there is one."""
        with contextlib.suppress(PbonetError):
            return self.nodes.client().call("arm0", m.Hello(), m.AgentInfo).zid
        self.nodes.forget_session()
        return None

    def refusals(self):
        """Return what the agent has said of configurations that are no good."""
        found = self.nodes.client().call("arm0", m.Events(), list[m.Event])
        return [event.text for event in found if event.code == "NOT_RESTARTED"]


@pytest.fixture
def program(nodes, tmp_path):
    made = Program(nodes, tmp_path)
    made.configure()
    return made


def test_it_starts_anew_in_its_place(program, nodes, tmp_path):
    """As the same process, with its configuration read again; tasks go on.

    A configuration that is no good is not taken, and the agent stays what it is.
    """
    process = program.start()
    master = nodes.master("arm0", "arm")
    master.spawn("a", "counts")
    master.on("a")
    before, zid = master.status("a"), program.zid()
    listing = f.FileList(path="")
    with pytest.raises(XmAccessError, match="declares no files"):
        nodes.client().call("arm0", listing, f.Listing)
    for count, (what, said) in enumerate(NO_GOOD.items()):
        program.file.write_text(what)
        process.send_signal(signal.SIGHUP)
        wait_for(lambda n=count: program.refusals()[n:], f"the refusal of {what!r}")
        assert said in program.refusals()[-1]
        assert program.zid() == zid
    program.configure(files=str(tmp_path))
    process.send_signal(signal.SIGHUP)
    wait_for(lambda: program.zid() not in {None, zid}, "another session", 30.0)
    assert process.poll() is None
    again = nodes.master("arm0", "arm", table=False, take_over=True)
    after = again.wait_cycles("a", 10)
    assert (after.state, after.tid) == ("ON", before.tid)
    assert after.cycle > before.cycle
    found = nodes.client().call("arm0", f.FileList(path=""), f.Listing)
    assert "agent.toml" in [one.name for one in found.entries]


def test_what_comes_while_it_starts_anew_is_heeded(program, tmp_path):
    """Whether the old program leaves or the new one loads: again, and an end."""
    said = tmp_path / "said"
    with said.open("w") as file:
        process = program.start(stderr=file)
    process.send_signal(signal.SIGHUP)
    wait_for(lambda: "restarts" in said.read_text(), "its leaving")
    process.send_signal(signal.SIGHUP)
    process.send_signal(signal.SIGTERM)
    assert process.wait(60.0) == 0


LEAVES = """
import os, signal, sys, threading
from pathlib import Path
from pbonet.node.agent.agent_main import AgentRun

class Agent:
    name = "arm0"
    heed_signals = ask_to_end = lambda self: None

def pending():
    status = Path("/proc/thread-self/status").read_text()
    mask = int(status.partition("SigPnd:")[2].split()[0], 16)
    return mask >> signal.SIGTERM - 1 & 1

threading.Thread(target=threading.Event().wait, daemon=True).start()
life = AgentRun(Agent())
life.heed_signals()
if "before" in sys.argv:
    os.kill(os.getpid(), signal.SIGTERM)
life.leave_signals()
if "after" in sys.argv:
    os.kill(os.getpid(), signal.SIGTERM)
    while not pending():
        pass
asked = "import signal; print(sorted(map(int, signal.sigpending())))"
os.execv(sys.executable, [sys.executable, "-c", asked])
"""


@pytest.mark.parametrize("when", ["before", "after", "never"])
def test_an_end_is_left_to_the_next_program(when):
    """Though another thread, which exec ends, is there to take it."""
    said = subprocess.check_output([sys.executable, "-c", LEAVES, when], text=True)
    assert said.split() == (["[]"] if when == "never" else [f"[{signal.SIGTERM:d}]"])


@pytest.mark.parametrize("how", [[], ["nohup"]], ids=["plain", "nohup"])
def test_a_terminal_that_is_closed(program, how, tmp_path):
    """It ends the agent in order, unless that was started to outlive it."""
    master, slave = pty.openpty()
    heeds = ("env", "--default-signal=HUP")  # whatever the tests were started under
    words, said = ("setsid", "--ctty", *heeds, *how), tmp_path / "said"
    with said.open("w") as file:
        process = program.start(*words, stdin=slave, stdout=DEVNULL, stderr=file)
    os.close(slave)
    zid = program.zid()
    if how:
        process.send_signal(signal.SIGHUP)
        wait_for(lambda: program.zid() not in {None, zid}, "another session", 60.0)
        zid = program.zid()
    os.close(master)
    if how:
        assert program.zid() == zid
        process.send_signal(signal.SIGTERM)
    assert process.wait(60.0) == 0
    assert ("SIGHUP" in said.read_text()) == (not how)
