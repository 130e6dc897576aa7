"""Two machines for tests of links: agents with shared memory of their own each."""

from __future__ import annotations

import contextlib
import json
import os
import secrets
import signal
import socket
import subprocess
import sys
import tempfile
import threading
from pathlib import Path

import msgspec
from nodekit import AGENT, CORE, MISBEHAVING
from watching import END_TIME, clean_folder, free_port, processes_of, wait_for

from pbonet.config.model import AgentConfig
from pbonet.xm.net import messages as m, run_folder, session
from pbonet.xm.net.rpc import Client

END = """
import json, sys, time
import numpy as np
from pbonet import tbuf, xm

settings = json.loads(sys.argv[1])
xm.live_on(settings["home"], domain=settings["domain"])
"""
WRITER = (
    END
    + """
end = tbuf.Writer(settings["name"], np.dtype(settings["dtype"]))
period = settings["period"]
for n in range(1, 1 << 40):
    end.value[...] = n
    end.write()
    if n == 1:
        print("ready", flush=True)
    time.sleep(period)
"""
)
READER = (
    END
    + """
end = tbuf.Reader(settings["name"], np.dtype(settings["dtype"]))
print("ready", flush=True)
for line in sys.stdin:
    new = end.read()
    values = np.unique(end.value).tolist()
    print(json.dumps({
        "new": new, "values": values, "number": end.number, "lost": end.lost,
        "age": None if end.age_ns() is None else end.age_ns() * 1e-9,
        "restarts": end.restarts, "dtype": end.value.dtype.str,
        "apart": (end.stamp_ns - end.time_ns) * 1e-9,
    }), flush=True)
"""
)


class Program:
    """A process with one end of a link."""

    def __init__(self, machine: Machine, code: str, **settings: object) -> None:
        text = json.dumps({"domain": machine.domain, **settings})
        self.process = subprocess.Popen(
            [*machine.prefix, sys.executable, "-c", code, text],
            env=machine.env,
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            text=True,
        )
        assert self.process.stdout.readline() == "ready\n"

    def look(self) -> dict:
        """Have a reader read, and return what it has."""
        self.process.stdin.write("\n")
        self.process.stdin.flush()
        return json.loads(self.process.stdout.readline())

    def kill(self, which: int = signal.SIGKILL) -> None:
        self.process.send_signal(which)
        self.process.wait(60)
        for pipe in (self.process.stdin, self.process.stdout):
            pipe.close()


class Machine:
    """A machine of its own: a shared memory, a runtime folder, and one agent.

    Args:
        name: The agent's.
        domain: Its domain.
        connect: Ports of agents that it dials.
        prefix: What its programs are started with, such as a clock of their own.
    """

    def __init__(
        self, name: str, domain: str, *connect: int, prefix: tuple[str, ...] = ()
    ) -> None:
        self.name, self.domain, self.prefix = name, domain, prefix
        self.port = free_port()
        self.shm = Path(tempfile.mkdtemp(prefix="pbonet-", dir="/dev/shm"))
        self.run = Path(tempfile.mkdtemp(prefix="pbonet-", dir="/tmp"))
        self.env = os.environ | {
            "PBONET_SHM_DIR": str(self.shm),
            "PBONET_RUN_DIR": str(self.run),
        }
        self.files: Path | None = None
        """The folder of files for others that its agent declares."""
        self.connect = tuple(f"tcp/127.0.0.1:{port}" for port in connect)
        self.lease_ms = session.LEASE_MS
        """Of its agent's links."""
        self.programs: list[Program] = []
        self.agent: subprocess.Popen | None = None
        self.other: subprocess.Popen | None = None

    def start(self, *libraries: Path) -> None:
        """Start the agent and wait until it can be seen."""
        listen = (f"tcp/127.0.0.1:{self.port}",)
        self.agent = self._agent(self.name, listen, *libraries)

    def start_another(self, name: str) -> None:
        """Start a second agent, which reaches others on its own."""
        self.other = self._agent(name, ())

    def _agent(
        self, name: str, listen: tuple[str, ...], *libraries: Path
    ) -> subprocess.Popen:
        config = AgentConfig(
            name=name,
            domain=self.domain,
            core=CORE,
            grace=30.0,
            listen=listen,
            connect=self.connect,
            libraries=(str(MISBEHAVING), *map(str, libraries)),
            files=str(self.files) if self.files else None,
        )
        text = msgspec.json.encode(config).decode()
        lease = str(self.lease_ms)
        command = [*self.prefix, sys.executable, "-c", AGENT, text, lease]
        agent = subprocess.Popen(command, env=self.env)
        lock = self.run / self.domain / f"{name}.agent"
        wait_for(lambda: run_folder.is_held(lock), f"the lock of {name}")
        return agent

    def kill_agent(self) -> None:
        self.agent.kill()
        self.agent.wait(60)

    def writer(self, name="x", dtype="f8", period=0.001, home=None) -> Program:
        return self._run(WRITER, name=name, dtype=dtype, period=period, home=home)

    def reader(self, name, dtype="f8") -> Program:
        return self._run(READER, name=name, dtype=dtype, home=None)

    def _run(self, code: str, *, home: str | None, **settings: object) -> Program:
        program = Program(self, code, home=home or self.name, **settings)
        self.programs.append(program)
        return program

    def links(self) -> list[str]:
        return sorted(path.name for path in self.shm.glob("*.tbuf"))

    def close(self) -> None:
        """End everything and fail when something is left."""
        for program in self.programs:
            if program.process.poll() is None:
                program.kill()
        for agent in filter(None, (self.other, self.agent)):
            agent.terminate()
            agent.wait(60)
        for pid, command in processes_of("PBONET_RUN_DIR", str(self.run)):
            if (
                "pbonet.node.rtpu.rtpu_process" in command
            ):  # of an agent that was killed
                with contextlib.suppress(ProcessLookupError):  # it has just ended
                    os.kill(pid, signal.SIGTERM)
        clean_folder(self.run, "PBONET_RUN_DIR")
        clean_folder(self.shm, "PBONET_SHM_DIR")


