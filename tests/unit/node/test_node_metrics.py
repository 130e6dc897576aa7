"""The metrics of an agent: what they are made of, and who may read them."""

from __future__ import annotations

import http.client
import json
import re
import socket
import ssl
import sys
from pathlib import Path
from types import SimpleNamespace

import pytest
from prometheus_client import CollectorRegistry, generate_latest
from prometheus_client.parser import text_string_to_metric_families
from xm_rig import agent_info

from pbonet.config import parse_agent
from pbonet.errors import ConfigError, NodeError, SvarError
from pbonet.node.metrics import MetricsServer, check_address, scrape_server
from pbonet.node.metrics.rtpu_collector import FAMILIES, RtpuCollector
from pbonet.xm.net import (
    RtpuStatus,
    TaskStatus,
    TbufStatus,
    messages as m,
    pki,
)

ROOT = Path(__file__).parents[3]


def task(name, state="ON", **more):
    given = {"tid": 1, "S": "P", "crit": 5, "cycle": 100, "miss": 3, "ref_f": 50.0}
    given |= {"mez_f": 0.0, "mez_t": 0.0, "ptime": 2.0, "tot_c": 0.25, "tick": 1e-9}
    given |= {"min_c": 0.0, "max_c": 0.004, "last_c": 0.0, "warn": 2}
    return TaskStatus(rmod=name, task=name, rtpu="arm0", state=state, **given | more)


class Figures:
    """What an agent knows: two tasks, a variable that is stale, a link, a peer."""

    def __init__(self):
        self.restarting = self.ending = False
        self.asked = []

    def info(self):
        return agent_info(
            "arm0",
            host="lab1",
            machine="m",
            version="9",
            claims={"arm": 7},
            keys_left=86400.0,
        )

    def status(self, subsystem):
        self.asked.append(subsystem)
        if self.restarting:
            raise NodeError("the RTPU process has ended and is being started again")
        return RtpuStatus(
            rtpu="arm0",
            backend="fifo",
            scheduler="MUF",
            tasks=[
                task("pid", failures={"missed deadline": 4}),
                task("plan", "ERROR", failed=1),
            ],
            util=0.25,
            stalls=2,
            stalled=0.5,
            illegal=["plan is in ERROR (arm0/plan)"],
            events={"pid": {"WARNING": 2}},
            tbufs=[TbufStatus(name="way", writer="1", reader="2", number=9, age=0.1)],
        )

    def ages(self, subsystem):
        assert subsystem == "arm"
        if self.ending:
            raise SvarError("the table is closed")
        return [
            SimpleNamespace(variable="Q", seconds=0.02, stale=False),
            SimpleNamespace(variable="REF", seconds=None, stale=True),
        ]

    def ways(self, *, measure=True):
        assert not measure, "a scrape sends nothing to other agents"
        return m.LinkReport(
            rtpu="arm0",
            ways=[m.Way(rtpu="arm1", trip=0.001), m.Way(rtpu="arm2", error="gone")],
        )

    def machine(self):
        return m.MachineInfo(wall=0.0, runs="/runs", disk_free=7, disk_size=9)


@pytest.fixture
def figures():
    return Figures()


def scraped(figures):
    """Return the samples of a scrape, by name and labels without the RTPU's."""
    registry = CollectorRegistry()
    registry.register(RtpuCollector("arm0", figures))
    text = generate_latest(registry).decode()
    found = {}
    for family in text_string_to_metric_families(text):
        for sample in family.samples:
            labels = dict(sample.labels)
            assert labels.pop("rtpu") == "arm0"
            found[sample.name, *sorted(labels.values())] = sample.value
    return found


