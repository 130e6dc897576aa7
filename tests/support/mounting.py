"""Small file systems for tests of full disks, with the right to mount or without it.

A test that is marked ``mounts`` runs here where this process may mount, else in name
spaces of its own where it may, and is skipped where there are none.
"""

from __future__ import annotations

import contextlib
import functools
import os
import subprocess
import sys
import tempfile
from pathlib import Path

import pytest

ENTER = ("unshare", "--user", "--map-root-user", "--mount")
ENTERED = "PBONET_TEST_ENTERED"


def _run(*command):
    return subprocess.run(command, capture_output=True, text=True, check=False)


def _mount(folder, size):
    options = ("-t", "tmpfs", "-o", f"size={size}")
    return _run("mount", *options, "none", str(folder))


@functools.cache
def refused() -> str:
    """Return why this process may not mount; nothing if it may."""
    with tempfile.TemporaryDirectory() as folder:
        made = _mount(folder, "64k")
        if made.returncode:
            return made.stderr.strip() or "it is refused"
        _run("umount", folder)
    return ""


@contextlib.contextmanager
def tmpfs(folder: Path, size: str):
    """Have a small file system at a folder that is there, where one may mount."""
    if refused():
        yield  # the test's own part runs elsewhere
        return
    made = _mount(folder, size)
    assert not made.returncode, made.stderr
    try:
        yield
    finally:
        subprocess.run(["umount", "-l", str(folder)], check=True)


def run_elsewhere(item: pytest.Item) -> None:
    """Run a test where it may mount."""
    why = refused()
    if os.environ.get(ENTERED):
        pytest.skip(f"nobody may mount, not even in a name space: {why}")
    tried = _run(*ENTER, "true")
    if tried.returncode:
        pytest.skip(f"nobody may mount: {why}; {tried.stderr.strip()}")
    plain = {k: v for k, v in os.environ.items() if not k.startswith("PYTEST_")}
    with tempfile.TemporaryDirectory() as base:  # root's own is another user's there
        options = ["-p", "no:cacheprovider", f"--basetemp={base}/t"]
        done = subprocess.run(
            [*ENTER, sys.executable, "-m", "pytest", *options, item.nodeid],
            cwd=item.config.rootpath,
            env=plain | {ENTERED: "1"},
            capture_output=True,
            text=True,
            check=False,
        )
    if "1 skipped" in done.stdout:
        pytest.skip(done.stdout.strip().splitlines()[-2])
    if done.returncode or "1 passed" not in done.stdout:
        pytest.fail(done.stdout + done.stderr)
