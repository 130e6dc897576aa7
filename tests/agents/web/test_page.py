"""The page in a browser: a job that really runs is watched and steered."""

from __future__ import annotations

import csv
import re
import shutil
from pathlib import Path
from urllib.parse import urlsplit

import pytest
from page_kit import PageServer, keep_picture, opened
from watching import wait_for

from pbonet.log import Log, last_run

PUMA = Path(__file__).parents[3] / "examples" / "puma"
MODULES = PUMA.parents[1] / "pbonet" / "modules"
TASKS = ["puma_pidg", "grav_comp", "qrdiff", "jttrace"]
SLID = """MODULE pid
DESC a parameter between two bounds
SVARALIAS Z_REF=Q_REF
SVARALIAS Z_MEZ=Q_MEZ
SVARALIAS Z_CMD=T_GRAV
INCONST NDOF
OUTCONST none
INVAR Z_REF Z_MEZ
OUTVAR Z_CMD
TASKTYPE periodic
FREQ 10
LOCAL
KP 1
LOWER -1
UPPER 1
EOF
"""
pytestmark = pytest.mark.timeout(600)


@pytest.fixture(scope="module")
def job(programs, browser, tmp_path_factory):  # noqa: ARG001 - skips before it starts
    """The PUMA job, on two agents, and a second differentiator beside it."""
    folder = tmp_path_factory.mktemp("puma")
    for name in ("puma.sbs", "puma.svar", "puma.job"):
        shutil.copy(PUMA / name, folder / name)
    (found,) = MODULES.rglob("qrdiff.rmod")
    shutil.copy(found, folder / "qrdiff2.rmod")
    (folder / "slid.rmod").write_text(SLID)
    for name in ("arm0", "arm1"):
        programs.begin("agent", "--name", name, "--runs", folder / "runs")
    wait_for(lambda: "jttrace ON" in programs.call("start", folder / "puma.job"), "job")
    return folder / "puma.job"


@pytest.fixture(scope="module")
def server(programs, job):
    return PageServer(programs, job)


@pytest.fixture
def page(browser, server):
    with opened(browser, server.link()) as page:
        page.locator(".card.is-on").nth(3).wait_for()
        yield page


def card(page, task):
    """Return the card of a task."""
    return page.locator(".card", has=page.locator(f".name:text-is('{task}')"))


def tab(page, name):
    """Open a panel; return it."""
    page.locator(f"#tab-{name}").click()
    return page.locator("#panel")


def give(page, line):
    """Give a command at the page's command line; return its entry in the list."""
    tab(page, "Commands")
    page.get_by_role("combobox", name="command").fill(line)
    page.get_by_role("button", name="give").click()
    entry = page.locator(".sent li").first
    entry.locator(f"code:text-is('{line}')").wait_for()
    page.locator(".sent li:not(.sent-running)").first.wait_for()
    return entry


def test_the_job_is_drawn(page):
    names = page.locator(".card .name")
    assert sorted(names.all_inner_texts()) == sorted(TASKS)
    assert page.locator(".card .state").all_inner_texts() == ["ON"] * 4
    assert page.locator(".frame b").all_inner_texts() == ["arm0", "arm1"]
    page.locator(".wire-label .age").first.wait_for()
    wires = page.locator(".react-flow__edge")
    assert wires.count() == 9
    assert page.locator(".react-flow__edge .wire-constant").count() == 4
    assert page.locator(".flag").inner_text() == "✓ legal"
    page.locator(".wire-label button", has_text="Q_MEZ").hover()
    inspector = page.get_by_label("variable Q_MEZ")
    inspector.locator(".elements li").nth(5).wait_for()
    assert "written by puma_pidg" in inspector.inner_text()
    keep_picture(page, "graph")


def test_a_task_is_turned_off_and_on_by_its_buttons_and_the_flag_says_why(page):
    one = card(page, "jttrace")
    assert one.locator(".signal").all_inner_texts() == ["off", "reinit", "kill"]
    one.get_by_role("button", name="off jttrace").click()
    page.locator(".bar.illegal", has_text="no task writes Q_REF").wait_for()
    one.locator(".outcome.warned", has_text="turn jttrace on").wait_for()
    page.locator(".wire.stale").first.wait_for()
    assert one.locator(".state").inner_text() == "OFF"
    page.get_by_role("button", name="explain flag").click()
    causes = page.locator(".why pre", has_text="the flag of puma is up")
    causes.wait_for()
    assert "because task jttrace on arm1 is OFF" in causes.inner_text()
    keep_picture(page, "illegal")
    one.get_by_role("button", name="on jttrace").click()
    page.locator(".flag.legal").wait_for()
    assert one.locator(".state").inner_text() == "ON"


