"""An agent as a process: its signals, its service manager, its restart."""

from __future__ import annotations

import contextlib
import logging
import os
import signal
import sys
import threading
from typing import TYPE_CHECKING

from pbonet.config import absent
from pbonet.node import rt
from pbonet.xm.net import open_files

from . import systemd_notify
from .agent import Agent

if TYPE_CHECKING:
    from collections.abc import Callable
    from types import FrameType

    from pbonet.config import AgentConfig
    from pbonet.xm.net import AgentInfo

log = logging.getLogger("pbonet.node")

ENDS = (signal.SIGTERM, signal.SIGINT)
HEEDED = (*ENDS, signal.SIGHUP)


class AgentRun:
    """One agent, until it ends or restarts.

    Args:
        agent: The agent, before its start.
        again: Returns the configuration for a restart; by default the same one.
    """

    def __init__(
        self, agent: Agent, again: Callable[[], AgentConfig] | None = None
    ) -> None:
        self.agent = agent
        self._again = again
        self._anew = self._ends = False
        self._on_terminal = _has_terminal()
        self._stays = signal.getsignal(signal.SIGHUP) is signal.SIG_IGN

    def heed_signals(self) -> None:
        """End on SIGTERM and SIGINT, restart on SIGHUP."""
        for which in ENDS:
            signal.signal(which, self._on_end)
        signal.signal(signal.SIGHUP, self._on_hangup)
        self.agent.heed_signals()
        signal.pthread_sigmask(signal.SIG_UNBLOCK, HEEDED)

    def leave_signals(self) -> None:
        """Leave later signals, and a requested end, to the next agent.

        Zenoh's threads outlive their session and would receive this process's signals.
        """
        signal.pthread_sigmask(signal.SIG_BLOCK, HEEDED)
        for which in ENDS:
            rt.leave_to_next(which)
        if self._stays:  # the next agent does whatever else a hangup asks for
            signal.signal(signal.SIGHUP, signal.SIG_IGN)
        if self._ends:
            signal.pthread_kill(threading.get_ident(), signal.SIGTERM)

    def wait(self) -> bool:
        """Wait for the end; return whether the agent must restart."""
        while True:
            self.agent.wait()
            if self._ends or not self._anew:
                return False
            if self.agent.may_start_anew(self._again):
                return True
            self._anew = False
            if not self.agent.go_on() or self._ends:
                return False

    def _on_end(self, number: int, _frame: FrameType | None) -> None:
        log.info("%s: %s", self.agent.name, signal.Signals(number).name)
        self._ends = True
        self.agent.ask_to_end()

    def _on_hangup(self, number: int, frame: FrameType | None) -> None:
        """Restart, or end if the signal came because the terminal is gone."""
        if not self._on_terminal or _has_terminal():
            self._anew = True
            self.agent.ask_to_end()
        elif not self._stays:  # nohup
            self._on_end(number, frame)


def _has_terminal() -> bool:
    """Return whether this process has a terminal that exists."""
    try:
        os.close(os.open("/dev/tty", os.O_RDWR | os.O_NOCTTY | os.O_CLOEXEC))
    except OSError:
        return False
    return True


def announce(info: AgentInfo, metrics_port: int | None = None) -> None:
    """Print that the RTPU accepts commands, and which guarantees are reduced.

    Args:
        info: The agent.
        metrics_port: The port on which it serves metrics, if it does.
    """
    lines = [f"{info.name}: ready on core {info.core}, scheduling by {info.backend}"]
    lines += [f"{info.name}: {limit}" for limit in info.limits]
    if metrics_port is not None:
        lines.append(f"{info.name}: metrics on port {metrics_port}")
    with contextlib.suppress(OSError):  # standard output is closed
        sys.stdout.write("\n".join([*lines, ""]))
        sys.stdout.flush()


def main(
    config: AgentConfig,
    *,
    backend: str = "auto",
    again: Callable[[], AgentConfig] | None = None,
    lasts: bool = True,
) -> int:
    """Run an agent until SIGTERM, SIGINT, or the end of its RTPU process.

    On SIGHUP the program replaces itself, with the same arguments: it reads its
    configuration and keys again, and takes over the RTPU process, which keeps running.
    Anything that would prevent this is checked before.

    Args:
        config: The agent's configuration.
        backend: See `Agent`.
        again: Returns the configuration for a restart; by default the same one.
        lasts: See `Agent`.

    Returns:
        The exit status: 0, or 1 if it ended by itself or a process had to be killed.

    Raises:
        NodeError: It cannot start, or too few files may be open.
    """
    agent = Agent(config, backend=backend, lasts=lasts)
    open_files.ensure(agent.name)
    life = AgentRun(agent, again)
    life.heed_signals()
    agent.start()
    for text in absent(config.libraries):
        log.warning("%s: %s", agent.name, text)
    announce(agent.info(), agent.metrics_port)
    systemd_notify.notify("READY=1")
    if life.wait():
        log.warning("%s: restarts", agent.name)
        agent.abandon()
        life.leave_signals()
        os.execv(sys.executable, [sys.executable, *sys.orig_argv[1:]])  # noqa: S606 - itself
    systemd_notify.notify("STOPPING=1")
    in_order = agent.stop(keep=systemd_notify.is_shutting_down())
    return 0 if in_order and not agent.reason else 1
