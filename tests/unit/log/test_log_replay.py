"""A task's code is run again on what its journal and its cycles left.

The table, the local table, the ring, the executor and the recorder are those of a task;
only the native loop around the cycles is done here in Python.
"""

from __future__ import annotations

import random
import struct
import subprocess
import sys
import time
from pathlib import Path

import msgspec
import pytest
from adding_module import ADDS
from log_of_python_tasks import RMOD, Shop, Task, drive

from pbonet.config.library import Library
from pbonet.errors import LogError, UnknownTaskError
from pbonet.log import Did, Log, code_of
from pbonet.log.cycle_columns import HEAD_DTYPE
from pbonet.log.schema import RECORD
from pbonet.node.recorder.recorder_process import Recorder
from pbonet.node.ring._ring import Ring
from pbonet.node.wire import rtpu_messages
from pbonet.testing import DivergedError, replay, rerun, verify

OFF_HEARS = """def off(self) -> None:
        self.it.ask(bytes, 1 << 17)"""


def recording(folder, **more):
    """Return what a recorder is told."""
    return rtpu_messages.Recording(
        domain="d",
        rtpu="arm0",
        subsystem="arm",
        core=0,
        folder=str(folder),
        file="run",
        run="r",
        job="j",
        mode="outputs",
        **more,
    )


@pytest.fixture
def shop(tmp_path):
    shop = Shop(tmp_path)
    yield shop
    shop.close()


def test_all_that_tasks_do_gives_the_same_again(shop) -> None:
    drive(shop)
    path = shop.log()
    verdicts = {one.task: one for one in verify(path)}
    assert str(verdicts["a"]).startswith("a: 20 cycles identical")
    assert str(verdicts["b"]).startswith("b: 21 cycles identical")
    assert all(one.good and not one.changed for one in verdicts.values())
    assert verdicts["a"].seconds == pytest.approx(0.2)
    assert replay(path, "b").cycles == 21


def test_a_method_that_heard_too_much_spoils_no_cycle_before_it(tmp_path) -> None:
    code = ADDS.replace("self.age = 0.1", 'self.age, self.it = 0.1, Outside("it")')
    code = code.replace("+= dt", "+= len(self.it.ask(bytes, default=b'')) + dt")
    code = code.replace("def off(self) -> None:", OFF_HEARS)
    shop = Shop(tmp_path, f"from pbonet.io import Outside\n{code}")
    try:
        shop.cycles(5)
        shop.a.signal("off")
        path = shop.log()
    finally:
        shop.close()
    verdicts = {one.task: one for one in verify(path)}
    assert verdicts["b"].good
    assert verdicts["a"].cycles == 5
    assert verdicts["a"].gaps == [
        "off after cycle 5: its input from it did not fit on the tape"
    ]


def test_tasks_that_hand_over_give_the_same_again(shop) -> None:
    shop.cycles(3)
    shop.c = Task(shop.table, Library([shop.folder]), "c", RMOD.format(z="X", y="Y0"))
    for old, new in ((shop.a, shop.c), (shop.c, shop.a)):
        before = shop.table.generation
        old.hand_over()
        shop.b.cycle()
        assert shop.table.info("Y0").owner == old.task, "nobody else owns it meanwhile"
        new.engage(old.task)
        assert shop.table.info("Y0").owner == new.task
        assert shop.table.generation == before + 1, "one event"
        for _ in range(4):
            new.cycle()
            shop.b.cycle()
    path = shop.log()
    verdicts = {one.task: one for one in verify(path)}
    assert all(one.good for one in verdicts.values()), verdicts
    assert [verdicts[name].cycles for name in "abc"] == [7, 13, 4]
    shop.code.write_text(ADDS.replace("+= self.task.handover", "+= 0.0"))
    with pytest.raises(DivergedError, match=r"off, after cycle 3: Y0\[1\] is "):
        replay(path, "a")


