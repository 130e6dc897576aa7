"""The page in a browser: a job is assembled from modules; no agent is needed."""

from __future__ import annotations

import re
import shutil
from pathlib import Path

import pytest
from page_kit import PageServer, keep_picture, opened
from watching import wait_for

PUMA = Path(__file__).parents[3] / "examples" / "puma"
WITHOUT_QRDIFF = (("TASK  qrdiff     arm1\n", ""), ("jttrace qrdiff", "jttrace"))
pytestmark = pytest.mark.timeout(300)


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    """The PUMA's files."""
    folder = tmp_path_factory.mktemp("puma")
    for name in ("puma.sbs", "puma.svar", "puma.job"):
        shutil.copy(PUMA / name, folder / name)
    return folder


@pytest.fixture(scope="module")
def server(programs, browser, folder):  # noqa: ARG001 - skips before it starts
    return PageServer(programs, folder / "puma.job")


@pytest.fixture(scope="module")
def opened_page(browser, server):
    """The page while jobs are assembled."""
    with opened(browser, server.link()) as page:
        page.on("dialog", lambda dialog: dialog.accept())
        page.get_by_role("button", name="Assemble").click()
        page.locator(".canvas .card").first.wait_for()
        yield page


@pytest.fixture
def assembling(opened_page, folder):
    """The page, in whose folder is nothing that another test has saved."""
    yield opened_page
    for path in folder.glob("*.rmod"):
        path.unlink()
    shutil.copy(PUMA / "puma.svar", folder)


def begin(page, folder, name, changes=()):
    """Open a job like that of the PUMA; return its file."""
    text = (PUMA / "puma.job").read_text()
    for old, new in changes:
        assert old in text
        text = text.replace(old, new)
    file = folder / f"{name}.job"
    file.write_text(text)
    page.get_by_label("name of a new job").fill(name)
    page.get_by_role("button", name="begin").click()
    page.locator(f"select:has(option:checked:text-is('{name}'))").wait_for()
    return file


def port(page, task, name):
    """Return a port on the canvas."""
    return page.locator(f".draft [data-task='{task}'][data-port='{name}']")


def drag(page, task, end, to):
    """Drag from an end of wires to a place; the mouse button stays down there."""
    handle = page.locator(f"[data-nodeid='task {task}'][data-handleid='{end}']")
    page.mouse.move(*middle(handle))
    page.mouse.down()
    page.mouse.move(*middle(to), steps=6)
    page.locator(".ports li.fits").first.wait_for()
    x, y = middle(to)
    page.mouse.move(x + 2, y + 2, steps=2)


def middle(place):
    """Return the middle of a place on the page."""
    box = place.bounding_box()
    return box["x"] + box["width"] / 2, box["y"] + box["height"] / 2


def lit(page):
    """Return the ports that are lit."""
    found = page.locator(".ports li.fits")
    return {
        (one.get_attribute("data-task"), one.get_attribute("data-port"))
        for one in found.all()
    }


def save(page):
    """Save by the page; return what it showed before, and wait until all is."""
    page.locator("#assemble-Save").click()
    button = page.get_by_role("button", name=re.compile(r"save (one|\d+) file"))
    button.wait_for()
    shown = page.locator(".diff").all_inner_texts()
    button.click()
    page.locator(".unsaved:text-is('all is saved')").wait_for()
    return "\n".join(shown)


def test_a_module_is_dragged_onto_an_rtpu_and_wired_by_its_names(
    assembling, folder, programs
):
    page = assembling
    file = begin(page, folder, "dragged", WITHOUT_QRDIFF)
    note = page.locator(".draft .note", has_text="no task")
    assert "writes Q^_REF, which puma_pidg reads" in note.inner_text()
    page.get_by_role("searchbox").fill("qrdiff")
    module = page.get_by_label("module qrdiff", exact=True)
    module.drag_to(page.locator(".frame header", has_text="arm1"))
    page.locator("button.flag.legal").wait_for()
    assert port(page, "qrdiff", "Z").inner_text() == "Q_REF"
    assert page.get_by_role("combobox", name="RTPU").input_value() == "arm1"
    keep_picture(page, "assemble")
    assert re.search(r"\+TASK +qrdiff +arm1", save(page))
    assert programs.call("check", file).endswith(": legal\n")