def test_several_tasks_get_a_signal_as_one_list(page):
    panel = tab(page, "Tasks")
    for name in ("jttrace", "qrdiff"):
        panel.get_by_label(f"select {name}").check()
    panel.get_by_role("button", name="off", exact=True).click()
    panel.get_by_text("done for jttrace, qrdiff").wait_for()
    card(page, "qrdiff").locator(".state-off").wait_for()
    panel.get_by_role("button", name="on", exact=True).click()
    page.locator(".card.is-on").nth(3).wait_for()


def test_a_refused_command_reads_as_at_the_prompt(page, programs, job):
    entry = give(page, "on puma_pidg")
    assert entry.locator(".outcome-word").inner_text() == "refused"
    refused = entry.locator("pre").inner_text()
    assert "signal on is not valid in state ON" in refused
    said = programs.call("on", job, "puma_pidg")
    assert said.split() == ["pbonet:", *refused.split()]


def test_a_parameter_is_set_and_refused_at_its_field(page):
    panel = tab(page, "Task")
    panel.locator("select").first.select_option("puma_pidg")
    follow = panel.locator(".parameter", has=page.locator("b:text-is('follow')"))
    field = follow.get_by_label("follow in 1/s")
    wait_for(lambda: field.input_value() == "10.0" or field.input_value() == "10", "it")
    field.fill("-1")
    field.press("Enter")
    refusal = follow.get_by_role("alert").inner_text()
    assert "parameter follow is out of bounds" in refusal
    assert "got -1" in refusal
    keep_picture(page, "parameters")
    field.fill("12")
    field.press("Enter")
    follow.get_by_role("alert").wait_for(state="detached")
    assert "12" in give(page, "get puma_pidg follow").locator("pre").inner_text()
    assert "SET" in tab(page, "Events").inner_text()
    give(page, "set puma_pidg follow 10")


def test_a_swap_is_shown_first_and_then_done(page):
    panel = tab(page, "Change").get_by_label("swap", exact=True)
    old, new = panel.locator("input").all()
    old.fill("qrdiff")
    new.fill("qrdiff_2")
    show = panel.get_by_role("button", name="show what would be done")
    show.click()
    refusal = panel.get_by_role("alert").inner_text()
    assert "there is no RMOD qrdiff_2" in refusal
    assert "did you mean qrdiff2?" in refusal
    new.fill("qrdiff2")
    show.click()
    steps = panel.locator(".steps")
    steps.wait_for()
    assert "qrdiff, stays OFF" in steps.locator(".step-goes").inner_text()
    assert "qrdiff2, created on arm1" in steps.locator(".step-comes").inner_text()
    assert card(page, "qrdiff").locator(".state").inner_text() == "ON"
    keep_picture(page, "swap")
    panel.get_by_role("button", name="do it").click()
    card(page, "qrdiff2").locator(".state-on").wait_for()
    card(page, "qrdiff").locator(".state-off").wait_for()
    assert give(page, "swap qrdiff2 qrdiff").locator(".outcome-word").inner_text()
    card(page, "qrdiff").locator(".state-on").wait_for()
    card(page, "qrdiff2").get_by_role("button", name="kill qrdiff2").click()
    card(page, "qrdiff2").wait_for(state="detached")


def test_a_killed_task_of_the_job_stays_and_says_why(page):
    assert page.locator(".who .job").inner_text() == "job teleop"
    one = card(page, "jttrace")
    one.get_by_role("button", name="kill jttrace").click()
    one.locator(".state-not-created").wait_for()
    note = one.locator(".note-missing")
    note.wait_for()
    assert "it was not spawned, or was killed; last: " in note.inner_text()
    assert page.locator(".card").count() == 4
    one.get_by_role("button", name="spawn jttrace").click()
    one.get_by_role("button", name="on jttrace").click()
    page.locator(".flag.legal").wait_for()
    note.wait_for(state="detached")


def test_a_parameter_with_both_bounds_has_a_slider(page):
    give(page, "spawn slid arm1")
    panel = tab(page, "Task")
    panel.locator("select").first.select_option("slid")
    weight = panel.locator(".parameter", has=page.locator("b:text-is('weight')"))
    slider = weight.get_by_label("weight, slider")
    slider.focus()
    page.keyboard.press("Home")
    field = weight.get_by_label("weight", exact=True)
    wait_for(lambda: field.input_value() == "0", "the least value")
    given = "get slid weight"
    wait_for(lambda: " 0" in give(page, given).locator("pre").inner_text(), "it is set")
    give(page, "kill slid")


