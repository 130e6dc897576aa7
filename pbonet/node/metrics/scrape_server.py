"""An HTTP server that a client can neither stop nor fill.

The one of `prometheus_client` makes the handshake where it accepts connections, and has
no time limit: a client that connects and says nothing would stop it, and the agent.
"""

from __future__ import annotations

import logging
import socketserver
import ssl
import threading
from socket import AF_INET6, socket
from typing import TYPE_CHECKING, ClassVar, Final
from wsgiref.simple_server import WSGIRequestHandler, WSGIServer

if TYPE_CHECKING:
    Request = socket | tuple[bytes, socket]

log = logging.getLogger("pbonet.node")
PATIENCE: Final = 5.0
"""Seconds for which a client may say nothing, or take nothing."""
AT_ONCE: Final = 16
"""Connections that are answered at one time."""
WAITS: Final = 1.0
"""Seconds for which one more waits until one of them has ended; then it is closed."""


class ScrapeHandler(WSGIRequestHandler):
    """Answers one request, and logs nothing."""

    timeout: ClassVar[float | None] = PATIENCE

    def log_message(self, format: str, *args: object) -> None:  # noqa: A002 - as there
        """Log nothing."""


class ScrapeServer(socketserver.ThreadingMixIn, WSGIServer):
    """Answers each connection in a thread of its own, and not more than `AT_ONCE`.

    Args:
        host: The address.
        port: The port; 0: any.
        context: The keys; None: plain HTTP.
    """

    daemon_threads = True
    request_queue_size = 64

    def __init__(self, host: str, port: int, context: ssl.SSLContext | None) -> None:
        if ":" in host:
            self.address_family = AF_INET6
        self._free = threading.BoundedSemaphore(AT_ONCE)
        super().__init__((host, port), ScrapeHandler)
        if context is not None:
            # Its first read makes the handshake: in a thread, with a time limit.
            self.socket = context.wrap_socket(
                self.socket, server_side=True, do_handshake_on_connect=False
            )

    def server_bind(self) -> None:
        """Bind without asking for the name of the address, which may take long."""
        socketserver.TCPServer.server_bind(self)
        self.server_name = str(self.server_address[0])
        self.server_port = self.server_address[1]
        self.setup_environ()

    def process_request(self, request: Request, client_address: object) -> None:
        """Answer in a thread, or close the connection if there are too many."""
        if self._free.acquire(timeout=WAITS):
            super().process_request(request, client_address)
        else:
            self.shutdown_request(request)

    def process_request_thread(self, request: Request, client_address: object) -> None:
        """Answer a connection."""
        try:
            super().process_request_thread(request, client_address)
        finally:
            self._free.release()

    def handle_error(self, request: Request, client_address: object) -> None:
        """Note a client that went away, or has no keys."""
        del request
        log.debug("metrics: %s was not answered", client_address)
