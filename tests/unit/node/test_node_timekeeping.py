"""What is told of cycles that fail in time."""

from types import SimpleNamespace as Plain

import pytest

from pbonet.node.rtpu import timing_failure_events
from pbonet.node.rtpu.timing_failure_events import TimingFailureEvents
from pbonet.node.wire.core_times import CoreTimes
from pbonet.node.wire.event_log import EventLog

MS = 1_000_000
TASK = Plain(name="pid", facts=Plain(subsystem="arm"))
CORE = Plain(stalls=0, stalled_ns=0, errors=0, core=1, leader_pid=0, leader_tid=0)


@pytest.mark.parametrize(
    ("now_ms", "longest_ms", "maxc_ms", "told"),
    [
        (0, 3, 2, "the longest cycle took 3 ms of CPU time; reserve 2 ms"),
        (1, 3, 0, "the longest cycle took 3 ms of CPU time"),
        (
            480,
            3,
            0,
            "the cycle under way has taken 480 ms of CPU time so far; MAXC in its "
            ".rmod would bound what a cycle takes; the longest cycle took 3 ms of CPU "
            "time",
        ),
        (
            9,
            0,
            2,
            "the cycle under way has taken 9 ms of CPU time so far; reserve 2 ms",
        ),
    ],
)
def test_a_cycle_that_does_not_end_is_told_with_its_time(
    now_ms, longest_ms, maxc_ms, told
):
    events = EventLog("arm0")
    slot = Plain(
        pid=7,
        hung=False,
        flooded=False,
        in_sync=False,
        failures=(4, 0, 0),
        held_off=0,
        safe=0,
        cycles=12,
        on_cycles=10,
        cpu_now_ns=now_ms * MS,
        cpu_max_ns=longest_ms * MS,
        maxc_ns=maxc_ms * MS,
    )
    keeper = TimingFailureEvents(events)
    keeper.report_new(CORE, [(TASK, slot)])
    keeper.report_new(CORE, [(TASK, slot)])  # nothing new
    (event,) = events.since(0)
    assert (event.code, event.task, event.cycle) == ("TIMING_FAILURE", "pid", 2)
    head, _, times = event.text.partition("; ")
    assert head.startswith("timing failures: 4 ")
    assert times == told


def kernel(folder, line, waited):
    """Write what the kernel says of core 1 and of the dispatcher's thread."""
    thread = folder / "7/task/8"
    thread.mkdir(parents=True, exist_ok=True)
    (thread / "schedstat").write_text(f"999 {waited} 12\n")
    (folder / "stat").write_text(f"cpu 9 9 9 9 9 9 9 9\ncpu1 {line} 0 0\nintr 5\n")


def test_what_a_core_did_is_the_kernels_difference(tmp_path):
    times = CoreTimes(1, tmp_path)
    kernel(tmp_path, "100 0 50 300 5 1 2 40", 1_000_000)
    assert times.read(7, 8) == ""  # nothing to compare with yet
    kernel(tmp_path, "120 0 55 310 5 1 4 43", 3_250_000)
    text = times.read(7, 8)
    assert text.startswith("core 1 in ")
    assert text.endswith(
        " s: busy 250 ms, idle 100 ms, interrupts 20 ms, stolen by the hypervisor 30 "
        "ms; its dispatcher waited 2.25 ms for it"
    )
    kernel(tmp_path, "120 0 55 310 5 1 4 43", 9_000_000)
    assert "dispatcher" not in times.read(7, 9)  # another one leads
    (tmp_path / "stat").unlink()
    assert times.read(7, 9) == ""


class CountedTimes:
    """Core times that count how often they were read."""

    readings = 0

    def __init__(self, _core):
        self.first = True

    def read(self, _pid, _tid):
        CountedTimes.readings += 1
        first, self.first = self.first, False
        return "" if first else "core 1 in 0.50 s"


def test_core_times_are_read_only_while_there_are_tasks(monkeypatch):
    """The first failure of the first task has them all the same."""
    monkeypatch.setattr(timing_failure_events, "CoreTimes", CountedTimes)
    monkeypatch.setattr(CountedTimes, "readings", 0)
    events = EventLog("arm0")
    keeper = TimingFailureEvents(events)
    fields = dict.fromkeys(
        ("hung", "flooded", "held_off", "safe", "cycles", "on_cycles", "maxc_ns"), 0
    )
    slot = Plain(**fields, pid=7, failures=(4, 0, 0), cpu_now_ns=0, cpu_max_ns=0)
    for _ in range(2):
        keeper.report_new(CORE, [])
        assert CountedTimes.readings == 0
        keeper.begin(CORE)
        keeper.report_new(CORE, [(TASK, slot)])
        assert events.since(0)[-1].text.endswith("core 1 in 0.50 s")
        keeper.report_new(CORE, [])
        assert CountedTimes.readings == 2
        CountedTimes.readings = 0


@pytest.mark.parametrize(("stalls", "said"), [(1, "once"), (3, "3 times")])
def test_a_stall_of_the_core_is_an_event_with_its_time(stalls, said):
    events = EventLog("arm0")
    stalled = Plain(**vars(CORE) | {"stalls": stalls, "stalled_ns": 45 * MS})
    keeper = TimingFailureEvents(events)
    keeper.report_new(stalled, [])
    keeper.report_new(stalled, [])  # nothing new
    (event,) = events.since(0)
    assert event.code == "CORE_STALLED"
    assert event.text.startswith(f"core 1 stood still {said}, 45 ms in all; ")
