"""Agents on the three hosts of a `lan.Lan`, and masters and tools that reach them."""

from __future__ import annotations

import contextlib
import os
import secrets
import shutil
import signal
import subprocess
import sys
import tempfile
import time
from pathlib import Path
from types import SimpleNamespace

import msgspec
from long_limits import LIMIT
from nodekit import AGENT, MISBEHAVING, alive
from tbuf_rig import Program
from watching import processes_of, wait_for

from pbonet.config.model import AgentConfig
from pbonet.errors import NoAnswerError, PbonetError, UnreachableError
from pbonet.testing.lan import Lan
from pbonet.xm.net import messages as m, session
from pbonet.xm.net.rpc import Client

PORT = 7447
OWN_PORT = 7547
SHM = Path("/dev/shm")  # noqa: S108 - where shared memory is
CORE = max(os.sched_getaffinity(0))
LEASE_MS = 1000
"""A silent link is given up after that; one that stands outlives shorter stalls."""


class Asking(Client):
    """Makes a request again, as the same one, when its link was given up meanwhile.

    A machine that stands still for longer than the lease loses its links, and a master
    is told so at once. The agent carries a request out once, however often it comes.
    """

    def _exchange(self, rtpu, request, timeout):
        over = time.monotonic() + LIMIT
        while True:
            try:
                return super()._exchange(rtpu, request, timeout)
            except (NoAnswerError, UnreachableError):
                if time.monotonic() > over:
                    raise
                time.sleep(0.05)


