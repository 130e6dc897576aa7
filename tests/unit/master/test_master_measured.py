"""Saved profiles: kept by machine, used while they hold, told when they don't."""

from __future__ import annotations

import json

import pytest
from msgspec import structs

from pbonet.analysis import legality
from pbonet.analysis.schedule.histogram import bin_of
from pbonet.config import parse_rmod, parse_svar
from pbonet.errors import ConfigFileError, StateError
from pbonet.master.configuration import saved_profiles
from pbonet.master.console import profile_plot, render
from pbonet.master.subsystem import profiling
from pbonet.xm.net import messages as m

RMOD = """MODULE diff
DESC
INCONST none
OUTCONST none
INVAR Z
OUTVAR none
TASKTYPE periodic
FREQ 100
{more}EOF
"""
SVAR = """NAME Z
TYPE double
DESC
UNITS none
NELEM {n}
EOF
"""
US = 1e-6


def rmod(more=""):
    return parse_rmod(RMOD.format(more=more), "diff.rmod")


def status(**more):
    known = {
        "rmod": "diff", "task": "diff", "rtpu": "arm0", "tid": 7, "S": "P", "crit": 5,
        "state": "ON", "cycle": 201, "miss": 1, "ref_f": 100.0, "mez_f": 99.0,
        "mez_t": 0.01, "ptime": 2.02, "on_ns": 1, "tot_c": 0.0201, "tick": 1e-9,
        "min_c": 50 * US, "max_c": 900 * US, "last_c": 60 * US, "warn": 0,
        "module": "diff", "version": "v1",
    }  # fmt: skip
    return m.TaskStatus(**(known | more))


def found(short=190, long=10, **more):
    """Return a profile of cycles of 60 and of 900 microseconds."""
    return m.TaskProfile(
        status=status(**more),
        least=50 * US,
        most=900 * US,
        cpu=[(bin_of(60_000), short), (bin_of(900_000), long)],
        jitter=[(bin_of(20_000), short + long)],
    )


@pytest.fixture
def store(tmp_path):
    return saved_profiles.Store(
        tmp_path / "a.sbs", parse_svar(SVAR.format(n=6), "a.svar")
    )


def keep(store, one=None, **more):
    return store.keep(one or found(), rmod(**more), host="h1", when="now")


def test_a_profile_is_found_as_it_was_saved(store, tmp_path):
    saved, path = keep(store)
    assert path == tmp_path / "profiles" / "h1" / "diff.json"
    assert list(path.parent.iterdir()) == [path]
    assert store.find(rmod(), "h1", None) == (saved, "")
    assert store.measured() == {"h1": ["diff"]}
    assert saved.cycles == 200
    assert saved.mean == pytest.approx(100 * US)
    assert saved.profile.worst_ns == 900_000
    assert saved.profile.effective_ns(0.1) < 64_000


def test_runs_are_joined(store):
    """The largest MAXC, the least MINC, and E from the cycles of all of them."""
    keep(store, found(tid=7))
    slower = structs.replace(found(short=50, long=150, tid=8), least=55 * US, most=2e-3)
    saved, path = keep(store, slower)
    assert saved.cycles == 400
    assert (saved.least, saved.most) == (50 * US, 2e-3)
    assert dict(saved.bins) == {bin_of(60_000): 240, bin_of(900_000): 160}
    assert [run.cycles for run in saved.runs] == [200, 200]
    assert saved_profiles.read(path) == saved
    assert saved.profile.effective_ns(0.1) > 800_000
    task = saved_profiles.with_times(legality.Task(rmod=rmod(), rtpu="arm0"), saved)
    assert legality.worst(task) == legality.Figure(2e-3, legality.Source.MEASURED)


def test_a_later_look_at_a_run_replaces_the_earlier(store):
    keep(store, found(tid=7))
    saved, _ = keep(store, found(short=290, long=10, tid=7))
    assert (saved.cycles, len(saved.runs)) == (300, 1)
    saved, _ = keep(store, found(short=190, long=9, tid=7))  # another process, same id
    assert (saved.cycles, len(saved.runs)) == (499, 2)


def test_other_parameters_or_another_version_begin_anew(store):
    keep(store, found(tid=7))
    assert keep(store, found(tid=8), more="LOCAL\ngain 2\n")[0].cycles == 200
    assert (
        keep(store, found(tid=9, version="v2"), more="LOCAL\ngain 2\n")[0].cycles == 200
    )
    assert keep(store, found(tid=10, version="v2"))[0].cycles == 200


