"""The agent and its service manager, systemd: `Type=notify`, and a shutdown."""

from __future__ import annotations

import contextlib
import os
import socket
import subprocess
from typing import Final

VARIABLE = "NOTIFY_SOCKET"
"""Variable with the manager's socket; not set if there is no manager."""
ASK_TIME: Final = 2.0
"""Seconds in which the manager must say whether the machine is being shut down."""


def notify(state: str) -> bool:
    """Report `state` to the service manager, if there is one.

    The protocol is one datagram to a Unix socket; a name that begins with `@` is in the
    abstract namespace (sd_notify(3)).

    Args:
        state: For example ``READY=1`` or ``STOPPING=1``.

    Returns:
        Whether it was sent.
    """
    name = os.environ.get(VARIABLE, "")
    if not name:
        return False
    address = f"\0{name[1:]}" if name.startswith("@") else name
    with (
        contextlib.suppress(OSError),  # the agent also works without its manager
        socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM | socket.SOCK_CLOEXEC) as sock,
    ):
        sock.sendto(state.encode(), address)
        return True
    return False


def is_shutting_down() -> bool:
    """Return whether the service manager ends the agent because the machine ends."""
    import shutil  # only at the end

    program = shutil.which("systemctl")
    if not os.environ.get(VARIABLE) or program is None:
        return False
    try:
        done = subprocess.run(
            [program, "is-system-running"],
            capture_output=True,
            timeout=ASK_TIME,
            check=False,
        )
    except (OSError, subprocess.TimeoutExpired):
        return False
    return done.stdout.strip() == b"stopping"
