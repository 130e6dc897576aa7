"""The metrics of a real agent with a task that runs."""

from __future__ import annotations

import urllib.request

from watching import wait_for


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
    assert scraped("pbonet_rtpu_up") == {'pbonet_rtpu_up{rtpu="arm0"}': 1.0}
