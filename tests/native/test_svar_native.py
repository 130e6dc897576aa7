"""The C headers of the table: full-speed torture, sanitizers, mutants.

The torture meets what it happens to meet. The sweep puts commits at every step of a
read and reads at every step of a commit, one case after the other. The mutants show
that it can fail: each lacks one check, and must be caught.
"""

import itertools
import re
import subprocess
from typing import NamedTuple

import pytest
from svar_rig import build, compiler, mutant, run

SIZES = (6, 32, 256)
ACCESS = re.compile(r"\s+(Previous )?(atomic )?(read|write) of size ", re.IGNORECASE)
"""The line of ThreadSanitizer above where a thread read or wrote."""


def judge(found: dict[str, int], reads: int = 1000) -> None:
    assert found["torn"] == 0
    assert found["false_cuts"] == 0
    assert found["bad_ends"] == 0
    assert found["least"] > 0, "everybody made progress"
    assert found["claims"] > 0
    assert found["reads"] > reads


@pytest.fixture(scope="module")
def torture(tmp_path_factory):
    return build("svar_torture.c", tmp_path_factory.mktemp("torture") / "torture")


@pytest.mark.parametrize("words", SIZES)
def test_two_writers_two_readers_and_two_hundred_kills(torture, words):
    found = run(torture, "processes", words, 1.0, 200 if words == 32 else 70)
    judge(found)
    assert found["lost"] == 0


@pytest.mark.parametrize("words", [6, 256])
def test_the_same_when_everybody_dawdles_between_steps(words, tmp_path):
    program = build("svar_torture.c", tmp_path / "jitter", "-DJITTER")
    judge(run(program, "processes", words, 1.0, 50), reads=100)


class Mutant(NamedTuple):
    header: str
    right: str
    wrong: str
    symptom: str


ACCEPT = "if (same && whole) return PB_CONSISTENT;"
MUTANTS = {
    "no second look": Mutant(
        "cut.h", ACCEPT, "(void)same; (void)whole; return PB_CONSISTENT;", "torn"
    ),
    "whole is enough": Mutant(
        "cut.h", ACCEPT, "(void)same; if (whole) return PB_CONSISTENT;", "false_cuts"
    ),
    "the first need not stand still": Mutant(
        "cut.h", "i + 1 == p->n_sources", "i == 0", "false_cuts"
    ),
    "the last need not be whole": Mutant(
        "cut.h", ACCEPT, "if (same) return PB_CONSISTENT;", "torn"
    ),
    "one slot": Mutant(
        "register.h", "slots + head % PB_SLOTS", "slots + head % 1", "torn"
    ),
}


def test_every_step_of_a_read_and_of_a_commit_may_be_met(tmp_path):
    found = run(build("svar_sweep.c", tmp_path / "sweep"))
    assert (found["torn"], found["false_cuts"]) == (0, 0)
    assert found["proven"] == found["reads"] > 500


@pytest.mark.parametrize("name", MUTANTS)
def test_the_sweep_catches_a_missing_check(name, tmp_path):
    header, right, wrong, symptom = MUTANTS[name]
    headers = mutant(tmp_path, header, right, wrong)
    program = build("svar_sweep.c", tmp_path / "mutant", headers=headers)
    assert run(program)[symptom] > 0


@pytest.mark.parametrize("words", [6, 256])
def test_thread_sanitizer_is_silent_but_for_the_one_copy(words, tmp_path):
    flags = ("-g", "-fsanitize=thread", "-fno-sanitize-recover=all")
    program = build("svar_torture.c", tmp_path / "tsan", *flags, cc=compiler("clang"))
    judge(run(program, "threads", words, 1.0))


def test_the_exemption_is_needed_and_covers_one_function(tmp_path):
    headers = mutant(tmp_path, "register.h", "no_sanitize_thread, noinline", "noinline")
    flags = ("-g", "-fsanitize=thread")
    program = build(
        "svar_torture.c",
        tmp_path / "tsan",
        *flags,
        cc=compiler("clang"),
        headers=headers,
    )
    done = subprocess.run(
        [str(program), "threads", "6", "0.5"],
        capture_output=True,
        text=True,
        check=False,
    )
    lines = done.stderr.splitlines()
    accesses = [
        below for line, below in itertools.pairwise(lines) if ACCESS.match(line)
    ]
    assert "data race" in done.stderr
    assert accesses
    assert all(" pb_copy " in top for top in accesses)


def test_address_and_undefined_sanitizers_are_silent(tmp_path):
    flags = ("-g", "-fsanitize=address,undefined", "-fno-sanitize-recover=all")
    program = build("svar_torture.c", tmp_path / "asan", *flags, cc=compiler("clang"))
    judge(run(program, "processes", 32, 1.0, 20))
