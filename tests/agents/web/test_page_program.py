"""Programs of jobs on the page: icons in a row are saved, checked, run and steered."""

from __future__ import annotations

import shutil
import subprocess
import sys
from pathlib import Path

import pytest
from page_kit import PageServer, keep_picture, opened
from watching import END_TIME, wait_for

CELL = Path(__file__).parents[3] / "examples" / "pick_and_place"
pytestmark = pytest.mark.timeout(600)


@pytest.fixture(scope="module")
def cell(programs, browser, tmp_path_factory):  # noqa: ARG001 - skips before it starts
    """The folder of the pick-and-place example, with two agents."""
    folder = tmp_path_factory.mktemp("programs") / "cell"
    shutil.copytree(CELL, folder)
    for name in ("arm0", "arm1"):
        words = "--name", name, "--library", folder, "--runs", folder / "runs"
        programs.begin("agent", *words)
    yield folder
    programs.call("stop", folder / "cell.sbs")


@pytest.fixture(scope="module")
def server(programs, cell):
    return PageServer(programs, cell / "approach.job")


@pytest.fixture
def page(browser, server):
    with opened(browser, server.link()) as page:
        page.get_by_role("button", name="Program", exact=True).click()
        page.locator(".jobs li").nth(7).wait_for()
        yield page


def tile(page, name):
    """Return the tile of a step."""
    return page.locator(
        ".program-row .tile.step", has=page.locator(f"b:text-is('{name}')")
    )


def names(page):
    return page.locator(".program-row .tile > b").all_inner_texts()


def form(page):
    return page.locator(".program-form")


def field(page, label):
    return form(page).get_by_label(label, exact=True)


def put(page, label, text):
    """Fill a field of the form."""
    field(page, label).fill(text)
    field(page, label).press("Enter")


def verdict(page, text):
    """Wait until the check behind the last edit has said something."""
    page.locator(".verdict:not(.verdict-checking)", has_text=text).wait_for()


def begin(page, name):
    page.get_by_label("new program").fill(name)
    page.get_by_label("new program").press("Enter")
    page.locator(f".program-tools h2:text-is('{name}')").wait_for()


def do(page, name):
    page.get_by_role("button", name=name, exact=True).click()


def test_three_icons_make_a_program_that_is_saved_and_runs(page, programs, cell):
    begin(page, "three")
    row = page.locator(".program-row")
    for job in ("approach", "grasp"):
        page.locator(".jobs button", has_text=job).drag_to(row)
    page.locator(".jobs button", has_text="descend").drag_to(
        tile(page, "grasp"), target_position={"x": 5, "y": 30}
    )
    assert names(page) == ["approach", "descend", "grasp"]
    keep_picture(page, "program-begun")
    for job, signal in (
        ("approach", "FINISH"),
        ("descend", "FINISH"),
        ("grasp", "CLOSED"),
    ):
        tile(page, job).click()
        do(page, "add an end")
        put(page, "signal", signal)
        tile(page, job).locator(f".until:text-is('until {signal}')").wait_for()
    do(page, "program")
    put(page, "wait for conditions (WAIT)", "5")
    put(page, "each step at most (WITHIN)", "60")
    do(page, "safe job")
    field(page, "job").select_option("retreat")
    verdict(page, "✓ no fault")
    page.locator(".verdict summary").click()
    page.locator(".verdict").get_by_text(
        "no task produces the constant TOOL_LENGTH"
    ).first.wait_for()
    tile(page, "approach").focus()
    do(page, "command")  # after the chosen line, or at the end
    put(page, "rmod", "short_fingers")
    page.locator(".tile.kind-order").focus()
    for _ in range(3):
        page.keyboard.press("Alt+ArrowLeft")
    assert names(page) == ["spawn", "approach", "descend", "grasp"]
    page.get_by_text("not saved:").wait_for()
    verdict(page, "✓ no fault")
    keep_picture(page, "program-three")
    do(page, "save and run")
    for job in ("approach", "descend", "grasp"):
        page.locator(f".tile.lit[data-key] b:text-is('{job}')").wait_for()
        if job == "descend":
            page.get_by_text("step descend, waits for FINISH").wait_for()
            keep_picture(page, "program-runs")
    page.locator(".run-bar.run-done", has_text="done").wait_for()
    assert page.locator(".tile.lit").count() == 0
    assert not page.get_by_text("not saved:").count()
    with page.expect_download() as coming:
        do(page, "export as Python")
    coming.value.save_as(cell / coming.value.suggested_filename)
    assert "three of 3 steps: legal" in programs.call("check", cell / "three.seq")
    runs = "--runs", cell / "runs"
    assert ": done" in programs.call("run", cell / "three.seq", "--sim", *runs)
    done = subprocess.run(
        [sys.executable, cell / "three.py", "--sim"],
        env=programs.env,
        cwd=cell,
        check=False,
        capture_output=True,
        text=True,
        timeout=END_TIME,
    )
    assert done.returncode == 0, done.stderr
    assert "grasp" in done.stdout


