"""A job is edited step by step: tasks, wires, settings, undo, and saving."""

import errno
import json
import os
import shutil
from pathlib import Path

import msgspec
import pytest
from edited_jobs import PUMA, TASKS, content, puma, puma_files

from pbonet.config import Library
from pbonet.errors import ConfigError, ConfigFileError, PbonetError, UnknownTaskError
from pbonet.master.configuration import Files, Saved, check_file, job_graph
from pbonet.master.configuration.saved_profiles import setup_of
from pbonet.master.editing import JobEditor, Offer, Step
from pbonet.master.editing.simulated_run import _copy

__all__ = ["puma"]


def assembled(folder, name="own"):
    """Return an editor with the four tasks of the PUMA job, added one by one."""
    editor = JobEditor(folder / "puma.sbs", name=name)
    for task, rtpu in TASKS:
        editor.add_task(task, rtpu=rtpu)
    return editor


def wires(graph):
    return {
        (wire["variable"], wire["from"], wire["to"], wire["constant"])
        for wire in graph["wires"]
    }


def test_the_puma_job_is_assembled_by_names_only(puma):
    original = JobEditor(puma).state()
    editor = JobEditor(puma.parent / "puma.sbs", name="own")
    assert not editor.state()["legal"]
    for task, rtpu in TASKS[:-1]:
        assert not editor.add_task(task, rtpu=rtpu)["legal"]
    state = editor.add_task(*TASKS[-1][:1], rtpu=TASKS[-1][1])
    assert state["legal"], state["errors"]
    assert wires(state["graph"]) == wires(original["graph"])
    assert len(wires(state["graph"])) > 8
    assert state["graph"]["variables"] == original["graph"]["variables"]
    assert state["timing"] == original["timing"]


def test_what_was_assembled_is_saved_and_checked(puma):
    editor = assembled(puma.parent)
    (change,) = editor.changes()
    assert change.kind == "new"
    assert "+TASK      grav_comp arm1" in change.diff
    before = content(puma.parent)
    assert editor.save() == [puma.parent / "own.job"]
    assert editor.changes() == []
    after = content(puma.parent)
    own = after.pop("own.job")
    assert after == before
    assert own.startswith(b"JOB       own\n")
    found = check_file(puma.parent / "own.job")
    assert found.legal
    again = JobEditor(puma.parent / "own.job").state()
    assert wires(again["graph"]) == wires(editor.state()["graph"])


def test_saving_without_a_change_touches_no_file(puma):
    stamps = {path: path.stat().st_mtime_ns for path in puma.parent.iterdir()}
    editor = JobEditor(puma)
    assert editor.changes() == []
    assert editor.save() == []
    assert {p: p.stat().st_mtime_ns for p in puma.parent.iterdir()} == stamps


def test_the_state_is_json_and_has_the_graph_of_the_files(puma):
    state = JobEditor(puma).state()
    assert json.loads(json.dumps(state)) == state
    graph = job_graph(Files(puma, Library()))
    assert [task["name"] for task in state["graph"]["tasks"]] == [
        task.name for task in graph.tasks
    ]
    assert state["legal"]
    assert state["settings"]["puma_pidg"]["freq"] == 500.0
    assert state["settings"]["puma_pidg"]["critical"] is True


def test_the_state_has_what_the_forms_show(puma):
    state = JobEditor(puma).state()
    assert state["about"] == {
        "name": "teleop",
        "desc": "joint teleoperation of a PUMA 560",
        "pre": [],
        "post": ["max(abs(Q^_MEZ)) < 0.1 [rad/s]"],
    }
    entry = state["table"]["Q_REF"]
    assert (entry["units"], entry["nelem"], entry["maxage"]) == ("rad", 6, 1.0)
    assert len(entry["init"]) == 6
    assert state["settings"]["puma_pidg"]["local"]["KP"].split()[0] == "2400"


def test_a_task_with_a_wrong_parameter_is_at_fault_and_keeps_its_place(puma):
    before = JobEditor(puma).state()
    editor = JobEditor(puma)
    state = editor.set_parameter("puma_pidg", "follow", "fast")
    (fault,) = state["graph"]["faults"]
    assert "follow is not a float" in fault["text"]
    assert fault["tasks"] == ["puma_pidg"]
    names = [one["name"] for one in state["graph"]["tasks"]]
    assert names == [one["name"] for one in before["graph"]["tasks"]]
    assert state["settings"]["puma_pidg"]["local"]["follow"] == "fast"


