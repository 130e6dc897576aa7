"""Jobs and programs of jobs as the page edits them."""

from __future__ import annotations

import json
import shutil
import subprocess
import sys
import threading
from pathlib import Path

import msgspec
import pytest

from pbonet.config import Library, read_seq
from pbonet.errors import (
    ConfigError,
    ConfigFileError,
    NodeError,
    PbonetError,
    StateError,
)
from pbonet.master.configuration import Place, check_file
from pbonet.master.web.job_edits import JobEdits
from pbonet.master.web.programs import Programs

EXAMPLES = Path(__file__).parents[3] / "examples"


@pytest.fixture
def puma(tmp_path):
    """A copy of the PUMA's example, and its editor with what it told."""
    shutil.copytree(EXAMPLES / "puma", tmp_path / "puma")
    told = []
    edits = JobEdits(tmp_path / "puma" / "puma.job", Library(()), told.append)
    return edits, told, tmp_path / "puma"


def names(state):
    return [one["name"] for one in state["graph"]["tasks"]]


def test_a_job_is_opened_edited_and_saved_and_check_agrees(puma):
    edits, told, folder = puma
    before = (folder / "puma.job").read_bytes()
    state = edits.do("open", {})["state"]
    assert names(state) == ["puma_pidg", "grav_comp", "qrdiff", "jttrace"]
    assert state["jobs"] == ["puma"]
    assert edits.do("changes", {}) == {"changes": []}
    assert edits.do("save", {})["written"] == []
    assert (folder / "puma.job").read_bytes() == before
    state = edits.do("remove_task", {"task": "qrdiff"})["state"]
    assert not state["legal"]
    assert told[-1] == {"kind": "editor", "state": state}
    json.dumps(state)  # all of it can be sent
    (offer,) = [one for one in state["offers"] if "add qrdiff" in one["text"]]
    state = edits.do("apply", {"offer": offer})["state"]
    assert state["legal"]
    (change,) = edits.do("changes", {})["changes"]
    assert change["file"].endswith("puma.job")
    assert edits.do("save", {})["written"] == [str(folder / "puma.job")]
    assert check_file(folder / "puma.job").legal
    state = edits.do("undo", {})["state"]
    assert not state["legal"]
    assert edits.do("redo", {})["state"]["legal"]


def test_a_page_that_comes_later_finds_the_changes_of_the_one_before(puma):
    edits, _, folder = puma
    edits.do("open", {})
    edits.do("set_job", {"desc": "another one"})
    state = edits.do("open", {})["state"]
    assert state["about"]["desc"] == "another one"
    assert state["unsaved"] == [str(folder / "puma.job")]
    assert state["jobs"] == ["puma"]
    state = edits.do("open", {"job": "puma"})["state"]  # as its files are
    assert state["unsaved"] == []


def test_the_palette_is_searched_without_an_agent(puma):
    edits, _, _ = puma
    found = edits.do("palette", {"text": "joint", "class": "teleop", "out": "Q_REF"})
    assert {"jtball"} == {one["name"] for one in found["modules"]}
    assert edits.do("open", {"job": "other"})["state"]["graph"]["tasks"] == []
    assert edits.do("palette", {"text": "", "class": "connector"})["modules"]
    with pytest.raises(PbonetError, match="no such module"):
        edits.do("palette", {"text": "nonsuch"})


def test_a_new_job_is_begun_beside_the_others(puma):
    edits, _, folder = puma
    state = edits.do("open", {"job": "second"})["state"]
    assert names(state) == []
    state = edits.do("add_task", {"module": "jttrace"})["state"]
    assert names(state) == ["jttrace"]
    fits = edits.do("fitting", {"task": "jttrace", "port": "Q_REF"})["fits"]
    assert any(one["fits"] for one in fits)
    assert not (folder / "second.job").exists()
    with pytest.raises(NodeError, match="not a valid name"):
        edits.do("open", {"job": "../../etc/job"})


@pytest.mark.parametrize(
    ("name", "args", "text"),
    [
        ("fly", {}, "there is no edit fly"),
        ("remove_task", {}, "task"),
        ("remove_task", {"task": "x", "do": "y"}, ""),
        ("apply", {"offer": 3}, "this is no offer"),
        ("fitting", {}, "the job has no task"),
        ("set_field", {"task": "qrdiff", "field": "f", "value": []}, ""),
    ],
)
def test_wrong_edits_are_refused_and_change_nothing(puma, name, args, text):
    edits, _, _ = puma
    before = edits.do("open", {})["state"]
    with pytest.raises((NodeError, ConfigError, StateError, KeyError)) as refused:
        edits.do(name, args)
    assert text in str(refused.value)
    assert edits.do("open", {})["state"] == before


