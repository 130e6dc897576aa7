"""The triple buffer in C: torture, kills at every step, all schedules, mutants.

The mutants show that the schedules can fail: each lacks one thing, and must be caught.
"""

import shutil

import pytest
from svar_rig import ROOT, build, compiler, run

HEADERS = ROOT / "pbonet" / "tbuf"


def judge(found: dict[str, int]) -> None:
    for fault in ("torn", "old", "twice"):
        assert found[fault] == 0, f"{fault}: {found}"
    assert found["reads"] > 10, "the reader made progress"
    assert found["written"] > 10, "the writer made progress"


@pytest.fixture(scope="module")
def torture(tmp_path_factory):
    target = tmp_path_factory.mktemp("torture") / "torture"
    return build("tbuf_torture.c", target, headers=HEADERS)


def test_threads_at_full_speed_read_the_newest_whole_record(torture):
    judge(run(torture, "threads", 1.0))


def test_processes_that_are_killed_two_hundred_times(torture):
    judge(run(torture, "processes", 2.0, 200))


def test_killed_at_every_step(tmp_path):
    program = build("tbuf_torture.c", tmp_path / "steps", "-DSTEPS", headers=HEADERS)
    found = run(program, "steps")
    judge(found)
    assert found["kills"] > 30


def test_the_thread_sanitizer_finds_no_race_in_links(tmp_path):
    flags = ("-g", "-fsanitize=thread", "-fno-sanitize-recover=all")
    cc = compiler("clang")
    program = build("tbuf_torture.c", tmp_path / "tsan", *flags, cc=cc, headers=HEADERS)
    judge(run(program, "threads", 1.0))


def test_address_and_undefined_sanitizers_find_nothing_in_links(tmp_path):
    flags = ("-g", "-fsanitize=address,undefined", "-fno-sanitize-recover=all")
    cc = compiler("clang")
    program = build("tbuf_torture.c", tmp_path / "asan", *flags, cc=cc, headers=HEADERS)
    judge(run(program, "threads", 0.5))
    judge(run(program, "processes", 0.5, 30))


def test_a_sender_follows_the_grid_and_looks_for_what_is_late(tmp_path):
    found = run(build("tbuf_pace.c", tmp_path / "pace", headers=HEADERS))
    assert found["regular"] == found["lost"] == 0
    assert 50_000 <= found["late"] <= 80_000, "a quarter of 200 us, and a longer period"
    assert found["pause"] == -1, "nothing is expected behind a pause"
    assert (found["found"], found["rung"]) == (0, 0)


@pytest.fixture
def sweep(tmp_path):
    """Return a function that goes through all schedules, with some headers."""

    def run_all(headers=HEADERS):
        program = build("tbuf_sweep.c", tmp_path / "sweep", headers=headers)
        return run(program)

    return run_all


def test_all_schedules_of_five_switches(sweep):
    found = sweep()
    judge(found)
    assert found["schedules"] > 200_000


MUTANTS = {
    "the reader's slot is taken for free": (
        "return newest == held ? (newest + 1) % TB_SLOTS : TB_SLOTS - newest - held;",
        "return (newest + 1 + 0 * held) % TB_SLOTS;",
    ),
    "published without looking": (
        "} while (!atomic_compare_exchange_strong(&b->word, &word, next));",
        "} while (atomic_store(&b->word, next), 0);",
    ),
    "published before it is whole": (
        "bytes);\n    PBONET_STEP(3);\n    do {",
        "bytes / 2);\n    PBONET_STEP(3);\n    do {",
    ),
    "taken without telling": (
        "word = atomic_fetch_or(&b->word, TB_TAKEN);",
        "word = atomic_load(&b->word);",
    ),
    "the slot held before is forgotten": (
        "return word & TB_TAKEN ? tb_newest(word) : word >> 2 & 3;",
        "return tb_newest(word);",
    ),
}


def mutant(folder, right, wrong):
    """Copy the headers with one thing made wrong; return the copy's folder."""
    copy = folder / "tbuf"
    copy.mkdir()
    for path in HEADERS.glob("*.h"):
        shutil.copy(path, copy)
    text = (copy / "triple.h").read_text()
    assert text.count(right) == 1, f"triple.h no longer says {right!r} once"
    (copy / "triple.h").write_text(text.replace(right, wrong))
    return copy


@pytest.mark.parametrize("name", MUTANTS)
def test_the_schedules_catch_a_mutant(name, sweep, tmp_path):
    found = sweep(mutant(tmp_path, *MUTANTS[name]))
    assert found["torn"] + found["old"] + found["twice"] > 0
