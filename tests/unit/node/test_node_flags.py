"""An RTPU's entries in the illegal-configuration flag."""

import asyncio
import os
import subprocess
from types import SimpleNamespace

import pytest

from pbonet.config import parse_svar
from pbonet.errors import SvarFullError, UnknownVariableError
from pbonet.node.rtpu.illegal_flag import Flags
from pbonet.node.rtpu.rtpu_state import Rtpu
from pbonet.node.wire.event_log import EventLog
from pbonet.node.wire.rtpu_messages import OpenTable
from pbonet.svar import Table
from pbonet.svar._svar import CAUSES_EACH

ME = os.getpid()
SVAR = """NAME Y
TYPE double
DESC another one
UNITS none
NELEM 1

NAME X
TYPE double
DESC an output
UNITS none
NELEM 1

EOF
"""


class Opened:
    """A table as the RTPU process has it open."""

    use = OpenTable(keep=True)

    def __init__(self, table):
        self.table = table


class Tables(dict):
    """The open tables of an RTPU process; their files are whole."""

    sound = dict.get
    need = dict.__getitem__
    subsystems = dict.keys


@pytest.fixture
def table(monkeypatch, tmp_path):
    monkeypatch.setenv("PBONET_SHM_DIR", str(tmp_path))
    table = Table.create("flags", parse_svar(SVAR, "t.svar").variables)
    yield table
    table.destroy()


def flags(table, events=None, tables=None):
    tables = tables or Tables(arm=Opened(table))
    return Flags("arm0", tables, events or EventLog("arm0"))


def standing(table):
    return [one.cause for one in table.illegal]


def test_an_entry_stands_until_it_is_withdrawn(table):
    mine = flags(table)
    mine.up("arm", "servo", "servo is in ERROR")
    assert table.illegal
    mine.down("arm", "servo")
    assert not table.illegal


def test_a_cause_without_room_is_raised_when_others_have_gone(table):
    crowd = CAUSES_EACH
    for k in range(crowd):
        table.raise_illegal("one of many", f"crowd/{k}")
    with pytest.raises(SvarFullError):
        table.raise_illegal("one too many", "crowd")
    mine = flags(table)
    mine.up("arm", "servo", "servo has died")
    for k in range(crowd):
        table.clear_illegal(f"crowd/{k}")
    assert not table.illegal
    mine.evaluate()
    assert [one.cause for one in table.illegal] == ["servo has died"]
    mine.down("arm", "servo")
    mine.evaluate()
    assert not table.illegal


def test_entering_and_leaving_are_events_with_the_cause(table):
    events = EventLog("arm0")
    mine = flags(table, events)
    mine.up("arm", "servo", "servo has died")
    mine.up("arm", "servo", "servo has died")  # it is up already
    table.raise_illegal("of another RTPU", "arm1/eye")
    table.raise_illegal("equation 2", "master")
    mine.report()
    mine.down("arm", "servo")
    assert [(event.code, event.text) for event in events.since(1)] == [
        ("ILLEGAL", "servo has died (arm0/servo)"),
        ("ILLEGAL", "equation 2 (master)"),
        ("LEGAL", "no longer: servo has died (arm0/servo)"),
    ]


def test_who_has_ended_is_no_writer(table):
    """It owns the variable until its RTPU gives that up; then whoever comes counts."""
    made = flags(table)
    old = table.local("old", ME, outvar=["X"])
    old.claim()
    assert made.written("arm", ["X"])
    old.cede()
    assert table.info("X").owner == "old"
    assert not made.written("arm", ["X"])
    made.up("arm", "heir", "heir is in ERROR", ["X"])
    made.evaluate()
    assert len(table.illegal) == 1
    old.release()
    old.claim()
    assert made.written("arm", ["X"])
    made.evaluate()
    assert not table.illegal