class Pair:
    """Machine A, and machine B that dials it, in one domain.

    Args:
        prefix: What the programs of A are started with.
    """

    def __init__(self, *prefix: str) -> None:
        self.domain = f"t{secrets.token_hex(3)}"
        self.a = Machine("vision0", self.domain, prefix=prefix)
        self.cable = Cable(self.a.port)
        self.b = Machine("arm0", self.domain, self.cable.port)

    def start(self, *libraries: Path) -> None:
        self.a.start(*libraries)
        self.b.start(*libraries)
        self.wait_both()

    def wait_both(self) -> None:
        """Wait until both agents are seen from A."""

        def seen() -> bool:
            link = session.client(
                self.domain, connect=[f"tcp/127.0.0.1:{self.a.port}"], timeout=10.0
            )
            try:
                return session.rtpus(link, self.domain) == ["arm0", "vision0"]
            finally:
                link.close()

        wait_for(seen, "both agents")

    def close(self) -> None:
        with contextlib.ExitStack() as everything:
            everything.callback(self.cable.close)
            everything.callback(self.a.close)
            everything.callback(self.b.close)

    def events(self, machine: Machine, code: str) -> list[str]:
        """Return the texts of a machine's events of one code."""
        where = [f"tcp/127.0.0.1:{machine.port}"]
        client = Client(session.client(self.domain, connect=where), self.domain, "test")
        try:
            found = client.call(machine.name, m.Events(), list[m.Event])
        finally:
            client.close()
        return [event.text for event in found if event.code == code]


def flows(reader: Program, limit: float = END_TIME) -> dict:
    """Wait for a new record and return it."""
    return wait_for(
        lambda: (found := reader.look())["new"] and found, "a new record", limit
    )


class Cable:
    """Carries bytes between a port of its own and another, until it is cut.

    While it is cut nothing passes and nobody is told, as if it were pulled out.
    """

    def __init__(self, target: int) -> None:
        self._target = target
        self._listener = socket.create_server(("127.0.0.1", 0))
        self.port = self._listener.getsockname()[1]
        self._whole = threading.Event()
        self._whole.set()
        self._over = False
        self._sockets: list[socket.socket] = []
        threading.Thread(target=self._accept, daemon=True).start()

    def cut(self) -> None:
        self._whole.clear()

    def heal(self) -> None:
        """Let bytes pass; links that were cut long enough have been given up."""
        self._whole.set()

    def close(self) -> None:
        self._over = True
        self._whole.set()
        for one in [self._listener, *self._sockets]:
            with contextlib.suppress(OSError):
                one.shutdown(socket.SHUT_RDWR)
            one.close()

    def _accept(self) -> None:
        with contextlib.suppress(OSError):
            while True:
                near, _ = self._listener.accept()
                try:
                    far = socket.create_connection(("127.0.0.1", self._target))
                except ConnectionRefusedError:  # nobody is there just now
                    near.close()
                    continue
                self._sockets += [near, far]
                for one, other in ((near, far), (far, near)):
                    threading.Thread(
                        target=self._copy, args=(one, other), daemon=True
                    ).start()

    def _copy(self, source: socket.socket, target: socket.socket) -> None:
        with contextlib.suppress(OSError):
            while data := source.recv(65536):
                self._whole.wait()
                target.sendall(data)
        for one in (source, target):
            with contextlib.suppress(OSError):
                one.shutdown(socket.SHUT_RDWR)