def test_a_job_is_simulated_in_place(puma):
    edits, _, folder = puma
    simulate = edits.simulation({"seconds": 0.2, "variables": ["Q_MEZ"]})
    edits.do("remove_task", {"task": "jttrace"})  # it runs what was there before
    run = simulate()["run"]
    assert run["ok"], run
    assert len(run["series"]["Q_MEZ"]["t"]) > 10
    assert not list(folder.glob("runs*"))


FULL = """
import resource, sys
from pbonet.config import Library
from pbonet.errors import ConfigFileError
from pbonet.master.configuration import Place
from pbonet.master.web.job_edits import JobEdits
from pbonet.master.web.programs import Programs
folder, library = sys.argv[1], Library(())
edits = JobEdits(folder + "/puma.job", library, lambda _: None)
edits.do("set_field", {"task": "qrdiff", "field": "freq", "value": 40.0})
programs = Programs(folder + "/puma.job", Place(), library, lambda _: None)
lines = [{"keyword": "STEP", "job": "puma"}]
program = {"name": "one", "seq": {"name": "one", "lines": lines}}
resource.setrlimit(resource.RLIMIT_FSIZE, (20, 20))
for save in (lambda: edits.do("save", {}), lambda: programs.do("save", program)):
    try:
        save()
    except ConfigFileError as error:
        print(error)
print(edits.do("open", {})["state"]["unsaved"])
"""


def test_a_full_disk_is_said_and_leaves_files_and_changes_as_they_are(puma):
    """No file can be longer than 20 bytes here, as on a disk without room."""
    _, _, folder = puma
    before = {path: path.read_bytes() for path in folder.iterdir() if path.is_file()}
    command = [sys.executable, "-c", FULL, str(folder)]
    done = subprocess.run(command, capture_output=True, text=True, check=True)
    edited, program, unsaved = done.stdout.splitlines()
    for text in (edited, program):
        assert "the file cannot be written" in text
        assert "make room on the disk and save again" in text
    assert "qrdiff" in unsaved or "puma.job" in unsaved
    after = {path: path.read_bytes() for path in folder.iterdir() if path.is_file()}
    assert after == before


@pytest.mark.parametrize("seconds", [1e9, "x"])
def test_a_senseless_time_is_not_simulated(puma, seconds):
    edits, _, _ = puma
    with pytest.raises(ConfigError, match="is not simulated on a page"):
        edits.simulation({"seconds": seconds})


def test_a_simulation_is_cancelled(puma):
    edits, _, _ = puma
    run = edits.simulation({"seconds": 20})
    results = []
    thread = threading.Thread(target=lambda: results.append(run()["run"]))
    thread.start()
    edits.cancel()
    thread.join(60)
    assert results[0]["problems"] == ["it was cancelled"]


@pytest.fixture
def cell(tmp_path):
    """A copy of the pick-and-place example, and its programs."""
    shutil.copytree(EXAMPLES / "pick_and_place", tmp_path / "cell")
    folder = tmp_path / "cell"
    path = folder / "cell.sbs"
    return Programs(path, Place(), Library(()), lambda _: None), folder


def test_the_program_with_which_the_page_was_opened_is_listed_as_that(cell):
    programs, folder = cell
    assert programs.do("list", {})["opened"] == ""
    path = folder / "carry.seq"
    programs = Programs(path, Place(), Library(()), lambda _: None)
    assert programs.do("list", {})["opened"] == "carry"


def test_programs_and_the_icons_of_jobs_are_listed(cell):
    programs, _ = cell
    listed = programs.do("list", {})
    assert listed["programs"] == ["carry"]
    jobs = {one["name"]: one for one in listed["jobs"]}
    assert {"approach", "grasp", "lift"} <= jobs.keys()
    assert jobs["lift"]["pre"]
    assert not any(one["fault"] for one in jobs.values())


def test_a_program_is_opened_and_saved_without_a_change(cell):
    programs, folder = cell
    before = (folder / "carry.seq").read_bytes()
    opened = programs.do("open", {"name": "carry"})
    assert opened["errors"] == []
    given = {"name": "carry", "seq": opened["seq"], "base": opened["base"]}
    assert programs.do("save", given) == {
        "written": [],
        "comments": True,
        "lost": [],
        "base": opened["base"],
    }
    assert (folder / "carry.seq").read_bytes() == before


def test_a_changed_program_keeps_the_comments_of_other_lines(cell):
    programs, folder = cell
    opened = programs.do("open", {"name": "carry"})
    seq = opened["seq"]
    step = next(one for one in seq["lines"] if one.get("job") == "move")
    step["within"] = 12.0
    lift = next(one for one in seq["lines"] if one.get("job") == "lift")
    seq["lines"] = [one for one in seq["lines"] if one != lift]
    checked = programs.do("check", {"name": "carry", "seq": seq})
    assert checked["errors"] == []
    assert checked["lost"] == ["refused unless a part is held"]
    seq["lines"].insert(4, lift)
    given = {"name": "carry", "seq": seq, "base": opened["base"]}
    saved = programs.do("save", given)
    assert (saved["comments"], saved["lost"]) == (True, [])
    text = (folder / "carry.seq").read_text()
    assert "WITHIN 12" in text
    assert "# refused unless a part is held" in text
    assert check_file(folder / "carry.seq").legal