def test_who_has_died_is_no_writer(table):
    """Its RTPU hears of it before it gives its variables up."""
    with subprocess.Popen(["sleep", "60"]) as process:
        table.local("old", process.pid, outvar=["X"]).claim()
        assert table.written("X")
        process.kill()
    assert table.info("X").owner == "old"
    assert not table.written("X")


@pytest.mark.parametrize("taken", [True, False])
def test_what_an_heir_has_taken_over_is_handed_over_for_good(table, taken):
    """If it gives that up again soon, it is its own list that says what is wrong."""
    made = flags(table)
    heir = table.local("heir", ME, outvar=["X"])
    if taken:
        heir.claim()
    made.handed_over("arm", "old", ["X"])
    if taken:
        heir.release()
    made.evaluate()
    nobody = "off old is done, and no task took over X"
    assert standing(table) == [nobody] * (not taken)


def test_what_a_master_found_goes_when_somebody_writes(table):
    """No master is needed: a fallback has come on, which asks none."""
    events = EventLog("arm0")
    mine = flags(table, events)
    mine.master_found("arm", "equation 2", ["X"])
    mine.evaluate()
    assert standing(table) == ["equation 2"]
    second = table.local("second", ME, outvar=["X"])
    second.claim()
    mine.evaluate()
    assert standing(table) == []
    second.release()
    mine.evaluate()
    assert standing(table) == [], "whoever stops writing is told by others"
    assert [(event.code, event.text) for event in events.since(1)] == [
        ("ILLEGAL", "equation 2 (master)"),
        ("LEGAL", "no longer: equation 2 (master)"),
    ]


def test_what_a_master_found_too_late_is_not_raised(table):
    """The fallback was engaged before the master heard of it."""
    mine = flags(table)
    mine.master_found("arm", "equation 2", ["X"])
    second = table.local("second", ME, outvar=["X"])
    second.claim()
    mine.master_found("arm", "equation 2", ["X"])
    assert standing(table) == []
    second.cede()  # it has ended, and its heir has failed
    mine.master_found("arm", "equation 2", ["X"])
    mine.evaluate()
    assert standing(table) == ["equation 2"]
    mine.master_mended("arm", "equation 2")
    mine.master_mended("arm", "equation 2")
    assert standing(table) == []
    with pytest.raises(UnknownVariableError, match="W"):
        mine.master_found("arm", "equation 2", ["W"])
    assert standing(table) == []


def test_what_a_master_says_of_no_variables_stands_until_it_is_withdrawn(table):
    mine = flags(table)
    mine.master_found("arm", "a test", [])
    table.local("second", ME, outvar=["X"]).claim()
    mine.evaluate()
    assert standing(table) == ["a test"]


def test_what_a_master_found_ends_with_its_table(table):
    """Another table of the subsystem may have other variables."""
    tables = Tables(arm=Opened(table))
    mine = flags(table, tables=tables)
    mine.master_found("arm", "equation 2", ["X"])
    del tables["arm"]
    mine.evaluate()
    other = Table.create(
        "other", parse_svar(SVAR.replace("X", "Z"), "t.svar").variables
    )
    try:
        tables["arm"] = Opened(table)
        mine.master_found("arm", "equation 2", ["X"])
        tables["arm"] = Opened(other)
        mine.evaluate()
        assert standing(other) == []
    finally:
        other.destroy()


def test_the_watch_ends_when_it_is_told_to_while_something_changes():
    """Python 3.11's `wait_for` loses a cancellation that comes with its result."""

    async def ends(passes: int) -> bool:
        waits = asyncio.Event()
        flags = SimpleNamespace(waits=waits, evaluate_if_changed=lambda: None)
        watch = asyncio.create_task(Rtpu._pause(SimpleNamespace(flags=flags)))
        await asyncio.sleep(0.0)
        await asyncio.sleep(0.0)
        waits.set()
        for _ in range(passes):
            await asyncio.sleep(0.0)
        watch.cancel()
        await asyncio.wait([watch])
        return watch.cancelled()

    for passes in range(4):
        assert asyncio.run(ends(passes))