def test_a_file_that_names_no_runs_is_one(store):
    _, path = keep(store)
    data = json.loads(path.read_text())
    del data["runs"]
    path.write_text(json.dumps(data))
    saved, _ = keep(store, found(tid=8))
    assert (saved.cycles, len(saved.runs)) == (400, 2)


def test_old_runs_are_joined_and_lose_nothing(store):
    for tid in range(1, 40):
        most = 5e-3 if tid == 3 else 900 * US
        saved, _ = keep(store, structs.replace(found(tid=tid), most=most))
    assert len(saved.runs) == saved_profiles.RUNS
    assert (saved.cycles, saved.most) == (39 * 200, 5e-3)


def test_it_counts_on_its_own_machine_only(store):
    keep(store)
    assert store.find(rmod(), "h2", None) == (None, "")
    task = legality.Task(rmod=rmod(), rtpu="arm0")
    assert saved_profiles.unused(store, [task], "h2") == [
        "diff was measured on h1 and not on h2; '--host h1' judges with those times"
    ]
    assert saved_profiles.unused(store, [task], "h1") == []
    declared = legality.Task(rmod=rmod("MAXC 0.001\n"), rtpu="arm0")
    assert saved_profiles.unused(store, [declared], "h2") == []


def test_declared_times_do_not_change_the_setup_but_parameters_do(store):
    keep(store)
    assert store.find(rmod("MINC 1e-6\nMAXC 0.001\n"), "h1", None)[0] is not None
    none, note = store.find(rmod("LOCAL\ngain 2\n"), "h1", None)
    assert none is None
    assert note.endswith(
        "diff was measured with another module, other parameters or other variables; "
        "the profile is not used, measure again"
    )
    larger = parse_svar(SVAR.format(n=7), "a.svar")
    other = saved_profiles.Store(store.folder.parent / "a.sbs", larger)
    assert other.find(rmod(), "h1", None)[0] is None


def test_another_version_of_the_module_is_told(store):
    from verify_parts import module

    keep(store)
    same = structs.replace(module(), version="v1")
    assert store.find(rmod(), "h1", same)[1] == ""
    none, note = store.find(rmod(), "h1", structs.replace(same, version="v2"))
    assert none is None
    assert "was measured with version v1 of its module, now v2" in note


@pytest.mark.parametrize(
    ("change", "what"),
    [
        (lambda data: data | {"format": 9}, "format 9, this pbonet knows 1"),
        (lambda data: data | {"bins": []}, "not all 0"),
        (lambda data: data | {"bins": [[9999, 3]]}, "there is no bin 9999"),
        (lambda _: {}, "missing required field"),
    ],
)
def test_a_damaged_file_is_told_and_not_used(store, change, what):
    path = keep(store)[1]
    path.write_text(json.dumps(change(json.loads(path.read_text()))))
    none, note = store.find(rmod(), "h1", None)
    assert none is None
    assert what in note
    assert note.endswith("it is not used")
    with pytest.raises(ConfigFileError, match="not a saved profile"):
        saved_profiles.read(path)


def test_too_few_cycles_are_refused(store):
    with pytest.raises(StateError) as caught:
        keep(store, found(short=50, long=9))
    assert str(caught.value) == (
        "arm0/diff: diff has not run long enough to be measured (expected at least 100 "
        "cycles since it was spawned, got 59 cycles); let it run longer"
    )
    assert not store.folder.exists()


def test_a_task_takes_what_was_measured_where_nothing_is_declared(store):
    saved = keep(store)[0]
    plain = saved_profiles.with_times(legality.Task(rmod=rmod(), rtpu="arm0"), saved)
    assert legality.worst(plain) == legality.Figure(900 * US, legality.Source.MEASURED)
    both = rmod("MAXC 0.002\nSOFTNESS 0.1\n")
    soft = saved_profiles.with_times(legality.Task(rmod=both, rtpu="arm0"), saved)
    assert legality.worst(soft) == legality.Figure(0.002, legality.Source.RMOD)
    assert legality.effective(soft).source is legality.Source.MEASURED
    assert legality.effective(soft).seconds < 64 * US
    assert saved_profiles.with_times(plain, None) is plain


# -- what is shown --------------------------------------------------------------------


