"""The page of a recorded run in a browser: it answers why."""

from __future__ import annotations

from pathlib import Path

import pytest
from page_kit import PageServer, keep_picture, opened

PUMA = Path(__file__).parents[3] / "examples" / "puma" / "puma.job"
pytestmark = pytest.mark.timeout(300)


@pytest.fixture(scope="module")
def recorded(programs, browser, tmp_path_factory):  # noqa: ARG001 - skips before it runs
    """The folder of a simulated run."""
    runs = tmp_path_factory.mktemp("runs")
    programs.call("run", PUMA, "--sim", "--seconds", "2", "--runs", runs)
    (run,) = runs.iterdir()
    return run


def test_why_explains_the_whole_run_as_the_command_line_does(
    programs, browser, recorded
):
    server = PageServer(programs, recorded)
    with opened(browser, server.link("observer")) as page:
        assert page.locator(".badge", has_text="recorded run").count() == 1
        page.locator(".card .name:text-is('puma_pidg')").click()
        page.locator("#tab-Task").click()
        why = page.get_by_label("explain puma_pidg")
        assert "Of the whole run, not of this time." in why.get_attribute("title")
        why.click()
        said = page.locator("#panel").get_by_text("nothing is wrong: it was ON since")
        said.wait_for()
        shown = " ".join(said.inner_text().split())
        for line in programs.call("explain", recorded, "puma_pidg").splitlines():
            assert " ".join(line.split()) in shown
        keep_picture(page, "recorded_why")
        assert page.get_by_role("button", name="off").count() == 0, "it has no orders"
