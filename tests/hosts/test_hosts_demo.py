"""The example of two hosts as a user runs it: ``make hosts-demo``."""

import subprocess
import sys
from pathlib import Path

import pytest

from pbonet.testing.lan import missing

ROOT = Path(__file__).resolve().parents[2]
DEMO = ROOT / "examples" / "two_hosts" / "demo.py"


def left():
    """Return what the demonstration would leave if it cleaned up badly."""
    spaces = subprocess.run(["ip", "netns"], capture_output=True, text=True, check=True)
    folders = (Path("/tmp"), Path("/dev/shm"))  # noqa: S108 - where they would be
    names = {path.name for one in folders for path in one.glob("pbonet-host-?-*")}
    return set(spaces.stdout.split()) | names


@pytest.mark.slow
def test_link_is_cut_and_heals_by_itself():
    if why := missing():
        pytest.skip(why)
    before = left()
    done = subprocess.run(
        [sys.executable, DEMO], capture_output=True, text=True, check=False
    )
    assert done.returncode == 0, done.stdout + done.stderr
    lines = done.stdout.splitlines()
    pulled = lines.index("-- the cable between a and b is pulled")
    plugged = lines.index("-- and plugged in again")
    ages = [float(line.split()[1]) for line in lines[pulled + 1 : plugged]]
    assert ages == sorted(ages)  # nothing came
    assert ages[-1] > 1000
    assert any("sees its target again" in line for line in lines[plugged:])
    assert left() == before
