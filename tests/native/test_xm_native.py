"""The C headers of express mail: torture, sanitizers, mutants.

The torture meets what it happens to meet. The sweep has a process die, or stand still,
at every step of every deed, one case after the other. The mutants show that it can
fail: each lacks one thing, and must be caught.
"""

from typing import NamedTuple

import pytest
from svar_rig import build, compiler, mutant, run
from xm_rig import HEADERS


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


@pytest.fixture(scope="module")
def sound_sweep(tmp_path_factory):
    target = tmp_path_factory.mktemp("sweep") / "sweep"
    return run(build("xm_sweep.c", target, headers=HEADERS))


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


class Mutant(NamedTuple):
    header: str
    right: str
    wrong: str
    symptom: str


MUTANTS = {
    "no rebuilding": Mutant(
        "queue.h",
        "if (!q->o.hurt || !xm_rebuild(q))",
        "if (!q->o.hurt || (q->o.hurt = 0, 1))",
        "broken",
    ),
    "no orphans": Mutant(
        "sem.h", "while ((word >> XM_HOLDER) == m + 1)", "while (0)", "stuck"
    ),
    "linked before it is copied": Mutant(
        "mail.h",
        "    if (is_long)\n        xm_unlock(&q->o);\n",
        "    if (is_long) {\n        h->seq = ++q->seq;\n"
        "        atomic_store(&h->state, XM_QUEUED);\n"
        "        xm_insert(q, i);\n        xm_queue_unlock(q);\n"
        "        return xm_put_in(q, i, data);\n    }\n",
        "torn",
    ),
    "taken in two steps": Mutant(
        "sem.h",
        "sees this one's writes. */\n"
        "    } while (!atomic_compare_exchange_weak(&s->word, &word, next));",
        "sees this one's writes. */\n    } while (atomic_store(&s->word, next), 0);",
        "intruders",
    ),
}
SYMPTOMS = ("torn", "lost", "broken", "stuck", "intruders")


def test_a_death_at_any_step_leaves_all_in_order(sound_sweep):
    assert {symptom: sound_sweep[symptom] for symptom in SYMPTOMS} == dict.fromkeys(
        SYMPTOMS, 0
    )
    assert sound_sweep["deaths"] > 300


@pytest.mark.parametrize("name", MUTANTS)
def test_the_sweep_catches_a_missing_check(name, tmp_path):
    header, right, wrong, symptom = MUTANTS[name]
    headers = mutant(tmp_path, header, right, wrong, HEADERS)
    found = run(build("xm_sweep.c", tmp_path / "mutant", headers=headers))
    assert found[symptom] > 0


NODE = HEADERS.parents[1] / "node" / "rt"


def test_a_task_is_held_behind_its_locks_and_calls_not_amid_them(tmp_path):
    """As without real-time rights; who is more urgent then wants the same lock."""
    program = build("xm_held.c", tmp_path / "held", f"-I{NODE}", headers=HEADERS)
    found = run(program)
    assert found["held"] > 50
    assert (found["amid"], found["uncalled"]) == (0, 0)


def test_a_task_that_is_held_at_once_keeps_others_waiting(tmp_path):
    right = "    steady->owed = signal;\n    return 1;\n"
    headers = mutant(tmp_path, "steady.h", right, "    return signal == 0;\n", HEADERS)
    flags = (f"-I{NODE}", f"-I{HEADERS}")
    found = run(build("xm_held.c", tmp_path / "held", *flags, headers=headers))
    assert found["amid"] > 10
    assert found["uncalled"] > 0
