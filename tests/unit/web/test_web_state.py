"""What is kept for browsers that come late, and what is sent to each."""

from __future__ import annotations

import asyncio
import math

import msgspec
import pytest

from pbonet.master.web.access import Role
from pbonet.master.web.browsers import Browser, Browsers
from pbonet.master.web.differences import States, Values, signals
from pbonet.master.web.history import EVENTS, SECONDS, History
from pbonet.xm.net import messages as m


def value(name="X", seq=1, age=0.5, numbers=(1.0,), **more):
    given = {"writer": "pid", "stale": False} | more
    return m.VarValue(
        name=name, index=0, values=list(numbers), units="m", seq=seq, age=age, **given
    )


def task(name="pid", rtpu="arm0", **more):
    given = {"state": "ON", "cycle": 5, "miss": 0, "now": 10**9, "ref_f": 100.0} | more
    times = {
        **dict.fromkeys(("mez_f", "mez_t", "ptime", "tot_c", "tick"), 0.0),
        **dict.fromkeys(("min_c", "max_c", "last_c"), 0.0),
    }
    return m.TaskStatus(
        rmod=name, task=name, rtpu=rtpu, tid=7, S="P", crit=3, warn=0, **times, **given
    )


def rtpu(name="arm0", tasks=()):
    return m.RtpuStatus(rtpu=name, backend="fifo", scheduler="MUF", tasks=list(tasks))


def test_history_keeps_a_minute_of_each_variable_and_the_last_events():
    kept = History()
    for n in range(200):
        kept.add_values({"X": {"t": float(n), "v": [n]}})
    kept.add_values({"X": {"t": 199.0, "v": [-1]}})
    found = kept.values(["X", "Y"])
    assert found.keys() == {"X"}
    assert found["X"]["t"] == [float(n) for n in range(199 - int(SECONDS), 200)]
    assert found["X"]["v"][-1] == [199]
    kept.add_events({"n": n} for n in range(EVENTS + 10))
    assert [one["n"] for one in kept.events] == list(range(10, EVENTS + 10))


def test_the_history_of_many_variables_at_once_has_fewer_samples_of_each():
    kept = History()
    names = [f"V{n}" for n in range(100)]
    for n in range(200):
        kept.add_values({name: {"t": n * 0.1, "v": [n] * 20} for name in names})
    found = kept.values(names)
    numbers = sum(len(one["t"]) * 20 for one in found.values())
    assert 100_000 < numbers <= 200_000
    assert {one["v"][-1][0] for one in found.values()} == {199}
    assert len(kept.values(["V0"])["V0"]["t"]) == 200


def test_values_are_new_when_written_again_or_stale_and_have_their_sample_time():
    sent = Values()
    first = sent.new([value(), value("Y", writer=None, age=None)], 100.0)
    assert first["X"] == {
        "t": 99.5, "v": [1.0], "writer": "pid", "age": 0.5, "stale": False
    }  # fmt: skip
    assert first["Y"]["t"] is None
    assert first["Y"]["writer"] == ""
    assert sent.new([value(age=1.5)], 101.0) == {}
    assert sent.new([value(seq=2)], 102.0).keys() == {"X"}
    assert sent.new([value(seq=2, stale=True)], 103.0)["X"]["stale"]


def test_a_table_made_anew_or_a_clock_that_was_set_hides_no_value():
    """The table counts from the beginning again: the count is that of an old value."""
    sent = Values()
    nan = math.nan
    assert sent.new([value(numbers=(1.0, nan))], 100.0)
    assert not sent.new([value(numbers=(1.0, nan), age=1.5)], 101.0)
    assert sent.new([value(numbers=(7.0, nan), age=1.6)], 101.1)["X"]["v"][0] == 7.0
    assert sent.new([value(numbers=(7.0, nan), age=0.1)], 200.0)["X"]["t"] == 199.9
    assert sent.new([value(numbers=(7.0, nan), age=0.6)], 50.0)["X"]["t"] == 49.4
    assert sent.new([value(numbers=(0.0, 0.0), age=None)], 51.0)["X"]["t"] is None


def test_history_goes_on_when_the_clock_is_put_back():
    kept = History()
    for at in (100.0, 101.0, 102.0, 50.0, 51.0):
        kept.add_values({"X": {"t": at, "v": [at]}})
    assert kept.values(["X"])["X"]["t"] == [50.0, 51.0]


