"""Programs of jobs on the page: icons in a row are saved, checked, run and steered."""

from __future__ import annotations

import shutil
import subprocess
import sys
from pathlib import Path

import pytest
from page_kit import PageServer, Programs, chromium, keep_picture, opened
from watching import END_TIME, wait_for

CELL = Path(__file__).parents[3] / "examples" / "pick_and_place"
pytestmark = pytest.mark.timeout(600)


@pytest.fixture(scope="module")
def browser():
    with chromium() as browser:
        yield browser


@pytest.fixture(scope="module")
def programs():
    programs = Programs()
    yield programs
    programs.close()


@pytest.fixture(scope="module")
def cell(programs, browser, tmp_path_factory):  # noqa: ARG001 - skips before it starts
    """The folder of the pick-and-place example, with two agents."""
    folder = tmp_path_factory.mktemp("programs") / "cell"
    shutil.copytree(CELL, folder)
    for name in ("arm0", "arm1"):
        programs.begin("agent", "--name", name, "--runs", folder / "runs")
    return folder


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
    return page.locator(".program-row .tile.step", has=page.locator(f"b:text-is('{name}')"))


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
    for job, signal in (("approach", "FINISH"), ("descend", "FINISH"), ("grasp", "CLOSED")):
        tile(page, job).click()
        do(page, "add an end")
        put(page, "signal", signal)
        tile(page, job).locator(f".until:text-is('until {signal}')").wait_for()
    do(page, "program")
    put(page, "wait for conditions (WAIT)", "5")
    put(page, "each step at most (WITHIN)", "60")
    do(page, "safe job")
    field(page, "job").select_option("retreat")
    verdict(page, "no task produces the constant TOOL_LENGTH")
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
    page.locator(".outcome.refusal").wait_for(state="detached")
    for job in ("approach", "descend", "grasp"):
        page.locator(f".tile.lit[data-key] b:text-is('{job}')").wait_for()
        if job == "descend":
            assert "waits for FINISH" in page.locator(".run-bar .where").inner_text()
            keep_picture(page, "program-runs")
    page.locator(".run-bar.run-done", has_text="done").wait_for()
    assert page.locator(".tile.lit").count() == 0
    assert not page.get_by_text("not saved:").count()
    with page.expect_download() as coming:
        do(page, "export as Python")
    coming.value.save_as(cell / coming.value.suggested_filename)
    assert "0 errors" in programs.call("check", cell / "three.seq")
    print(programs.call("check", cell / "three.seq"))
    said = programs.call("run", cell / "three.seq", "--sim")
    assert "3 steps" in said, said
    done = subprocess.run(
        [sys.executable, cell / "three.py", "--sim"],
        env=programs.env,
        check=False,
        capture_output=True,
        text=True,
        timeout=END_TIME,
    )
    assert done.returncode == 0, done.stderr