def test_branches_and_loops_are_drawn_and_edited_by_keyboard(page, cell):
    page.locator(".program-names button", has_text="carry").click()
    wait_for(lambda: len(names(page)) == 19, "the lines of the program")
    before = (cell / "carry.seq").read_bytes()
    assert page.locator(".arc-goto.arc").count() == 2
    assert page.locator(".arc-else.arc").count() == 1
    assert "else give_up" in tile(page, "lift").locator(".else").inner_text()
    verdict(page, "✓ no fault")
    assert page.locator(".edge-asked").count() == 6
    keep_picture(page, "program-carry")
    tile(page, "move").focus()
    page.keyboard.press("Enter")
    assert field(page, "job").evaluate("one => one === document.activeElement")
    tile(page, "move").focus()
    page.keyboard.press("Alt+ArrowRight")
    assert names(page)[5:7] == ["place", "move"]
    page.keyboard.press("Delete")
    assert "move" not in names(page)
    page.keyboard.press("Control+z")
    page.keyboard.press("Control+z")
    assert names(page)[5:7] == ["move", "place"]
    page.keyboard.press("Control+Shift+z")
    assert names(page)[5:7] == ["place", "move"]
    page.get_by_text("not saved: step move moved").wait_for()
    tile(page, "place").drag_to(tile(page, "move"), target_position={"x": 100, "y": 9})
    assert names(page)[5:7] == ["move", "place"]
    do(page, "undo")
    tile(page, "place").click()
    put(page, "label", "home")
    page.locator(".tile.has-error").wait_for()
    verdict(page, "the label 'home' is given twice")
    keep_picture(page, "program-fault")
    do(page, "save")
    page.get_by_role("alert").filter(
        has_text="the label 'home' is given twice"
    ).wait_for()
    with page.expect_event("dialog") as asked:
        page.evaluate("() => void setTimeout(() => location.reload())")
    assert asked.value.type == "beforeunload"
    asked.value.dismiss()
    for _ in range(2):
        do(page, "undo")
    assert not page.get_by_text("not saved").count()
    tile(page, "lift").click()
    do(page, "remove")
    page.get_by_text("Saving drops a comment of the file: refused unless a").wait_for()
    do(page, "undo")
    do(page, "repeat")
    assert page.locator(".loop").get_by_text("end of repeat").count() == 1
    do(page, "undo")
    assert (cell / "carry.seq").read_bytes() == before
    page.get_by_label("new program").fill("../x")
    page.get_by_label("new program").press("Enter")
    page.get_by_role("alert").filter(
        has_text="not a valid name for a program"
    ).wait_for()


def test_the_forms_write_the_file_and_a_foreign_change_is_not_overwritten(page, cell):
    begin(page, "forms")
    for job in ("approach", "lift"):
        page.locator(".jobs button", has_text=job).press("Enter")
    put(page, "or after (FOR)", "x")
    form(page).get_by_text("“x” is no number above 0").wait_for()
    put(page, "or after (FOR)", "3")
    field(page, "after an error (ELSE)").select_option("approach")
    tile(page, "approach").click()
    do(page, "add an end")
    field(page, "by").select_option("condition")
    put(page, "condition", "WIDTH > 7 [cm]")
    do(page, "repeat")
    do(page, "go to")
    field(page, "go to").select_option("lift")
    field(page, "when").select_option("if")
    field(page, "by").select_option("condition")
    put(page, "condition", "HELD")
    page.locator(".loop .tile", has_text="if (HELD)").wait_for()
    keep_picture(page, "program-loop")
    do(page, "save")
    page.locator(".program-tools .outcome", has_text="saved: forms.seq").wait_for()
    file = cell / "forms.seq"
    lines = file.read_text().splitlines()[3:]
    assert [" ".join(line.split()) for line in lines] == [
        "STEP approach UNTIL (WIDTH > 7 [cm])", "REPEAT 2", "GOTO lift IF (HELD)",
        "END", "STEP lift FOR 3.0 ELSE approach", "EOF",
    ]  # fmt: skip
    file.write_text(file.read_text().replace("FOR 3.0", "FOR 4.0"))
    tile(page, "lift").click()
    put(page, "or after (FOR)", "5")
    do(page, "save")
    page.get_by_role("alert").filter(has_text="since it was opened").wait_for()
    assert "FOR 4.0" in file.read_text()
    do(page, "open it again")
    tile(page, "lift").get_by_text("until 4 s").wait_for()
    do(page, "undo")
    do(page, "save")
    page.locator(".program-tools .outcome", has_text="saved: forms.seq").wait_for()
    assert "FOR 5.0" in file.read_text()


def test_a_program_is_steered_from_every_browser_and_aborted_to_its_safe_job(
    page, browser, server, cell
):
    (cell / "stay.seq").write_text(
        "SEQUENCE stay\nDESC\nSBS cell.sbs\nSAFE retreat\nWAIT 5\n"
        "SPAWN short_fingers arm1\nSTEP retreat FOR 600\nEOF\n"
    )
    page.keyboard.press("F8")  # the tasks of a program that has ended go on
    page.locator(".stop-place .outcome.done").wait_for()
    page.reload()
    page.get_by_role("button", name="Program", exact=True).click()
    page.locator(".program-names button", has_text="stay").click()
    do(page, "run paused")
    bar = page.locator(".run-bar")
    bar.get_by_text("paused before its first line").wait_for()
    page.locator(".tile.lit[aria-label*='comes next']").wait_for()
    with opened(browser, server.link("observer")) as looker:
        looker.locator(".run-bar", has_text="paused before its first line").wait_for()
        assert not looker.locator(".run-bar button").count()
        do(page, "step")
        page.locator(".tile.lit.kind-order").wait_for()
        looker.locator(".run-bar", has_text="stay").wait_for()
        do(page, "resume")
        page.locator(".program-row .tile.lit b:text-is('retreat')").wait_for()
        looker.get_by_text("step retreat, waits for 600 s").wait_for()
        keep_picture(looker, "program-watched")
        do(page, "abort")
        bar.get_by_text("2 steps entered; went to the safe job retreat").wait_for()
        assert bar.locator(".where").inner_text() == "aborted"
        looker.locator(".run-bar").wait_for(state="detached")
    keep_picture(page, "program-aborted")
