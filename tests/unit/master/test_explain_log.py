"""`pbonet explain` about a log: what it reads from cycles, events and files."""

from __future__ import annotations

import random

import pytest
from made_logs import PLAIN, about, group, record, run
from msgspec import structs

from pbonet.errors import LogError
from pbonet.log import Attached, Log, LogWriter
from pbonet.log.part import Part
from pbonet.master import diagnosis
from pbonet.master.configuration import Place
from pbonet.master.diagnosis import REMEDIES, log_facts

PERIOD = 10_000_000
SBS = b"SUBSYSTEM arm\nSVARFILE a.svar\nRTPU arm0\nEOF\n"
SVAR = b"NAME Y\nTYPE double\nDESC place\nUNITS m\nNELEM 6\nEOF\n"
RMOD = """MODULE m
DESC d
INCONST none
OUTCONST none
INVAR none
OUTVAR Y
TASKTYPE periodic
FREQ 100
EOF
"""


def event(code, text, at, task="", state=""):
    return {
        "n": 1,
        "time": at,
        "wall": at * 1e-9,
        "severity": 30,
        "code": code,
        "rtpu": "arm0",
        "subsystem": "arm",
        "task": task,
        "state": state,
        "text": text,
    }


def cycle(number, at, cpu=1_000_000, seed=1):
    data, _ = group(PLAIN, random.Random(seed))
    return record(
        data,
        cycle=number,
        release_ns=at,
        start_ns=at,
        end_ns=at + cpu,
        cpu_ns=cpu,
    )


FAILS = (
    event("STATE", "turned on", PERIOD, "pid", "ON"),
    event("ILLEGAL", "the grip is open (arm0/pid)", 20 * PERIOD),
    event("METHOD", "pid.cycle: no grip", 34 * PERIOD, "pid", "ERROR"),
    event("STATE", "turned off", 35 * PERIOD, "other", "OFF"),
    event("ILLEGAL", "equation 2: no task writes Y for pid (master)", 36 * PERIOD),
    event("STOPPED", "all", 37 * PERIOD),
)
SOUND = (
    event("STATE", "turned on", PERIOD, "pid", "ON"),
    event("ILLEGAL", "the grip is open (arm0/pid)", 20 * PERIOD),
    event("LEGAL", "no longer: the grip is open (arm0/pid)", 22 * PERIOD),
    event("STATE", "turned off", 35 * PERIOD, "pid", "OFF"),
    event("STOPPED", "all", 36 * PERIOD),
)


@pytest.fixture
def log(tmp_path):
    return recorded(tmp_path, FAILS)


def recorded(folder, events, without=(), missed=3, again=0):
    """Record cycle 10 of the task pid that takes too long, and three that are missed.

    Return a function that answers questions about it.

    Args:
        folder: Where.
        events: The events of the run.
        without: Cycles that are not in the log.
        missed: How many are missed.
        again: In which period it is spawned for the second time, for five cycles.
    """
    path = folder / "run.mcap"
    files = [Attached("a.sbs", SBS), Attached("a.svar", SVAR)]
    writer = LogWriter(path, run(), files)
    number = writer.add_task(structs.replace(about("pid", PLAIN), rmod=RMOD))
    for n in sorted({*range(1, 31)} - {*without}):
        cpu = 35_000_000 if n == 10 else 1_000_000
        writer.add(number, cycle(n, (n + missed * (n > 10)) * PERIOD, cpu))
    for n in range(1, 6 if again else 1):
        writer.add(number, cycle(n, (again + n) * PERIOD))
    for one in events:
        writer.add_event(one)
    writer.close()

    def answer(*words):
        return diagnosis.answer(path, words, Place())

    return answer


def test_missed_releases_have_the_cycle_that_took_too_long(log):
    text = str(log("miss", "pid"))
    assert text.startswith("pid has missed 3 cycles in 1 place\n")
    assert "because 3 releases before cycle 11 [log]" in text
    assert "the cycle before took 35 ms of CPU time, and its period is 10 ms" in text