class Lab:
    """Three hosts with agents of one domain.

    Args:
        lan: The hosts.
        port: The one that agents listen on; two labs of one network need two.
        keys: By host, the folder of its agents' keys; all links are TLS then.
        lease_ms: After which a silent link is given up.
    """

    def __init__(
        self, lan: Lan, port: int = PORT, keys=None, lease_ms: int = LEASE_MS
    ) -> None:
        self.lan = lan
        self.lease_ms = lease_ms
        self.port = port
        self.keys: dict[str, Path] = keys or {}
        self.protocol = "tls" if self.keys else "tcp"
        self.domain = f"h{secrets.token_hex(3)}"
        self.agents: dict[str, tuple[str, subprocess.Popen]] = {}
        self.routers: dict[str, subprocess.Popen] = {}
        """By host."""
        self._sessions: dict[str, object] = {}
        self.run_dirs: dict[str, Path] = {}
        self.shm_dirs: dict[str, Path] = {}
        self.releases: dict[str, Path] = {}
        """By host, a folder that Python runs first there; see `test_hosts_upgrade`."""
        for name in lan.hosts:
            made = tempfile.mkdtemp(prefix=f"pbonet-{name}-", dir="/tmp")
            self.run_dirs[name] = Path(made)
            self.shm_dirs[name] = SHM / f"pbonet-host-{self.domain}{name}"
            self.shm_dirs[name].mkdir(mode=0o700)

    def endpoint(self, host: str, seen_from: str, *, six: bool = False) -> str:
        """Return the endpoint of a host's agent, over the cable to another host."""
        address = self.lan[host].address(seen_from, six=six)
        return f"{self.protocol}/{f'[{address}]' if six else address}:{self.port}"

    def start(
        self, name, host, *, connect=(), listen=None, wait=True, code=AGENT, **more
    ):
        """Start an agent on a host; it listens on every address unless told."""
        more = {"core": CORE, "grace": 1.0, "domain": self.domain, **more}
        if self.keys:
            more["keys"] = str(self.keys[host])
        everywhere = f"{self.protocol}/[::]:{self.port}"
        config = AgentConfig(
            name=name,
            listen=(everywhere,) if listen is None else tuple(listen),
            connect=tuple(connect),
            libraries=(str(MISBEHAVING), *more.pop("libraries", ())),
            insecure=not self.keys,
            **more,
        )
        text = msgspec.json.encode(config).decode()
        process = subprocess.Popen(
            self.lan[host].command(
                sys.executable, "-c", code, text, str(self.lease_ms)
            ),
            env=self.environment(host),
        )
        self.agents[name] = (host, process)
        if wait:
            self.wait_seen(name, host)
        return process

    def start_router(self, host, *, connect=(), keys=None):
        """Start a router on a host, and wait until it accepts connections."""
        words = ["--listen", f"{self.protocol}/[::]:{self.port}"]
        words += [word for one in connect for word in ("--connect", one)]
        words += ["--keys", str(keys)] if keys else ["--insecure"]
        command = (sys.executable, "-m", "pbonet.cli", "router", *words)
        process = subprocess.Popen(
            self.lan[host].command(*command),
            env=self.environment(host),
            stdout=subprocess.PIPE,
            text=True,
        )
        self.routers[host] = process
        assert "ready" in process.stdout.readline()

    def kill_router(self, host):
        """Kill a router, as a fault of its machine would."""
        with self.routers.pop(host) as process:
            process.kill()

    def chain(self):
        """Start arm0 on a, arm1 on b, arm2 on c; a and c have no way but by b."""
        self.lan.cut("a", "c")
        self.start("arm1", "b", wait=False)
        self.start("arm0", "a", connect=[self.endpoint("b", "a")], wait=False)
        self.start("arm2", "c", connect=[self.endpoint("b", "c")], wait=False)
        self.wait_all()

    def triangle(self):
        """Start arm0, arm1 and arm2 on a, b and c, each linked to each other."""
        self.start("arm0", "a", wait=False)
        to_a = [self.endpoint("a", "b")]
        self.start("arm1", "b", connect=to_a, wait=False)
        both = [self.endpoint("a", "c"), self.endpoint("b", "c")]
        self.start("arm2", "c", connect=both, wait=False)
        self.wait_all()

    def tend(self, name, host, **more):
        """Start an agent unless it runs; return whether it had to be started."""
        if name in self.agents and self.agents[name][1].poll() is None:
            return False
        self.agents.pop(name, None)
        self.forget_session(host)
        self.start(name, host, **more)
        return True

    def wait_seen(self, name, host):
        """Wait until a client on a host sees an agent."""
        process = self.agents[name][1]

        def there():
            assert process.poll() is None, f"agent {name} has ended"
            return name in self.seen(host)

        wait_for(there, f"agent {name} from host {host}")

    def wait_all(self):
        """Wait until every agent is seen from every host that has one."""
        for host in {host for host, _ in self.agents.values()}:
            for name in self.agents:
                self.wait_seen(name, host)

    def seen(self, host):
        """Return the RTPUs that a client of a host's agent sees."""
        try:
            return session.rtpus(self.session(host), self.domain)
        except PbonetError:
            return []

    def session(self, host):
        """Return a client's session on a host: it knows the agents there alone."""
        if host not in self._sessions:
            here = self.run_dirs[host] / self.domain
            names = [n for n, (at, _) in self.agents.items() if at == host]
            sockets = [f"unixsock-stream/{here / name}.sock" for name in names]
            self._sessions[host] = session.client(
                self.domain, connect=sockets, timeout=30.0, local=False
            )
        return self._sessions[host]

    def forget_session(self, host):
        """Close a host's client, as its agent is gone."""
        if host in self._sessions:
            self._sessions.pop(host).close()

    def client(self, host):
        """Return a client of a host's agent."""
        return Asking(self.session(host), self.domain, f"c{secrets.token_hex(3)}")

    def info(self, name, host=None):
        """Return who an agent is, asked by way of a host."""
        return self.client(host or self.agents[name][0]).call(
            name, m.Hello(), m.AgentInfo
        )

    def wait_reached(self, name, host):
        """Wait until an agent answers by way of a host."""

        def reached():
            with contextlib.suppress(PbonetError):
                return self.info(name, host)
            return None

        return wait_for(reached, f"agent {name} by way of host {host}")

    def program(self, host, code, **settings):
        """Start a program with an end of a link on a host; see `tbuf_rig`."""
        machine = SimpleNamespace(
            prefix=self.lan[host].command(),
            env=self.environment(host),
            domain=self.domain,
        )
        return Program(machine, code, **settings)

    def kill(self, name):
        """Kill an agent's process; its RTPU process stays."""
        host, process = self.agents.pop(name)
        self.forget_session(host)
        process.kill()
        process.wait(LIMIT)

    def stop(self, name):
        """Tell an agent to end, and wait for it."""
        host, process = self.agents.pop(name)
        self.forget_session(host)
        process.send_signal(signal.SIGTERM)
        process.wait(LIMIT)

    def cli(self, host, *words, limit=60.0):
        """Run a verb of the command line on a host."""
        words = (sys.executable, "-m", "pbonet.cli", *words, "--domain", self.domain)
        return subprocess.run(
            self.lan[host].command(*words),
            env=self.environment(host),
            capture_output=True,
            text=True,
            timeout=limit,
            check=False,
        )

    def environment(self, host):
        """Return the environment of a host's processes."""
        return {
            **os.environ,
            "PBONET_RUN_DIR": str(self.run_dirs[host]),
            "PBONET_STATE_DIR": str(self.run_dirs[host] / "state"),
            "PBONET_SHM_DIR": str(self.shm_dirs[host]),
            **(
                {"PYTHONPATH": str(first)} if (first := self.releases.get(host)) else {}
            ),
        }

    def close(self):
        """End everything; fail when a process or a file is left."""
        try:
            for host in list(self._sessions):
                self.forget_session(host)
            running = [process for _, process in self.agents.values()]
            running += self.routers.values()
            for process in running:
                process.send_signal(signal.SIGTERM)
            for process in running:
                process.wait(LIMIT)
            for process in self.routers.values():
                process.stdout.close()
            self._check()
        finally:
            for pid, _ in self._left():
                os.kill(pid, signal.SIGKILL)
            for folder in (*self.run_dirs.values(), *self.shm_dirs.values()):
                shutil.rmtree(folder)

    def processes(self, host, word):
        """Return the processes on a host that have a word in their command."""
        found = processes_of("PBONET_RUN_DIR", str(self.run_dirs[host]))
        return [pid for pid, command in found if word in command]

    def wait_no_orphans(self):
        """Wait until every process stands under a test's own, or an agent's RTPU."""
        wait_for(lambda: not self.orphans(), "the end of orphans")

    def orphans(self):
        """Return the processes whose parents have all ended, but agents' RTPUs."""
        owned = {os.getpid(), *(self.info(name).rtpu_pid for name in self.agents)}
        return [(p, c) for p, c in self._left() if not owned & ancestry(p)]

    def _left(self):
        folders = self.run_dirs.values()
        return [p for f in folders for p in processes_of("PBONET_RUN_DIR", str(f))]

    def _check(self):
        wait_for(lambda: not self._left(), f"the end of {self._left()}")
        for folder in (*self.run_dirs.values(), *self.shm_dirs.values()):
            files = [str(p) for p in folder.rglob("*") if not p.is_dir()]
            # What an agent knows of others' orders, or had when it was killed, stays.
            files = [file for file in files if f"{folder}/state/" not in file]
            assert not files, f"left: {files}"


def ancestry(pid):
    """Return a process and all whose child it is, but the first of the machine."""
    found = set()
    while pid > 1:
        found.add(pid)
        try:
            stat = Path(f"/proc/{pid}/stat").read_text()
        except OSError:  # it has ended
            return {os.getpid()}
        pid = int(stat.rpartition(")")[2].split()[1])
    return found


__all__ = ["CORE", "LEASE_MS", "OWN_PORT", "PORT", "Lab", "alive"]
