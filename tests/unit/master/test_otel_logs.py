"""Events reach a collector of OpenTelemetry as its protocol says."""

from __future__ import annotations

import http.server
import queue
import socket
import sys
import threading

import pytest
from opentelemetry.proto.collector.logs.v1.logs_service_pb2 import (
    ExportLogsServiceRequest,
)

from pbonet.errors import NodeError, Severity, StateError
from pbonet.master.operating import OtelLogs, otel_logs
from pbonet.xm.net import Event


@pytest.fixture
def collector():
    """Give a collector's address, and what it has received."""
    got = queue.SimpleQueue()

    class Takes(http.server.BaseHTTPRequestHandler):
        def do_POST(self):
            size = int(self.headers["Content-Length"])
            got.put((self.path, self.headers, self.rfile.read(size)))
            self.send_response(200)
            self.end_headers()

        def log_message(self, *_):
            """Print nothing."""

    server = http.server.ThreadingHTTPServer(("127.0.0.1", 0), Takes)
    thread = threading.Thread(target=server.serve_forever)
    thread.start()
    yield f"http://127.0.0.1:{server.server_port}", got
    server.shutdown()
    server.server_close()
    thread.join()


def event(**more):
    given = {"n": 1, "time": 5, "wall": 1000.5, "severity": int(Severity.ERROR)}
    given |= {"code": "METHOD", "rtpu": "arm0", "task": "pid", "text": "no grip"}
    return Event(**given | more)


def test_an_event_is_a_log_record(collector):
    address, got = collector
    warned = []
    with OtelLogs(address, warned.append) as logs:
        logs.add(event(cycle=7, subsystem="arm", place="pid.py:3 in cycle"))
        logs.add(event(severity=int(Severity.WARNING), task=""))
    path, headers, body = got.get(timeout=30)
    assert warned == []
    assert path == "/v1/logs"
    assert headers["Content-Type"] == "application/x-protobuf"
    (resource,) = ExportLogsServiceRequest.FromString(body).resource_logs
    about = {one.key: one.value.string_value for one in resource.resource.attributes}
    assert about["service.name"] == "pbonet"
    first, second = resource.scope_logs[0].log_records
    assert first.time_unix_nano == 1_000_500_000_000
    assert (first.severity_number, first.severity_text) == (17, "ERROR")
    assert first.body.string_value == "no grip"
    assert first.event_name == "pbonet.method"
    found = {one.key: one.value for one in first.attributes}
    assert found["pbonet.task"].string_value == "pid"
    assert found["pbonet.cycle"].int_value == 7
    assert found["pbonet.subsystem"].string_value == "arm"
    assert found["code.filepath"].string_value == "pid.py:3 in cycle"
    assert second.severity_number == 13
    assert "pbonet.task" not in {one.key for one in second.attributes}


def test_a_collector_that_answers_nothing_does_not_hold_up_the_end(monkeypatch):
    """It takes the connection and is silent, for longer than the test may take."""
    monkeypatch.setattr(otel_logs, "END_TIME", 0.2)
    warned = []
    with socket.create_server(("127.0.0.1", 0)) as silent:
        address = f"http://127.0.0.1:{silent.getsockname()[1]}"
        monkeypatch.setenv("OTEL_EXPORTER_OTLP_LOGS_TIMEOUT", "3600")
        with OtelLogs(address, warned.append) as logs:
            logs.add(event())
            logs.add(event(n=2))
    (text,) = warned
    assert text.startswith(f"2 of 2 events did not reach the collector {address}/v1/")
    assert "check that it runs" in text


@pytest.mark.parametrize("address", ["localhost:4318", "127.0.0.1", "ftp://x", "http:"])
def test_what_is_no_address_of_a_collector_is_refused(address):
    with pytest.raises(StateError, match="no address of a collector"):
        OtelLogs(address, print)


def test_without_the_sdk_it_is_said_what_to_install(monkeypatch):
    monkeypatch.setitem(sys.modules, "opentelemetry.sdk._logs", None)
    with pytest.raises(NodeError) as refused:
        OtelLogs("http://127.0.0.1:1", print)
    assert "pip install 'pbonet[otel]'" in refused.value.remedy


def test_it_needs_events_that_are_followed(call, puma):
    status, _, err = call("events", puma, "--otlp", "http://127.0.0.1:4318")
    assert status == 1
    assert "--otlp needs --follow" in err
