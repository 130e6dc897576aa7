"""What is played goes out at its times: rate, start, end, loop, and how late it was."""

from __future__ import annotations

from types import SimpleNamespace

import numpy as np
import pytest
from made_logs import about, record, run

from pbonet.config.model import Variable
from pbonet.errors import LogError, SvarLayoutError
from pbonet.log import LogWriter, Step
from pbonet.master.tools import playback
from pbonet.master.tools.playback import Span, play
from pbonet.svar import Table

Y = Variable(name="Y", type="double", nelem=1, units="m")
N = Variable(name="N", type="int", nelem=1)
MS = 10**6
PERIOD, COUNT = 2, 50
"""Milliseconds between cycles, and how many there are."""


class Time:
    """A clock that goes on only while somebody sleeps.

    Args:
        seen: Told before each sleep at what time it begins.
    """

    def __init__(self, seen):
        self.now, self.seen, self.extra = 1000.0, seen, {}

    def monotonic(self):
        return self.now

    def monotonic_ns(self):
        return round(self.now * 1e9)

    def sleep(self, seconds):
        self.seen(self.now)
        self.now += seconds + self.extra.pop(round((self.now - 1000.0) * 1e3), 0.0)


@pytest.fixture
def path(tmp_path):
    """A log in which `a` writes n into Y in its cycle n, from 2 ms on."""
    writer = LogWriter(tmp_path / "run.mcap", run(epoch_ns=10**18))
    told = about("a", [Y], outconst=[N])
    number = writer.add_task(told)
    parts = [record(np.array([7], "<i8").tobytes(), kind=Step.CONSTS_OUT)]
    parts.append(record(bytes(8), kind=Step.CLAIM))
    for n in range(1, COUNT + 1):
        at = n * PERIOD * MS
        parts.append(record(np.array([n], float).tobytes(), cycle=n, end_ns=at))
    writer.add(number, b"".join(parts))
    writer.close()
    return tmp_path / "run.mcap"


@pytest.fixture
def live(monkeypatch):
    """The table, the clock, and what stood in Y when, in ms since the beginning."""
    table = Table.create("d.arm", [Y, N])
    seen: list[tuple[float, float]] = []

    def look(now):
        seen.append((round((now - 1000.0) * 1e3, 3), float(table.read("Y")[0])))

    clock = Time(look)
    monkeypatch.setattr(playback, "time", clock)
    yield SimpleNamespace(table=table, clock=clock, seen=seen)
    table.destroy()


@pytest.mark.parametrize("rate", [1.0, 2.0, 0.25])
def test_each_value_goes_out_at_its_time(path, live, rate) -> None:
    (played,) = play(path, ["a"], Span(rate=rate), domain="d")
    # Before the sleep that ends at the time of value n, value n - 1 stands.
    period = PERIOD / rate
    assert live.seen == [(round(n * period, 3), n) for n in range(COUNT)]
    assert live.clock.now == pytest.approx(1000.0 + COUNT * period * 1e-3)
    assert (played.commits, played.refused) == (COUNT + 1, 0)
    assert played.late == pytest.approx(0.0, abs=1e-9)
    assert live.table.read("Y")[0] == COUNT
    assert live.table.read("N")[0] == 7, "its constants too"


def test_several_tasks_are_played_in_one_time(tmp_path, monkeypatch) -> None:
    """`a` writes Y each 2 ms, `b` writes Z each 3 ms; each of them owns its own."""
    names = {"a": ("Y", 2), "b": ("Z", 3)}
    variables = {one: Variable(name=one, type="double") for one in "YZ"}
    writer = LogWriter(tmp_path / "run.mcap", run(epoch_ns=10**18))
    for task, (name, period) in names.items():
        number = writer.add_task(about(task, [variables[name]]))
        parts = [record(bytes(8), kind=Step.CLAIM)]
        for n in range(1, 60 // period + 1):
            value = np.array([n * period], float).tobytes()
            parts.append(record(value, cycle=n, end_ns=n * period * MS))
        writer.add(number, b"".join(parts))
    writer.close()
    table = Table.create("d.arm", list(variables.values()))
    seen, owners = {}, set()

    def look(now):
        at = round((now - 1000.0) * 1e3 * 2, 3)
        seen[at] = [float(table.read(one)[0]) for one in "YZ"]
        owners.update((one, table.info(one).owner) for one in "YZ")

    monkeypatch.setattr(playback, "time", Time(look))
    try:
        one, two = play(tmp_path, ["a", "b"], Span(rate=2.0), domain="d")
    finally:
        table.destroy()
    assert (one.task, one.commits) == ("a", 31)
    assert (two.task, two.commits) == ("b", 21)
    assert owners == {("Y", "replay:a"), ("Z", "replay:b")}
    assert seen == {at: [at - at % 2, at - at % 3] for at in seen}
    assert sorted(seen) == [n for n in range(60) if not n % 2 or not n % 3]


def test_a_part_begins_at_once(path, live) -> None:
    (played,) = play(path, ["a"], Span(start=0.02, end=0.03), domain="d")
    assert live.seen == [(2.0 * n, 10 + n) for n in range(5)]
    assert played.commits == 6, "10 to 15, both among them"
    assert live.table.read("Y")[0] == 15


def test_over_and_over_until_an_interrupt(path, live, monkeypatch) -> None:
    def look(now):
        live.seen.append(round((now - 1000.0) * 1e3, 3))
        if now > 1000.0315:
            raise KeyboardInterrupt

    monkeypatch.setattr(live.clock, "seen", look)
    (played,) = play(path, ["a"], Span(start=0.02, end=0.03, loop=True), domain="d")
    assert live.seen == [2.0 * n for n in range(17)], (
        "a round each 10 ms, without a gap"
    )
    assert played.commits == 3 * 6 + 2
    assert live.table.info("Y").owner is None


def test_how_late_the_latest_value_was(path, live) -> None:
    live.clock.extra = {10: 0.0073, 40: 0.0012}
    (played,) = play(path, ["a"], Span(), domain="d")
    assert played.late == pytest.approx(0.0073)
    assert "7.3" in str(played)
    assert live.clock.now == pytest.approx(1000.1), "what was late is made up for"


@pytest.mark.usefixtures("live")
def test_what_does_not_fit_is_refused(path) -> None:
    with pytest.raises(
        LogError, match="no commit of these tasks in that time"
    ) as caught:
        play(path, ["a"], Span(start=3.0), domain="d")
    assert caught.value.got == "3 s to 0.1 s"
    other = Table.create("d.leg", [Variable(name="Y", type="double", units="rad")])
    try:
        with pytest.raises(SvarLayoutError, match="Y differs between"):
            play(path, ["a"], domain="d", subsystem="leg")
    finally:
        other.destroy()
