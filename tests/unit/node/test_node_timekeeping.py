"""What is told of cycles that fail in time."""

from types import SimpleNamespace as Plain

import pytest

from pbonet.node.rtpu.timing_failure_events import TimingFailureEvents
from pbonet.node.wire.event_log import EventLog

MS = 1_000_000
TASK = Plain(name="pid", facts=Plain(subsystem="arm"))
CORE = Plain(stalls=0, stalled_ns=0, errors=0, core=1)


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
