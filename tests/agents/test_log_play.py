"""Recorded outputs are played into the table of a subsystem that runs."""

from __future__ import annotations

import json
import os
import signal
import subprocess
import sys
import time

import log_of_real_tasks
import numpy as np
import pytest
from adding_module import ADDS
from log_of_real_tasks import spawn
from nodekit import svar
from watching import wait_for

from pbonet.config import parse_svar
from pbonet.errors import SvarOwnerError
from pbonet.log import LogWriter, RunAbout, Step, TaskAbout
from pbonet.log.cycle_columns import HEAD_DTYPE
from pbonet.log.groups import pack
from pbonet.log.schema import RECORD
from pbonet.svar import Table
from pbonet.testing import verify

VARIABLES = {v.name: v for v in parse_svar(svar(), "t.svar").variables}
COUNT = 50
PERIOD = 2_000_000


def record(values, **head) -> bytes:
    row = np.zeros(1, HEAD_DTYPE)
    for name, value in head.items():
        row[name] = value
    data = pack([VARIABLES["Y0"]], lambda _: np.array(values, float))
    body = row.tobytes() + data
    return RECORD.pack(RECORD.size + len(body), 0, len(data), 0, 0, 0) + body


@pytest.fixture
def log(tmp_path):
    """A log in which task `a` wrote (n, 2n) into Y0 in its cycle n, at 500 Hz."""
    about = RunAbout(
        run="r", job="j", subsystem="arm", domain="d", rtpu="arm0", epoch_ns=10**18
    )
    writer = LogWriter(tmp_path / "run.mcap", about)
    named = {"domain": "d", "rtpu": "arm0", "subsystem": "arm", "module": "adds"}
    named |= {"task": "a", "pid": 1, "freq": 500.0, "rmod_name": "a.rmod"}
    outvar = [VARIABLES["Y0"]]
    number = writer.add_task(TaskAbout(**named, rmod="", outvar=outvar))
    parts = [record((0, 0), kind=Step.CLAIM, end_ns=0)]
    parts += [
        record((n, 2 * n), cycle=n, end_ns=n * PERIOD) for n in range(1, COUNT + 1)
    ]
    parts[30] = record((np.nan, 0), cycle=30, end_ns=30 * PERIOD)
    writer.add(number, b"".join(parts))
    writer.close()
    return tmp_path / "run.mcap"


@pytest.fixture
def line(nodes):
    """A master, its table, and a task `b` that adds up what stands in Y0."""
    nodes.write_module("adds", ADDS)
    nodes.agent_process("arm0")
    master = nodes.master("arm0", "arm")
    spawn(master, "b", "Y0", "Y1")
    master.on("b")
    return master


def command(nodes, log, *words):
    done = [sys.executable, "-m", "pbonet.cli", "replay", str(log), "--play", "a"]
    return [*done, "--domain", nodes.domain, *map(str, words)]


def run(nodes, log, *words):
    done = subprocess.run(
        command(nodes, log, *words), capture_output=True, text=True, check=False
    )
    return done.returncode, done.stdout, done.stderr


def test_played_values_arrive_in_a_table_that_others_read(line, nodes, log) -> None:
    code, out, err = run(nodes, log, "--json", "--rate", 2)
    assert (code, err) == (0, "")
    (played,) = json.loads(out)
    assert (played["task"], played["commits"], played["refused"]) == ("a", COUNT, 1)
    value = line.value("Y0")
    assert (value.values, value.writer, value.cycle) == (
        *([COUNT, 2 * COUNT], "replay:a"),
        COUNT,
    )
    before = line.value("Y1").values
    line.wait_cycles("b", 5)
    assert line.value("Y1").values[1] > before[1], "the reader has gone on with them"
    with Table.attach(f"{nodes.domain}.arm") as table:
        assert table.info("Y0").owner is None, "nobody owns it behind the end"


@pytest.mark.parametrize("which", [signal.SIGINT, signal.SIGTERM])
def test_a_part_is_played_over_and_over_until_an_interrupt(
    line, nodes, log, which
) -> None:
    words = ("--loop", "--start", 0.03, "--end", 0.05)
    with subprocess.Popen(
        command(nodes, log, *words), stdout=subprocess.PIPE, text=True
    ) as player:
        seen = []
        with Table.attach(f"{nodes.domain}.arm") as table:

            def again():
                seen.append(table.read("Y0")[0])
                return seen[-1] and max(seen) > seen[-1]

            wait_for(again, "a second round")
            assert table.info("Y0").owner == "replay:a"
            error = line.refused(SvarOwnerError, spawn_and_turn_on, line)
            assert "replay:a" in str(error), "the player owns them like a task"
        player.send_signal(which)
        out, _ = player.communicate(timeout=60)
    assert player.returncode == 0
    assert "a: " in out
    values = {value for value in seen if value}
    assert values <= set(range(15, 26))


def spawn_and_turn_on(line):
    spawn(line, "a", "X", "Y0")
    line.on("a")


def test_what_cannot_be_played_is_refused(line, nodes, log) -> None:
    spawn_and_turn_on(line)
    code, _, err = run(nodes, log)
    assert code == 1
    assert "replay:a cannot write Y0: another task does" in err
    assert "got owner a" in err
    assert "turn a off first" in err
    line.off("a")
    assert run(nodes, log, "--rate", 10)[0] == 0
    code, _, err = run(nodes, log, "--start", 9)
    assert code == 1
    assert "the log has no commit of these tasks in that time" in err
    code, _, err = run(nodes, log, "--subsystem", "leg")
    assert code == 1
    assert "there is no such table" in err


@pytest.mark.parametrize("writer", ["replay:a", "a@far"])
def test_what_comes_from_outside_stands_with_the_cycle(line, nodes, writer) -> None:
    """What a player, or an agent for another machine, commits is in nobody's record."""
    line.off("b")
    line.kill("b")
    path = log_of_real_tasks.record(line)
    spawn(line, "b", "Y0", "Y1")
    line.on("b")
    with (
        Table.attach(f"{nodes.domain}.arm") as table,
        table.local(writer, os.getpid(), outvar=["Y0"]) as local,
    ):
        local.claim()
        for n in range(1, 6):
            local.array("Y0")[:] = n, 1.0 / n
            assert local.commit(time.monotonic_ns(), n) == 0
            line.wait_cycles("b", 2)
        log = log_of_real_tasks.end(line, path, ["b"])
    (life,) = log.lives("b")
    stored = [bool(life.schema.rest(one)[1]) for one in life.commits]
    assert 5 <= sum(stored) < len(stored), "only where there was something new"
    (verdict,) = verify(log)
    assert verdict.good, str(verdict)