def test_a_scrape_has_what_status_reads(figures):
    found = scraped(figures)
    assert figures.asked == ["arm"], "the status is read once"
    expected = {
        ("pbonet_rtpu_up",): 1,
        ("pbonet_rtpu_utilization_ratio",): 0.25,
        ("pbonet_rtpu_stalled_seconds_total",): 0.5,
        ("pbonet_illegal_causes", "arm"): 1,
        ("pbonet_events_total", "arm", "pid", "WARNING"): 2,
        ("pbonet_task_cycles_total", "arm", "pid"): 100,
        ("pbonet_task_missed_total", "arm", "pid"): 3,
        ("pbonet_task_failed_total", "arm", "plan"): 1,
        ("pbonet_task_cpu_seconds_total", "arm", "pid"): 0.25,
        ("pbonet_task_cpu_longest_seconds", "arm", "pid"): 0.004,
        ("pbonet_task_state", "arm", "plan", "ERROR"): 1,
        ("pbonet_task_state", "arm", "plan", "ON"): 0,
        ("pbonet_task_timing_failures_total", "arm", "pid", "missed deadline"): 4,
        ("pbonet_variable_age_seconds", "arm", "Q"): 0.02,
        ("pbonet_variable_stale", "arm", "REF"): 1,
        ("pbonet_link_age_seconds", "way"): 0.1,
        ("pbonet_link_records_total", "way"): 9,
        ("pbonet_peer_round_trip_seconds", "arm1"): 0.001,
        ("pbonet_agent_info", "9", "d", "fifo", "lab1"): 1,
        ("pbonet_agent_keys_left_seconds",): 86400,
        ("pbonet_runs_free_bytes",): 7,
    }
    ordered = {(key[0], *sorted(key[1:])): n for key, n in expected.items()}
    assert ordered.items() <= found.items()
    assert ("pbonet_variable_age_seconds", "arm", "REF") not in found
    assert ("pbonet_peer_round_trip_seconds", "arm2") not in found


def test_an_rtpu_process_that_starts_again_is_down_and_nothing_fails(figures):
    figures.restarting = True
    found = scraped(figures)
    assert found["pbonet_rtpu_up",] == 0
    assert not any("task" in name for name, *_ in found)


def test_a_subsystem_that_has_just_ended_is_no_rtpu_that_is_down(figures):
    figures.ending = True
    found = scraped(figures)
    assert found["pbonet_rtpu_up",] == 1
    assert not any("age" in name for name, *_ in found if "variable" in name)


@pytest.mark.parametrize("family", FAMILIES, ids=lambda one: one.name)
def test_names_and_units_follow_the_conventions(family):
    """https://prometheus.io/docs/practices/naming: `_total`, base units."""
    assert family.name.endswith("_total") == family.counter
    assert re.fullmatch("[a-z_]+", family.name)
    assert not re.search(r"_(ms|us|percent|mb|minutes)\b", family.name)
    assert family.help.endswith(".")


WORDS = {"rate", "sum", "topk", "by", "and"}
"""Functions and operators of PromQL in the dashboard."""


def exported(figures):
    """Return the kind and the labels of each sample of a scrape, by its name."""
    registry = CollectorRegistry()
    registry.register(RtpuCollector("arm0", figures))
    text = generate_latest(registry).decode()
    return {
        sample.name: (family.type, {*sample.labels})
        for family in text_string_to_metric_families(text)
        for sample in family.samples
    }


def dashboard():
    text = (ROOT / "deploy" / "grafana-dashboard.json").read_text("utf-8")
    return json.loads(text)


QUERIES = [
    (panel["title"], target["expr"], target["legendFormat"])
    for panel in dashboard()["panels"]
    for target in panel["targets"]
]


UNITS = {"short", "percentunit", "cps", "hertz", "s", "bytes"}
"""Names of units as Grafana has them."""


@pytest.mark.parametrize(("title", "query", "legend"), QUERIES)
def test_the_dashboard_asks_for_what_a_scrape_has(figures, title, query, legend):
    there = exported(figures)
    parts = r"(pbonet_\w+)(?:\{([^}]*)\})?(\[\w+\])?"
    asked = re.findall(parts, query)
    assert asked, title
    for name, selected, span in asked:
        kind, labels = there[name]
        assert {*re.findall(r"(\w+)[!=]=?~?\"", selected)} <= labels
        assert bool(span) == (kind == "counter"), f"{name} is a {kind}"
    grouped = {*re.findall(r"\w+", "".join(re.findall(r"by \(([^)]*)\)", query)))}
    labels = there[asked[0][0]][1]
    assert grouped <= labels
    assert {*re.findall(r"\{\{(\w+)\}\}", legend)} <= (grouped or labels)
    bare = re.sub(r"\{[^}]*\}|\[\w+\]", "", query)
    assert {*re.findall(r"[A-Za-z_]\w*", bare)} <= {*there} | WORDS | grouped
    assert bare.count("(") == bare.count(")")


