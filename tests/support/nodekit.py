"""Real agents, RTPU processes and tasks for integration tests.

`Nodes` starts agents, within the test's process or as processes of their own, and makes
masters: each claims one RTPU, opens the table and sends requests under its claim.
"""

from __future__ import annotations

import contextlib
import json
import os
import secrets
import shutil
import signal
import subprocess
import sys
import textwrap
from pathlib import Path

import msgspec
import pytest
from long_limits import LIMIT
from watching import END_TIME, clean_folder, processes_of, wait_for

from pbonet.config.model import AgentConfig
from pbonet.errors import PbonetError
from pbonet.node.agent.agent import STOP_TIME, Agent
from pbonet.node.rtpu import cleanup
from pbonet.xm.net import key_expressions, messages as m, run_folder, session
from pbonet.xm.net.rpc import Client

MISBEHAVING = Path(__file__).parents[1] / "misbehaving"
CORE = max(os.sched_getaffinity(0))
AGENT = """
import json, sys
from pbonet.config.model import AgentConfig
from pbonet.node.agent import Agent
from pbonet.node.agent.agent_main import main
from pbonet.xm.net import session
import msgspec
if sys.argv[2:]:
    session.LEASE_MS = int(sys.argv[2])
    session.OPEN_MS = max(session.OPEN_MS, session.LEASE_MS)
    session.SILENT_MS = session.LEASE_MS
if sys.argv[3:]:
    Agent.stop.__defaults__ = (float(sys.argv[3]),)
sys.exit(main(msgspec.json.decode(sys.argv[1], type=AgentConfig)))
"""
SVAR = """
NAME N
TYPE int
DESC number of elements
UNITS none
NELEM 1
INIT 2

NAME X
TYPE double
DESC an input that no task writes
UNITS none
NELEM 2
INIT 1 2
"""
VARIABLE = """
NAME {name}
TYPE double
DESC a task's output
UNITS none
NELEM {nelem}
"""
OUTPUTS = 8


def svar(outputs=OUTPUTS):
    """Return a table's text: N, X, and outputs Y0, Y1, ... of two elements each."""
    return (
        SVAR
        + "".join(VARIABLE.format(name=f"Y{i}", nelem=2) for i in range(outputs))
        + "\nEOF\n"
    )


def rmod(module, out="Y0", freq=200.0, *, local=None, invar="", critical=False):
    """Return the text of an RMOD for one of the modules in `misbehaving`.

    Args:
        module: Its name.
        out: The variable that its output Y stands for.
        freq: Hz.
        local: Parameters by name.
        invar: The variable that its input Z stands for; empty for none.
        critical: Whether it is marked CRITICAL.
    """
    lines = [f"MODULE {module}", f"DESC {module}"]
    lines += [f"SVARALIAS Z={invar}"] if invar else []
    lines += [f"SVARALIAS Y={out}"] if out else []
    lines += ["INCONST none", "OUTCONST none"]
    lines += [f"INVAR {'Z' if invar else 'none'}", f"OUTVAR {'Y' if out else 'none'}"]
    lines += ["TASKTYPE periodic", f"FREQ {freq:g}"]
    lines += ["CRITICAL yes"] if critical else []
    if local:
        lines += ["LOCAL", *(f"{key} {value}" for key, value in local.items())]
    return "\n".join([*lines, "EOF", ""])


