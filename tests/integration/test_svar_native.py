"""The C headers alone: strict compilation, full-speed torture, sanitizers, mutants.

The mutants show that the torture can fail: each lacks one check, and must be caught.
"""

import json
import subprocess
from typing import NamedTuple

import pytest
from svar_rig import HEADERS, build, compiler, mutant

SIZES = (6, 32, 256)


def run(program, *args: object) -> dict[str, int]:
    done = subprocess.run(
        [str(program), *map(str, args)],
        capture_output=True,
        text=True,
        check=False,
        timeout=50,
    )
    assert done.returncode == 0, done.stdout + done.stderr
    return json.loads(done.stdout)


def judge(found: dict[str, int]) -> None:
    assert found["torn"] == 0
    assert found["false_cuts"] == 0
    assert found["bad_ends"] == 0
    assert found["least"] > 0, "everybody made progress"
    assert found["claims"] > 0
    assert found["reads"] > 1000


@pytest.fixture(scope="module")
def torture(tmp_path_factory):
    return build("svar_torture.c", tmp_path_factory.mktemp("torture") / "torture")


@pytest.mark.parametrize("header", sorted(path.name for path in HEADERS.glob("*.h")))
@pytest.mark.parametrize("cc", ["gcc", "clang"])
def test_every_header_compiles_alone(header, cc, tmp_path):
    unit = tmp_path / "unit.c"
    unit.write_text(f'#include "{header}"\nint main(void) {{ return 0; }}\n')
    command = [compiler(cc), "-std=c11", "-Wall", "-Wextra", "-Werror", f"-I{HEADERS}"]
    done = subprocess.run(
        [*command, "-c", str(unit), "-o", str(tmp_path / "unit.o")],
        capture_output=True,
        text=True,
        check=False,
    )
    assert done.returncode == 0, done.stderr


def test_every_atomic_names_its_partner():
    """A SYNC POINT stands within ten lines above every ordered operation."""
    for path in HEADERS.glob("*.h"):
        lines = path.read_text().splitlines()
        for number, line in enumerate(lines):
            code = line.split("/*")[0]
            if "memory_order_acquire" in code or "memory_order_release" in code:
                above = "\n".join(lines[max(0, number - 10) : number + 1])
                assert "SYNC POINT" in above, f"{path.name}:{number + 1}"


@pytest.mark.parametrize("words", SIZES)
def test_two_writers_two_readers_and_two_hundred_kills(torture, words):
    found = run(torture, "processes", words, 1.0, 200 if words == 32 else 70)
    judge(found)
    assert found["lost"] == 0


@pytest.mark.parametrize("words", [6, 256])
def test_the_same_when_everybody_dawdles_between_steps(words, tmp_path):
    program = build("svar_torture.c", tmp_path / "jitter", "-DJITTER")
    judge(run(program, "processes", words, 1.0, 50))


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


@pytest.mark.parametrize("name", MUTANTS)
def test_torture_catches_a_missing_check(name, tmp_path):
    header, right, wrong, symptom = MUTANTS[name]
    headers = mutant(tmp_path, header, right, wrong)
    program = build("svar_torture.c", tmp_path / "mutant", "-DJITTER", headers=headers)
    for _ in range(20):
        if run(program, "processes", 32, 0.3)[symptom] > 0:
            return
    pytest.fail(f"twenty runs did not show {symptom}")


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
    tops = [line for line in done.stderr.splitlines() if line.strip().startswith("#0 ")]
    assert "data race" in done.stderr
    assert tops
    assert all(" pb_copy " in line for line in tops if "pthread_create" not in line)


def test_address_and_undefined_sanitizers_are_silent(tmp_path):
    flags = ("-g", "-fsanitize=address,undefined", "-fno-sanitize-recover=all")
    program = build("svar_torture.c", tmp_path / "asan", *flags, cc=compiler("clang"))
    judge(run(program, "processes", 32, 1.0, 20))
