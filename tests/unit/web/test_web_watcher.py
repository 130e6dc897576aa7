"""The reading of a subsystem for all browsers, when it does not answer."""

from __future__ import annotations

from pathlib import Path
from types import SimpleNamespace

import pytest

from pbonet.errors import UnreachableError
from pbonet.master.configuration import Place
from pbonet.master.web.watcher import Watcher

PUMA = Path(__file__).parents[3] / "examples" / "puma" / "puma.job"


def test_a_graph_that_lacks_a_task_is_drawn_again_until_it_has_all():
    watcher = Watcher(PUMA, Place())
    (planned, *_) = watcher.first()
    whole = planned["graph"]
    lacking = whole | {"tasks": whole["tasks"][:-1]}
    graphs = [lacking, lacking, whole]
    subsystem = SimpleNamespace(
        task_set=SimpleNamespace(refresh=lambda *, strict: strict),
        graph=lambda: graphs.pop(0),
    )
    tasks = [
        SimpleNamespace(
            task=one["name"],
            rtpu=one["rtpu"],
            tid=1,
            state="ON",
            ref_f=1.0,
            fallback_of="",
        )
        for one in whole["tasks"]
    ]
    statuses = {"arm0": SimpleNamespace(tasks=tasks)}
    told = []
    watcher._told = told.append
    for _ in range(5):
        watcher._redraw(subsystem, statuses)
    assert [one["graph"] for one in told] == [lacking, whole]
    assert graphs == []


def test_rtpus_that_are_all_silent_are_told_at_once():
    """Nothing more is asked of them, which would take seconds and fail."""
    error = UnreachableError("the agent cannot be reached", where="arm0")
    away = SimpleNamespace(
        clients=SimpleNamespace(
            names=["arm0", "arm1"], each=lambda *_: ({}, [error, error])
        ),
        task_set=SimpleNamespace(refresh=lambda **_: pytest.fail("asked again")),
    )
    follower = SimpleNamespace(take=list, complaints=dict)
    watcher, told = Watcher(PUMA, Place()), []
    watcher._told = told.append
    assert watcher._read_states(away, follower) == [str(error)]
    (status,) = told
    assert {one["rtpu"] for one in status["rtpus"] if one["silent"]} == {"arm0", "arm1"}


def test_a_graph_is_drawn_again_when_a_task_has_changed_its_state():
    watcher = Watcher(PUMA, Place())
    (planned, *_) = watcher.first()
    faulty = planned["graph"] | {"faults": ["no task that is ON writes Q_MEZ"]}
    graphs = [faulty, planned["graph"]]
    subsystem = SimpleNamespace(
        task_set=SimpleNamespace(refresh=lambda *, strict: strict),
        graph=lambda: graphs.pop(0),
    )
    tasks = [
        SimpleNamespace(
            task=one["name"],
            rtpu=one["rtpu"],
            tid=1,
            state="OFF",
            ref_f=1.0,
            fallback_of="",
        )
        for one in planned["graph"]["tasks"]
    ]
    told = []
    watcher._told = told.append
    watcher._redraw(subsystem, {"arm0": SimpleNamespace(tasks=tasks)})
    tasks[0].state = "ON"
    watcher._redraw(subsystem, {"arm0": SimpleNamespace(tasks=tasks)})
    assert [one["graph"]["faults"] for one in told] == [faulty["faults"], []]