def test_a_cycle_before_which_nothing_was_missed_is_well(log):
    there, beyond = log("miss", "pid", "25"), log("miss", "pid", "31")
    assert str(there) == (
        "pid has missed 0 releases before cycle 25\n"
        "  nothing is wrong: what it has missed was before cycle 11"
    )
    assert there.healthy
    assert str(beyond) == (
        "cycle 31 of pid is not in the log, which has 30 cycles of it, from 1 to 30\n"
        "no cause was found"
    )


def test_the_last_seconds_of_a_task_have_its_cycles_and_no_others(tmp_path):
    """A log of the seconds before errors begins late and has holes."""
    answer = recorded(tmp_path, SOUND, without=[*range(1, 6), *range(20, 25)])
    assert str(answer("miss", "pid", "30")).startswith("pid has missed 0 releases")
    assert str(answer("miss", "pid", "11")).startswith("pid has missed 3 releases")
    for n in (5, 22):
        assert str(answer("miss", "pid", str(n))) == (
            f"cycle {n} of pid is not in the log, which has 20 cycles of it, "
            "from 6 to 30\nno cause was found"
        )


def test_a_task_that_was_spawned_again_has_missed_nothing_meanwhile(tmp_path):
    """Its cycles are counted from 1 when it is spawned again, 0.3 s later."""
    killed = event("STATE", "killed", 35 * PERIOD, "pid", "NOT-CREATED")
    on = event("STATE", "turned on", 60 * PERIOD, "pid", "ON")
    ask = recorded(tmp_path, [SOUND[0], killed, on], again=60)
    assert str(ask("miss", "pid")).startswith("pid has missed 3 cycles in 1 place\n")
    text = str(ask("miss", "pid", "1"))
    assert text.startswith("pid has missed 0 releases before cycle 1\n")
    assert str(ask("miss", "pid", "31")).startswith("cycle 31 of pid is not in the log")


def test_a_task_that_was_off_has_missed_nothing_meanwhile(tmp_path):
    """Cycles 10 and 11 are three periods apart: it was turned off, and on again."""
    off = event("STATE", "turned off", 11 * PERIOD, "pid", "OFF")
    on = event("STATE", "turned on", 13 * PERIOD, "pid", "ON")
    text = str(recorded(tmp_path, [SOUND[0], off, on])("miss", "pid"))
    assert text.startswith("pid has missed 0 of ")


def test_what_was_reported_long_before_or_after_made_it_miss_nothing(tmp_path):
    """The releases from 0.11 to 0.13 s are missed; it is checked twice a second."""
    stood = [
        event("CORE_STALLED", f"for the {n} time", at * PERIOD)
        for n, at in enumerate((8, 60, 70, 190))
    ]
    text = str(recorded(tmp_path, [*SOUND[:1], *stood])("miss", "pid"))
    assert [n for n in range(4) if f"for the {n} time" in text] == [1]
    assert "turned on" not in text


def test_a_cycle_of_a_task_without_misses_is_one_of_the_log(tmp_path):
    answer = recorded(tmp_path, SOUND, missed=0)("miss", "pid", "5")
    assert str(answer).startswith("pid has missed 0 releases before cycle 5\n")
    assert "nothing is wrong: 30 cycles at 100 Hz, none missed" in str(answer)


def test_the_flag_has_the_causes_from_before_the_end(log):
    text = str(log())
    assert "because the grip is open (arm0/pid), on arm0" in text
    assert "equation 2" not in text, "everything was being turned off"


def test_a_task_is_explained_as_it_was_before_the_end(log):
    text = str(log("pid"))
    assert text.startswith("task pid on arm0 is ERROR")
    assert "METHOD of arm0/pid" in text


def test_a_variable_has_its_writer(log):
    found = log("Y")
    assert found.kind == "variable"
    assert found.what.startswith("Y was 0.")
    assert "stale" not in found.what, "a log has no limits"


