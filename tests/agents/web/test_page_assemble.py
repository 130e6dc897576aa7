"""The page in a browser: a job is assembled from modules; no agent is needed."""

from __future__ import annotations

import shutil
from pathlib import Path

import pytest
from page_kit import PageServer, Programs, chromium, keep_picture, opened

PUMA = Path(__file__).parents[3] / "examples" / "puma"
pytestmark = pytest.mark.timeout(300)


@pytest.fixture(scope="module")
def programs():
    programs = Programs()
    yield programs
    programs.close()


@pytest.fixture(scope="module")
def browser():
    with chromium() as browser:
        yield browser


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


@pytest.fixture
def edited(browser, server, folder, request):
    """The page with a job of the test's own: that of the PUMA, and its file."""
    name = request.node.name.removeprefix("test_")[:20]
    file = folder / f"{name}.job"
    text = (PUMA / "puma.job").read_text()
    for old, new in getattr(request, "param", ()):
        text = text.replace(old, new)
    file.write_text(text)
    with opened(browser, server.link(), ready=".modes") as page:
        page.on("dialog", lambda dialog: dialog.accept())
        page.get_by_role("button", name="Assemble").click()
        page.get_by_role("combobox", name="job", exact=True).select_option(name)
        page.locator(".canvas .card").nth(2).wait_for()
        page.locator(".unsaved:text-is('all is saved')").wait_for()
        yield page, file


WITHOUT_QRDIFF = [("TASK  qrdiff     arm1\n", ""), ("jttrace qrdiff", "jttrace")]


def port(page, task, name):
    """Return a port on the canvas."""
    return page.locator(f".draft [data-task='{task}'][data-port='{name}']")


def drag(page, task, name, *, to):
    """Drag from the end of a port to another place; the mouse stays down there."""
    side = "left" if port(page, task, name).locator("xpath=../..//ul[1]").count() else ""
    assert side
    row = port(page, task, name).bounding_box()
    card = port(page, task, name).locator("xpath=ancestor::article").bounding_box()
    left = row["x"] < card["x"] + card["width"] / 3
    x = card["x"] if left else card["x"] + card["width"]
    page.mouse.move(x, row["y"] + row["height"] / 2)
    page.mouse.down()
    page.mouse.move(x + 25, row["y"] + 25, steps=3)
    page.locator(".ports li.fits").first.wait_for()
    there = to.bounding_box()
    page.mouse.move(
        there["x"] + there["width"] / 2, there["y"] + there["height"] / 2, steps=4
    )


def save(page):
    """Save by the page; wait until all is."""
    page.locator("#assemble-Save").click()
    page.get_by_role("button", name="save", exact=False).last.click()
    page.locator(".unsaved:text-is('all is saved')").wait_for()


@pytest.mark.parametrize("edited", [WITHOUT_QRDIFF], indirect=True)
def test_drag(edited, programs):
    page, file = edited
    assert "no task that is ON writes Q^_REF" in page.locator(".draft .note").inner_text()
    page.get_by_role("searchbox").fill("differentiates")
    module = page.locator(".module[aria-label='module qrdiff']")
    module.drag_to(page.locator(".frame", has_text="arm1").locator("header"))
    page.locator("button.flag.legal").wait_for()
    assert port(page, "qrdiff", "Z").inner_text() == "Q_REF"
    assert page.locator(".canvas .card").count() == 4
    keep_picture(page, "assemble")
    save(page)
    assert "TASK  qrdiff arm1" in file.read_text().replace("      ", "  ")
    assert "legal" in programs.call("check", file)