def test_three_icons_make_a_program_that_runs(cell):
    programs, folder = cell
    end = [{"signal": "FINISH"}]
    lines = [
        {"keyword": "STEP", "job": job, "until": end}
        for job in ("approach", "descend", "retreat")
    ]
    fingers = {"keyword": "ORDER", "command": "spawn", "words": ["short_fingers"]}
    seq = {"name": "short", "wait": 5.0, "lines": [fingers, *lines]}
    checked = programs.do("check", {"name": "short", "seq": seq})
    assert checked["about"] == "sequence short of 3 steps"
    assert programs.do("save", {"name": "short", "seq": seq})["written"]
    assert [one.job for one in read_seq(folder / "short.seq").steps] == [
        "approach", "descend", "retreat"
    ]  # fmt: skip
    exported = programs.do("export", {"name": "short"})
    (folder / exported["file"]).write_text(exported["text"])
    done = subprocess.run(
        [sys.executable, str(folder / "short.py"), "--sim"],
        capture_output=True,
        text=True,
        check=False,
        cwd=folder,
    )
    assert done.returncode == 0, done.stderr


def test_a_neighbour_that_does_not_fit_is_told_before_the_start(cell):
    programs, _ = cell
    seq = programs.do("open", {"name": "carry"})["seq"]
    seq["lines"] = [{"keyword": "STEP", "job": "nosuch"}]
    (error, *_) = programs.do("check", {"name": "carry", "seq": seq})["errors"]
    assert "nosuch" in error


def test_what_is_no_program_is_refused_and_one_changed_meanwhile_is_kept(cell):
    programs, folder = cell
    with pytest.raises(NodeError, match="this is no program"):
        programs.do("save", {"name": "carry", "seq": {"lines": 3}})
    with pytest.raises(NodeError, match="not a valid name"):
        programs.do("save", {"name": "../x", "seq": {}})
    with pytest.raises(NodeError, match="nothing to do with a program called fly"):
        programs.do("fly", {})
    with pytest.raises(StateError, match="no program runs"):
        programs.do("pause", {})
    opened = programs.do("open", {"name": "carry"})
    other = (folder / "carry.seq").read_text().replace("WAIT     5", "WAIT     6")
    (folder / "carry.seq").write_text(other)
    opened["seq"]["wait"] = 7.0
    given = {"name": "carry", "seq": opened["seq"], "base": opened["base"]}
    with pytest.raises(ConfigFileError, match="changed the file since it was opened"):
        programs.do("save", given)
    assert (folder / "carry.seq").read_text() == other
    json.dumps(msgspec.to_builtins(opened))


def test_a_program_that_is_saved_leaves_the_others_as_they_are(cell):
    """Programs are files of their own, unlike the files of one edited job."""
    programs, folder = cell
    lines = [{"keyword": "STEP", "job": "retreat"}]
    for name in ("one", "two"):
        given = {"name": name, "seq": {"name": name, "lines": lines}}
        assert programs.do("save", given)["written"] == [str(folder / f"{name}.seq")]
        with pytest.raises(ConfigFileError, match="changed the file"):
            programs.do("save", given)  # it was not opened since
    assert {"one", "two"} < set(programs.do("list", {})["programs"])


@pytest.mark.parametrize(
    ("line", "text"),
    [
        ({"keyword": "STEP", "job": ""}, "STEP is malformed"),
        ({"keyword": "END"}, "END without REPEAT"),
        ({"keyword": "GOTO", "step": "nosuch"}, "GOTO names 'nosuch'"),
    ],
)
def test_what_no_file_can_say_is_told_with_the_line_it_would_have(cell, line, text):
    programs, _ = cell
    step = {"keyword": "STEP", "job": "retreat"}
    seq = {"name": "new", "wait": 5.0, "lines": [step, line]}
    checked = programs.do("check", {"name": "new", "seq": seq})
    (error,) = checked["errors"]
    assert f"new.seq:{checked['first'] + 1}:" in error
    assert text in error
    with pytest.raises(ConfigError, match=text):
        programs.do("save", {"name": "new", "seq": seq})


def test_signals_and_parameters_of_tasks_are_listed(cell):
    listed = cell[0].do("list", {})
    jaws = listed["tasks"]["jaws"]
    assert jaws["signals"] == ["CLOSED", "OPENED"]
    assert "speed" in jaws["params"]
    assert {"short_fingers", "go_home"} <= listed["tasks"].keys()
    assert "FINISH" in listed["signals"]
    assert listed["rtpus"] == ["arm0", "arm1"]
