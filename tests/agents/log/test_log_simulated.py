"""One job, run for real and simulated: the two logs have the same in them."""

from __future__ import annotations

from itertools import dropwhile
from pathlib import Path

import msgspec
import pytest
from adding_module import ADDS
from log_of_python_tasks import RMOD

from pbonet.log import Did, Log, Step, text
from pbonet.log.cycle_columns import head
from pbonet.log.groups import size
from pbonet.log.schema import StepSchema
from pbonet.master.configuration.environment import Place
from pbonet.master.console.run_job import run
from pbonet.testing import verify

SVAR = (
    "NAME N\nTYPE int\nDESC size\nUNITS none\nNELEM 1\nINIT 2\n\n"
    "NAME X\nTYPE double\nDESC input\nUNITS none\nNELEM 2\nINIT 1 2\n\n"
    "NAME Y\nTYPE double\nDESC sum\nUNITS none\nNELEM 2\n\nEOF\n"
)
TOLD = {"pid", "domain", "libraries", "seed", "timing"}
"""What a simulation cannot say of a task, or says otherwise: nothing is late there, and
random numbers are the same each time."""


@pytest.fixture(scope="module")
def logs(tmp_path_factory):
    """The log of a real run of a job, and that of its simulation."""
    folder = tmp_path_factory.mktemp("job")
    (folder / "adds.py").write_text(ADDS)
    (folder / "x.job").write_text("JOB x\nDESC\nSBS x.sbs\nTASK a\nTASK b\nEOF\n")
    (folder / "a.rmod").write_text(RMOD.format(z="X", y="Y"))
    (folder / "b.rmod").write_text(RMOD.format(z="Y", y="X"))
    (folder / "x.sbs").write_text("SUBSYSTEM x\nSVARFILE x.svar\nRTPU r\nEOF\n")
    (folder / "x.svar").write_text(SVAR)
    found = []
    for sim in (False, True):
        outcome = run(
            folder / "x.job",
            Place(domain=folder.parent.name, libraries=(str(folder),)),
            seconds=1.0,
            sim=sim,
            runs=folder / f"runs-{sim}",
            quiet=True,
            record="all",
        )
        assert outcome.status == 0, outcome.faults
        found.append(Log(Path(outcome.log)))
    return found


def test_their_channels_are_the_same(logs) -> None:
    real, sim = (
        {one.topic: one for part in log.parts for one in part.channels.values()}
        for log in logs
    )
    assert real.keys() - sim.keys() == {"x/commands"}, "nobody sends any"
    assert sim.keys() <= real.keys()
    for topic, channel in sim.items():
        assert channel.schema == real[topic].schema
        assert channel.encoding == real[topic].encoding
    for task in ("a", "b"):
        told, wanted = (
            msgspec.to_builtins(log.task_about(task)) for log in (sim_of(logs), logs[0])
        )
        assert {k for k in told if told[k] != wanted[k]} <= TOLD


def sim_of(logs):
    return logs[1]


def test_their_cycles_have_the_same_parts(logs) -> None:
    for log in logs:
        for task in ("a", "b"):
            (life,) = log.lives(task)
            cycles = [one for one in life.commits if head(one)["kind"] == Step.CYCLE]
            numbers = [int(head(one)["cycle"]) for one in cycles]
            assert numbers == list(range(1, len(numbers) + 1))
            assert len(numbers) > 10
            # The recorder asks for all inputs when it takes up a ring.
            late = list(dropwhile(lambda one: not life.schema.rest(one)[1], cycles))  # noqa: B023
            assert all(head(one)["register"] for one in late)
            parts = {tuple(map(len, life.schema.rest(one)[:2])) for one in late}
            one_commit = 16, size(life.about.invar)
            assert one_commit in parts, "on a slow machine writers are late"
            if log is sim_of(logs):  # where no writer is late
                assert parts == {one_commit}
            commits = [int(head(one)["number"]) for one in life.commits]
            assert commits == list(range(commits[0], commits[0] + len(commits)))


def test_the_same_was_done_between_cycles(logs) -> None:
    def steps(log, task):
        (life,) = log.lives(task)
        for one in life.steps:
            kind = Step(int(head(one)["kind"]))
            data = StepSchema.data(one)
            yield kind, msgspec.json.decode(data, type=Did) if kind == Step.DID else 0

    for task in ("a", "b"):
        real, sim = (list(steps(log, task)) for log in logs)
        assert real == sim


def test_their_events_states_and_counts_say_the_same(logs) -> None:
    real, sim = (
        [(one["task"], one["code"], one["state"]) for one in log.events()]
        for log in logs
    )
    told = {"SPAWNED", "STATE", "STOPPED"}
    for task in ("a", "b", ""):
        assert [one for one in sim if one[0] == task] == [
            one for one in real if one[0] == task and one[1] in told
        ]
    for log in logs:
        data = text.info(log)
        for task in ("a", "b"):
            states = [state for state, _ in data["tasks"][task]["timeline"]]
            first = states[0] == "NOT-CREATED"  # a status of the time of its creation
            assert states[first:] == ["OFF", "ON", "OFF", "NOT-CREATED"]
            assert data["tasks"][task]["gaps"] == 0
        assert log.missed().keys() == {"a", "b"}


def test_their_files_are_the_same_and_they_can_be_verified(logs) -> None:
    real, sim = logs
    assert real.attached.keys() - sim.attached.keys() == {"agent.toml"}
    assert sim.attached.keys() <= real.attached.keys()
    assert real.about["format"] == sim.about["format"]
    assert (real.about["seconds"], sim.about["seconds"]) == (0.0, 1.0)
    for log in logs:
        for verdict in verify(log):
            assert verdict.good, str(verdict)
