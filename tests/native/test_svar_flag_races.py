"""The illegal-configuration flag at full speed: raisers killed, no torn text."""

import os
import random
import signal
import subprocess
import time

import pytest
from svar_rig import Child, build, counters, mutant, variables, wait_for

from pbonet.svar import Table

RAISERS, KILLS = 3, 60
STOP, WRONG, TURNS = 0, 1, 4


@pytest.fixture
def table(tmp_path, monkeypatch):
    monkeypatch.setenv("PBONET_SHM_DIR", str(tmp_path))
    with Table.create("flag", variables(3)) as made:
        yield made


def texts(number: int) -> tuple[str, str]:
    """Return a cause and a raiser that show by themselves whether they are whole."""
    return f"{number:020d}" * 6, f"{number:020d}" * 3


def raise_for_ever(shared, which: int) -> None:
    with Table.attach("flag") as table:
        local = table.local(f"r{which}", os.getpid())
        while not shared[STOP]:
            cause, raiser = texts(
                time.monotonic_ns() * RAISERS + which
            )  # nobody else's
            table.raise_illegal(cause, raiser)
            shared[WRONG] += not local.illegal
            shared[WRONG] += not any(c.cause == cause for c in table.illegal)
            shared[WRONG] += table.clear_illegal(raiser) != 1
            shared[WRONG] += any(c.cause == cause for c in table.illegal)
            shared[TURNS + which] += 1


def test_raisers_at_full_speed_killed_at_random_leave_whole_causes(table):
    shared = counters(16)
    dice = random.Random(7)
    raisers = [Child(raise_for_ever, shared, i, core=i) for i in range(RAISERS)]

    def look() -> None:
        for cause in table.illegal:
            assert texts(int(cause.raiser[:20])) == (cause.cause, cause.raiser)

    def reap() -> None:
        for cause in table.illegal:
            table.clear_illegal(cause.raiser)

    try:
        for _ in range(KILLS):
            which = dice.randrange(RAISERS)
            seen = int(shared[TURNS + which])
            wait_for(lambda w=which, n=seen: shared[TURNS + w] > n, "the raiser")
            for _ in range(dice.randrange(40)):
                look()
            raisers[which].kill(signal.SIGKILL)
            raisers[which] = Child(raise_for_ever, shared, which, core=which)
        seen = [int(shared[TURNS + i]) for i in range(RAISERS)]
        wait_for(
            lambda: all(shared[TURNS + i] > seen[i] for i in range(RAISERS)),
            "every raiser to go on behind the last kill",
        )
    finally:
        shared[STOP] = 1
        ends = [child.end() for child in raisers]
    assert ends == [0] * RAISERS
    assert shared[WRONG] == 0
    look()
    reap()
    assert table.illegal == []
    assert table.unlisted == 0
    for n in range(64):
        table.raise_illegal(f"{n}", "me")
    assert len(table.illegal) == 64


def looks(program) -> list[str]:
    """Return what looks between the steps of a raise, and of a clear, have seen."""
    done = subprocess.run([program], check=True, capture_output=True, text=True)
    return done.stdout.split()


def test_a_look_amid_a_change_does_not_hide_it_from_the_next(tmp_path):
    raised, cleared = looks(build("svar_flag.c", tmp_path / "flag"))
    assert raised == "0" * raised.count("0") + "1" * raised.count("1")
    assert cleared == "1" * cleared.count("1") + "0" * cleared.count("0")
    assert raised[-1] == "1"
    assert cleared[-1] == "0"
    assert len(raised) > 30


@pytest.mark.parametrize(
    ("right", "wrong"),
    [
        ("PBONET_STEP(32);\n    pb_changed(t);", "PBONET_STEP(32);"),
        ("    pb_changed(t); /* also for a process", "    /* also for a process"),
    ],
)
def test_the_number_of_changes_moves_behind_every_change(tmp_path, right, wrong):
    headers = mutant(tmp_path, "flag.h", right, wrong)
    seen = looks(build("svar_flag.c", tmp_path / "flag", headers=headers))
    assert [line[-1] for line in seen] != ["1", "0"]