def test_every_figure_of_section_6_7_1_is_there():
    data = profiling.task_data(found(), rmod("MAXC 0.002\nSOFTNESS 0.1\n"))
    named = "ptime cycle miss mezF mezT totC minC maxC avgC minU maxU avgU tick"
    assert all(data["figures"][name] is not None for name in named.split())
    assert data["figures"]["avgU"] == pytest.approx(1.0)
    assert data["quantiles"]["p50"] == pytest.approx(60 * US, rel=0.07)
    assert data["quantiles"]["p99.9"] <= data["most"] == 900 * US
    assert data["declared"]["softness"] == 0.1
    assert data["effective"] == pytest.approx(60 * US, rel=0.07)
    assert data["psi"][-1] == [pytest.approx(900 * US), 1.0]
    json.dumps(data)


def test_the_figures_of_an_rtpu_are_the_sums_of_its_tasks():
    rtpu = m.RtpuStatus(
        rtpu="arm0", backend="fifo", scheduler="MUF", tasks=[], util=0.5, dispatcher=0.1
    )
    tasks = [profiling.task_data(found(rtpu=name), None) for name in ("arm0", "arm0")]
    other = profiling.task_data(found(rtpu="arm1"), None)
    data = profiling.rtpu_data(rtpu, [*tasks, other])
    assert (data["tasks"], data["cycle"], data["miss"]) == (2, 402, 2)
    assert data["avgU"] == pytest.approx(2.0)
    assert profiling.rtpu_data(rtpu, [])["avgU"] is None


def test_a_task_that_never_ran_has_no_profile():
    empty = m.TaskProfile(status=status(cycle=0), least=0.0, most=0.0)
    assert profiling.task_data(empty, None)["psi"] == []
    assert profiling.task_data(empty, None)["figures"]["minC"] is None
    text = render.text("profile", {"tasks": [profiling.task_data(empty, None)]} | RTPUS)
    assert "CPU time of 0 cycles since it was spawned: least -, p50 -" in text


RTPUS = {"rtpus": []}


def test_one_task_is_shown_whole_and_several_as_a_table():
    sections = {"jac": m.SectionStatus(count=2, total=4e-6, min=1e-6, max=3e-6)}
    failures = {"deadline": 0, "maxexec": 3}
    one = found(failures=failures, overruns=2, delivery_max=5e-6, sections=sections)
    data = profiling.task_data(one, rmod("MAXC 0.002\nSOFTNESS 0.1\n"))
    text = render.text("profile", {"tasks": [data]} | RTPUS)
    assert "CPU time of 200 cycles since it was spawned: least 50 us" in text
    assert "ended late 0, failed 0\n" in text
    assert (
        "timing failures: deadline 0, maxexec 3, reserve used up 2, aborted 0, skipped "
        "0; longest delivery 5 us\n"
    ) in text
    assert "declared: MAXC 2 ms, SOFTNESS 0.1, E " in text
    assert "section jac: 2 times, least 1 us, mean 2 us, most 3 us\n" in text
    assert text.splitlines()[-1].endswith("0.9 ms")
    both = render.text("profile", {"tasks": [data, data]} | RTPUS)
    assert both.splitlines()[0].split()[:3] == ["task", "rtpu", "cycle"]
    assert len(both.splitlines()) == 3


def test_the_curve_rises_from_left_to_right():
    lines = profile_plot.as_text([(2e-3, 0.5), (6e-3, 0.9), (10e-3, 1.0)], columns=10)
    rows = lines.splitlines()
    assert rows[0] == "100%          " + "█"
    assert rows[5] == " 50%  █████████"
    assert rows[9] == " 10%  █████████"
    assert rows[10] == "     0    10 ms"


def test_a_picture_is_drawn(tmp_path):
    pytest.importorskip("matplotlib")
    data = profiling.task_data(found(), rmod("SOFTNESS 0.1\n"))
    for name, head in (("psi.svg", b"<?xml"), ("psi.png", b"\x89PNG")):
        profile_plot.draw(tmp_path / name, [data])
        assert (tmp_path / name).read_bytes().startswith(head)
    with pytest.raises(ConfigFileError, match="no plot can be written"):
        profile_plot.draw(tmp_path / "psi.txt", [data])
    with pytest.raises(ConfigFileError, match="cannot be written"):
        profile_plot.draw(tmp_path / "no" / "psi.svg", [data])
    with pytest.raises(Exception, match="no profile to draw"):
        profile_plot.draw(tmp_path / "psi.svg", [])
