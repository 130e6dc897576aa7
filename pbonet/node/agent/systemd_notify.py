"""Reports the agent's state to its service manager (systemd's `Type=notify`)."""

from __future__ import annotations

import contextlib
import os
import socket

VARIABLE = "NOTIFY_SOCKET"
"""Variable with the manager's socket; not set if there is no manager."""


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
