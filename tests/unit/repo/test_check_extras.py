"""What the script that installs the extras says about what it has compared."""

from __future__ import annotations

import importlib.util
from pathlib import Path

import pytest

PATH = Path(__file__).parents[3] / "scripts" / "check_extras.py"


@pytest.fixture(scope="module")
def script():
    spec = importlib.util.spec_from_file_location("check_extras", PATH)
    made = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(made)
    return made


ONE = ("4.0.0", {"FkJac.x": [1.0, 2.0], "Gravity.t": [3.0]})
SAME = ("3.8.0", {"FkJac.x": [1.0, 2.0 + 1e-12], "Gravity.t": [3.0]})
OTHER = ("3.7.0", {"FkJac.x": [1.0, 2.1], "Gravity.t": [3.0]})


@pytest.mark.parametrize(
    ("given", "said"),
    [
        ([], "nothing was compared: no extra that was installed brings pinocchio"),
        ([ONE], "nothing was compared: pinocchio 4.0.0 alone was installed"),
        ([ONE, SAME], "2 outputs of modules agree with pinocchio 4.0.0 and 3.8.0"),
    ],
)
def test_it_says_what_was_compared(script, given, said):
    assert script.differences(given) == []
    assert script.agreement(given).startswith(said)


def test_it_names_what_differs(script):
    assert script.differences([ONE, SAME, OTHER]) == [
        "FkJac.x differs between pinocchio 4.0.0 and 3.7.0"
    ]
