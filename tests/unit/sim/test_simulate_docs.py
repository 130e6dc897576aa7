"""The page on analysis: its example runs, its figures can be drawn, its links hold."""

import importlib.util
import re
from pathlib import Path
from types import ModuleType
from xml.etree import ElementTree

import pytest
from verify_parts import with_server

from pbonet.analysis import legality

DOCS = Path(__file__).resolve().parents[3] / "docs"
PAGE = (DOCS / "analysis.md").read_text()


@pytest.fixture
def figures() -> ModuleType:
    pytest.importorskip("matplotlib")
    spec = importlib.util.spec_from_file_location("figures", DOCS / "figures.py")
    assert spec is not None
    assert spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


def test_the_example_of_the_page_runs(capsys: pytest.CaptureFixture[str]) -> None:
    (code,) = re.findall(r"```python\n(.*?)```", PAGE, re.DOTALL)
    exec(compile(code, "analysis.md", "exec"), {})  # noqa: S102 - our own page
    assert capsys.readouterr().out.startswith("t1 ██···")


@pytest.mark.slow
def test_every_figure_of_the_page_is_drawn(figures, tmp_path) -> None:
    """And none for nothing; twice the same file."""
    shown = set(re.findall(r"\(_generated/(.*?)\)", PAGE))
    figures.draw(tmp_path)
    assert {path.name for path in tmp_path.iterdir()} == shown
    for path in tmp_path.iterdir():
        root = ElementTree.parse(path).getroot()  # noqa: S314 - our own
        assert root.tag == "{http://www.w3.org/2000/svg}svg"
    first = (tmp_path / "figure-6-7.svg").read_text()
    figures.figure_6_7(tmp_path)
    assert (tmp_path / "figure-6-7.svg").read_text() == first


def test_the_report_on_the_page_is_what_the_code_says() -> None:
    config = with_server()
    shown = re.findall(r"```text\n(.*?)```", PAGE, re.DOTALL)[0].splitlines()
    text = legality.report_text(legality.report(config)).splitlines()
    assert shown == [line for line in text if not line.startswith("  idle")]
