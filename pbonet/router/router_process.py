"""A router as a process: its signals, its service manager, its end."""

from __future__ import annotations

import contextlib
import logging
import signal
import sys
import threading
from typing import TYPE_CHECKING

import zenoh

from pbonet.errors import NodeError
from pbonet.node.agent import Retransmission, systemd_notify
from pbonet.xm.net import open_files, session

from . import router_config

if TYPE_CHECKING:
    from collections.abc import Generator

log = logging.getLogger("pbonet.router")

ENDS = {signal.SIGTERM, signal.SIGINT}
FIND_PERIOD = 10.0
"""Seconds until connections are found again, among them those that became no link."""


def main(config: zenoh.Config) -> int:
    """Run a router until SIGTERM or SIGINT; return the exit status, 0.

    Raises:
        NodeError: An endpoint cannot be listened on, or too few files may be open.
    """
    open_files.ensure("pbonet router")
    signal.pthread_sigmask(signal.SIG_BLOCK, ENDS)  # before zenoh's threads exist
    with _open(config) as opened, tended(opened):
        _announce(router_config.endpoints(config, "listen"))
        systemd_notify.notify("READY=1")
        number = signal.sigwait(ENDS)
        log.info("%s", signal.Signals(number).name)
        systemd_notify.notify("STOPPING=1")
    return 0


def _open(config: zenoh.Config) -> zenoh.Session:
    try:
        return zenoh.open(config)
    except zenoh.ZError as error:
        raise NodeError(
            "the router cannot be opened",
            where=" ".join(router_config.endpoints(config, "listen")),
            got=session.reason(error),
            remedy="if the address is in use, stop the program there (`ss -tlnp` "
            "names it) or give another one with --listen",
        ) from None


@contextlib.contextmanager
def tended(opened: zenoh.Session) -> Generator[None]:
    """Have no thread of a session wait for the other side of a link that is lost."""
    connections, changed, is_over = Retransmission(), threading.Event(), False

    def tend() -> None:
        while not is_over:
            changed.clear()  # a thousand new links take a few passes, not one each
            with contextlib.suppress(OSError):  # no file can be opened
                connections.find()
            changed.wait(FIND_PERIOD)

    thread = threading.Thread(target=tend, name="pbonet links", daemon=True)
    listener = opened.info.declare_link_events_listener(lambda _: changed.set())
    thread.start()
    try:
        yield
    finally:
        listener.undeclare()  # type: ignore[no-untyped-call]
        is_over = True
        changed.set()
        thread.join()


def _announce(listens: list[str]) -> None:
    """Print that agents and masters may connect."""
    with contextlib.suppress(OSError):  # standard output is closed
        sys.stdout.write(f"router: ready on {' '.join(listens)}\n")
        sys.stdout.flush()
