"""An agent whose process is stopped: verbs say so and end, and the others are steered.

How long that takes is measured by ``benchmarks/unreachable.py``; here stand the limits
that it is made of.
"""

from __future__ import annotations

import json
import os
import signal
import subprocess
import sys
from contextlib import contextmanager

import pytest
from watching import wait_for

from pbonet.master.subsystem.subsystem import Subsystem
from pbonet.xm.net import rpc, session

pytestmark = pytest.mark.own_limits
START_UP = 0.6
"""Seconds that Python and its imports take on the machine of the benchmark."""


def test_the_limits_add_up_to_less_than_two_seconds():
    stopped = session.OPEN_MS * 1e-3 + rpc.ASK_TIME  # passed over; no answer
    silent = rpc.ASK_TIME + rpc.PROOF_TIME
    nobody = session.OPEN_TIME
    assert START_UP + max(stopped, silent, nobody) < 2.0


@pytest.fixture
def two(nodes):
    nodes.agent_processes("arm0", "arm1")
    return nodes


@pytest.fixture
def verb(two, puma):
    """Run a verb on the PUMA subsystem; return its status, output and errors."""

    def run(name, *words, data=False):
        where = ["puma"] if name == "stop" else [str(puma)]
        command = [sys.executable, "-m", "pbonet.cli", name, *where, *words]
        command += ["--domain", two.domain, *(["--json"] if data else [])]
        return subprocess.run(
            command, capture_output=True, text=True, timeout=200, check=False
        )

    return run


@contextmanager
def stopped(nodes, *names):
    """Hold agents; return their processes."""
    processes = [nodes.processes[name] for name in names]
    try:
        for process in processes:
            process.send_signal(signal.SIGSTOP)
        for process in processes:
            os.waitid(os.P_PID, process.pid, os.WSTOPPED | os.WNOWAIT)
        yield [process.pid for process in processes]
    finally:
        for process in processes:
            process.send_signal(signal.SIGCONT)


def told(name, pid):
    return (
        f"{name}: the agent cannot be reached, although its process runs (got "
        f"process {pid}, which is stopped); 'kill -CONT {pid}' resumes it; else "
        f"end it with 'kill -9 {pid}' and start it again"
    )


@pytest.mark.parametrize("hung", ["arm0", "arm1"])
def test_one_of_two_is_named_and_the_other_is_steered(two, puma, verb, hung):
    other = {"arm0": "arm1", "arm1": "arm0"}[hung]
    with Subsystem(puma, domain=two.domain) as arm:
        arm.spawn("puma_pidg", "arm0")
        arm.spawn("jttrace", "arm1")
        arm.control("jttrace", "on")
        arm.detach()
    mine = {"arm0": "puma_pidg", "arm1": "jttrace"}[other]
    with stopped(two, hung) as (pid,):
        text = told(hung, pid)
        seen = verb("status")
        assert (seen.returncode, seen.stderr) == (0, f"WARNING> {text}\n")
        assert mine in seen.stdout
        for words in (("spawn", "qrdiff", other), ("on", "qrdiff")):
            # The first master was seen through the hung agent, until its link goes.
            steered = wait_for(
                lambda w=words: (one := verb(*w)).returncode == 0 and one, str(words)
            )
            assert steered.stderr.startswith(f"WARNING> {text}\n")
        assert verb("start", "puma").returncode == 1, "it needs both"
        done = verb("kill", mine)
        assert done.returncode == 0
        assert done.stderr.startswith(f"WARNING> {text}\n")
        unknown = verb("off", "nobody", data=True)
        assert unknown.returncode == 1
        data = json.loads(unknown.stdout)
        assert data["error"]["code"] == "UNKNOWN_TASK"
        assert data["warnings"] == [text]
        halted = verb("stop")
        assert halted.returncode == 1
        assert "an RTPU did not confirm the stop" in halted.stderr
        assert text in halted.stderr
    wait_for(lambda: len(two.client().rtpus()) == 2, f"return of {hung}")
    assert verb("stop").returncode == 0


def test_all_are_named_when_all_are_stopped(two, verb):
    with stopped(two, "arm0", "arm1") as (first, second):
        for words in (("status",), ("on", "sine"), ("spawn", "sine"), ("stop",)):
            done = verb(*words)
            assert done.returncode == 1
            assert done.stderr.endswith(
                f"every agent of domain {two.domain} on this machine is stopped (got "
                f"arm0: process {first}, arm1: process {second}); 'kill -CONT {first} "
                f"{second}' resumes them\n"
            )
