"""The page on architecture: the files that it names exist, its figure is up to date."""

import re
import runpy
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[3]
DOCS = ROOT / "docs"
PAGE = (DOCS / "architecture.md").read_text(encoding="utf-8")
NAMED = sorted(set(re.findall(r"`((?:pbonet|docs)/[\w/.]+)`", PAGE)))


@pytest.mark.parametrize("name", NAMED)
def test_a_file_that_it_names_exists(name):
    assert (ROOT / name).exists()


def test_every_room_is_listed():
    table = PAGE[PAGE.index("## The rooms") :]
    rooms = [
        face.parent.relative_to(ROOT).as_posix()
        for face in (ROOT / "pbonet").rglob("__init__.py")
        if len(list(face.parent.glob("*.py"))) > 1
        and face.parents[1].name not in {"cli", "modules"}
    ]
    listed = set(re.findall(r"`(pbonet/[\w/]+)`", table))
    assert set(rooms) - {"pbonet", "pbonet/svar/pure"} <= listed


def test_the_figure_is_what_the_script_draws():
    draw = runpy.run_path(str(DOCS / "draw_architecture.py"))
    assert (DOCS / "architecture.svg").read_text(encoding="utf-8") == draw["figure"]()
