"""Safe values at a timing failure: found at every step of a cycle, no set is torn.

The dispatcher commits them, or the task's handler of the signal, or the task itself
behind its cycle, also after a dispatcher that was killed at any of its own steps. The
mutants show that each check is needed.
"""

import subprocess

import pytest
from svar_rig import build, compiler, mutant, run

WRONG = ("torn", "stale", "unsafe", "refused")
MUTANTS = {
    "what came before the cycle began": (
        "local.h",
        "if (wanted == number) pb_make_safe(l);",
        "if (wanted == number) wanted = 0;",
        "unsafe",
    ),
    "the commit asks nobody": (
        "local.h",
        "return !l->open || pb_safe_take(l->safe, l->open, PB_COMMITS);",
        "return true;",
        "torn",
    ),
    "what came amid the commit": (
        "safe.h",
        "return atomic_load(&s->wanted) == number ? PB_COMMITS : PB_CLOSED;",
        "return PB_CLOSED;",
        "unsafe",
    ),
    "the task does not know of the commit": (
        "local.h",
        "PB_CLOSED);\n    g->head = pb_write_last(&g->reg->head);\n",
        "PB_CLOSED);\n",
        "refused",
    ),
    "a dead dispatcher is relied on": (
        "local.h",
        "if (how == PB_TAKEN) {",
        "if (how == PB_OPEN) {",
        "unsafe",
    ),
}
ODD_MUTANTS = {
    "a cycle without a number": ("local.h", "!l->safe || !number ||", "!l->safe ||"),
    "a failure of long ago": ("local.h", "else if (wanted)", "else if (!number)"),
    "slots that were given up": (
        "safe.h",
        "atomic_load(&reg->state) == PB_HELD && pb_inside",
        "pb_inside",
    ),
    "two writers": (
        "local.h",
        "l->outputs[PB_GROUP_VARS].live = false; /* the register has",
        "/* the register has",
    ),
}


@pytest.mark.parametrize("who", ["dispatcher", "signal", "killed"])
def test_a_failure_at_any_step_of_a_cycle_makes_its_outputs_safe(tmp_path, who):
    found = run(build("svar_safe.c", tmp_path / "safe"), who)
    assert {name: found[name] for name in WRONG} == dict.fromkeys(WRONG, 0)
    assert found["safe"] > 20
    assert found["kept"] > 20
    assert (found["deaths"] > 50) == (who == "killed")


@pytest.mark.parametrize("name", MUTANTS)
def test_the_sweep_catches_a_missing_check(name, tmp_path):
    header, right, wrong, symptom = MUTANTS[name]
    headers = mutant(tmp_path, header, right, wrong)
    program = build("svar_safe.c", tmp_path / "mutant", "-w", headers=headers)
    assert run(program, "killed")[symptom] > 0


def test_what_comes_once_in_years_or_amid_a_burial(tmp_path):
    found = run(build("svar_safe.c", tmp_path / "safe"), "odd")
    assert {name: found[name] for name in WRONG} == dict.fromkeys(WRONG, 0)


def test_the_thread_sanitizer_is_silent_about_task_dispatcher_and_reader(tmp_path):
    flags = ("-g", "-fsanitize=thread", "-fno-sanitize-recover=all")
    program = build("svar_safe.c", tmp_path / "tsan", *flags, cc=compiler("clang"))
    found = run(program, "threads")
    assert {name: found[name] for name in WRONG} == dict.fromkeys(WRONG, 0)
    assert found["safe"] > 100
    assert found["kept"] > 100


def test_the_thread_sanitizer_finds_a_missing_order(tmp_path):
    right = "atomic_store(&s->wanted, number); /* SYNC"
    wrong = "*(uint64_t *)(void *)&s->wanted = number; /* SYNC"
    headers = mutant(tmp_path, "safe.h", right, wrong)
    flags = ("-g", "-w", "-fsanitize=thread")
    program = build(
        "svar_safe.c", tmp_path / "t", *flags, cc=compiler("clang"), headers=headers
    )
    done = subprocess.run(
        [str(program), "threads"], capture_output=True, text=True, check=False
    )
    assert "data race" in done.stderr


@pytest.mark.parametrize("name", ODD_MUTANTS)
def test_the_odd_cases_catch_a_missing_check(name, tmp_path):
    header, right, wrong = ODD_MUTANTS[name]
    headers = mutant(tmp_path, header, right, wrong)
    program = build("svar_safe.c", tmp_path / "mutant", "-w", headers=headers)
    assert run(program, "odd")["unsafe"] > 0