@pytest.mark.parametrize(
    ("old", "new", "where"),
    [
        ("dt / 3.0", "dt / 3.5", "cycle 1: Y0[0] is "),
        ("= 0.1", "= 0.2", "cycle 1: Y0[0] is "),
        ("self.y[0] = self.task.cyclecount", "pass", "off, after cycle 4: Y0[0] is "),
        ("self.age = 0.1", "raise OSError('no scale')", "no scale"),
        (
            "self.y += self",
            "raise OSError\n        self",
            "it raised OSError",
        ),
    ],
)
def test_the_first_divergence_is_named(shop, old, new, where) -> None:
    shop.cycles(4)
    shop.a.signal("off")
    path = shop.log()
    shop.code.write_text(ADDS.replace(old, new))
    with pytest.raises(DivergedError) as caught:
        replay(path, "a")
    assert where in str(caught.value)
    number = next(i for i, line in enumerate(ADDS.splitlines(), 1) if old in line)
    assert f"adds.py has changed: {shop.a.about.code[0].sha256[:12]} to " in str(
        caught.value
    )
    assert f", lines {number}" in str(caught.value)


def test_what_counts_is_the_code_that_is_run_again(shop, tmp_path) -> None:
    """A log of another machine, whose folders are not here, with the code that is."""
    shop.cycles(2)
    path = shop.log()
    here = tmp_path / "elsewhere" / "modules"
    here.mkdir(parents=True)
    shop.code.rename(here / "adds.py")
    (one,) = verify(path, ["a"], libraries=[here])
    assert one.good
    assert not one.changed, "it stands elsewhere, and is the same"
    code = ADDS.replace("dt / 3.0", "2.0 * dt / 6.0")
    helper = "from ._more import NOTHING\n"
    (here / "adds.py").write_text(f"{code}{helper}")
    (here / "_more.py").write_text("NOTHING = 0\n")
    shop.code.write_text(ADDS)
    verdict = verify(path, ["a"], libraries=[here])[0]
    number = next(i for i, line in enumerate(ADDS.splitlines(), 1) if "dt / 3" in line)
    end = len(ADDS.splitlines()) + 1
    other, new = map(str, verdict.changed)
    assert other.startswith(f"{here / 'adds.py'} has changed: ")
    assert other.endswith(f", lines {number}, {end}")
    assert new.startswith(f"{here / '_more.py'} is new (")


def test_a_task_whose_code_is_missing_hides_no_other(shop) -> None:
    shop.cycles(2)
    path = shop.log(hidden=["Y0"])
    shop.code.unlink()
    for verdicts in (verify(path), rerun(path).tasks):
        assert [one.cycles for one in verdicts] == [0, 0]
        for one in verdicts:
            assert one.divergence is None
            assert "the library has no module adds" in str(one)
            assert "adds.py is gone" in str(one)


def test_a_file_that_is_used_no_more_is_told(shop) -> None:
    (shop.folder / "_more.py").write_text("NOTHING = 0\n")
    about = shop.a.about
    more = msgspec.structs.replace(about.code[0], path=f"{shop.folder}/_more.py")
    about.code.append(more)
    shop.cycles(2)
    (one,) = verify(shop.log(), ["a"])
    assert [str(it) for it in one.changed] == [
        f"{shop.folder}/_more.py is gone (recorded {more.sha256[:12]})"
    ]


def test_one_other_bit_is_a_divergence_unless_told(shop) -> None:
    shop.cycles(3)
    path = shop.log()
    shop.code.write_text(ADDS.replace("dt / 3.0", "dt / 3.0000000000001"))
    (one,) = verify(path, ["a"])
    assert one.divergence is not None
    assert one.divergence.variable == "Y0"
    assert one.divergence.recorded != one.divergence.computed
    assert verify(path, ["a"], rtol=1e-9)[0].good


@pytest.mark.parametrize("odd", ["a bit", "NaN", "-0.0"])
def test_each_other_value_of_a_cycle_is_named(shop, odd) -> None:
    """Wherever it stands: at either end of what one message holds, and amid."""
    shop.cycles(20)
    place, rng = RECORD.size + HEAD_DTYPE.itemsize, random.Random(20)
    whole, first = list(shop.a.records), len(shop.a.records) - 20
    for cycle in range(1, 21):
        element = rng.randrange(2)
        record = bytearray(whole[first + cycle - 1])
        at = place + 8 * element
        if odd == "a bit":
            record[at + rng.randrange(8)] ^= 1 << rng.randrange(8)
        else:
            record[at : at + 8] = struct.pack("<d", float(odd))
        shop.a.records = list(whole)
        shop.a.records[first + cycle - 1] = bytes(record)
        path = shop.log()
        (one,) = verify(path, ["a"])
        path.unlink()
        assert not one.good
        assert f"cycle {cycle}: Y0[{element}] is " in str(one.divergence)


