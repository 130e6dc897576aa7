"""The protocol's model under reordered stores and loads, checked exhaustively by spin.

The model must hold, and must fail for every fence or check that is taken out: a model
that cannot fail proves nothing.
"""

import os
import re
import shutil
import subprocess

import pytest
from svar_rig import NATIVE, compiler

PARTS = ("REGISTER", "CUT", "OWNER")
MUTATIONS = {
    "REGISTER": {
        "NO_R1": "no fence between publishing a commit and writing the next",
        "NO_R2": "a commit published before all of it has arrived",
        "NO_R3": "words loaded before the head that names their slot",
        "NO_R4": "second look made before the words were loaded",
        "NO_LOOK": "no second look",
        "KEEP_MORE": "a promise to keep one commit more than there are slots for",
        "ONE_MOVE": "to and fro between two slots in spite of a promise",
    },
    "CUT": {
        "NO_R3": "a first look as late as the other register's second one",
        "LOOK_EACH": "register after register instead of all first looks first",
        "WHOLE_ENOUGH": "whole groups taken for a consistent cut",
    },
    "OWNER": {
        "NO_O1": "a register used again before all see that it was freed",
        "NO_R2": "a directory published before all of it has arrived",
        "NO_C1": "entries used before it is known that they belong together",
        "NO_C4": "generation not looked at again",
        "IN_PLACE": "the present directory changed instead of a copy",
    },
}
NO_SPIN = shutil.which("spin") is None


@pytest.fixture(autouse=True)
def _spin():
    """Skip without spin, but not where CI says that it must be there."""
    if NO_SPIN and not os.environ.get("CI"):
        pytest.skip("spin is not installed (apt install spin)")


def check(folder, *defines: str, optimize: str = "-O0") -> tuple[int, int]:
    """Return the number of errors and of states of the model built with `defines`.

    A mutation is found early, so there compiling takes longer than checking.
    """
    flags = [f"-D{name}" for name in defines]
    subprocess.run(
        ["spin", *flags, "-a", str(NATIVE / "svar.pml")],
        cwd=folder,
        check=True,
        capture_output=True,
    )
    pan = [
        optimize,
        "-w",
        "-DSAFETY",
        "-DNOCLAIM",
        "-DMEMLIM=1024",
        "-o",
        "pan",
        "pan.c",
    ]
    subprocess.run([compiler(), *pan], cwd=folder, check=True, capture_output=True)
    done = subprocess.run(
        ["./pan", "-m200000", "-E"],
        cwd=folder,
        check=False,
        capture_output=True,
        text=True,
    )
    errors = re.search(r"errors: (\d+)", done.stdout)
    states = re.search(r"(\d+) states, stored", done.stdout)
    assert errors, done.stdout + done.stderr
    assert states
    assert "Search not completed" not in done.stdout or int(errors[1])
    assert "max search depth too small" not in done.stdout
    return int(errors[1]), int(states[1])


@pytest.mark.parametrize("part", PARTS)
def test_the_protocol_holds(part, tmp_path):
    errors, states = check(tmp_path, part, optimize="-O2")
    assert errors == 0
    assert states > 10_000, "the model does move"


@pytest.mark.parametrize(
    ("part", "mutation"), [(part, name) for part in PARTS for name in MUTATIONS[part]]
)
def test_the_protocol_needs_every_fence_and_check(part, mutation, tmp_path):
    errors, _ = check(tmp_path, part, mutation)
    assert errors > 0, MUTATIONS[part][mutation]


def test_every_mutation_of_the_model_is_tried():
    text = (NATIVE / "svar.pml").read_text()
    known = {name for names in MUTATIONS.values() for name in names}
    for name in re.findall(r"#ifn?def (\w+) /\* mutations?:", text):
        assert name in known
    for name in known:
        assert re.search(rf"#ifn?def {name}\b", text)