def test_a_parameter_of_a_library_rmod_makes_a_copy_beside_the_job(puma):
    editor = JobEditor(puma)
    state = editor.set_parameter("puma_pidg", "wind", "1 2 3 4 5 6")
    (change,) = editor.changes()
    assert change.kind == "new"
    assert change.file == str(puma.parent / "puma_pidg.rmod")
    assert "+WIND        1 2 3 4 5 6" in change.diff
    assert "+# Gains for a stiffness" in change.diff  # comments of the library's
    (task,) = (t for t in state["graph"]["tasks"] if t["name"] == "puma_pidg")
    assert {p["name"]: p["value"] for p in task["params"]}["wind"] == [1, 2, 3, 4, 5, 6]
    assert not (puma.parent / "puma_pidg.rmod").exists()
    # what the library says again needs no copy
    editor.set_parameter("puma_pidg", "WIND", "40 40 20 4 4 4")
    assert editor.changes() == []


def test_a_copy_has_a_name_of_its_own_where_another_job_would_find_it(puma):
    editor = assembled(puma.parent)
    state = editor.set_parameter("qrdiff", "TAU", "0.1")
    names = [task["name"] for task in state["graph"]["tasks"]]
    assert names == ["puma_pidg", "grav_comp", "qrdiff_2", "jttrace"]
    editor.save()
    assert not (puma.parent / "qrdiff.rmod").exists()
    assert JobEditor(puma).state()["graph"]["tasks"][2]["name"] == "qrdiff"


def test_settings_of_the_job_and_of_the_rmod(puma):
    editor = JobEditor(puma)
    editor.set_field("qrdiff", "rtpu", "arm0")
    editor.set_field("qrdiff", "freq", 50)
    editor.set_field("qrdiff", "restart", "on")
    assert [c.file for c in editor.changes()] == [str(puma)]
    assert "+TASK  qrdiff     arm0 FREQ 50.0 RESTART on" in editor.changes()[
        0
    ].diff.replace("qrdiff arm0", "qrdiff     arm0")
    state = editor.set_field("qrdiff", "maxc", "0.001")
    bar = state["timing"][0]
    assert bar["utilization"] == pytest.approx(0.05)
    assert state["settings"]["qrdiff"]["maxc"] == 0.001
    state = editor.set_field("qrdiff", "maxc", 0.03)
    assert not state["legal"]
    assert any("qrdiff" in text for text in state["errors"])
    state = editor.set_field("qrdiff", "maxc", None)
    assert state["settings"]["qrdiff"]["maxc"] is None
    state = editor.set_field("qrdiff", "safe_at", "deadline maxexec")
    assert state["settings"]["qrdiff"]["safe_at"] == "deadline maxexec"
    assert any("SAFE maxexec does nothing without MAXC" in e for e in state["errors"])
    text = "".join(change.diff for change in editor.changes())
    assert "+SAFE      deadline maxexec" in text
    state = editor.set_field("qrdiff", "safe_at", "")
    assert state["settings"]["qrdiff"]["safe_at"] == ""


@pytest.mark.parametrize(
    ("field", "value", "says"),
    [
        ("maxc", "long", "MAXC cannot be 'long'"),
        ("crit", -5, "CRIT cannot be '-5'"),
        ("restart", "maybe", "RESTART cannot be 'maybe'"),
        ("safe_at", "deadline late", "'late' is not a timing failure"),
        ("tasktype", "often", "TASKTYPE cannot be 'often'"),
        ("maxcc", 1, "did you mean maxc?"),
    ],
)
def test_a_setting_that_cannot_be_is_refused_and_nothing_changes(
    puma, field, value, says
):
    editor = JobEditor(puma)
    before = editor.state()
    with pytest.raises(PbonetError) as refused:
        editor.set_field("qrdiff", field, value)
    assert says in str(refused.value)
    assert editor.state() == before


