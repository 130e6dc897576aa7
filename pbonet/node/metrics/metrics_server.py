"""Serves the metrics of an agent over HTTP, beyond this machine only with keys."""

from __future__ import annotations

import threading
from typing import TYPE_CHECKING, cast

from pbonet.errors import ConfigError, NodeError
from pbonet.xm.net import credentials, session

if TYPE_CHECKING:
    import ssl
    from collections.abc import Callable
    from pathlib import Path
    from wsgiref.types import WSGIApplication

    from prometheus_client import CollectorRegistry

    from .rtpu_collector import Figures

    _MakeApp = Callable[[CollectorRegistry], WSGIApplication]


def check_address(address: str, key_folder: Path | None) -> tuple[str, int, bool]:
    """Return host, port, and whether they are of this machine alone.

    Args:
        address: ``HOST:PORT``.
        key_folder: The agent's keys.

    Raises:
        ConfigError: It is no address, or reaches beyond this machine without keys.
    """
    if not session.is_address(address):
        raise ConfigError(
            "this is no address for metrics",
            where="metrics",
            expected="HOST:PORT, such as 127.0.0.1:9464",
            got=address,
            remedy="correct it in agent.toml",
        )
    host, _, port = address.rpartition(":")
    local = session.is_loopback(address)
    if not local and key_folder is None:
        raise ConfigError(
            "metrics beyond this machine are not protected",
            where=f"metrics {address}",
            expected="keys, or an address of this machine alone, such as 127.0.0.1",
            remedy="make keys with `pbonet keys agent`, and name them in agent.toml; "
            "Prometheus then needs keys of its own, such as of `pbonet keys observer`",
        )
    return host.strip("[]"), int(port), local


class MetricsServer:
    """Answers ``GET /metrics`` until it is stopped.

    On this machine alone it is plain HTTP. Beyond, the client must have a certificate
    of the same authority, and so has the server.

    Args:
        rtpu: The RTPU's name.
        address: ``HOST:PORT``.
        key_folder: The agent's keys.
        figures: Where the metrics are read.

    Raises:
        ConfigError: The address cannot be used.
        NodeError: `prometheus-client` is missing, or the port is taken.
    """

    def __init__(
        self, rtpu: str, address: str, key_folder: Path | None, figures: Figures
    ) -> None:
        host, port, local = check_address(address, key_folder)
        try:
            import prometheus_client
        except ImportError:
            raise NodeError(
                "prometheus-client is not installed, which metrics need",
                where=rtpu,
                remedy="pip install 'pbonet[metrics]', or remove metrics in agent.toml",
            ) from None
        from .rtpu_collector import RtpuCollector
        from .scrape_server import ScrapeServer

        registry = prometheus_client.CollectorRegistry(auto_describe=False)
        registry.register(RtpuCollector(rtpu, figures))
        keys = None if local else key_folder
        try:
            self._server = ScrapeServer(host, port, _context(keys) if keys else None)
        except OSError as error:
            raise NodeError(
                "the metrics cannot be served",
                where=f"{rtpu}, {address}",
                got=error.strerror or str(error),
                remedy="give each agent of a machine a port of its own in agent.toml, "
                "and an address that the machine has",
            ) from None
        make = cast("_MakeApp", prometheus_client.make_wsgi_app)  # pyright: ignore[reportUnknownMemberType]
        self._server.set_app(make(registry))
        self._thread = threading.Thread(
            target=self._server.serve_forever, name="metrics", daemon=True
        )
        self._thread.start()
        self.port: int = self._server.server_port
        """The port, also where 0 was asked for."""

    def stop(self) -> None:
        """Answer no more."""
        self._server.shutdown()
        self._server.server_close()
        self._thread.join()


def _context(keys: Path) -> ssl.SSLContext:
    """Return what proves the server, and demands a proof of each client."""
    import ssl

    context = ssl.SSLContext(ssl.PROTOCOL_TLS_SERVER)
    context.load_verify_locations(keys / credentials.CA)
    context.load_cert_chain(keys / credentials.CERT, keys / credentials.KEY)
    context.verify_mode = ssl.CERT_REQUIRED
    return context
