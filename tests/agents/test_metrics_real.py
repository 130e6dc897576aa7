"""A real agent with a task that runs: its metrics, and what `fleet` shows of it."""

from __future__ import annotations

import contextlib
import json
import shutil
import socket
import subprocess
import urllib.error
import urllib.parse
import urllib.request
from pathlib import Path

import pytest
from watching import wait_for

from pbonet.errors import NodeError
from pbonet.master.operating import fleet
from pbonet.node.agent import Agent, agent_main
from pbonet.xm.net import messages as m


def test_a_scrape_shows_the_task_and_takes_no_cycle_of_it(nodes):
    agent = nodes.agent("arm0", metrics="127.0.0.1:0")
    arm = nodes.master("arm0", "arm")
    arm.spawn("a", "counts")
    arm.on("a")
    url = f"http://127.0.0.1:{agent.metrics_port}/metrics"

    def scraped(name):
        with urllib.request.urlopen(url, timeout=60) as answer:
            lines = answer.read().decode().splitlines()
        found = [line for line in lines if line.startswith(name + "{")]
        return {
            line.rpartition(" ")[0]: float(line.rpartition(" ")[2]) for line in found
        }

    cycles = 'pbonet_task_cycles_total{rtpu="arm0",subsystem="arm",task="a"}'
    first = scraped("pbonet_task_cycles_total")[cycles]
    wait_for(lambda: scraped("pbonet_task_cycles_total")[cycles] > first, "more cycles")
    state = 'pbonet_task_state{rtpu="arm0",state="ON",subsystem="arm",task="a"}'
    assert scraped("pbonet_task_state")[state] == 1.0
    ages = scraped("pbonet_variable_age_seconds")
    assert any('variable="Y0"' in name for name in ages)
    told = nodes.client().call("arm0", m.Machine(), m.MachineInfo)
    free = 'pbonet_runs_free_bytes{rtpu="arm0"}'
    assert told.disk_size > scraped("pbonet_runs_free_bytes")[free] > 0
    found = fleet.ask(nodes.domain, ())
    assert [one.rtpus[0].name for one in found.machines] == ["arm0"]
    assert abs(found.machines[0].clock) <= found.machines[0].within + 1.0
    assert [(one.name, one.tasks) for one in found.subsystems] == [("arm", {"ON": 1})]
    assert scraped("pbonet_rtpu_up") == {'pbonet_rtpu_up{rtpu="arm0"}': 1.0}


def test_an_agent_prints_the_port_that_it_took(nodes, capfd):
    agent = nodes.agent("arm0", metrics="127.0.0.1:0")
    agent_main.announce(agent.info(), agent.metrics_port)
    assert f"arm0: metrics on port {agent.metrics_port}\n" in capfd.readouterr().out
    other = nodes.config("arm1", metrics=f"127.0.0.1:{agent.metrics_port}")
    with pytest.raises(NodeError, match="the metrics cannot be served"):
        Agent(other).start()


ROOT = Path(__file__).parents[2]
SCRAPE = """
global: {scrape_interval: 200ms, scrape_timeout: 200ms}
scrape_configs:
  - job_name: pbonet
    static_configs: [{targets: ["127.0.0.1:%d"]}]
"""
NOTHING = ("state!=", "variable_stale", "peer_round_trip", "keys_left")
"""Parts of queries that find nothing while one task runs well, alone, without keys."""


@pytest.fixture
def prometheus(nodes, tmp_path):
    """Prometheus, which reads an agent with a task; return how to ask it."""
    program = shutil.which("prometheus")
    if program is None:
        pytest.skip("prometheus is not installed (apt-get install prometheus)")
    agent = nodes.agent("arm0", metrics="127.0.0.1:0")
    arm = nodes.master("arm0", "arm")
    arm.spawn("a", "counts")
    arm.on("a")
    with socket.socket() as one:
        one.bind(("127.0.0.1", 0))
        where = f"127.0.0.1:{one.getsockname()[1]}"
    config = tmp_path / "prometheus.yml"
    config.write_text(SCRAPE % agent.metrics_port)
    words = [f"--config.file={config}", f"--web.listen-address={where}"]
    words += [f"--storage.tsdb.path={tmp_path / 'data'}", "--log.level=error"]
    process = subprocess.Popen([program, *words])

    def ask(path, **about):
        url = f"http://{where}/api/v1/{path}?{urllib.parse.urlencode(about)}"
        with urllib.request.urlopen(url, timeout=60) as answer:
            return json.load(answer)["data"]

    def has_read():
        with contextlib.suppress(ConnectionError, urllib.error.URLError):
            return ask("label/rtpu/values", **{"match[]": "pbonet_agent_info"})

    try:
        assert wait_for(has_read, "a reading by Prometheus") == ["arm0"]
        yield ask
    finally:
        process.terminate()
        process.wait()


def test_prometheus_answers_each_query_of_the_dashboard(prometheus):
    text = (ROOT / "deploy" / "grafana-dashboard.json").read_text("utf-8")
    panels = json.loads(text)["panels"]
    queries = [target["expr"] for panel in panels for target in panel["targets"]]
    for query in queries:
        plain = query.replace("$rtpu", ".*")

        def found(asked=plain):
            return prometheus("query", query=asked)["result"]

        if any(part in query for part in NOTHING):
            assert found() == [], query
        else:
            wait_for(found, query)
