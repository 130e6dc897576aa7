"""What a run of pytest shows of a refusal: the user's own line, and what to do."""

import subprocess
import sys

import pytest
from log_of_python_tasks import Shop

TESTS = """
from typing import Annotated as A

from pbonet import Params, param
from pbonet.testing import replay

pytest_plugins = ["pbonet.testing.fixtures"]


class Gains(Params):
    kp: A[float, param("N/rad", "stiffness", ge=0)] = 1.0


def test_out_of_bounds():
    Gains(kp=-3.0)


def test_mistyped():
    Gains(kp="high")


def test_unknown():
    Gains(kq=1.0)


def test_run():
    replay("run.mcap", "a")


def test_run_beside_the_test(replayed):
    replayed("run.mcap", "a")
"""
SHOWN = {
    "out_of_bounds": ("Gains(kp=-3.0)", "got -3); choose a value within the bounds"),
    "mistyped": ('Gains(kp="high")', "got 'high'); give a value of that type"),
    "unknown": ("Gains(kq=1.0)", "one of kp); name one of these, or remove it"),
    "run": ('replay("run.mcap", "a")', "correct the module, or record a new log"),
    "run_beside_the_test": ('replayed("run.mcap", "a")', "adds.py has changed: "),
}


@pytest.fixture
def folder(tmp_path):
    """Return a folder with a log, and its module, which has been changed since."""
    shop = Shop(tmp_path)
    try:
        shop.cycles(4)
        shop.log().rename(tmp_path / "run.mcap")
    finally:
        shop.close()
    return tmp_path


def test_the_last_lines_are_the_user_s_own_and_the_remedy(folder) -> None:
    module = folder / "adds.py"
    module.write_text(module.read_text().replace("dt / 3.0", "dt / 3.5"))
    (folder / "test_own.py").write_text(TESTS)
    command = (
        sys.executable,
        "-m",
        "pytest",
        "-c",
        "/dev/null",
        "-p",
        "no:cacheprovider",
    )
    done = subprocess.run(
        [*command, "--rootdir", ".", "test_own.py"],
        cwd=folder,
        capture_output=True,
        text=True,
        check=False,
    )
    for name, (line, remedy) in SHOWN.items():
        shown = done.stdout.split(f" test_{name} ___")[1].split("\n____")[0]
        marked = [one for one in shown.splitlines() if one.startswith(("> ", "E "))]
        assert marked[-2:-1] == [f">       {line}"], shown
        assert remedy in marked[-1], shown
        assert "pbonet/" not in shown.split(marked[-2])[1].replace(marked[-1], ""), (
            shown
        )
