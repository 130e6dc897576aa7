"""Every module of the library has what a module needs, and its page is up to date."""

from __future__ import annotations

import importlib
import re
import sys
from pathlib import Path

import numpy as np
import pytest

import pbonet.modules
from pbonet.config import Library

ROOT = Path(__file__).parents[3]
FOLDER = Path(pbonet.modules.__file__).parent
FILES = {
    path.stem: path for path in FOLDER.glob("*/*.py") if not path.name.startswith("_")
}
NAMES = sorted(FILES)
TESTS = [path.read_text() for path in Path(__file__).parent.glob("test_*.py")]


@pytest.fixture(scope="module", autouse=True)
def _docs_are_importable():
    sys.path.insert(0, str(ROOT / "docs"))
    yield
    sys.path.remove(str(ROOT / "docs"))


@pytest.fixture(scope="module")
def pages():
    return importlib.import_module("library_pages")


@pytest.fixture(scope="module")
def responses():
    return importlib.import_module("library_responses")


def test_the_pages_are_up_to_date(pages) -> None:
    old = [
        path.name
        for path, text in pages.pages().items()
        if not path.is_file() or path.read_text(encoding="utf-8") != text
    ]
    assert old == [], "run python docs/library_pages.py"


@pytest.mark.parametrize("name", NAMES)
def test_every_module_has_its_rmod(name: str) -> None:
    assert FILES[name].with_suffix(".rmod").is_file()


@pytest.mark.parametrize("name", NAMES)
def test_every_module_stands_in_the_folder_of_its_class(name: str, pages) -> None:
    kind = Library().load(name).info.module_class
    assert FILES[name].parent.name == pages.FOLDERS[kind]


@pytest.mark.parametrize("name", NAMES)
def test_every_module_has_its_section_and_its_code_in_the_pages(name: str) -> None:
    own = FILES[name].parent.name
    page = (ROOT / "docs" / "library" / f"{own}.md").read_text()
    assert f"\n## {name}\n" in page
    reference = (ROOT / "docs" / "reference" / "library.md").read_text()
    assert f".. automodule:: pbonet.modules.{own}.{name}\n" in reference
    assert f"library/{own}\n" in (ROOT / "docs" / "library.md").read_text()


@pytest.mark.parametrize("name", NAMES)
def test_every_module_is_stepped_on_a_bench(name: str) -> None:
    """Some test here imports it, or names its RMOD, and has a bench."""
    named = re.compile(rf"\b{name}\b")
    assert any(named.search(text) and "Bench" in text for text in TESTS)


def test_every_module_is_measured(pages) -> None:
    """The figures on its page are of a named machine; none is of a module that went."""
    found = pages.measured()
    missing = [name for name in NAMES if name not in found]
    assert missing == [], "run python -m benchmarks.library --grow 20000 --save NAME"
    assert sorted(found) == NAMES
    assert [one for one in NAMES if "memory" in found[one]["missed"]] == []
    assert all("cores of" in one["machine"] for one in found.values())
    for path, text in pages.pages().items():
        sections = text.split("\n## ")[1:] if path.parent.name == "library" else []
        assert all("MAXC: " in section for section in sections), path


def test_a_goal_that_is_missed_is_marked_in_the_table(pages) -> None:
    """It follows from the period, the library's call and the memory of its row."""
    library = importlib.import_module("benchmarks.library")
    found = pages.measured()
    assert {name: one["missed"] for name, one in found.items()} == {
        name: library.faults(one) for name, one in found.items()
    }
    page = pages.pages()[pages.MEASURED.with_suffix(".md")]
    rows = [line.split(" | ") for line in page.splitlines() if line.startswith("| `")]
    assert {cells[0].strip("| `"): cells[8].strip() for cells in rows} == {
        name: ", ".join(one["missed"]) for name, one in found.items()
    }
    slow = {"p50": 9.0, "p99": 201.0, "hz": 1000.0, "bare": 3.9}
    assert library.faults(slow) == ["p99", "overhead"]
    fast = {"p50": 9.0, "p99": 199.0, "hz": 1000.0, "bare": 4.1}
    assert library.faults(fast) == []


def test_laws_are_shown_as_they_are_written(pages) -> None:
    (text,) = [text for path, text in pages.pages().items() if path.stem == "signals"]
    assert "y = gain \\* z + bias." in text
    assert "![Response of diff](../_generated/response-diff.svg)" in text


def test_responses_are_those_of_the_code(responses) -> None:
    gain = responses.response(Library().load("gain"))
    steady = gain.output[-1]
    assert steady != 0.0
    assert np.allclose(gain.output[:5], 0.0)
    assert np.allclose(gain.gain, abs(steady), rtol=1e-9)
    integrated = responses.response(Library().load("integrator"))
    assert len(integrated.freq) == 0, "its answer to an impulse does not end"
    assert np.allclose(np.diff(integrated.output[5:50]), 0.01)


def test_a_picture_of_each_module_is_drawn(responses, monkeypatch, tmp_path):
    """But of those whose answer comes from a device, a link, or a person."""
    pytest.importorskip("placo", reason="pip install 'pbonet[placo]'")
    pytest.importorskip("mujoco", reason="pip install 'pbonet[mujoco]'")
    drawn: dict[str, dict[str, np.ndarray]] = {}

    def one(found, path):
        drawn[path.stem.removeprefix("response-")] = {"": found.output}

    def several(found, path):
        drawn[path.stem.removeprefix("response-")] = found.outputs

    monkeypatch.setattr(responses, "_picture", one)
    monkeypatch.setattr(responses, "_picture_of_reaction", several)
    responses.draw(tmp_path)
    assert {"diff", "pid", "otg", "ik_placo", "whole_body_dyn"} <= drawn.keys()
    rows = [row for found in drawn.values() for row in found.values()]
    assert all(np.isfinite(row).all() and np.ptp(row) > 0.0 for row in rows)
    devices = {"robot interface", "sensor", "teleoperation", "subsystem interface"}
    for name in set(NAMES) - set(drawn) - {"mppi_arm", "visual_ball", "ros_trajectory"}:
        kind = Library().load(name).info.module_class
        assert kind in devices or name in responses.QUIET, name


def test_a_picture_is_small_and_always_the_same(responses, tmp_path):
    found = responses.response(Library().load("diff"))
    picture = responses._picture
    texts = []
    for name in ("one.svg", "two.svg"):
        picture(found, tmp_path / name)
        texts.append((tmp_path / name).read_text())
    assert texts[0] == texts[1]
    assert len(texts[0]) < 100_000
