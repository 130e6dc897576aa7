"""Decisions: each is in the index by topic, and each that is named is there."""

from __future__ import annotations

import re
from pathlib import Path

ROOT = Path(__file__).resolve().parents[3]
FOLDER = ROOT / "docs" / "decisions"
PAGES = {path.name[:4]: path for path in FOLDER.glob("[0-9]*.md")}
NAMED = re.compile(r"decisions?\s+(?:#\s*)?((?:0\d{3}(?:,? and |, )?)+)")


def test_every_decision_is_in_the_index_once():
    listed = re.findall(r"\[(\d{4})\]\(([^)]+)\)", (FOLDER / "README.md").read_text())
    assert sorted(number for number, _ in listed) == sorted(PAGES)
    assert all(PAGES[number].name == name for number, name in listed)


def test_every_decision_that_is_named_is_there():
    named = {
        number
        for folder in ("pbonet", "docs", "tests", "benchmarks", "examples")
        for path in (ROOT / folder).rglob("*")
        if path.suffix in {".py", ".pyi", ".pyx", ".pxi", ".h", ".md"}
        for found in NAMED.findall(path.read_text())
        for number in re.findall(r"\d{4}", found)
    }
    assert len(named) > 20
    assert named <= set(PAGES)