def test_only_ports_that_fit_light_up_and_a_refusal_is_said_there(assembling, folder):
    page = assembling
    begin(page, folder, "wired")
    drag(page, "jttrace", "out:Q_REF", port(page, "puma_pidg", "T_GRAV"))
    assert lit(page) == {
        ("puma_pidg", "Q_REF"),
        ("grav_comp", "Q_MEZ"),
        ("qrdiff", "Z"),
    }
    reason = port(page, "puma_pidg", "T_GRAV").get_attribute("title")
    assert reason == "units differ: N*m and rad"
    assert reason in page.locator(".connection").inner_text()
    keep_picture(page, "assemble_fits")
    page.mouse.up()
    assert reason in page.locator(".canvas .refusal").inner_text()
    assert page.locator(".unsaved").inner_text() == "all is saved"

    drag(page, "puma_pidg", "out:Q_MEZ", port(page, "qrdiff", "Z"))
    page.mouse.up()
    own = port(page, "qrdiff_2", "Z")  # a copy, because other jobs use qrdiff
    own.locator("text=Q_MEZ").wait_for()
    page.keyboard.press("Control+z")
    port(page, "qrdiff", "Z").locator("text=Q_REF").wait_for()
    page.keyboard.press("Control+Shift+z")
    own.locator("text=Q_MEZ").wait_for()
    page.get_by_role("button", name="undo").click()
    page.locator(".unsaved:text-is('all is saved')").wait_for()


def test_a_second_writer_is_joined_by_an_offer_and_check_agrees(
    assembling, folder, programs
):
    page = assembling
    file = begin(page, folder, "joined")
    page.get_by_role("searchbox").fill("qrdiff")
    page.get_by_label("module qrdiff", exact=True).press("Enter")
    page.locator("button.flag.illegal:text-is('✕ one fault')").wait_for()
    assert port(page, "qrdiff_2", "Z^").get_by_label("fault", exact=True).count() == 1
    page.locator(".draft .note").first.click()
    keep_picture(page, "assemble_fault")
    page.get_by_role("button", name="by join_average into Q^_REF").click()
    page.locator("button.flag.legal").wait_for()
    assert page.locator(".canvas .card").count() == 6
    keep_picture(page, "assemble_joined")
    shown = save(page)
    assert "+NAME      Q^_REF''" in shown
    assert re.search(r"\+TASK +join_Q__REF_1", shown)
    assert programs.call("check", file).endswith(": legal\n")


def test_a_job_that_was_not_changed_is_saved_without_a_byte_of_difference(
    assembling, folder
):
    page = assembling
    begin(page, folder, "kept")
    before = {path: path.read_bytes() for path in folder.iterdir()}
    page.locator("#assemble-Save").click()
    page.locator("text=Nothing: the files are as this page shows them.").wait_for()
    page.locator(".canvas .card", has_text="jttrace").locator(".kind").click()
    rate = page.get_by_label("FREQ")
    rate.fill("40")
    rate.press("Enter")
    page.locator(".unsaved:text-is('not saved: kept.job')").wait_for()
    asked = []
    page.on("dialog", lambda dialog: asked.append(dialog.type))
    page.reload()
    assert asked == ["beforeunload"]
    page.get_by_role("button", name="Assemble").click()
    page.locator(".unsaved:text-is('not saved: kept.job')").wait_for()
    page.get_by_role("button", name="undo").click()
    page.locator("#assemble-Save").click()
    page.locator("text=Nothing: the files are as this page shows them.").wait_for()
    assert page.get_by_role("button", name="save", exact=True).is_disabled()
    assert {path: path.read_bytes() for path in folder.iterdir()} == before