def test_the_end_of_a_run_is_no_cause(tmp_path):
    ask = recorded(tmp_path, SOUND)
    assert ask("pid").what == "task pid on arm0 is ON"
    assert not ask("Y").found, "its task was ON until then"
    assert "nothing is wrong: pid on arm0 wrote it" in str(ask("Y"))
    since = log_facts.read_log(tmp_path / "run.mcap").on_since
    assert since == {"pid": pytest.approx(PERIOD * 1e-9)}


def test_a_cause_that_was_withdrawn_is_not_explained_by_the_end(tmp_path):
    text = str(recorded(tmp_path, SOUND)())
    assert text.startswith("the flag of arm was up\n")
    assert "the grip is open (arm0/pid), on arm0, between" in text
    assert f"do: {REMEDIES['withdrawn']}" in text


def test_what_was_turned_off_long_before_the_end_was_off(tmp_path):
    late = [event("STATE", "turned off", 3000 * PERIOD, "other", "OFF")]
    late += [event("STOPPED", "all", 3001 * PERIOD)]
    ask = recorded(tmp_path, [*SOUND[:4], *late])
    assert ask("pid").what == "task pid on arm0 is OFF"
    assert ask("arm0").what == "RTPU arm0 was used in this run, with 1 task"


def test_a_log_with_the_earlier_words_of_signals_is_explained_as_one_of_today(tmp_path):
    """Else a task that was turned off in order would have gone off by itself."""
    words = {"turned on": "on: ON", "turned off": "off: OFF"}
    late = [event("STATE", "turned off", 3000 * PERIOD, "other", "OFF")]
    late += [event("STOPPED", "all", 3001 * PERIOD)]
    today = [*SOUND[:4], *late]
    before = [dict(one, text=words.get(one["text"], one["text"])) for one in today]
    assert before != today
    texts = []
    for name, events in (("today", today), ("before", before)):
        (tmp_path / name).mkdir()
        ask = recorded(tmp_path / name, events)
        texts.append([str(ask(one)) for one in ("pid", "arm0")])
    assert texts[0] == texts[1]


def test_a_log_is_read_again_only_when_it_has_changed(tmp_path, monkeypatch):
    """What one answer adds to what is unknown is not in the next one."""
    path = tmp_path / "run.mcap"
    recorded(tmp_path, FAILS)
    reads = []

    def counted(found):
        reads.append(found)
        return Log(found)

    monkeypatch.setattr(log_facts, "Log", counted)
    log_facts.read_log(path).unknown.append("of one answer")
    assert not log_facts.read_log(path).unknown
    assert reads == [path]
    with path.open("ab") as file:
        file.write(b"more")
    assert log_facts.read_log(path).unknown
    assert len(reads) == 2


HUNG = event("HANGS", "a cycle does not return", 30 * PERIOD, "pid")
SAFE = event("LEFT_SAFE", "Y got the safe values", 35 * PERIOD, "pid")
FORCED = event("FORCED", "pid was ended by force", 37 * PERIOD, "pid")


@pytest.mark.parametrize("ended", [0, 34], ids=["alone", "with the run"])
def test_a_task_that_was_ended_by_force_has_no_process(tmp_path, ended):
    off = [event("STATE", "off: OFF", ended * PERIOD, "other", "OFF")] if ended else []
    kill = event("STATE", "kill: ON", 36 * PERIOD, "pid", "ON")
    stopped = event("STOPPED", "all", 38 * PERIOD)
    events = [*SOUND[:3], HUNG, *off, SAFE, kill, FORCED, stopped]
    found = recorded(tmp_path, events)("pid")
    assert found.what == "task pid on arm0 is NOT-CREATED"
    text = str(found)
    assert "because pid was ended by force" in text
    for code in ("FORCED", "HANGS", "LEFT_SAFE"):
        assert f"{code} of arm0/pid" in text


