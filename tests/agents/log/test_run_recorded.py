"""``pbonet run`` for a time: every release counts, and every cycle is on record."""

from __future__ import annotations

import json
import subprocess
import sys
from pathlib import Path

import numpy as np
from watching import processes_of

from pbonet.log import Log
from pbonet.node.rt import _rt


def test_run_for_a_time_leaves_nothing_and_records_every_cycle(
    nodes, puma, tmp_path, shared_memory
):
    words = ("--seconds", "1.5", "--runs", str(tmp_path / "kept"), "--json")
    job, domain = str(puma.with_suffix(".job")), nodes.domain
    done = subprocess.run(
        [sys.executable, "-m", "pbonet.cli", "run", job, *words, "--domain", domain],
        capture_output=True,
        text=True,
        timeout=200,
        check=False,
    )
    err = done.stderr
    assert done.returncode == 0, err
    outcome = json.loads(done.stdout)
    assert outcome["reason"] == "1.5 s are over"
    tasks = {task["task"]: task for task in outcome["tasks"]}
    assert set(tasks) == {"puma_pidg", "grav_comp", "qrdiff", "jttrace"}
    servo = tasks["puma_pidg"]
    released, passed = servo["cycles"] + servo["missed"], servo["cycles"] / servo["hz"]
    # Of the last look; a core that stood still just then had not counted all yet.
    assert released >= 500
    assert 400 * passed <= released <= 525 * passed
    assert servo["jitter_exact"]
    assert 0 < servo["jitter_p50"] <= servo["jitter_p99"] <= servo["jitter_max"]
    assert "arm0 has no agent: started one on core" in err
    for limit in _rt.probe().reasons:
        assert err.count(limit) == 1, "what is reduced is said, once for all RTPUs"
    assert processes_of("PBONET_RUN_DIR", str(nodes.folder)) == []
    assert list(shared_memory.iterdir()) == []
    assert Path(outcome["log"]).parent == tmp_path / "kept"
    recording = Log(outcome["log"])
    assert recording.lost() == {}
    assert all(part.complete for part in recording.parts)
    cycles = recording.arrays("puma_pidg")["cycle"]
    assert len(cycles) >= servo["cycles"]
    assert np.all(np.diff(cycles) == 1)  # every one of them
    assert [task for _, task in recording.writers("T_GRAV")] == ["grav_comp"]
