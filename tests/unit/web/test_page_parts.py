"""The page's source: its types, and the parts of it that need no browser."""

from __future__ import annotations

import os
import shutil
import subprocess
from pathlib import Path

import pytest

WEB = Path(__file__).parents[3] / "web"


@pytest.mark.slow
def test_types_and_parts_of_the_page_are_right():
    there = (WEB / "node_modules").is_dir() and shutil.which("npm")
    if not there and not os.environ.get("CI"):
        pytest.skip("the page's packages are not installed: 'npm ci' in web/")
    done = subprocess.run(
        ["npm", "test"],
        cwd=WEB,
        check=False,
        text=True,
        stdout=subprocess.PIPE,
        stderr=subprocess.STDOUT,
    )
    assert done.returncode == 0, done.stdout
    assert "# fail 0" in done.stdout


def test_the_lock_file_names_no_registry():
    assert '"resolved"' not in (WEB / "package-lock.json").read_text("utf-8")
