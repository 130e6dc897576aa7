"""The illegal-configuration flag: who raises, who clears, what is counted (3.10)."""

import os
import subprocess
import sys

import pytest

from pbonet.config.model import Variable
from pbonet.errors import SvarFullError, SvarOwnerError
from pbonet.svar import Table

ME = os.getpid()
RAISE = """
import os, sys
from pbonet.svar import Table
table = Table.attach("arm")
task = table.local("other", os.getpid(), outvar=["V0"])
task.claim()
for n in range({count}):
    table.raise_illegal(f"cause {{n}}", "other")
table.raise_illegal("shared", "both")
print(len(table.illegal), flush=True)
sys.stdin.read()
"""


@pytest.fixture
def table(tmp_path, monkeypatch):
    monkeypatch.setenv("PBONET_SHM_DIR", str(tmp_path))
    with Table.create("arm", [Variable(name="V0", type="double")]) as made:
        yield made


@pytest.fixture
def other(table):  # noqa: ARG001 - it attaches to the table
    """Return a function that starts a process which raises causes and waits."""
    started = []

    def start(count: int) -> subprocess.Popen[str]:
        child = subprocess.Popen(
            [sys.executable, "-c", RAISE.format(count=count)],
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            text=True,
        )
        started.append(child)
        assert child.stdout.readline()
        return child

    yield start
    for child in started:
        child.kill()
        child.communicate()


def test_flag_is_up_while_any_cause_stands(table):
    local = table.local("t", ME)
    assert not local.illegal
    table.raise_illegal("task pid is dead", "arm0")
    table.raise_illegal("task pid is dead", "arm0")
    table.raise_illegal("task pid is stale", "arm0")
    table.raise_illegal("reconfiguring", "master", "host2")
    assert [(c.cause, c.raiser) for c in table.illegal] == [
        ("task pid is dead", "arm0"),
        ("task pid is stale", "arm0"),
        ("reconfiguring", "master"),
    ]
    assert table.illegal[0].machine == os.uname().nodename
    assert table.illegal[2].machine == "host2"
    assert local.illegal
    assert table.clear_illegal("master") == 0, "raised on another machine"
    assert table.clear_illegal("master", machine="host2") == 1
    assert table.clear_illegal("arm0", "task pid is stale") == 1
    assert local.illegal
    assert table.clear_illegal("arm0") == 1
    assert not local.illegal
    assert table.illegal == []


def test_a_process_has_room_for_64_causes_and_what_finds_none_is_counted(table):
    assert table.unlisted == 0
    for n in range(64):
        table.raise_illegal(f"cause {n}", "t")
    with pytest.raises(
        SvarFullError,
        match=r"there are too many causes; this one was not added: one more \(expected "
        r"at most 64 of a process and 128 in all\)",
    ):
        table.raise_illegal("one more", "t")
    assert table.unlisted == 1
    table.raise_illegal("cause 5", "t")
    assert table.unlisted == 1, "it stands already"
    assert table.clear_illegal("t", "cause 5") == 1
    table.raise_illegal("one more", "t")
    assert table.clear_illegal("t") == 64
    assert table.illegal == []


def test_a_process_that_raises_without_end_leaves_room_for_others(table, other):
    other(63)
    table.raise_illegal("mine", "me")
    assert len(table.illegal) == 65
    assert table.clear_illegal("me") == 1


def test_long_texts_of_a_cause_are_cut(table):
    table.raise_illegal("c" * 500, "r" * 500, "m" * 500)
    (cause,) = table.illegal
    assert (len(cause.cause), len(cause.raiser), len(cause.machine)) == (127, 63, 63)
    assert table.clear_illegal("r" * 500, "c" * 500, "m" * 500) == 1


def test_a_live_raiser_alone_clears_what_it_raised(table, other):
    child = other(2)
    text = r"arm: the causes of other are not cleared, because its process is alive"
    with pytest.raises(SvarOwnerError, match=text):
        table.clear_illegal("other")
    assert len(table.illegal) == 3
    child.kill()
    child.wait()
    assert len(table.illegal) == 3, "the dead one's causes stand until it is reaped"
    assert table.clear_illegal("other", "cause 1") == 1
    assert table.clear_illegal("other") == 1
    assert table.clear_illegal("both") == 1
    assert table.illegal == []


def test_a_cause_of_two_processes_is_listed_once_and_stands_until_both_clear(
    table, other
):
    child = other(0)
    looker = table.local("t", ME)
    table.raise_illegal("shared", "both")
    assert [(c.cause, c.raiser) for c in table.illegal] == [("shared", "both")]
    assert table.clear_illegal("both") == 1
    assert len(table.illegal) == 1
    assert looker.illegal
    child.kill()
    child.wait()
    table.raise_illegal("mine", "me")
    assert table.reap("other") == ["V0"]
    assert [c.cause for c in table.illegal] == ["mine"], "only the dead one's are gone"
    assert looker.illegal
    table.clear_illegal("me")
    assert not looker.illegal


def test_reaping_who_lives_leaves_its_causes(table, other):
    other(1)
    with pytest.raises(SvarOwnerError, match="its process runs"):
        table.reap("other")
    assert len(table.illegal) == 2