def test_history_of_a_large_variable_is_shorter():
    kept = History()
    for n in range(500):
        kept.add_values({"X": {"t": n * 0.05, "v": [float(n)] * 1000}})
    found = kept.values(["X"])["X"]
    assert len(found["t"]) == 100
    assert found["v"][-1] == [499.0] * 1000


def test_states_send_only_what_changed_and_whole_has_all():
    states = States()
    both = {"arm0": rtpu(tasks=[task()]), "arm1": rtpu("arm1")}
    first = states.new(both, [], 1.0)
    assert [one["task"] for one in first["tasks"]] == ["pid"]
    assert [one["rtpu"] for one in first["rtpus"]] == ["arm0", "arm1"]
    states.new(both, [], 1.5)  # the first status of a task has no rates
    same = states.new(both, [], 2.0)
    assert (same["tasks"], same["rtpus"], same["gone"]) == ([], [], [])
    off = {**both, "arm0": rtpu(tasks=[task(state="OFF")])}
    changed = states.new(off, [], 3.0)["tasks"]
    assert [(one["state"], one["signals"]) for one in changed] == [
        ("OFF", signals("OFF"))
    ]
    whole = states.whole(3.0)
    assert [len(whole["tasks"]), len(whole["rtpus"])] == [1, 2]


def test_a_page_gets_when_a_core_last_stood_still():
    states, status = States(), rtpu()
    for age in (None, 0.0, 3.21987):
        status.stall_age = age
        (sent,) = states.new({"arm0": status}, [], 1.0)["rtpus"]
        assert sent["stall_age"] == (age and 3.22)


def test_tasks_of_a_silent_rtpu_stay_and_it_is_marked():
    states = States()
    states.new({"arm0": rtpu(tasks=[task()])}, [], 1.0)
    message = states.new({}, ["arm0"], 2.0)
    assert message["gone"] == []
    assert message["rtpus"][0]["silent"]
    assert states.whole(2.0)["tasks"][0]["task"] == "pid"
    back = states.new({"arm0": rtpu()}, [], 3.0)
    assert back["gone"] == ["pid"]
    assert not back["rtpus"][0]["silent"]


@pytest.mark.parametrize(
    ("state", "legal"),
    [
        ("NOT-CREATED", []),
        ("OFF", ["on", "kill", "reinit"]),
        ("ON", ["off", "kill", "reinit"]),
        ("ERROR", ["kill", "clear", "reinit"]),
    ],
)
def test_signals_are_those_that_are_legal_now(state, legal):
    assert signals(state) == legal


def take(browser):
    async def taken():
        async with asyncio.timeout(10):
            return [msgspec.json.decode(text) for text in await browser.take()]

    return asyncio.run(taken())


def test_a_browser_gets_the_newest_of_the_values_that_it_watches():
    watched = []
    all_ = Browsers(watched.append)
    one, other = Browser(Role.OPERATOR), Browser(Role.OBSERVER)
    all_.add(one)
    all_.add(other)
    one.watched = frozenset("AB")
    other.watched = frozenset("C")
    all_.rewatch()
    for n in range(3):
        all_.send({"kind": "values", "t": n, "values": {"A": {"v": [n]}, "C": {}}})
    all_.send({"kind": "values", "t": 3, "values": {"B": {"v": [math.nan]}}})
    assert take(one) == [
        {"kind": "values", "t": 3, "values": {"A": {"v": [2]}, "B": {"v": [None]}}}
    ]
    assert take(other) == [{"kind": "values", "t": 2, "values": {"C": {}}}]
    all_.remove(one)
    assert watched == [frozenset("ABC"), frozenset("C")]


def test_a_browser_that_reads_nothing_is_lost_and_keeps_a_bounded_number():
    all_ = Browsers(lambda _: None)
    browser = Browser(Role.OPERATOR)
    all_.add(browser)
    for n in range(2000):
        all_.send({"kind": "events", "events": [n]})
    assert browser.lost
    assert len(take(browser)) <= 500
    other = Browser(Role.OBSERVER)
    for _ in range(50):
        other.put(b"1" + 1_000_000 * b" ")
    assert other.lost
    assert len(take(other)) < 40