def test_a_job_is_changed_in_assemble_and_applied_to_the_running_system(page, job):
    page.get_by_role("button", name="Assemble").click()
    page.locator(".canvas .card", has_text="qrdiff").locator(".kind").click()
    page.keyboard.press("Delete")
    page.locator("button.flag.illegal").wait_for()
    page.get_by_role("searchbox").fill("qrdiff2")
    page.get_by_label("module qrdiff2", exact=True).press("Enter")
    page.locator("button.flag.legal").wait_for()
    page.locator("#assemble-Save").click()
    page.get_by_role("button", name="save one file").click()
    page.locator(".unsaved:text-is('all is saved')").wait_for()
    apply = page.get_by_label("apply to the running system")
    apply.get_by_role("button", name="show what would be done").click()
    steps = apply.locator(".steps")
    page.locator(".apply .plan, .apply .refusal").first.wait_for()
    keep_picture(page, "apply")
    assert apply.locator(".refusal").all_inner_texts() == []
    assert "qrdiff2, created on arm" in steps.locator(".step-comes").inner_text()
    apply.get_by_role("button", name="do it").click()
    apply.locator(".outcome.done").wait_for()
    assert "qrdiff2" in job.read_text()
    page.get_by_role("button", name="Watch").click()
    card(page, "qrdiff2").locator(".state-on").wait_for()
    card(page, "qrdiff").wait_for(state="detached")
    assert page.locator(".card.is-on").count() == 4


def test_who_did_what_is_in_the_log(page, job):
    give(page, "set puma_pidg follow 10")

    def given():
        done = Log(last_run(job.parent / "runs")).commands()
        return {one["op"] for one in done if one["client"].startswith("web-operator-")}

    wait_for(lambda: {"claim", "set"} <= given(), "the page's commands in the log")


def test_variables_are_plotted_triggered_and_saved(page, tmp_path):
    new = page.get_by_label("variable for new chart")
    for words in ("Q_MEZ[0:3]", "Q_REF[1] Q_MEZ[1]"):
        new.fill(words)
        new.press("Enter")
    assert page.locator(".chart").count() == 2
    shown = page.locator(".chart .series b").first
    wait_for(lambda: shown.inner_text() not in {"", "\N{EN DASH}"}, "a value")
    page.get_by_label("seconds shown").select_option("2 s")
    page.get_by_text("trigger", exact=True).click()
    form = page.locator(".trigger form")
    form.locator("input").first.fill("Q^_REF[0]")  # no chart shows it
    form.get_by_label("level").fill("0.1")
    form.get_by_role("button", name="arm").click()
    page.locator(".trigger .badge", has_text="triggered at").wait_for()
    keep_picture(page, "plots")
    files = {}
    for kind in ("CSV", "PNG"):
        with page.expect_download() as coming:
            page.get_by_role("button", name=kind).click()
        files[kind] = tmp_path / coming.value.suggested_filename
        coming.value.save_as(files[kind])
    with files["CSV"].open(newline="") as text:
        head, *rows = csv.reader(text)
    assert head == ["t (s)", *(f"{one} (rad)" for one in
        ("Q_MEZ[0]", "Q_MEZ[1]", "Q_MEZ[2]", "Q_REF[1]"))]  # fmt: skip
    times = [float(row[0]) for row in rows]
    assert len(times) > 20
    assert times == sorted(times)
    assert files["PNG"].read_bytes().startswith(b"\x89PNG")


def test_an_observer_sees_everything_and_has_no_control(browser, server):
    with opened(browser, server.link("observer")) as page:
        page.locator(".card.is-on").nth(3).wait_for()
        assert page.locator(".stop, .signal").count() == 0
        names = page.get_by_role("tab").all_inner_texts()
        assert [re.sub(r"\d", "", one) for one in names] == [
            "Tasks", "Task", "Variables", "Events"
        ]  # fmt: skip
        assert "steers nothing" in page.locator(".observer-note").inner_text()
        panel = tab(page, "Task")
        panel.locator(".parameter").first.wait_for()
        assert panel.locator(".parameter input, .parameter button").count() == 0
        page.keyboard.press("F8")
        tab(page, "Events").locator(".events li").first.wait_for()
        assert page.locator(".card.is-on").count() == 4


def test_a_lost_server_is_said_and_its_successor_is_found(browser, programs, job):
    first = PageServer(programs, job)
    link = first.link()
    with opened(browser, link) as page:
        page.locator(".card.is-on").nth(3).wait_for()
        first.kill()
        page.get_by_text("Connection lost.").wait_for()
        assert page.locator(".page.link-lost").count() == 1
        assert page.locator(".link-state").inner_text() == "connection lost"
        keep_picture(page, "lost")
        page.get_by_role("button", name="off jttrace").wait_for()
        assert page.get_by_role("button", name="off jttrace").is_disabled()
        PageServer(programs, job, port=urlsplit(link).port)
        page.locator(".page.link-live .card.is-on").nth(3).wait_for()
        assert page.get_by_text("Connection lost.").count() == 0
        tab(page, "Events").get_by_text("SPAWNED").first.wait_for()


def test_one_key_stops_everything_and_a_button_starts_the_job(page):
    tab(page, "Commands")
    page.get_by_role("combobox", name="command").fill("half a line")
    page.keyboard.press("F8")
    page.locator(".stop-place .outcome.done", has_text="turned off").wait_for()
    page.locator(".card.is-not-created").nth(3).wait_for()
    keep_picture(page, "stopped")
    page.get_by_role("button", name="start job teleop").click()
    page.locator(".card.is-on").nth(3).wait_for()
