"""Profiles of tasks that run: shown, drawn, saved, adopted, and used for the next."""

from __future__ import annotations

import json

import pytest
from watching import wait_for

from pbonet.analysis import legality
from pbonet.analysis.schedule import histogram
from pbonet.cli import main
from pbonet.config import read_rmod
from pbonet.errors import StateError, UnknownTaskError
from pbonet.master.configuration import adopt_times as adopt, saved_profiles
from pbonet.master.console.command_session import CommandSession
from pbonet.master.subsystem.subsystem import Subsystem

ENOUGH = 150
"""Cycles; a profile wants 100."""


@pytest.fixture
def running(arm):
    """The whole job, after enough cycles of the fast tasks."""
    arm.start("puma")
    for task in ("puma_pidg", "grav_comp"):
        wait_for(
            lambda task=task: arm.status(task).cycle >= ENOUGH,
            f"cycles of {task}",
            30.0,
        )
    return arm


@pytest.fixture
def call(capsys, two, puma):
    """Run a verb on the subsystem in this process; return status, output, errors."""

    def run(verb, *argv):
        words = [verb, str(puma), *map(str, argv)]
        if verb not in {"adopt", "check"}:
            words += ["--domain", two.domain, "--library", str(two.library)]
        with pytest.raises(SystemExit) as caught:
            main(words)
        told = capsys.readouterr()
        return caught.value.code or 0, told.out, told.err

    return run


def test_the_profile_counts_every_cycle_but_the_first(running):
    running.control("grav_comp", "off")
    (found,) = running.profile(["grav_comp"])
    status = found.status
    assert status.state == "OFF"
    assert sum(count for _, count in found.cpu) == status.cycle - 1
    assert sum(count for _, count in found.jitter) == status.cycle
    assert (found.least, found.most) == (status.min_c, status.max_c)
    bins = [index for index, _ in found.cpu]
    assert bins[0] == histogram.bin_of(round(status.min_c * 1e9))
    assert bins[-1] == histogram.bin_of(round(status.max_c * 1e9))
    with pytest.raises(UnknownTaskError):
        running.profile(["nobody"])


def test_after_a_second_on_the_extremes_bound_all_cycles(running):
    before = running.profile(["grav_comp"])[0]
    running.control("grav_comp", "off")
    running.control("grav_comp", "on")
    wait_for(lambda: running.status("grav_comp").cycle > 1, "two more cycles")
    after = running.profile(["grav_comp"])[0]
    assert after.status.on_ns > before.status.on_ns, "its cycles count anew"
    assert after.least <= before.least
    assert after.most >= before.most
    assert sum(count for _, count in after.cpu) > sum(count for _, count in before.cpu)


def test_the_command_shows_every_figure(running):
    desk = CommandSession(running)
    reply = desk.execute("profile")
    assert {task["task"] for task in reply.data["tasks"]} == set(running.model.names)
    assert {rtpu["rtpu"] for rtpu in reply.data["rtpus"]} == {"arm0", "arm1"}

    def counted():
        """A core that stands still just now has not counted yet what that costs."""
        data = desk.execute("profile puma_pidg").data
        found = data["tasks"][0]["figures"]
        rate = (found["cycle"] + found["miss"]) / found["ptime"]
        return rate == pytest.approx(500, rel=0.1) and data

    one = wait_for(counted, "500 releases a second")
    (task,) = one["tasks"]
    names = "ptime cycle miss mezF mezT totC minC maxC avgC minU maxU avgU tick"
    names += " firstC nowC"
    assert all(task["figures"][name] is not None for name in names.split())
    figures = task["figures"]
    assert figures["mezF"] == pytest.approx(figures["cycle"] / figures["ptime"])
    assert 0 < task["least"] <= task["quantiles"]["p50"] <= task["most"]
    assert task["psi"][-1][1] == 1.0
    assert one["rtpus"][0]["dispatcher"] > 0
    assert all(one["rtpus"][0][name] is not None for name in names.split())


