"""Events as log records of OpenTelemetry, sent by its SDK to a collector."""

from __future__ import annotations

import threading
from typing import TYPE_CHECKING, Any, Final
from urllib.parse import urlsplit

from pbonet.errors import NodeError, Severity, StateError

if TYPE_CHECKING:
    from collections.abc import Callable, Sequence
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
END_TIME: Final = 2.0
"""Seconds in which the last events can be sent when it ends."""


class OtelLogs:
    """Sends events to a collector over HTTP, in batches and by a thread of its own.

    A collector that does not answer stops nothing; the SDK reports it in its log. At
    the end the last events have `END_TIME` to be sent.

    Args:
        endpoint: The collector, such as ``http://127.0.0.1:4318``.
        warned: Called at the end with a sentence if events did not reach it.

    Raises:
        NodeError: The SDK is not installed.
        StateError: That is no address of a collector.
    """

    def __init__(self, endpoint: str, warned: Callable[[str], None]) -> None:
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
        self._address, self._warned, self._added = address, warned, 0
        sent: Any = _Counted(OTLPLogExporter(endpoint=address))
        self._sent: _Counted = sent
        self._provider.add_log_record_processor(BatchLogRecordProcessor(sent))
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
        self._added += 1
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
        """Send what is left as far as there is time, and end."""
        ending = threading.Thread(target=self._provider.shutdown, daemon=True)
        ending.start()
        ending.join(END_TIME)
        lost = self._added - self._sent.records
        if lost:
            self._warned(
                f"{lost} of {self._added} events did not reach the collector "
                f"{self._address}; check that it runs and can be reached from here"
            )


class _Counted:
    """An exporter that counts the records that its collector has taken.

    Args:
        exporter: Sends them.
    """

    def __init__(self, exporter: Any) -> None:  # noqa: ANN401 - the SDK is an extra
        self._exporter = exporter
        self.records = 0

    def export(self, batch: Sequence[object]) -> Any:  # noqa: ANN401 - the SDK's result
        """Send records."""
        result = self._exporter.export(batch)
        if result.name == "SUCCESS":
            self.records += len(batch)
        return result

    def shutdown(self) -> None:
        """Send nothing more."""
        self._exporter.shutdown()


def _must_be_url(endpoint: str) -> None:
    parts = urlsplit(endpoint)
    if parts.scheme not in {"http", "https"} or not parts.hostname:
        raise StateError(
            "this is no address of a collector",
            expected="a URL, such as http://127.0.0.1:4318",
            got=endpoint,
            remedy="correct --otlp",
        )
