"""The C headers of express mail: strict compilation, torture, sanitizers, mutants.

The mutants show that the torture can fail: each lacks one thing, and must be caught.
"""

import json
import subprocess

import pytest
from svar_rig import build, compiler
from xm_rig import HEADERS, mutant


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
    for fault in ("intruders", "torn", "errors", "over"):
        assert found[fault] == 0, fault
    assert found["sound"] == 1, "lists and states fit together"
    assert found["binary"] == 1, "the critical section is free"
    assert found["least"] > 0, "everybody made progress"


@pytest.fixture(scope="module")
def torture(tmp_path_factory):
    target = tmp_path_factory.mktemp("torture") / "torture"
    return build("xm_torture.c", target, headers=HEADERS)


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


def test_every_ordered_operation_names_its_partner():
    for path in HEADERS.glob("*.h"):
        lines = path.read_text().splitlines()
        for number, line in enumerate(lines):
            code = line.split("/*")[0]
            if "memory_order_" in code:
                above = "\n".join(lines[max(0, number - 10) : number + 1])
                assert "SYNC POINT" in above, f"{path.name}:{number + 1}"


def test_threads_at_full_speed_lose_nothing(torture):
    found = run(torture, "threads", 1.0, 0)
    judge(found)
    assert found["tokens"] == 3


def test_processes_that_are_killed_three_hundred_times(torture):
    judge(run(torture, "processes", 3.0, 300))


def test_thread_sanitizer_is_silent(tmp_path):
    flags = ("-g", "-fsanitize=thread", "-fno-sanitize-recover=all")
    cc = compiler("clang")
    program = build("xm_torture.c", tmp_path / "tsan", *flags, cc=cc, headers=HEADERS)
    judge(run(program, "threads", 1.0, 0))


def test_address_and_undefined_sanitizers_are_silent(tmp_path):
    flags = ("-g", "-fsanitize=address,undefined", "-fno-sanitize-recover=all")
    cc = compiler("clang")
    program = build("xm_torture.c", tmp_path / "asan", *flags, cc=cc, headers=HEADERS)
    judge(run(program, "threads", 0.5, 0))
    judge(run(program, "processes", 1.0, 30))


MUTANTS = {
    "no rebuilding": (
        "queue.h",
        "if (!q->o.hurt || !xm_rebuild(q))",
        "if (!q->o.hurt || (q->o.hurt = 0, 1))",
    ),
    "no orphans": ("sem.h", "while ((word >> XM_HOLDER) == m + 1)", "while (0)"),
    "copied before it is linked": (
        "mail.h",
        "    if (is_long)\n        xm_unlock(&q->o);\n",
        "    if (is_long) {\n        h->seq = ++q->seq;\n"
        "        atomic_store(&h->state, XM_QUEUED);\n"
        "        xm_insert(q, i);\n        xm_queue_unlock(q);\n"
        "        return xm_put_in(q, i, data);\n    }\n",
    ),
    "taken in two steps": (
        "sem.h",
        "seen by the next. */\n"
        "    } while (!atomic_compare_exchange_weak(&s->word, &word, next));",
        "seen by the next. */\n    } while (atomic_store(&s->word, next), 0);",
    ),
}


@pytest.mark.parametrize("name", MUTANTS)
def test_torture_catches_a_missing_check(name, tmp_path):
    headers = mutant(tmp_path, *MUTANTS[name])
    program = build("xm_torture.c", tmp_path / "mutant", headers=headers)
    for _ in range(10):
        try:
            judge(run(program, "processes", 0.5, 100))
        except AssertionError:
            return
    pytest.fail("ten runs did not show it")