def test_lost_records_make_a_gap_in_what_is_verified(shop) -> None:
    shop.cycles(3)
    shop.a.cycle(lost=2)
    path = shop.log()
    (one,) = verify(path, ["a"])
    assert (one.cycles, one.recorded, one.divergence) == (4, 4, None)
    assert one.gaps == ["2 records were lost after cycle 3"]
    with pytest.raises(DivergedError, match="a cannot be verified: 2 records were"):
        replay(path, "a")


def test_inputs_of_a_task_that_is_not_on_record(shop) -> None:
    shop.cycles(3)
    (one,) = verify(shop.log(without="a"), ["b"])
    assert one.divergence is None
    assert "is not recorded" in one.gaps[0]


def test_inputs_that_are_hidden(shop) -> None:
    shop.cycles(3)
    a, b = verify(shop.log(hidden=["Y0"]))
    assert a.good, "what is not recorded is not compared"
    assert b.gaps[0].endswith("Y0 is not recorded")


def test_a_cycle_that_failed_ends_it(shop) -> None:
    shop.cycles(3)
    shop.a.do(Did("fault", name="cycle", arg="it hurts"), lambda: None)
    (one,) = verify(shop.log(), ["a"])
    assert one.gaps == ["cycle after cycle 3: it hurts"]
    assert one.good, "the failed one is no recorded cycle"


def test_a_log_without_the_task_or_its_cycles(shop) -> None:
    path = shop.log()
    with pytest.raises(UnknownTaskError):
        replay(path, "c")
    with pytest.raises(LogError, match="the log has no cycle of a"):
        replay(path, "a")


def test_the_fixture_looks_beside_the_test(shop, tmp_path) -> None:
    shop.cycles(2)
    shop.log()
    (tmp_path / "conftest.py").write_text(
        'pytest_plugins = ["pbonet.testing.fixtures"]\n'
    )
    status, out = pytest_on(
        tmp_path,
        "def test_it(replayed):\n    assert replayed('run.mcap', 'b').cycles == 2\n",
    )
    assert status == 0, out
    assert "1 passed" in out


def pytest_on(folder, code):
    """Return the status and output of pytest on the code of a test."""
    (folder / "test_it.py").write_text(code)
    command = [sys.executable, "-m", "pytest", "-q", "-p", "no:cacheprovider"]
    done = subprocess.run(
        [*command, "test_it.py"],
        cwd=folder,
        capture_output=True,
        text=True,
        check=False,
    )
    return done.returncode, done.stdout


def test_pytest_ends_with_what_differs_and_the_line_of_the_test(shop, tmp_path) -> None:
    shop.cycles(3)
    shop.log()
    shop.code.write_text(ADDS.replace("= 0.1", "= 0.2"))
    status, out = pytest_on(
        tmp_path,
        "from pbonet.testing import Bench, replay\n"
        "from adds import Adds, Gain\n\n"
        "def test_log():\n    replay('run.mcap', 'a')\n\n"
        "def test_gain():\n    Gain(gain='much')\n\n"
        "def test_bench():\n    Bench(Adds, params={'gian': 2.0}, n=2)\n",
    )
    assert status == 1
    sections = out.partition("short test summary")[0].split("\n____")[1:]
    ends = [one.rstrip("=\n ").splitlines() for one in sections]
    wanted = [
        (5, "DivergedError: a differs from its log: cycle 1: Y0[0] is ", "or record a"),
        (8, "Gain.gain: parameter gain has the wrong type (", "a value of that type"),
        (11, "Gain: Gain has no parameter gian (", "did you mean gain?"),
    ]
    for lines, (number, begin, end) in zip(ends, wanted, strict=True):
        *_, error, _, place = lines
        assert place.startswith(f"test_it.py:{number}: "), lines
        assert begin in error
        assert end in error


