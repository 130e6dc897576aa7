"""The reading of a subsystem for all browsers, when it does not answer."""

from __future__ import annotations

import os
from pathlib import Path
from types import SimpleNamespace

import pytest
from msgspec import structs

from pbonet.errors import UnknownVariableError, UnreachableError
from pbonet.master.configuration import GraphFault, Place
from pbonet.master.web.watcher import Watcher
from pbonet.xm.net import messages as m

PUMA = Path(__file__).parents[3] / "examples" / "puma" / "puma.job"


def status(name, rtpu="arm0", state="ON"):
    about = {"tid": 1, "ref_f": 1.0, "fallback_of": ""}
    return SimpleNamespace(task=name, rtpu=rtpu, state=state, **about)


def statuses(*tasks):
    found = {}
    for name in ("arm0", "arm1"):
        own = [one for one in tasks if one.rtpu == name]
        found[name] = m.RtpuStatus(rtpu=name, scheduler="muf", backend="", tasks=own)
    return found


class FakeSubsystem:
    """A subsystem whose graphs, present job and table are given.

    Args:
        files: Its files.
        graphs: What `graph` returns, one after the other.
    """

    def __init__(self, files, graphs):
        self.files = files
        self.graphs = list(graphs)
        self.task_set = SimpleNamespace(refresh=lambda *, strict: strict)
        self.clients = self
        self.jobs = []
        self.table = None
        """Variables of the table; None: all that are asked for."""

    def graph(self):
        return self.graphs.pop(0)

    def call(self, _, request, __):
        if isinstance(request, m.Job):
            return self.jobs
        unknown = set(request.names or ()) - set(self.table or request.names)
        if unknown:
            raise UnknownVariableError("the table has no such variable")
        return [
            m.VarValue(
                name=name,
                index=0,
                units="",
                values=[1.0],
                seq=1,
                writer="",
                age=0.1,
                stale=False,
            )
            for name in request.names or self.table
        ]


@pytest.fixture
def watcher():
    """What reads the PUMA, its graph and files, and what it told."""
    made = Watcher(PUMA, Place())
    told = []
    made._told = told.append
    subsystem = made._made()
    return made, subsystem.graph(), subsystem.files, told


def test_a_graph_that_lacks_a_task_is_drawn_again_until_it_has_all(watcher):
    watcher, whole, files, told = watcher
    extra = structs.replace(whole.tasks[0], name="extra")
    more = structs.replace(whole, tasks=[*whole.tasks, extra])
    subsystem = FakeSubsystem(files, [whole, whole, more])
    tasks = [status(one.name, one.rtpu) for one in more.tasks]
    for _ in range(5):
        watcher._redraw(subsystem, statuses(*tasks))
    drawn = [[one["name"] for one in message["graph"]["tasks"]] for message in told]
    assert drawn[-1] == [one.name for one in more.tasks]
    assert subsystem.graphs == []


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


def test_a_graph_is_drawn_again_when_a_task_has_changed_its_state(watcher):
    watcher, whole, files, told = watcher
    fault = GraphFault(text="no task that is ON writes Q_MEZ", severity="refuse")
    faulty = structs.replace(whole, faults=[fault])
    subsystem = FakeSubsystem(files, [faulty, whole])
    tasks = [status(one.name, one.rtpu, "OFF") for one in whole.tasks]
    watcher._redraw(subsystem, statuses(*tasks))
    tasks[0].state = "ON"
    watcher._redraw(subsystem, statuses(*tasks))
    faults = [[f["text"] for f in one["graph"]["faults"]] for one in told]
    assert faults == [[fault.text], []]


def test_a_task_of_the_job_that_was_killed_stays_and_says_why(watcher):
    watcher, whole, files, told = watcher
    rest = structs.replace(whole, tasks=whole.tasks[1:])
    killed = whole.tasks[0].name
    tasks = statuses(*(status(one.name, one.rtpu) for one in rest.tasks))
    watcher._redraw(FakeSubsystem(files, [rest]), tasks)
    graph = told[-1]["graph"]
    assert [one["name"] for one in graph["tasks"]] == [one.name for one in whole.tasks]
    assert graph["missing"] == {killed: "it was not spawned, or was killed"}
    wires = [one for one in graph["wires"] if killed in {one["from"], one["to"]}]
    assert wires


def test_the_job_that_was_entered_is_the_present_one(watcher, tmp_path):
    watcher, whole, files, told = watcher
    for one in ("puma.sbs", "puma.svar"):
        (tmp_path / one).write_bytes((PUMA.parent / one).read_bytes())
    other = tmp_path / "hold.job"
    other.write_text("JOB hold\nDESC\nSBS puma.sbs\nTASK grav_comp arm1\nEOF\n")
    task = next(one for one in whole.tasks if one.name == "grav_comp")
    alone = structs.replace(whole, tasks=[task])
    subsystem = FakeSubsystem(files, [alone, alone])
    tasks = statuses(status("grav_comp", "arm1"))
    subsystem.jobs = [m.Standing(name="hold", file=str(other), post=[])]
    watcher._redraw(subsystem, tasks)
    graph = told[-1]["graph"]
    assert graph["job"] == "hold"
    assert [one["name"] for one in graph["tasks"]] == ["grav_comp"]
    assert graph["missing"] == {}


def test_variables_that_the_running_table_lacks_hide_no_others(watcher):
    watcher, _, files, told = watcher
    subsystem = FakeSubsystem(files, [])
    subsystem.table = ["Q_MEZ"]
    watcher.want(["Q_MEZ", "Q_REF"])
    watcher._read_values(subsystem, every=False)
    watcher._read_values(subsystem, every=False)
    assert [[*one["values"]] for one in told] == [["Q_MEZ"]]
    (said,) = watcher._about_files()
    assert "had Q_REF: stop everything and start the job again" in said
    subsystem.table = None  # it was done
    watcher._recheck = True
    watcher._read_values(subsystem, every=False)
    assert watcher._about_files() == []
    assert [*told[-1]["values"]] == ["Q_REF"]


def test_an_edited_table_is_read_and_a_wrong_one_said(tmp_path):
    for one in ("puma.sbs", "puma.svar", "puma.job"):
        (tmp_path / one).write_bytes((PUMA.parent / one).read_bytes())
    watcher = Watcher(tmp_path / "puma.job", Place())
    files = watcher._made().files
    svar = tmp_path / "puma.svar"
    before = svar.read_text()
    assert not watcher._files_changed(files)
    svar.write_text("nonsense\n")
    assert not watcher._files_changed(files)
    (said,) = watcher._about_files()
    assert "puma.svar" in said
    svar.write_text(
        before.replace("EOF", "\nNAME NEW\nTYPE double\nDESC x\nUNITS m\nNELEM 1\nEOF")
    )
    os.utime(svar, ns=(1, 1))
    assert watcher._files_changed(files)
    watcher._take_files(watcher._made().files)
    assert "NEW" in watcher.variables
    assert watcher._about_files() == []