def test_forms_the_keyboard_and_a_simulated_run(assembling, folder):
    page = assembling
    begin(page, folder, "formed")
    port(page, "qrdiff", "Z").get_by_role("button").press("Enter")
    choose = page.get_by_role("button", name="Q_MEZ of puma_pidg", exact=True)
    choose.press("Enter")
    port(page, "qrdiff_2", "Z").locator("text=Q_MEZ").wait_for()
    page.get_by_role("button", name="undo").press("Enter")

    page.locator(".canvas .card", has_text="puma_pidg").locator(".kind").click()
    page.get_by_text("More settings").click()
    safe = page.get_by_role("combobox", name="SAFE", exact=True)
    safe.fill("deadline late")
    safe.press("Enter")
    page.locator("[role=alert]", has_text="'late' is not a timing failure").wait_for()
    safe.fill("deadline")
    safe.press("Enter")
    nothing = "has nothing to write at SAFE deadline"
    page.locator(".side .fault-card", has_text=nothing).wait_for()
    page.get_by_role("button", name="undo").click()
    page.locator(".side .fault-card", has_text=nothing).wait_for(state="detached")
    follow = page.get_by_role("textbox", name="follow")
    follow.fill("fast")
    follow.press("Enter")
    wrong = "a value of parameter follow is not a float"
    page.locator(".draft .note", has_text=wrong).wait_for()
    assert wrong in page.locator(".side .fault-card").inner_text()
    keep_picture(page, "assemble_forms")
    page.locator("#assemble-Simulate").click()
    page.get_by_label("seconds").fill("0.5")
    simulate = page.get_by_role("button", name="simulate", exact=True)
    simulate.click()
    page.locator(".problem", has_text=wrong).wait_for()
    page.get_by_role("button", name="undo").click()
    page.locator("button.flag.legal").wait_for()
    simulate.click()
    page.locator(".run-chart canvas").first.wait_for()
    cycles = page.locator("tr", has_text="puma_pidg").locator("td").nth(2)
    assert cycles.inner_text() == "250"
    keep_picture(page, "assemble_simulated")


def test_a_second_browser_is_told_what_the_first_one_did(
    assembling, browser, server, folder
):
    page = assembling
    begin(page, folder, "shared")
    with opened(browser, server.link()) as other:
        other.get_by_role("button", name="Assemble").click()
        other.locator(".canvas .card").nth(3).wait_for()
        page.locator(".canvas .card", has_text="jttrace").locator(".kind").click()
        rate = page.get_by_label("FREQ")
        rate.fill("40")
        rate.press("Enter")
        said = other.locator(".elsewhere", has_text="Another browser changed the job:")
        said.wait_for()
        keep_picture(other, "assemble_shared")
        assert page.locator(".elsewhere").count() == 0
        other.get_by_role("button", name="undo").click()
        page.locator(".elsewhere", has_text="Another browser took back:").wait_for()
        said.wait_for(state="detached")


def test_tasks_and_wires_are_drawn_by_touch(browser, server, assembling, folder):
    begin(assembling, folder, "touched")
    size = {"width": 1180, "height": 820}
    with opened(browser, server.link(), has_touch=True, viewport=size) as page:
        page.get_by_role("button", name="Assemble").tap()
        page.locator(".canvas .card").nth(3).wait_for()
        touch = page.context.new_cdp_session(page)

        def drag_by_touch(begin, end):
            points = [
                (
                    begin[0] + (end[0] - begin[0]) * k / 6,
                    begin[1] + (end[1] - begin[1]) * k / 6,
                )
                for k in range(7)
            ]
            for k, (x, y) in enumerate(points):
                kind = "touchMove" if k else "touchStart"
                where = {"type": kind, "touchPoints": [{"x": x, "y": y}]}
                touch.send("Input.dispatchTouchEvent", where)
            touch.send(
                "Input.dispatchTouchEvent", {"type": "touchEnd", "touchPoints": []}
            )

        head = page.locator(".canvas .card", has_text="grav_comp").locator(".name")
        before = middle(head)
        drag_by_touch(before, (before[0] + 40, before[1] + 30))
        wait_for(lambda: middle(head)[0] > before[0] + 20, "the card has moved")
        handle = "[data-nodeid='task puma_pidg'][data-handleid='out:Q_MEZ']"
        drag_by_touch(middle(page.locator(handle)), middle(port(page, "qrdiff", "Z")))
        port(page, "qrdiff_2", "Z").locator("text=Q_MEZ").wait_for()
        page.get_by_role("button", name="undo").click()
        page.locator(".unsaved:text-is('all is saved')").wait_for()
