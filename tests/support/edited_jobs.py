"""Folders with files of a subsystem, to be edited by tests."""

from __future__ import annotations

import shutil
from pathlib import Path

import pytest

PUMA = Path(__file__).parents[2] / "examples" / "puma"
TASKS = (
    ("puma_pidg", "arm0"),
    ("grav_comp", "arm1"),
    ("qrdiff", "arm1"),
    ("jttrace", "arm1"),
)
"""The tasks of the PUMA job, and their RTPUs."""


def puma_files(folder: Path) -> Path:
    """Copy the files of the PUMA example; return its job."""
    folder.mkdir(parents=True, exist_ok=True)
    for name in ("puma.job", "puma.sbs", "puma.svar"):
        shutil.copy(PUMA / name, folder)
    return folder / "puma.job"


def content(folder: Path) -> dict[str, bytes]:
    """Return what all files of a folder hold."""
    return {path.name: path.read_bytes() for path in sorted(folder.iterdir())}


@pytest.fixture
def puma(tmp_path: Path) -> Path:
    """The PUMA job in a folder of its own."""
    return puma_files(tmp_path / "puma")