def test_profiles_are_saved_used_and_adopted(running, puma, call, tmp_path):
    """The whole way: measured, saved, judged with, and written into the RMODs."""
    desk = CommandSession(running)
    saved = desk.execute("profile save grav_comp").data["saved"]
    host = saved_profiles.here()
    path = tmp_path / "profiles" / host / "grav_comp.json"
    assert saved[0]["file"] == str(path)
    assert saved[0]["cycles"] >= 100
    known = {task.task: task for one in running.report() for task in one.tasks}
    assert known["grav_comp"].maxc.source is legality.Source.ASSUMED
    running.finish()

    again = Subsystem(puma, domain=running.domain, libraries=[])
    again.open()
    try:
        again.start("puma")
        known = {task.task: task for one in again.report("puma") for task in one.tasks}
        assert known["grav_comp"].maxc.seconds == saved[0]["most"]
        assert known["grav_comp"].maxc.source is legality.Source.MEASURED
        assert known["qrdiff"].maxc.source is legality.Source.ASSUMED
        assert again.status("grav_comp").crit_assumed  # until it is adopted
    finally:
        again.finish()

    status, out, _ = call("adopt", "grav_comp")
    assert status == 0
    assert out.splitlines()[-1].endswith("cycles: written")
    assert read_rmod(tmp_path / "grav_comp.rmod").maxc >= saved[0]["most"]
    again = Subsystem(puma, domain=running.domain, libraries=[])
    with again:
        again.spawn("puma_pidg", "arm0")
        status = again.spawn("grav_comp", "arm1")
        assert not status.crit_assumed


def test_a_saved_profile_gives_a_soft_task_its_reserve(running, puma, tmp_path):
    """E travels with the spawn, so the RTPU ranks the task by it (section 6.4)."""
    text = adopt.with_lines(
        running.files.rmod("grav_comp").text,
        running.files.rmod("grav_comp").record,
        {"MAXC": 0.0039},
    )
    soft = text.replace("MAXC ", "SOFTNESS 0.1\nMAXC ")
    (tmp_path / "grav_comp.rmod").write_text(soft)
    CommandSession(running).execute("profile save grav_comp")
    running.finish()
    rmod = tmp_path / "jttrace.rmod"
    source = running.files.rmod("jttrace")
    rmod.write_text(adopt.with_lines(source.text, source.record, {"MAXC": 0.01}))
    again = Subsystem(puma, domain=running.domain, libraries=[])
    with again:
        again.spawn("puma_pidg", "arm0")
        again.spawn("grav_comp", "arm1")
        again.spawn("jttrace", "arm1")
        # With MAXC reserved both would be above 95 %, and jttrace out of the set.
        assert again.status("grav_comp").crit == 5
        assert again.status("jttrace").crit == 5
    (tmp_path / "profiles" / saved_profiles.here() / "grav_comp.json").unlink()
    again = Subsystem(puma, domain=running.domain, libraries=[])
    with again:
        again.spawn("puma_pidg", "arm0")
        again.spawn("grav_comp", "arm1")
        again.spawn("jttrace", "arm1")
        assert again.status("jttrace").crit == 3


def test_too_few_cycles_are_not_saved(arm, tmp_path):
    arm.spawn("puma_pidg", "arm0")
    arm.spawn("grav_comp", "arm1")
    desk = CommandSession(arm)
    with pytest.raises(StateError, match="has not run long enough"):
        desk.execute("profile save grav_comp")
    reply = desk.execute("profile save")
    assert reply.data == {"saved": []}
    assert "has not run long enough" in reply.warnings[0]
    assert not (tmp_path / "profiles").exists()


@pytest.mark.usefixtures("running")
def test_the_verb_shows_draws_and_saves(call, tmp_path):
    status, out, _ = call("profile", "grav_comp", "--plot", tmp_path / "psi.png")
    assert status == 0
    assert "share of the cycles within a CPU time:" in out
    assert (tmp_path / "psi.png").read_bytes().startswith(b"\x89PNG")
    status, out, _ = call("profile", "grav_comp", "--save", "--json")
    (one,) = json.loads(out)["saved"]
    assert saved_profiles.read(
        tmp_path / "profiles" / saved_profiles.here() / "grav_comp.json"
    )
    assert one["task"] == "grav_comp"
    status, _, err = call("profile", "nobody")
    assert status == 1
    assert "no task nobody" in err
