"""Has no thread of a client wait for the other side of a link that is lost.

zenoh sets `SO_LINGER` on its connections: closing one waits for up to ten seconds
until the other side has confirmed what was sent. After a cut it cannot, and a tool
would end that much later, or a master's next link begin. Without the option the kernel
sends what is left by itself. Agents and routers take it off in
`pbonet.node.agent.retransmission`, where every connection is zenoh's.
"""

from __future__ import annotations

import contextlib
import os
import socket
import struct

import zenoh

NEVER = struct.pack("ii", 0, 0)
"""The value of `SO_LINGER` by which to close a connection takes no time."""


def end(opened: zenoh.Session) -> None:
    """Take the option off the connections of a session, and off later ones."""
    opened.info.declare_link_events_listener(_on_link, history=True)


def _on_link(event: zenoh.LinkEvent) -> None:
    if event.kind != zenoh.SampleKind.PUT:
        return
    ends = tuple(str(one).partition("/")[2] for one in (event.link.src, event.link.dst))
    # Other connections of this process are its program's own.
    for name in os.listdir("/proc/self/fd"):  # noqa: PTH208 - numbers, no paths
        with contextlib.suppress(OSError):
            one = socket.socket(fileno=int(name))
            try:
                if ends == (_spelled(one.getsockname()), _spelled(one.getpeername())):
                    one.setsockopt(socket.SOL_SOCKET, socket.SO_LINGER, NEVER)
            finally:
                one.detach()


def _spelled(address: object) -> str:
    """Return an address as zenoh writes it; nothing for one of another kind."""
    match address:
        case (str(host), int(port)):
            return f"{host}:{port}"
        case (str(host), int(port), int(), int()):
            return f"[{host}]:{port}"
        case _:
            return ""
