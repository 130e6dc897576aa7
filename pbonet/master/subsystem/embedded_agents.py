"""Agents that a master starts itself, for RTPUs without one.

They are child processes that live as long as the master: when it ends, also by a kill,
they turn their tasks off in order and end. Of domain, endpoints and libraries they have
what the master has, also where that is nothing and the environment says something.
"""

from __future__ import annotations

import contextlib
import os
import signal
import subprocess
import sys
import tempfile
import time
from pathlib import Path
from typing import IO, TYPE_CHECKING, Final, Self

import zenoh
from msgspec import Struct

from pbonet.errors import NodeError, PbonetError, StateError, UnreachableError
from pbonet.master.configuration import environment
from pbonet.xm.net import credentials, run_folder, session

from .interrupt_signals import InterruptsInTurn

if TYPE_CHECKING:
    from collections.abc import Callable, Iterable, Sequence
    from threading import Event

START_TIME: Final = 40.0
"""Seconds in which agents must be there, on a busy machine."""
END_TIME: Final = 10.0
"""Seconds that an agent has to turn everything off and end."""
GRACE: Final = 1.0
"""Seconds for which control continues without an agent: no other one takes over."""
_LOOK: Final = 0.02
_TAIL: Final = 2000


class Child(Struct, frozen=True):
    """One agent."""

    rtpu: str
    core: int
    process: subprocess.Popen[bytes]
    output: IO[bytes]

    def said(self) -> str:
        """Return the end of what it wrote."""
        self.output.seek(0)
        return self.output.read()[-_TAIL:].decode(errors="replace").strip()


def assign_cores(rtpus: Sequence[str], allowed: Iterable[int]) -> dict[str, int]:
    """Return a core for each RTPU.

    The first core is left to housekeeping where there are two or more; the others are
    dealt out in turn, so RTPUs share a core when there are more of them than cores.
    """
    cores = sorted(allowed)
    usable = cores[1:] or cores
    return {rtpu: usable[n % len(usable)] for n, rtpu in enumerate(rtpus)}