def test_what_cannot_be_done_is_refused_in_words(puma):
    editor = JobEditor(puma)
    with pytest.raises(UnknownTaskError, match="did you mean qrdiff"):
        editor.remove_task("qrdif")
    with pytest.raises(
        ConfigError, match=r"has no port Q_REV .*; did you mean Q_REF\?"
    ):
        editor.connect("jttrace", "Q_REV", "Q_MEZ")
    with pytest.raises(ConfigError, match="the name jttrace is taken"):
        editor.rename_task("qrdiff", "jttrace")
    with pytest.raises(ConfigError, match="did you mean connect"):
        editor.edit("conect", task="qrdiff")
    with pytest.raises(ConfigError, match=r"`int`, got `str` - at `\$.nelem`"):
        editor.edit("add_variable", name="X", nelem="six")
    with pytest.raises(ConfigError, match="unknown field `where`"):
        editor.edit("remove_task", task="qrdiff", where=1)
    with pytest.raises(ConfigError, match="is in use"):
        editor.remove_variable("Q_REF")
    assert editor.state()["undo"] == ""


def test_a_second_instance_has_a_name_of_its_own(puma):
    editor = JobEditor(puma)
    state = editor.add_task("jttrace")
    assert [task["name"] for task in state["graph"]["tasks"]][-1] == "jttrace_2"
    assert [Path(c.file).name for c in editor.changes()] == [
        "puma.job",
        "jttrace_2.rmod",
    ]
    editor.remove_task("jttrace_2")
    assert editor.changes() == []  # the copy goes with the task


def test_rename_and_remove_reach_every_line_of_the_job(puma):
    editor = JobEditor(puma)
    state = editor.rename_task("qrdiff", "speeds")
    assert state["legal"], state["errors"]
    assert state["off_order"] == ["jttrace", "speeds", "puma_pidg", "grav_comp"]
    state = editor.remove_task("speeds")
    assert state["off_order"] == ["jttrace", "puma_pidg", "grav_comp"]
    assert not state["legal"]
    editor.set_off_order([])
    assert editor.state()["off_order"] == []


def test_a_line_of_a_renamed_task_keeps_its_place_and_its_comment(puma):
    before = puma.read_text()
    line = next(x for x in before.splitlines() if x.split()[:2] == ["TASK", "qrdiff"])
    noted = f"# of both\n{line}  # velocities"
    puma.write_text(before.replace(line, noted))
    editor = JobEditor(puma)
    editor.rename_task("qrdiff", "speeds")
    editor.set_field("speeds", "freq", 250)
    editor.rename_task("speeds", "rates")
    editor.add_task("qrdiff")  # the name is free again, and its line is a new one
    editor.save()
    lines = puma.read_text().splitlines()
    at = lines.index("# of both")
    assert lines[at - 1] == before.splitlines()[at - 1]
    assert lines[at + 1].split()[:2] == ["TASK", "rates"]
    assert "FREQ 250" in lines[at + 1]
    assert lines[at + 1].endswith("  # velocities")
    assert ["TASK", "qrdiff"] in [one.split()[:2] for one in lines]
    editor.rename_task("qrdiff", "other")
    editor.save()
    kept, added = (
        next(x for x in puma.read_text().splitlines() if x.split()[:2] == begin)
        for begin in (["TASK", "rates"], ["TASK", "other"])
    )
    assert kept == lines[at + 1]
    assert "#" not in added
    editor.undo()
    editor.undo()
    editor.undo()
    editor.save()
    assert "speeds" in puma.read_text()
    assert "# velocities" in puma.read_text()


def test_a_fallback_stands_by_and_is_taken_away(puma):
    editor = JobEditor(puma)
    state = editor.set_fallback("jttrace", "jtball", takeover=1.0)
    assert state["settings"]["jttrace"]["fallback"] == "jtball"
    assert {t["name"]: t["fallback_of"] for t in state["graph"]["tasks"]}["jtball"] == (
        "jttrace"
    )
    assert "FALLBACK jtball TAKEOVER 1.0" in editor.changes()[0].diff
    editor.set_field("jtball", "rtpu", "arm0")  # of a standby: in its RMOD
    assert {Path(c.file).name for c in editor.changes()} == {
        "puma.job",
        "jtball.rmod",
    }
    editor.remove_task("jtball")
    assert editor.changes() == []
    with pytest.raises(ConfigError, match="no RMOD jtbal"):
        editor.set_fallback("jttrace", "jtbal")