def test_the_dashboard_has_what_an_import_by_grafana_needs():
    """By Grafana's published kind `dashboard` (dashboard_kind.cue), version 36 on.

    Its source of data is a variable that the file itself declares, so that an import
    asks for nothing (no `__inputs`), and every query and panel names it.
    """
    board = dashboard()
    assert isinstance(board["title"], str)
    assert board["schemaVersion"] >= 36
    assert "id" not in board, "Grafana gives it one"
    assert 1 <= len(board["uid"]) <= 40
    variables = {one["name"]: one for one in board["templating"]["list"]}
    assert (
        variables["datasource"] | {"type": "datasource", "query": "prometheus"}
        == (variables["datasource"])
    )
    assert {one["type"] for one in variables.values()} == {"datasource", "query"}
    named = {
        *re.findall(r"\$\{?(\w+)", json.dumps([board["panels"], variables["rtpu"]]))
    }
    assert named - {"__all"} == {*variables}
    assert "__inputs" not in board
    source = {"type": "prometheus", "uid": "${datasource}"}
    assert variables["rtpu"]["datasource"] == source
    taken = set()
    for panel in board["panels"]:
        assert panel["type"] == "timeseries"
        assert panel["datasource"] == source
        assert {*panel["fieldConfig"]} == {"defaults", "overrides"}
        assert panel["fieldConfig"]["defaults"]["unit"] in UNITS
        ids = [target["refId"] for target in panel["targets"]]
        assert ids == [chr(ord("A") + n) for n in range(len(ids))]
        assert all(target["datasource"] == source for target in panel["targets"])
        place = panel["gridPos"]
        assert place["x"] + place["w"] <= 24
        cells = {
            (place["x"] + x, place["y"] + y)
            for x in range(place["w"])
            for y in range(place["h"])
        }
        assert not cells & taken, panel["title"]
        taken |= cells
    ids = [panel["id"] for panel in board["panels"]]
    assert len({*ids}) == len(ids)


def test_the_dashboard_chooses_among_the_rtpus_that_there_are(figures):
    there = exported(figures)
    chosen = [one for one in dashboard()["templating"]["list"] if one["name"] == "rtpu"]
    for name, label in re.findall(r"label_values\((\w+), (\w+)\)", json.dumps(chosen)):
        assert label in there[name][1]
    assert (
        len({name for _, query, _ in QUERIES for name in there if name in query}) > 15
    )


# -- the server ------------------------------------------------------------------------


@pytest.mark.parametrize("address", ["127.0.0.1:9464", "[::1]:9464", "localhost:1"])
def test_an_address_of_this_machine_needs_no_keys(address):
    assert check_address(address, None)[1:] == (int(address.rpartition(":")[2]), True)


@pytest.mark.parametrize("address", ["0.0.0.0:9464", "10.0.0.2:9464", "[::]:9464"])
def test_beyond_this_machine_keys_are_needed(address):
    with pytest.raises(ConfigError) as refused:
        check_address(address, None)
    assert "metrics beyond this machine are not protected" in str(refused.value)
    assert "`pbonet keys agent`" in refused.value.remedy


@pytest.mark.parametrize("address", ["9464", "127.0.0.1", "127.0.0.1:99999", ""])
def test_what_is_no_address_is_refused(address):
    with pytest.raises(ConfigError, match="this is no address for metrics"):
        check_address(address, None)


def test_agent_toml_has_the_address():
    assert parse_agent('metrics = "127.0.0.1:9464"\n').metrics == "127.0.0.1:9464"
    assert parse_agent("").metrics is None


def test_without_the_package_it_is_said_what_to_install(figures, monkeypatch):
    monkeypatch.setitem(sys.modules, "prometheus_client", None)
    with pytest.raises(NodeError) as refused:
        MetricsServer("arm0", "127.0.0.1:0", None, figures)
    assert "pip install 'pbonet[metrics]'" in refused.value.remedy


