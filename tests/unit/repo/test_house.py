"""The rules of the house: what a folder may hold, and how rooms use each other."""

from __future__ import annotations

import importlib.util
import subprocess
import sys
from pathlib import Path

import pytest

import pbonet

ROOT = Path(__file__).resolve().parents[3]
spec = importlib.util.spec_from_file_location("house", ROOT / "scripts" / "house.py")
assert spec is not None
assert spec.loader is not None
house = importlib.util.module_from_spec(spec)
sys.modules["house"] = house
spec.loader.exec_module(house)


@pytest.fixture(scope="module")
def ours():
    return house.House(ROOT)


@pytest.fixture
def planted(tmp_path):
    """A tree in which each rule is broken once."""
    files = {
        "__init__.py": "",
        "a/__init__.py": "",
        "a/__init__.pyi": "from .one import One as One\n",
        "a/one.py": "from pbonet.b import Two\nclass One: ...\n",
        "a/inner.py": "class Inner: ...\n",
        "b/__init__.py": "",
        "b/__init__.pyi": "from .two import Two as Two\n",
        "b/two.py": "from pbonet.a.inner import Inner\nfrom pbonet.a import One\n",
        "c/__init__.py": "",
        "c/x.py": "from . import y\n",
        "c/y.py": "def later():\n    from .x import y\n",
    }
    for name, text in files.items():
        path = tmp_path / "pbonet" / name
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_text(text)
    return house.House(tmp_path)


def test_what_breaks_a_rule_is_found(planted):
    assert planted.past_faces() == [
        "pbonet/b/two.py:1 imports pbonet.a.inner.Inner",
    ]
    assert planted.circles() == [
        ["pbonet.a.one", "pbonet.b.two"],
        ["pbonet.c.x", "pbonet.c.y"],
        ["pbonet.a", "pbonet.b"],
    ]


def test_no_room_is_used_past_its_face(ours):
    assert ours.past_faces() == []


def test_no_files_import_each_other_in_a_circle(ours):
    assert ours.circles() == []


def test_no_folder_is_too_full(ours):
    folders = ours.folders()
    assert {name: n for name, n in folders.items() if n > house.MOST_FILES} == {}


def test_every_name_of_a_face_is_there(ours):
    for room in sorted(ours.faces):
        module = importlib.import_module(room)
        for name in ours.faces[room]:
            assert hasattr(module, name), f"{room} has no {name}"


def test_a_name_that_a_face_lacks_is_no_attribute():
    with pytest.raises(AttributeError, match=r"'pbonet.xm' has no attribute 'nothing'"):
        _ = importlib.import_module("pbonet.xm").nothing
    assert not hasattr(pbonet, "nothing")


def test_import_contracts_name_every_room(ours):
    text = (ROOT / "scripts" / "rooms.toml").read_text()
    named = {line[8:-1] for line in text.splitlines() if line.startswith('room = "')}
    assert named == ours.rooms - {"pbonet"}


def test_the_script_says_how_the_house_stands():
    done = subprocess.run(
        [sys.executable, ROOT / "scripts" / "house.py"],
        capture_output=True,
        text=True,
        check=False,
    )
    assert done.returncode == 0, done.stdout
    assert "imports past a face             0" in done.stdout