def test_undo_and_redo_go_through_every_state(puma):
    editor = JobEditor(puma)
    states = [editor.state()]
    states.append(editor.add_task("jttrace"))
    states.append(editor.connect("jttrace_2", "Q_REF", "Q_MEZ"))
    states.append(editor.remove_task("jttrace"))
    assert states[-1]["undo"] == "remove task jttrace"

    def same(one, two):
        keys = {"undo", "redo"}
        return {k: v for k, v in one.items() if k not in keys} == {
            k: v for k, v in two.items() if k not in keys
        }

    for before in reversed(states[:-1]):
        assert same(editor.undo(), before)
    assert editor.state()["undo"] == ""
    assert same(editor.undo(), states[0])  # there is nothing more
    for after in states[1:]:
        assert same(editor.redo(), after)
    assert editor.state()["redo"] == ""
    editor.undo()
    editor.set_job(desc="another way")
    assert editor.state()["redo"] == ""


def test_what_is_undone_after_saving_is_saved_again(puma):
    first = content(puma.parent)
    editor = JobEditor(puma)
    editor.set_parameter("puma_pidg", "WIND", "1 1 1 1 1 1")
    editor.add_variable("SPEED", units="m/s", desc="of the belt", init=[0.5])
    editor.save()
    assert content(puma.parent) != first
    editor.undo()
    editor.undo()
    kinds = {Path(c.file).name: c.kind for c in editor.changes()}
    assert kinds == {"puma.svar": "changed", "puma_pidg.rmod": "removed"}
    editor.save()
    assert content(puma.parent) == first
    editor.redo()
    editor.save()
    assert "puma_pidg.rmod" in content(puma.parent)


def test_a_file_that_another_program_changed_is_not_written_over(puma):
    editor = JobEditor(puma)
    editor.set_job(desc="mine")
    editor.set_parameter("jttrace", "REPEAT", "no")
    theirs = puma.read_text().replace("joint teleoperation", "theirs")
    puma.write_text(theirs)
    with pytest.raises(ConfigFileError, match="changed the file since it was opened"):
        editor.save()
    assert puma.read_text() == theirs
    assert not (puma.parent / "jttrace.rmod").exists()  # all or nothing
    assert "+DESC  mine" in editor.changes()[0].diff  # and nothing is lost


def test_a_new_file_that_is_there_meanwhile_is_not_written_over(puma):
    editor = JobEditor(puma)
    editor.set_parameter("jttrace", "REPEAT", "no")
    (puma.parent / "jttrace.rmod").write_text("theirs")
    with pytest.raises(ConfigFileError, match="made the file since it was opened"):
        editor.save()
    assert (puma.parent / "jttrace.rmod").read_text() == "theirs"


def test_links_and_permissions_stay(puma):
    real = puma.parent / "shared"
    real.mkdir()
    target = puma.rename(real / "puma.job")
    target.chmod(0o640)
    puma.symlink_to(target)
    editor = JobEditor(puma)
    editor.set_job(desc="through a link")
    editor.save()
    assert puma.is_symlink()
    assert target.stat().st_mode & 0o777 == 0o640
    assert b"through a link" in target.read_bytes()
    assert not [path for path in puma.parent.iterdir() if path.name.startswith(".")]


def test_a_job_without_tasks_and_names_that_are_taken(puma):
    editor = JobEditor(puma.parent / "puma.sbs", name="own")
    with pytest.raises(ConfigError, match="a job without tasks cannot be saved"):
        editor.save()
    with pytest.raises(ConfigError, match="the job is there already"):
        JobEditor(puma.parent / "puma.sbs")
    with pytest.raises(ConfigError, match="no task to simulate"):
        editor.simulate(1.0)
    editor.add_task("jttrace")
    state = editor.remove_task("jttrace")
    assert state["unsaved"] == []