class Master:
    """A master of one subsystem on one RTPU.

    Args:
        nodes: The kit.
        rtpu: The RTPU's name.
        subsystem: Its name.
        token: Whether it shows a liveliness token.
        claim: More fields of the claim.
    """

    def __init__(self, nodes, rtpu, subsystem, *, token=True, **claim):
        self.nodes, self.rtpu, self.subsystem = nodes, rtpu, subsystem
        self.name = f"m{secrets.token_hex(3)}"
        self.client = Client(nodes.session, nodes.domain, self.name)
        self.token = None
        self.epoch = 0
        if token:
            key = key_expressions.master(nodes.domain, subsystem, self.name)
            self.token = nodes.session.liveliness().declare_token(key)
        self.settings = claim
        self.claimed = self.ask(m.Claim(**claim), m.Claimed)
        self.epoch = self.claimed.epoch

    def ask(self, request, result=object, *, limit=LIMIT, rtpu=None):
        """Send a request and return its result."""
        request.subsystem, request.epoch = self.subsystem, self.epoch
        if isinstance(request, m.Reconfig):
            request.timeout = limit
        return self.client.call(rtpu or self.rtpu, request, result, timeout=limit)

    def open_table(self, text=None, *, keep=True):
        text = svar() if text is None else text
        claim = m.Claim(svar=text, svar_name="t.svar", keep=keep, **self.settings)
        self.claimed = self.ask(claim, m.Claimed)
        return self.claimed

    def spawn(self, task, module, limit=LIMIT, **settings):
        """Spawn one of the modules in `misbehaving`; return its status."""
        names = {"crit", "priority", "restart"} & settings.keys()
        keep = {name: settings.pop(name) for name in names}
        text = settings.pop("text", None) or rmod(module, **settings)
        request = m.Spawn(
            task=task, rmod=text, rmod_name=f"{task}.rmod", timeout=limit, **keep
        )
        return self.ask(request, m.TaskStatus, limit=limit + LIMIT)

    def control(self, task, name, limit=LIMIT, **more):
        request = m.Control(task=task, signal=name, timeout=limit, **more)
        return self.ask(request, m.TaskStatus, limit=limit + LIMIT)

    def on(self, task, **more):
        return self.control(task, "on", **more)

    def off(self, task, **more):
        return self.control(task, "off", **more)

    def kill(self, task, **more):
        return self.control(task, "kill", **more)

    def rank_low(self, task):
        """Let a task that will hang run only when nothing else wants to."""
        self.ask(m.Rank(tasks={task: (1, 0)}))

    def status(self, task=None):
        """Return the status of one task, or of all by name."""
        got = self.ask(m.Status(task=task), m.RtpuStatus)
        by_name = {one.task: one for one in got.tasks}
        return by_name if task is None else by_name[task]

    def rtpu_status(self):
        return self.ask(m.Status(), m.RtpuStatus)

    def value(self, name):
        return self.ask(m.Display(names=[name]), list[m.VarValue])[0]

    def stop(self, limit=LIMIT, order=()):
        request = m.Stop(timeout=limit, order=list(order))
        return self.ask(request, m.Stopped, limit=limit + LIMIT)

    def events(self, code=None, task=None):
        """Return the events so far, of one code and task if told."""
        got = self.ask(m.Events(), list[m.Event])
        return [
            event
            for event in got
            if code in {None, event.code} and task in {None, event.task}
        ]

    def wait_event(self, code, task=None):
        """Return the first event of that code, waiting for it."""
        return wait_for(lambda: self.events(code, task), f"event {code}")[0]

    def wait_cycles(self, task, count):
        """Wait until a task that is ON has done so many more cycles."""
        first = self.status(task).cycle
        return wait_for(
            lambda: (now := self.status(task)).cycle >= first + count and now,
            f"{count} cycles of {task}",
        )

    def refused(self, kind, do, *args, **more):
        """Return the error of the class `kind` that `do` must raise."""
        with pytest.raises(kind) as caught:
            do(*args, **more)
        assert caught.type is kind, f"{caught.type.__name__}: {caught.value}"
        return caught.value


def fork_server_of(rtpu):
    """Return the process id of the fork server of an RTPU process."""
    (child,) = Path(f"/proc/{rtpu}/task/{rtpu}/children").read_text().split()
    return int(child)