def test_a_task_that_died_has_no_process_until_it_is_spawned_again(tmp_path):
    died = event("TASK_DIED", "signal SIGSEGV", 30 * PERIOD, "pid")
    found = recorded(tmp_path, [*SOUND[:3], HUNG, died])("pid")
    assert found.what == "task pid on arm0 is NOT-CREATED"
    assert "because signal SIGSEGV" in str(found)
    assert "HANGS" not in str(found), "that cycle may have ended"
    (tmp_path / "buried").mkdir()
    buried = event("STATE", "kill: NOT-CREATED", 31 * PERIOD, "pid", "NOT-CREATED")
    ask = recorded(tmp_path / "buried", [*SOUND[:3], died, buried])
    assert ask("pid").what == "task pid on arm0 is NOT-CREATED"
    again = event("SPAWNED", "process 7", 31 * PERIOD, "pid")
    on = event("STATE", "on: ON", 32 * PERIOD, "pid", "ON")
    for folder in ("again", "on"):
        (tmp_path / folder).mkdir()
    ask = recorded(tmp_path / "again", [*SOUND[:3], SAFE, died, again])
    assert ask("pid").what == "task pid on arm0 is OFF"
    ask = recorded(tmp_path / "on", [*SOUND[:3], SAFE, died, again, on])
    assert ask("pid").what == "task pid on arm0 is ON"
    assert "LEFT_SAFE" not in str(ask("pid"))


def test_cycles_that_are_not_in_the_log_are_not_missed(tmp_path):
    text = str(recorded(tmp_path, SOUND, without=range(20, 25))("miss", "pid"))
    assert text.startswith("pid has missed 3 cycles in 1 place\n")


def test_a_log_that_ends_early_is_said_to(tmp_path):
    ask = recorded(tmp_path, SOUND)
    path = tmp_path / "run.mcap"
    assert not ask().unknown
    path.write_bytes(path.read_bytes()[:-200])
    assert "not read: the end of the log" in str(ask())


def test_what_is_damaged_in_a_log_is_named(tmp_path):
    ask = recorded(tmp_path, SOUND)
    path = tmp_path / "run.mcap"
    data = bytearray(path.read_bytes())
    chunk = Part(path)._chunks[0]
    data[chunk.at + chunk.size - 9] ^= 0xFF
    path.write_bytes(data)
    assert f"not read: {path}: damaged chunk" in str(ask())


def test_what_is_no_log_is_refused(tmp_path):
    (tmp_path / "run.mcap").write_bytes(b"x" * 99)
    with pytest.raises(LogError):
        diagnosis.answer(tmp_path / "run.mcap", (), Place())


def test_who_had_the_core_while_a_task_was_ready(tmp_path):
    """A cycle of 35 ms had it for 1 ms, and another task for 12 and half of 10 ms."""
    path = tmp_path / "run.mcap"
    files = [Attached("a.sbs", SBS), Attached("a.svar", SVAR)]
    writer = LogWriter(path, run(), files)
    pid, other = (
        writer.add_task(structs.replace(about(name, PLAIN), rmod=RMOD))
        for name in ("pid", "other")
    )
    for n in range(1, 31):
        release = (n + (3 if n > 10 else 0)) * PERIOD
        data, _ = group(PLAIN, random.Random(1))
        writer.add(pid, record(
            data, cycle=n, release_ns=release, start_ns=release,
            end_ns=release + (35_000_000 if n == 10 else 1_000_000), cpu_ns=1_000_000,
        ))  # fmt: skip
    begin = 10 * PERIOD
    for n, start, end in ((1, 2_000_000, 14_000_000), (2, 30_000_000, 40_000_000)):
        data, _ = group(PLAIN, random.Random(1))
        writer.add(other, record(
            data, cycle=n, release_ns=begin + start, start_ns=begin + start,
            end_ns=begin + end, cpu_ns=end - start,
        ))  # fmt: skip
    for one in SOUND[:1]:
        writer.add_event(one)
    writer.close()
    text = str(diagnosis.answer(path, ("miss", "pid"), Place()))
    assert "other took 17 ms of the core meanwhile" in text
    assert "for 17 of the 35 ms in which pid was ready, no task of its RTPU" in text