def test_rmods_of_other_folders_and_other_jobs_are_named(tmp_path):
    puma = puma_files(tmp_path / "puma")
    other = puma.with_name("other.job")
    other.write_bytes(puma.read_bytes())
    library = Library()
    own = puma.with_name("jttrace.rmod")
    own.write_bytes(library.find_rmod("jttrace").read_bytes())
    editor = JobEditor(puma)
    editor.set_parameter("jttrace", "REPEAT", "no")
    (change,) = editor.changes()
    assert change.file == str(own)
    assert change.notes == ["it changes jttrace for other.job too"]


def test_a_task_whose_rmod_is_wrong_is_a_fault_and_others_are_shown(puma):
    puma.with_name("jttrace.rmod").write_text("MODULE jtball\nEOF\n")
    editor = JobEditor(puma)
    state = editor.state()
    assert not state["legal"]
    assert "error" in state["settings"]["jttrace"]
    assert len(state["graph"]["tasks"]) == 3
    assert state["offers"] == []
    state = editor.remove_task("jttrace")
    assert any("Q_REF" in fault["text"] for fault in state["graph"]["faults"])


def test_a_module_without_rmod_is_added_with_its_parameters(puma):
    (puma.parent / "halve.py").write_text(
        "from typing import Annotated as A\n"
        "from pbonet import InVar, OutVar, Params, PortBasedObject, Vector, param\n"
        "class By(Params):\n"
        '    by: A[float, param("none", "divisor", gt=0)]\n'
        "class Halve(PortBasedObject[By], freq=10):\n"
        '    """Divides."""\n'
        '    q: A[Vector, InVar("Q_MEZ", "n", "rad", "position")]\n'
        '    out: A[Vector, OutVar("HALF", "n", "rad", "a part of it")]\n'
        "    def cycle(self, dt: float) -> None:\n"
        "        self.out[:] = self.q / self.params.by\n"
    )
    editor = JobEditor(puma)
    with pytest.raises(ConfigError, match="none for BY"):
        editor.add_task("halve")
    state = editor.add_task("halve", params={"BY": "2"})
    assert [offer["kind"] for offer in state["offers"]] == ["add-variable"]
    state = editor.apply(editor.offers()[0])
    assert state["legal"], state["errors"]
    (half,) = (v for v in state["graph"]["variables"] if v["name"] == "HALF")
    assert (half["unit"], half["n"], half["type"]) == ("rad", 6, "double")
    editor.save()
    assert check_file(puma).legal


def test_a_parameter_of_a_part_is_written_into_the_combination(tmp_path):
    folder = tmp_path / "servoing"
    shutil.copytree(PUMA.parent / "servoing", folder)
    editor = JobEditor(folder / "combined.job")
    before = editor.state()
    assert before["legal"], before["errors"]
    state = editor.set_parameter("servo", "damped_ls.DAMPING", "0.2")
    assert state["legal"], state["errors"]
    (change,) = editor.changes()
    assert change.file == str(folder / "servo.rmod")
    assert "PART" not in change.diff
    editor.save()
    assert JobEditor(folder / "combined.job").state()["graph"] == state["graph"]
    assert not editor.set_parameter("servo", "damped_ls.DUMPING", "0.2")["legal"]


def test_names_that_would_be_paths_are_refused(puma):
    before = content(puma.parent)
    editor = JobEditor(puma)
    for name in ("../x", "a/b", "", ".."):
        with pytest.raises(PbonetError):
            editor.rename_task("qrdiff", name)
        with pytest.raises(PbonetError):
            editor.add_task(name)
        with pytest.raises(PbonetError):
            JobEditor(puma.parent / "puma.sbs", name=name or "9 lives")
    with pytest.raises(PbonetError):
        editor.add_task("jttrace", name="../x")
    with pytest.raises(PbonetError):
        editor.set_fallback("jttrace", "../x")
    assert content(puma.parent) == before
    assert editor.state()["undo"] == ""


def test_an_entry_that_other_jobs_use_is_noted(puma):
    puma.with_name("other.job").write_bytes(puma.read_bytes())
    editor = JobEditor(puma)
    editor.add_variable("MORE", desc="harms no other job")
    assert editor.changes()[0].notes == []
    editor.set_variable("Q_REF", "maxage", 0.1)
    assert editor.changes()[0].notes == ["it changes Q_REF for other.job too"]