def test_the_recorder_writes_what_is_in_the_rings(shop, tmp_path) -> None:
    said = []
    wanted = recording(tmp_path / "runs" / "r", files={"a.job": "JOB a"})
    ring = Ring.create("d.arm.c", 1 << 12, msgspec.json.encode(shop.a.about))
    other = Ring.create("d.arm.d", 1 << 12, b"not ours")
    for n in range(3):
        ring.put(bytes(16), cycle=n + 1, now_ns=n)
    recorder = Recorder(wanted, said.append)
    recorder.turn()
    while ring.put(bytes(16), cycle=9):
        pass
    recorder.turn()
    ring.put(bytes(16), cycle=10)
    ring.destroy()
    recorder.end()
    other.destroy()
    log = Log(tmp_path / "runs" / "r")
    cycles = log.arrays("a")["cycle"].tolist()
    assert cycles[:4] == [1, 2, 3, 9]
    assert cycles[-1] == 10
    assert log.parts[0].complete
    assert set(log.attached) == {"a.job", "a.rmod", str(shop.code)}
    codes = [one.code for one in said if isinstance(one, rtpu_messages.Note)]
    assert codes == ["RING_FULL"]
    assert log.lost() == {"a": 1}
    path = str(tmp_path / "runs" / "r" / "run.mcap")
    states = [one for one in said if isinstance(one, rtpu_messages.Recorder)]
    assert [(one.path, one.lost) for one in states] == [(path, 0), (path, 1)]


def test_a_recorder_that_cannot_write_says_so_and_goes_on(shop, tmp_path) -> None:
    blocked = tmp_path / "runs"
    blocked.write_text("a file where a folder should be")
    said = []
    wanted = recording(blocked / "r")
    ring = Ring.create("d.arm.c", 1 << 12, msgspec.json.encode(shop.a.about))
    one = Recorder(wanted, said.append)
    ring.put(bytes(16), cycle=1)
    one.turn()
    assert [note.code for note in said if isinstance(note, rtpu_messages.Note)] == [
        "LOG_FULL"
    ]
    assert said[-1] == rtpu_messages.Recorder(
        subsystem="arm", run="r", path="", lost=1, handed_on={"a": 1}
    )
    blocked.unlink()
    deadline = time.monotonic() + 10.0
    while not Path(blocked, "r", "run.mcap").exists() and time.monotonic() < deadline:
        one.turn()
        time.sleep(0.05)
    ring.put(bytes(16), cycle=2)
    one.end()
    ring.destroy()
    assert "LOG_CONTINUED" in [
        note.code for note in said if isinstance(note, rtpu_messages.Note)
    ]
    assert Log(blocked / "r").arrays("a")["cycle"].tolist() == [2]


def test_a_step_of_the_clock_does_not_reach_into_a_log(
    shop, tmp_path, monkeypatch
) -> None:
    """The time of day is set back by an hour, and a file begins behind that."""
    wanted = recording(
        tmp_path / "runs" / "r", limits=rtpu_messages.LogLimits(log_mb=0.001)
    )
    ring = Ring.create("d.arm.c", 1 << 12, msgspec.json.encode(shop.a.about))
    recorder = Recorder(wanted, lambda _: None)
    begun, day = time.monotonic_ns(), time.time_ns()
    recorder.turn()
    real = time.time_ns
    for n in range(1, 4):
        ring.put(bytes(16), cycle=n, now_ns=begun + n)
        recorder.turn()
        monkeypatch.setattr(time, "time_ns", lambda: real() - 3600 * 10**9)
        monkeypatch.setattr(time, "time", lambda: real() * 1e-9 - 3600)
    recorder.end()
    ring.destroy()
    log = Log(tmp_path / "runs" / "r")
    assert len(log.parts) > 1
    assert len({part.about.epoch_ns for part in log.parts}) == 1
    (life,) = log.lives("a")
    assert life.schema.arrays(life.commits)["cycle"].tolist() == [1, 2, 3]
    times = life.commits.times - life.commits.times[0]
    assert times.tolist() == [0, 1, 2]
    assert abs(log.begin_time_ns - day) < 60 * 10**9, "the time at which it began"


def test_code_of_the_library_and_its_devices_counts_native_code_too():
    """By the source, which is the same wherever it was compiled."""
    library = Library()

    def names(module):
        return {Path(one.path).name for one in code_of([library.load(module).path])}

    assert names("pid") == {"pid.py", "_values.py", "_takeover.pyx"}
    assert names("puma_pidg") >= {"arm.py", "_friction.pyx", "_poses.pyx", "puma560.py"}
