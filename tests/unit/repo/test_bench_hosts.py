"""The two machines of a benchmark, when they do not come up."""

from __future__ import annotations

import importlib
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[3]
SLEEPS = "import time; time.sleep(1000)"


@pytest.mark.parametrize("failed", ["agent one", "agent two"])
def test_a_pair_that_does_not_come_up_leaves_no_agent(monkeypatch, failed):
    monkeypatch.syspath_prepend(str(ROOT))
    hosts = importlib.import_module("benchmarks.hosts")
    started, folders = [], []
    run = hosts.Side.run

    def running(side, *words, **options):
        started.append(run(side, *words, **options))
        folders.append(side.run_dir)
        return started[-1]

    def waits(_condition, what):
        assert what != failed

    monkeypatch.setattr(hosts, "AGENT", SLEEPS)
    monkeypatch.setattr(hosts.Side, "run", running)
    monkeypatch.setattr(hosts, "wait", waits)
    try:
        with pytest.raises(AssertionError):
            hosts.Pair([[], []], "tcp/127.0.0.1:1", "tcp/127.0.0.1:1")
        assert len(started) == (1 if failed == "agent one" else 2)
        assert all(agent.poll() is not None for agent in started)
        assert not any(folder.exists() for folder in folders)
    finally:
        for agent in started:
            agent.kill()
            agent.wait()