def test_conditions_and_texts_of_the_job(puma):
    editor = JobEditor(puma)
    state = editor.set_job(desc="new words", pre=["NDOF == 6"], post=[])
    assert state["legal"], state["errors"]
    diff = editor.changes()[0].diff
    assert "+PRE       NDOF == 6" in diff
    assert "-POST" in diff
    assert not editor.set_job(pre=["NODF == 6"])["legal"]
    with pytest.raises(ConfigError):
        editor.set_job(pre=["== 6"])


def test_several_changes_are_made_or_refused_together(puma):
    editor = JobEditor(puma)
    before = editor.state()
    steps = (
        Step("add_task", {"module": "jttrace"}),
        Step("remove_task", {"task": "nobody"}),
    )
    with pytest.raises(UnknownTaskError):
        editor.apply(Offer(faults=(), kind="other", text="both", steps=steps))
    assert editor.state() == before
    assert editor.changes() == []


def test_a_saved_copy_that_is_undone_is_no_rmod_any_more(puma):
    editor = JobEditor(puma)
    editor.add_task("jttrace")
    editor.save()
    editor.undo()
    editor.remove_task("jttrace")
    added = [o.steps[0].args.get("module") for o in editor.offers()]
    assert "jttrace" in added
    assert "jttrace_2" not in added
    root = _copy(editor.files, puma.parent / "copy")
    assert root == puma.parent
    assert not (puma.parent / "copy" / "jttrace_2.rmod").exists()
    assert (puma.parent / "copy" / "puma.sbs").is_symlink()


def test_a_saved_copy_that_is_undone_can_be_added_again(puma):
    editor = JobEditor(puma)
    editor.add_task("jttrace")
    editor.save()
    editor.undo()
    editor.add_task("jttrace_2")
    assert {Path(c.file).name: c.kind for c in editor.changes()} == {}
    editor.remove_task("jttrace")
    editor.save()
    assert JobEditor(puma).state()["legal"]


def test_measured_times_count_until_the_variables_are_others(puma):
    editor = JobEditor(puma)
    task = editor.verdict.task("qrdiff")
    saved = Saved(
        rmod="qrdiff",
        module="diff",
        version=task.info.version,
        setup=setup_of(task.rmod, editor.files.table),
        host="lab",
        rtpu="arm1",
        when="today",
        hz=100.0,
        cycles=1000,
        least=0.001,
        most=0.002,
        mean=0.001,
        bins=((100, 1000),),
    )
    folder = puma.parent / "profiles" / "lab"
    folder.mkdir(parents=True)
    (folder / "qrdiff.json").write_bytes(msgspec.json.encode(saved))
    editor = JobEditor(puma, host="lab")
    state = editor.state()
    assert state["timing"][1]["utilization"] == pytest.approx(0.2)
    (bar,) = (one for one in state["timing"][1]["tasks"] if one["task"] == "qrdiff")
    assert (bar["maxc"], bar["source"]) == (0.002, "measured")
    state = editor.set_variable("Q_REF", "type", "float")
    assert any("other variables" in text for text in state["warnings"])
    assert editor.undo()["timing"][1]["utilization"] == pytest.approx(0.2)


def test_a_disk_that_is_full_loses_nothing(puma, monkeypatch):
    editor = JobEditor(puma)
    editor.add_task("jttrace")
    editor.set_variable("Q_REF", "maxage", 0.1)
    first = content(puma.parent)
    calls = []

    def fsync(handle):
        calls.append(handle)
        if len(calls) == 2:
            raise OSError(errno.ENOSPC, "No space left on device")

    monkeypatch.setattr(os, "fsync", fsync)
    with pytest.raises(ConfigFileError, match="No space left") as full:
        editor.save()
    assert str(full.value).endswith(
        f"saved before it: {puma.parent / 'jttrace_2.rmod'}"
    )
    now = content(puma.parent)
    assert now.pop("jttrace_2.rmod")
    assert now == first  # no part of a file, and the job does not name the new one yet
    assert [Path(path).name for path in editor.state()["unsaved"]] == [
        "puma.svar",
        "puma.job",
    ]
    editor.save()
    assert editor.changes() == []
    assert b"jttrace_2" in puma.read_bytes()
