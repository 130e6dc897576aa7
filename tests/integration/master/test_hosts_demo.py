"""The example of two hosts as a user runs it: ``make hosts-demo``."""

import re
import subprocess
import sys
from itertools import pairwise
from pathlib import Path

import pytest

from pbonet.testing.lan import missing

ROOT = Path(__file__).resolve().parents[3]
DEMO = ROOT / "examples" / "two_hosts" / "demo.py"
AGE = re.compile(r"^ *\d+\.\d+ +(\d+) ")
"""Of the target, behind the time at which it was looked at."""


def left():
    """Return what the demonstration would leave if it cleaned up badly."""
    spaces = subprocess.run(["ip", "netns"], capture_output=True, text=True, check=True)
    folders = (Path("/tmp"), Path("/dev/shm"))  # noqa: S108 - where they would be
    names = {path.name for one in folders for path in one.glob("pbonet-host-?-*")}
    return set(spaces.stdout.split()) | names


def demo():
    return subprocess.run(
        [sys.executable, DEMO], capture_output=True, text=True, check=False
    )


@pytest.mark.slow
def test_link_is_cut_and_heals_by_itself():
    if why := missing():
        pytest.skip(why)
    before = left()
    for _ in range(4):
        done = demo()
        if not done.returncode or "can be reached" not in done.stderr:
            break  # else links were lost in a standstill while its master began
    assert done.returncode == 0, done.stdout + done.stderr
    lines = done.stdout.splitlines()
    pulled = lines.index("-- the cable between a and b is pulled")
    plugged = lines.index("-- and plugged in again")
    ages = [
        float(age) for age in map(AGE.findall, lines[pulled:plugged]) for age in age
    ]
    falls = [one for one, then in pairwise(ages) if then < one]
    assert len(falls) <= 1  # what was under way came, and nothing behind it
    assert ages[-1] > 1000
    assert any("sees its target again" in line for line in lines[plugged:])
    assert left() == before
