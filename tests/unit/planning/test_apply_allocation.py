"""A running task gets another RTPU by a copy; what a change that fails leaves."""

from __future__ import annotations

from types import SimpleNamespace

import pytest
from edited_jobs import content, puma

from pbonet.errors import PbonetError
from pbonet.master.configuration import Place
from pbonet.master.console import oneshot
from pbonet.master.planning import apply_allocation

__all__ = ["puma"]


def notes_of(monkeypatch, job, states, silent=""):
    """Return the notes of a switch that fails and leaves tasks in these states."""

    def run(_path, command, args, _place):
        if command == "status":
            if states is None:
                raise PbonetError("arm1 does not answer")
            tasks = [{"task": t, "fields": {"state": s}} for t, s in states.items()]
            rtpus = [{"rtpu": one} for one in ("arm0", "arm1") if one != silent]
            return SimpleNamespace(data={"tasks": tasks, "rtpus": rtpus})
        if not args["dry_run"]:
            raise PbonetError("the first cycle of qrdiff_2 failed")
        return SimpleNamespace(data={}, command="switch")

    monkeypatch.setattr(oneshot, "run", run)
    before = content(job.parent)
    editor = apply_allocation.draft_of_copies(job, {"qrdiff": "arm0"})
    with pytest.raises(PbonetError, match="first cycle") as failed:
        apply_allocation.switch(editor, Place(), dry_run=False)
    assert content(job.parent) == before
    first, *notes = failed.value.__notes__
    assert first == "the job's files are as they were before"
    return notes


@pytest.mark.parametrize(
    ("states", "said"),
    [
        ({"qrdiff": "OFF", "qrdiff_2": "ERROR"}, "OFF: 'pbonet on SBS qrdiff' cont"),
        ({"qrdiff": "OFF", "qrdiff_2": "ON"}, "'pbonet swap SBS qrdiff_2 qrdiff' cont"),
        ({"qrdiff": "ON", "qrdiff_2": "OFF"}, "'pbonet kill SBS qrdiff_2'"),
        ({"qrdiff_2": "ERROR"}, "does not exist: 'pbonet explain SBS qrdiff_2'"),
        ({"qrdiff": "ON"}, "no copy was left: the tasks run as before"),
        ({"qrdiff": "OFF"}, "no copy was left, and qrdiff is OFF"),
        ({}, "no copy was left, and qrdiff is not there"),
        (None, "which tasks run is not known: arm1 does not answer"),
    ],
)
def test_a_switch_that_fails_names_the_copy_that_it_leaves(
    puma, monkeypatch, states, said
):
    (note,) = notes_of(monkeypatch, puma, states)
    assert said.replace("SBS", str(puma.with_suffix(".sbs"))) in note
    if states and "qrdiff_2" in states:
        assert note.startswith(f"its copy qrdiff_2 is {states['qrdiff_2']}, and qrdiff")


@pytest.mark.parametrize(
    ("states", "said"),
    [
        ({"qrdiff_2": "ON"}, "its copy qrdiff_2 is ON, and qrdiff is not known: arm1"),
        ({"qrdiff": "OFF"}, "whether its copy qrdiff_2 was left is not known: arm1"),
    ],
)
def test_what_runs_where_nothing_answers_is_not_known(puma, monkeypatch, states, said):
    (note,) = notes_of(monkeypatch, puma, states, silent="arm1")
    assert said in note
    assert "does not exist" not in note


def test_the_line_of_a_task_that_moves_keeps_its_comment(puma):
    begin = ["TASK", "qrdiff"]
    line = next(x for x in puma.read_text().splitlines() if x.split()[:2] == begin)
    puma.write_text(puma.read_text().replace(line, f"{line}  # velocities"))
    editor = apply_allocation.draft_of_copies(puma, {"qrdiff": "arm0"})
    editor.save()
    lines = puma.read_text().splitlines()
    (moved,) = [x for x in lines if x.split()[:2] == ["TASK", "qrdiff_2"]]
    assert moved.endswith("  # velocities")
    assert moved.split()[2] == "arm0"
