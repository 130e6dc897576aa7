"""The goals of the benchmark of many agents."""

import importlib
from pathlib import Path

ROOT = Path(__file__).parents[3]
ALONE = {"agents": 1, "cpu": 0.1, "router": 0.1, "found": 0.1}
PAIR = {"table": 0.5, "all": 1.0, "loss": 0.1}
FAULTS = [{"fault": "agents that ended", "healed": 0}]


def test_one_agent_alone_is_judged_by_what_it_can_show(monkeypatch, capsys):
    """It has no subsystem of two, whose figures the others have."""
    monkeypatch.syspath_prepend(str(ROOT))
    scale = importlib.import_module("benchmarks.scale")
    assert scale.judge([ALONE], FAULTS)
    assert "loss" not in capsys.readouterr().out
    five = ALONE | PAIR | {"agents": 5}
    assert scale.judge([ALONE, five], FAULTS)
    assert "loss seen as with few: met" in capsys.readouterr().out
    assert not scale.judge([five, five | {"agents": 100, "all": 3.0}], FAULTS)