def test_a_port_that_is_taken_is_said(figures):
    one = MetricsServer("arm0", "127.0.0.1:0", None, figures)
    try:
        with pytest.raises(NodeError, match="the metrics cannot be served"):
            MetricsServer("arm1", f"127.0.0.1:{one.port}", None, figures)
    finally:
        one.stop()


def test_the_server_answers_until_it_is_stopped(figures):
    one = MetricsServer("arm0", "127.0.0.1:0", None, figures)
    link = http.client.HTTPConnection("127.0.0.1", one.port, timeout=30)
    link.request("GET", "/metrics")
    answer = link.getresponse()
    assert answer.status == 200
    assert b"pbonet_task_cycles_total{" in answer.read()
    link.close()
    one.stop()
    with pytest.raises(OSError, match="refused"):
        http.client.HTTPConnection("127.0.0.1", one.port, timeout=5).request("GET", "/")


@pytest.fixture
def secured(figures, tmp_path):
    """Serve on all addresses; yield the port, and a function that reads with keys."""
    authority = tmp_path / "ca"
    pki.make_authority(authority)
    agent = pki.issue(authority, pki.Role.GATEWAY, "arm0", hosts=["127.0.0.1"])
    observer = pki.issue(authority, pki.Role.OBSERVER, "prometheus")
    one = MetricsServer("arm0", "0.0.0.0:0", agent, figures)

    def read(*, keys=True):
        context = ssl.create_default_context(cafile=str(agent / "ca.pem"))
        context.check_hostname = False
        if keys:
            context.load_cert_chain(observer / "cert.pem", observer / "key.pem")
        link = http.client.HTTPSConnection(
            "127.0.0.1", one.port, timeout=30, context=context
        )
        try:
            link.request("GET", "/metrics")
            return link.getresponse().read()
        finally:
            link.close()

    yield one.port, read
    one.stop()


def test_beyond_this_machine_only_holders_of_keys_are_answered(secured):
    _, read = secured
    assert b"pbonet_rtpu_up" in read()
    with pytest.raises(OSError):  # noqa: PT011 - as the peer ends the handshake
        read(keys=False)


def test_a_client_that_says_nothing_stops_no_other(secured):
    port, read = secured
    with socket.create_connection(("127.0.0.1", port), timeout=30):
        assert b"pbonet_rtpu_up" in read()


def test_a_client_that_says_nothing_is_ended(figures, monkeypatch):
    monkeypatch.setattr(scrape_server.ScrapeHandler, "timeout", 0.05)
    one = MetricsServer("arm0", "127.0.0.1:0", None, figures)
    try:
        with socket.create_connection(("127.0.0.1", one.port), timeout=30) as idle:
            assert idle.recv(1) == b""
    finally:
        one.stop()


def test_a_client_waits_until_another_is_answered(figures, monkeypatch):
    monkeypatch.setattr(scrape_server, "AT_ONCE", 1)
    monkeypatch.setattr(scrape_server, "WAITS", 30.0)
    one = MetricsServer("arm0", "127.0.0.1:0", None, figures)
    try:
        with (
            socket.create_connection(("127.0.0.1", one.port), timeout=30) as first,
            socket.create_connection(("127.0.0.1", one.port), timeout=30) as more,
        ):
            more.sendall(b"GET /metrics HTTP/1.0\r\n\r\n")
            first.close()
            assert more.recv(8) == b"HTTP/1.0"
    finally:
        one.stop()


def test_more_clients_than_are_answered_at_once_are_refused(figures, monkeypatch):
    monkeypatch.setattr(scrape_server, "AT_ONCE", 1)
    monkeypatch.setattr(scrape_server, "WAITS", 0.01)
    one = MetricsServer("arm0", "127.0.0.1:0", None, figures)
    try:
        with (
            socket.create_connection(("127.0.0.1", one.port), timeout=30) as first,
            socket.create_connection(("127.0.0.1", one.port), timeout=30) as more,
        ):
            assert more.recv(1) == b""
            first.sendall(b"GET /metrics HTTP/1.0\r\n\r\n")
            assert first.recv(8) == b"HTTP/1.0"
    finally:
        one.stop()