class Embedded:
    """The agents that this process started.

    Args:
        domain: Their domain.
        libraries: Folders with modules.
        connect: Endpoints of agents on other machines, which they join.
        runs: Folder of their logs; None for PBONET_RUNS, else ``runs`` here.
        settings: An ``agent.toml`` for all of them; None: the defaults.
    """

    def __init__(
        self,
        domain: str,
        *,
        libraries: Sequence[str] = (),
        connect: Sequence[str] = (),
        runs: str | Path | None = None,
        settings: str | Path | None = None,
    ) -> None:
        self._runs = runs
        self._settings = settings
        self._domain = domain
        self._libraries = libraries
        self._connect = connect
        self.children: list[Child] = []
        self.launched = False
        """Whether those that are missing have been started."""

    def missing(self, rtpus: Sequence[str]) -> list[str]:
        """Return which of the RTPUs have no agent that can be reached."""
        try:
            opened = session.client(self._domain, connect=self._connect)
        except UnreachableError:
            return list(rtpus)
        try:
            there = session.rtpus(opened, self._domain)
        finally:
            opened.close()  # type: ignore[no-untyped-call]
        return [rtpu for rtpu in rtpus if rtpu not in there]

    def await_others(
        self,
        rtpus: Sequence[str],
        seconds: float,
        given_up: Event,
        tell: Callable[[str], None],
    ) -> None:
        """Wait until all of these RTPUs have an agent.

        Args:
            rtpus: Their names.
            seconds: How long at most.
            given_up: Ends the waiting when it is set.
            tell: Called with what is waited for, whenever that changes.

        Raises:
            NodeError: The time is over.
            StateError: It was given up.
        """
        deadline = time.monotonic() + seconds
        told: list[str] = []
        while missing := self.missing(rtpus):
            if missing != told:
                told = missing
                tell(f"waiting for {' and '.join(missing)}, at most {seconds:g} s")
            left = deadline - time.monotonic()
            if given_up.wait(max(min(left, _LOOK), 0.0)):
                raise StateError(
                    f"the wait for {' and '.join(missing)} was interrupted",
                    remedy="nothing was started; start it again",
                )
            if left <= 0.0:
                raise NodeError(
                    f"no agent for {' and '.join(missing)}",
                    expected=f"an agent of each within {seconds:g} s",
                    got=f"{len(rtpus) - len(missing)} of {len(rtpus)} RTPUs have one",
                    remedy=f"start 'pbonet agent --name {missing[0]}' where it "
                    "belongs, name an agent that reaches it with --connect, or wait "
                    "longer",
                )

    def start(self, rtpus: Sequence[str]) -> dict[str, int]:
        """Start an agent for each RTPU and wait until all can be reached.

        Returns:
            The core of each.

        Raises:
            UnreachableError: An endpoint that was named is not reached.
            NodeError: One of them ended, or did not come up; the others were ended.
        """
        self.launch(rtpus)
        return self.wait()

    def launch(self, rtpus: Sequence[str]) -> None:
        """Start an agent for each RTPU; `wait` follows.

        Raises:
            UnreachableError: An endpoint that was named is not reached, where these
                RTPUs may have agents; nothing was started.
            OSError: The system cannot create a process; the others were ended.
        """
        if rtpus:
            self._must_reach_endpoints(rtpus)
        self.launched = True
        try:
            for rtpu, core in assign_cores(rtpus, os.sched_getaffinity(0)).items():
                self.children.append(self._launch(rtpu, core))
        except BaseException:
            self.stop()
            raise

    def _must_reach_endpoints(self, rtpus: Sequence[str]) -> None:
        for endpoint in self._connect:
            try:
                opened = session.client(self._domain, connect=[endpoint], local=False)
            except UnreachableError as error:
                raise UnreachableError(
                    "this endpoint was named and is not reached; nothing was started",
                    where=endpoint,
                    expected=f"its answer, before {' and '.join(rtpus)} may be started "
                    "on this machine",
                    got=error.got,
                    remedy="check the address, start the agents there, or leave "
                    "--connect, PBONET_CONNECT and connect= out to run here; "
                    f"{error.remedy}",
                ) from None
            opened.close()  # type: ignore[no-untyped-call]

    def wait(self) -> dict[str, int]:
        """Wait until all that were started can be reached; return the core of each.

        Raises:
            NodeError: One of them ended, or did not come up; the others were ended.
        """
        try:
            self._wait()
        except BaseException:
            self.stop()
            raise
        return {child.rtpu: child.core for child in self.children}

    def ended(self) -> list[str]:
        """Return the RTPUs whose agent has ended unasked, with how it ended."""
        return [
            f"the agent of {child.rtpu} has ended: {_describe(code)}"
            for child in self.children
            if (code := child.process.poll()) is not None
        ]

    def resume(self) -> list[str]:
        """Continue agents that a signal has stopped; return what was done."""
        return [
            f"the agent of {child.rtpu} (process {child.process.pid}) was stopped by a "
            "signal and has been continued"
            for child in self.children
            if _resume(child.process.pid)
        ]

    def stop(self) -> list[str]:
        """End the agents in order; return the RTPUs that had to be killed.

        An RTPU process whose agent has died ends by itself; that is waited for, too.
        """
        with InterruptsInTurn(
            "ending the agents of this process",
            "they end by themselves then",
            lambda: " and ".join(one.rtpu for one in self.children),
            first=False,
        ):
            return self._stop()

    def _stop(self) -> list[str]:
        for child in self.children:
            if child.process.poll() is None:
                child.process.terminate()
                child.process.send_signal(signal.SIGCONT)  # it may be stopped
        killed: list[str] = []
        deadline = time.monotonic() + END_TIME
        for child in self.children:
            try:
                child.process.wait(max(0.1, deadline - time.monotonic()))
            except subprocess.TimeoutExpired:
                child.process.kill()
                child.process.wait()
                killed.append(child.rtpu)
            child.output.close()
        while self._remains() and time.monotonic() < deadline:
            time.sleep(_LOOK)
        self.children = []
        return killed

    def _remains(self) -> bool:
        """Return whether an RTPU process of these agents still runs."""
        return any(
            run_folder.is_held(run_folder.Places(self._domain, child.rtpu).ctl_lock)
            for child in self.children
        )

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.stop()

    def _launch(self, rtpu: str, core: int) -> Child:
        command = [sys.executable, "-m", "pbonet.cli", "agent"]
        command += ["--name", rtpu, "--core", str(core), "--domain", self._domain]
        command += ["--with-parent", str(os.getpid()), "--grace", str(GRACE)]
        for endpoint in self._connect:
            command += ["--connect", endpoint]
        if keys := credentials.named():
            command += ["--keys", str(keys)]
        if self._settings is not None:
            command += ["--config", str(Path(self._settings).absolute())]
        if self._runs is not None:
            command += ["--runs", str(Path(self._runs).absolute())]
        folders = [str(Path(folder).absolute()) for folder in self._libraries]
        for folder in folders:
            command += ["--library", folder]
        output = tempfile.TemporaryFile()  # noqa: SIM115 - closed with the child
        process = subprocess.Popen(
            command,
            env=environment.of(self._domain, self._connect, folders),
            stdin=subprocess.DEVNULL,
            stdout=output,
            stderr=subprocess.STDOUT,
            start_new_session=True,  # an interrupt at the terminal is the master's
        )
        return Child(rtpu, core, process, output)

    def _wait(self) -> None:
        """Wait until every agent shows its token.

        Raises:
            NodeError: One has ended, or the time is over.
        """
        deadline = time.monotonic() + START_TIME
        wanted = {child.rtpu for child in self.children}
        opened: zenoh.Session | None = None
        try:
            while True:
                self._must_live()
                if opened is None:
                    with contextlib.suppress(UnreachableError):
                        opened = session.client(self._domain, connect=self._connect)
                if opened and wanted <= set(session.rtpus(opened, self._domain)):
                    return
                if time.monotonic() > deadline:
                    raise self._not_there(wanted)
                time.sleep(_LOOK)
        finally:
            if opened is not None:
                opened.close()  # type: ignore[no-untyped-call]

    def _must_live(self) -> None:
        for child in self.children:
            if child.process.poll() is not None:
                said = child.said().removeprefix("pbonet: ")
                raise NodeError(
                    said.splitlines()[-1] if said else "the embedded agent ended",
                    where=child.rtpu,
                    got=f"exit status {child.process.returncode}",
                    remedy=f"try 'pbonet agent --name {child.rtpu}' by itself",
                    debug=said,
                )

    def _not_there(self, wanted: set[str]) -> PbonetError:
        return NodeError(
            f"the embedded agents are not there after {START_TIME:g} s",
            where=", ".join(sorted(wanted)),
            remedy="is the machine overloaded? 'pbonet doctor' checks it",
        )


def _describe(code: int) -> str:
    return f"exit status {code}" if code >= 0 else signal.Signals(-code).name


def _resume(pid: int) -> bool:
    """Continue a child process if it was stopped since the last call."""
    with contextlib.suppress(ChildProcessError, ProcessLookupError):
        if os.waitid(os.P_PID, pid, os.WSTOPPED | os.WNOHANG) is not None:
            os.kill(pid, signal.SIGCONT)
            return True
    return False
