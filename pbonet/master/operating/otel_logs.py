"""Events as log records of OpenTelemetry, sent by its SDK to a collector."""

from __future__ import annotations

from typing import TYPE_CHECKING, Final
from urllib.parse import urlsplit

from pbonet.errors import NodeError, Severity, StateError

if TYPE_CHECKING:
    from typing import Self

    from pbonet.xm.net import Event

_NUMBERS: Final = {
    Severity.DEBUG: 5,
    Severity.INFO: 9,
    Severity.WARNING: 13,
    Severity.ERROR: 17,
    Severity.FATAL: 21,
}
"""Severity numbers as OpenTelemetry's data model of logs has them."""
PATH: Final = "/v1/logs"
"""The path of a collector that takes logs over HTTP."""


class OtelLogs:
    """Sends events to a collector over HTTP, in batches and by a thread of its own.

    A collector that does not answer stops nothing; the SDK reports it in its log.

    Args:
        endpoint: The collector, such as ``http://127.0.0.1:4318``.

    Raises:
        NodeError: The SDK is not installed.
        StateError: That is no address of a collector.
    """

    def __init__(self, endpoint: str) -> None:
        _must_be_url(endpoint)
        try:
            # OpenTelemetry documents its logs under these names.
            from opentelemetry.exporter.otlp.proto.http._log_exporter import (  # noqa: PLC2701
                OTLPLogExporter,
            )
            from opentelemetry.sdk._logs import LoggerProvider  # noqa: PLC2701
            from opentelemetry.sdk._logs.export import (  # noqa: PLC2701
                BatchLogRecordProcessor,
            )
            from opentelemetry.sdk.resources import Resource
        except ImportError:
            raise NodeError(
                "the SDK of OpenTelemetry is not installed",
                remedy="pip install 'pbonet[otel]'",
            ) from None
        about = Resource.create({"service.name": "pbonet"})
        self._provider = LoggerProvider(resource=about, shutdown_on_exit=False)
        address = endpoint.rstrip("/")
        address += "" if address.endswith(PATH) else PATH
        exporter = OTLPLogExporter(endpoint=address)
        self._provider.add_log_record_processor(BatchLogRecordProcessor(exporter))
        self._logger = self._provider.get_logger("pbonet.events")

    def add(self, event: Event) -> None:
        """Send an event."""
        from opentelemetry._logs import LogRecord, SeverityNumber  # noqa: PLC2701

        attributes: dict[str, str | int] = {
            "pbonet.rtpu": event.rtpu,
            "pbonet.subsystem": event.subsystem,
            "pbonet.task": event.task,
            "pbonet.code": event.code,
            "pbonet.cycle": event.cycle,
            "pbonet.errnum": event.errnum,
            "pbonet.state": event.state,
            "code.filepath": event.place,
        }
        severity = Severity(event.severity)
        self._logger.emit(
            LogRecord(
                timestamp=round(event.wall * 1e9),
                severity_number=SeverityNumber(_NUMBERS[severity]),
                severity_text=severity.name,
                body=event.text,
                attributes={key: value for key, value in attributes.items() if value},
                event_name=f"pbonet.{event.code.lower()}",
            )
        )

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        """Send what is left, and end."""
        self._provider.shutdown()


def _must_be_url(endpoint: str) -> None:
    parts = urlsplit(endpoint)
    if parts.scheme not in {"http", "https"} or not parts.hostname:
        raise StateError(
            "this is no address of a collector",
            expected="a URL, such as http://127.0.0.1:4318",
            got=endpoint,
            remedy="correct --otlp",
        )