class Nodes:
    """Agents of one domain in a runtime folder of their own.

    Args:
        folder: The runtime folder.
        tmp_path: Where modules that a test writes may stand.
    """

    def __init__(self, folder, tmp_path):
        self.folder = folder
        self.library = tmp_path / "library"
        self.library.mkdir()
        self.domain = f"t{secrets.token_hex(3)}"
        self.agents: dict[str, Agent] = {}
        self.processes: dict[str, subprocess.Popen] = {}
        self._session = None

    def config(self, name, **more):
        more = {"core": CORE, "grace": LIMIT, **more}
        libraries = (str(MISBEHAVING), str(self.library), *more.pop("libraries", ()))
        return AgentConfig(name=name, domain=self.domain, libraries=libraries, **more)

    def agent(self, name, *, backend="auto", **more):
        """Start an agent within this process."""
        agent = Agent(self.config(name, **more), backend=backend).start()
        self.agents[name] = agent
        return agent

    def stop_rtpu(self, name):
        """Stop the RTPU process, which its agent does not continue; return its id."""
        self.agents[name]._stopped.stop()
        pid = self.state(name).pid
        os.kill(pid, signal.SIGSTOP)
        return pid

    def agent_process(self, name, *, wait=True, stop_time=STOP_TIME, **more):
        """Start an agent as a process of its own and wait until it answers.

        When it ends, it forces after `stop_time` seconds what has not ended by itself.
        """
        config = msgspec.json.encode(self.config(name, **more)).decode()
        times = str(session.LEASE_MS), str(stop_time)
        process = subprocess.Popen([sys.executable, "-c", AGENT, config, *times])
        self.processes[name] = process
        if wait:
            self.wait_agent(name, process)
        return process

    def agent_processes(self, *names, **more):
        """Start agents at once, as processes of their own; wait until all answer."""
        for name in names:
            self.agent_process(name, wait=False, **more)
        for name in names:
            self.wait_agent(name, self.processes[name])

    def wait_agent(self, name, process=None):
        """Wait until an agent's token is there."""

        def there():
            assert process is None or process.poll() is None, "the agent has ended"
            try:
                return name in session.rtpus(self.session, self.domain)
            except PbonetError:
                return False

        wait_for(there, f"agent {name}")

    @property
    def session(self):
        """A client's session, opened when it is first asked for."""
        if self._session is None:
            self._session = session.client(self.domain)
        return self._session

    def forget_session(self):
        """Close the session, as its agent is gone."""
        if self._session is not None:
            self._session.close()
            self._session = None

    def master(self, rtpu, subsystem, *, table=True, **more):
        """Return a master that has claimed the RTPU, with its table open."""
        master = Master(self, rtpu, subsystem, **more)
        if table:
            master.open_table()
        return master

    def client(self):
        return Client(self.session, self.domain, f"c{secrets.token_hex(3)}")

    def state(self, name):
        """Return what an RTPU process has written down about itself."""
        return cleanup.read(run_folder.Places(self.domain, name).state)

    def wait_restarted(self, name, old):
        """Wait until the agent has another RTPU process than `old`; return its info."""

        def there():
            info = self.client().call(name, m.Hello(), m.AgentInfo)
            return info if info.rtpu_pid not in {0, old} else None

        return wait_for(there, f"another RTPU process of {name}")

    def fork_server(self, name):
        """Return the process id of an RTPU's fork server."""
        return fork_server_of(self.state(name).pid)

    def write_module(self, name, text):
        """Write a module into the test's own library."""
        path = self.library / f"{name}.py"
        path.write_text(textwrap.dedent(text))
        return path

    def close(self):
        """End everything that was started, in order where that still works."""
        with contextlib.ExitStack() as everything:
            everything.callback(self._end_abandoned)
            for process in self.processes.values():
                everything.callback(process.wait, END_TIME)
            for process in self.processes.values():
                everything.callback(process.send_signal, signal.SIGTERM)
            for agent in self.agents.values():
                everything.callback(agent.stop)
            everything.callback(self.forget_session)

    def _end_abandoned(self):
        """End RTPU processes that wait for another agent, as theirs was killed."""
        killed = (
            n for n, p in self.processes.items() if p.returncode == -signal.SIGKILL
        )
        waiting = {state.pid for name in killed if (state := self.state(name))}
        for pid, _ in processes_of("PBONET_RUN_DIR", str(self.folder)):
            if pid in waiting:
                with contextlib.suppress(ProcessLookupError):  # its grace is over
                    os.kill(pid, signal.SIGTERM)

    def check_folder(self):
        """Fail when processes or files are left."""
        clean_folder(self.folder, "PBONET_RUN_DIR")


def level(pid):
    """Return the level that a process has in SCHED_FIFO, 1 for those that have none."""
    return max(os.sched_getparam(pid).sched_priority, 1)


def wait_hung(master, task):
    """Wait until a task hangs in its tenth cycle, which three releases have passed."""

    def hung():
        status = master.status(task)
        return status.cycle == 9 and status.ptime * status.ref_f > 13

    wait_for(hung, f"the cycle in which {task} hangs")


def alive(pid):
    """Tell whether a process runs and is no zombie."""
    try:
        stat = Path(f"/proc/{pid}/stat").read_text()
    except OSError:
        return False
    return stat.rpartition(")")[2].split()[0] not in {"Z", "X"}


def wait_gone(pids):
    wait_for(lambda: not any(map(alive, pids)), f"the end of {pids}")


__all__ = [
    "Master",
    "Nodes",
    "alive",
    "json",
    "level",
    "processes_of",
    "shutil",
    "wait_gone",
    "wait_hung",
]


def others_go_first(arm):
    """Require that `good` and all commands have the core, while `bad` wants it.

    Args:
        arm: The `Master` of both tasks, which are ON.
    """
    arm.wait_cycles("good", 20)
    assert arm.ask(m.Freq(task="good", hz=50.0), float) == 50.0
    arm.off("good")
    arm.on("good")
    assert arm.off("bad").state == "OFF"
    arm.kill("bad")
    assert not arm.events("FORCED", "bad")
