"""Commands of browsers: who may give which, and what they hear."""

from __future__ import annotations

import asyncio
import contextlib
import threading
from pathlib import Path

import pytest
from hypothesis import given, strategies as st

from pbonet.errors import ProtocolError, StateError
from pbonet.master.configuration import Place
from pbonet.master.console import COMMANDS, Reply, oneshot, stop_all
from pbonet.master.web import orders
from pbonet.master.web.access import Role

PUMA = Path(__file__).parents[3] / "examples" / "puma" / "puma.job"


class Given:
    """Commands that were carried out, in place of a subsystem's."""

    def __init__(self):
        self.calls = []
        self.gate = threading.Event()
        self.gate.set()
        self.stopped = threading.Event()

    def perform(self, _path, call, _place, *, kind="", begun=None):
        begun(self)
        self.gate.wait(30)
        self.calls.append((call.command.name, call.words, kind))
        if call.given.get("text") == "odd":
            raise KeyError("a name")
        if call.given.get("text") == "wrong":
            raise StateError("the task is asleep", got="OFF", remedy="wake it")
        return Reply(command="on", data={"states": {"pid": "ON"}})


@pytest.fixture
def carried(monkeypatch):
    carried = Given()
    monkeypatch.setattr(oneshot, "perform", carried.perform)
    return carried


@pytest.fixture
def made(carried):
    assert carried.calls == []
    made = orders.Orders(
        orders.Steered(PUMA, "puma", Place()), lambda task: task == "pid"
    )
    yield made
    made.close()


def ask(made, request, role=Role.OPERATOR, told=lambda _: None):
    return asyncio.run(made.answer(request, role, told))


def test_a_command_and_a_line_are_the_same(made, carried):
    one = ask(made, orders.Order(1, "on", {"task": ["pid"]}))
    other = ask(made, orders.Line(2, "on pid"))
    assert one == {**other, "id": 1}
    assert one["ok"]
    assert one["text"] == "pid ON"
    assert carried.calls == 2 * [("on", {"task": ["pid"]}, "web-operator")]


def test_arguments_of_all_kinds_arrive(made, carried):
    ask(made, orders.Line(1, "swap a,b c,d dry_run=yes"))
    ask(made, orders.Line(2, "reconfig a:off b:on"))
    ask(made, orders.Line(3, "freq pid 50"))
    assert [words for _, words, _ in carried.calls] == [
        {"old": "a,b", "new": "c,d", "dry_run": True},
        {"item": ["a:off", "b:on"]},
        {"task": "pid", "hz": 50.0},
    ]


def test_edits_and_programs_go_on_while_a_simulation_runs(made, monkeypatch):
    gate = threading.Event()

    def simulation(args):
        assert args == {"seconds": 3}
        return lambda: {"ran": gate.wait(30)}

    monkeypatch.setattr(made._edits, "simulation", simulation)
    monkeypatch.setattr(made._edits, "cancel", gate.set)
    monkeypatch.setattr(made._edits, "do", lambda name, _: {"did": name})
    monkeypatch.setattr(made._programs, "do", lambda name, _: {"did": name})

    async def work():
        def answer(request):
            return made.answer(request, Role.OPERATOR, lambda _: None)

        simulates = orders.Edit(1, "simulate", {"seconds": 3})
        waiting = asyncio.create_task(answer(simulates))
        await asyncio.sleep(0)
        asked = [orders.Program(2, "abort"), orders.Program(3, "save")]
        answers = [await answer(one) for one in [*asked, orders.Edit(4, "undo")]]
        assert not waiting.done()
        await answer(orders.Edit(5, "cancel"))
        return [one["data"]["did"] for one in answers], await waiting

    did, simulated = asyncio.run(work())
    assert did == ["abort", "save", "undo"]
    assert simulated["data"] == {"ran": True}


@pytest.mark.parametrize(
    ("here", "text"),
    [
        (False, "on was still being carried out elsewhere: it goes on there"),
        (True, "on was still being carried out from here: it is cut off"),
    ],
)
def test_the_end_waits_some_time_for_a_command_and_says_it_is_left(
    made, carried, monkeypatch, here, text
):
    monkeypatch.setattr(orders, "_END_TIME", 0.1)
    monkeypatch.setattr(orders, "_OTHERS_END_TIME", 0.1)
    started = threading.Event()

    def perform(_path, _call, _place, *, kind="", begun=None):  # noqa: ARG001
        if here:
            begun(carried)
        started.set()
        carried.gate.wait(30)
        return Reply(command="on", data={"states": {"pid": "ON"}})

    monkeypatch.setattr(oneshot, "perform", perform)
    carried.gate.clear()

    async def end():
        asked = orders.Line(1, "on pid")
        task = asyncio.create_task(made.answer(asked, Role.OPERATOR, lambda _: None))
        await asyncio.to_thread(started.wait, 30)
        await asyncio.to_thread(made.close)
        left = made.left
        carried.gate.set()
        await task
        return left

    assert asyncio.run(end()) == [text]
    assert made.left == []
    assert carried.stopped.is_set() == here


def test_a_refusal_is_told_word_for_word(made):
    answer = ask(made, orders.Line(4, "on pid text=wrong"))
    assert answer == {
        "kind": "answer",
        "id": 4,
        "ok": False,
        "text": str(StateError("the task is asleep", got="OFF", remedy="wake it")),
        "warnings": [],
        "data": None,
    }


def test_a_failure_inside_pbonet_is_answered_and_logged(made, caplog):
    answer = ask(made, orders.Line(5, "on pid text=odd"))
    assert not answer["ok"]
    assert answer["text"].startswith("it failed inside pbonet: KeyError: 'a name'")
    assert "a request of a browser failed inside pbonet" in caplog.text


@pytest.mark.parametrize(
    ("line", "text"),
    [
        ("bogus", "there is no command bogus; see 'help'"),
        ("quit", "quit is not available here"),
        ("sigwait pid", "sigwait is not available here"),
        ("network port", "network is not available here"),
        ("on 'pid", "the line is not understood"),
    ],
)
def test_lines_that_are_refused(made, carried, line, text):
    answer = ask(made, orders.Line(1, line))
    assert not answer["ok"]
    assert answer["text"].startswith(text)
    assert not carried.calls


def test_a_blank_line_does_nothing(made, carried):
    assert ask(made, orders.Line(1, "  # nothing"))["ok"]
    assert not carried.calls


def test_an_observer_may_look_and_may_not_steer(made, carried, monkeypatch):
    monkeypatch.setattr(stop_all, "stop", lambda *_, **__: pytest.fail("stopped"))
    for line in (
        "on pid", "kill pid", "set pid kp 3", "freq pid 5", "switch other",
        "stop", "profile save", "status reset=yes",
    ):  # fmt: skip
        answer = ask(made, orders.Line(1, line), Role.OBSERVER)
        assert not answer["ok"], line
        assert "this page is an observer's" in answer["text"]
    assert not ask(made, orders.Stop(1), Role.OBSERVER)["ok"]
    assert not ask(made, orders.Order(1, "stop"), Role.OBSERVER)["ok"]
    assert not carried.calls
    for line in ("status", "freq pid", "switch other dry_run=yes", "display"):
        assert ask(made, orders.Line(1, line), Role.OBSERVER)["ok"], line


def test_an_observer_has_no_files_from_elsewhere_read(made, carried):
    """Their modules would be imported here."""
    lines = ("check /tmp/other", "check ../other", "swap a ../b dry_run=yes")
    for line in (*lines, "explain start ../other"):
        assert (
            "names no files" in ask(made, orders.Line(1, line), Role.OBSERVER)["text"]
        )
    assert not carried.calls
    assert ask(made, orders.Line(1, "check other"), Role.OBSERVER)["ok"]
    assert ask(made, orders.Line(1, "check /tmp/other"))["ok"]


def test_every_command_that_changes_is_refused_to_an_observer(made, carried):
    """Whatever its arguments are, as far as they alone make it change something."""
    words = {"task": "pid", "rmod": "m", "job": "j", "old": "a", "new": "b"}
    words |= {"item": "a:on", "param": "kp", "value": "3", "hz": "5", "signal": "s"}
    words |= {"variable": "X", "portname": "p"}
    for command in COMMANDS:
        if not command.changes or not orders.is_fit(command):
            continue
        line = " ".join([command.name, *(words.get(a.name, "") for a in command.args)])
        assert not ask(made, orders.Line(1, line), Role.OBSERVER)["ok"], line
    assert not carried.calls


@pytest.mark.parametrize(
    "stop", [orders.Stop(2), orders.Order(2, "stop"), orders.Line(2, "stop")]
)
def test_a_stop_waits_for_no_command(made, carried, monkeypatch, stop):
    done = {"off": ["pid"], "killed": [], "rtpus": ["arm0"]}
    monkeypatch.setattr(stop_all, "stop", lambda *_, **__: done)

    async def both():
        carried.gate.clear()
        told = asyncio.Queue()
        slow = asyncio.create_task(
            made.answer(orders.Line(1, "on pid"), Role.OPERATOR, told.put_nowait)
        )
        await asyncio.sleep(0)
        stopped = await made.answer(stop, Role.OPERATOR, told.put_nowait)
        assert not slow.done()
        progress = await told.get()
        carried.gate.set()
        return stopped, await slow, progress

    stopped, slow, told = asyncio.run(both())
    assert stopped["text"] == "turned off: pid"
    assert slow["ok"]
    assert told["kind"] == "progress"
    assert told["id"] == 1


def test_what_was_asked_for_before_a_stop_does_not_start_after_it(
    made, carried, monkeypatch
):
    done = {"off": ["pid"], "killed": [], "rtpus": ["arm0"]}
    monkeypatch.setattr(stop_all, "stop", lambda *_, **__: done)

    async def all_():
        carried.gate.clear()
        asked = [
            asyncio.create_task(
                made.answer(orders.Line(n, line), Role.OPERATOR, lambda _: None)
            )
            for n, line in enumerate(("switch other wait=9", "on pid", "status"))
        ]
        await asyncio.sleep(0.1)
        assert (await made.answer(orders.Stop(9), Role.OPERATOR, print))["ok"]
        assert carried.stopped.is_set()  # which ends the wait of the first
        carried.gate.set()
        return await asyncio.gather(*asked)

    _, second, third = asyncio.run(all_())
    assert not second["ok"]
    assert second["text"].startswith("a stop came before on was carried out")
    assert third["ok"]
    assert [name for name, _, _ in carried.calls] == ["switch", "status"]


def test_the_end_gives_a_command_up_that_waits_for_conditions(made, carried):
    carried.gate = carried.stopped

    async def end():
        asking = asyncio.create_task(
            made.answer(orders.Line(1, "start wait=600"), Role.OPERATOR, lambda _: None)
        )
        await asyncio.sleep(0.1)
        await asyncio.to_thread(made.close)
        await asking

    asyncio.run(end())
    assert carried.calls


def test_only_so_many_commands_may_wait(made, carried):
    async def many():
        carried.gate.clear()
        asked = [
            asyncio.create_task(
                made.answer(orders.Line(n, "on pid"), Role.OPERATOR, lambda _: None)
            )
            for n in range(20)
        ]
        await asyncio.sleep(0.05)
        carried.gate.set()
        return await asyncio.gather(*asked)

    answers = asyncio.run(many())
    refused = [one for one in answers if not one["ok"]]
    assert len(refused) == 4
    assert refused[0]["text"].startswith("16 commands wait already")


def test_observers_keep_no_operator_waiting(made, carried):
    async def many():
        carried.gate.clear()
        looks = [
            asyncio.create_task(
                made.answer(orders.Line(n, "status"), Role.OBSERVER, lambda _: None)
            )
            for n in range(20)
        ]
        await asyncio.sleep(0)
        steers = asyncio.create_task(
            made.answer(orders.Line(99, "on pid"), Role.OPERATOR, lambda _: None)
        )
        await asyncio.sleep(0)
        carried.gate.set()
        return await steers, await asyncio.gather(*looks)

    steered, looked = asyncio.run(many())
    assert steered["ok"]
    assert [one["ok"] for one in looked].count(False) == 4


def test_a_program_is_aborted_while_files_are_busy(made, monkeypatch):
    busy = threading.Event()
    monkeypatch.setattr(made._edits, "do", lambda *_: {"waited": busy.wait(30)})

    async def both():
        slow = asyncio.create_task(
            made.answer(orders.Edit(1, "save"), Role.OPERATOR, lambda _: None)
        )
        await asyncio.sleep(0)
        aborted = await made.answer(
            orders.Program(2, "abort"), Role.OPERATOR, lambda _: None
        )
        assert not slow.done()
        busy.set()
        return aborted, await slow

    aborted, slow = asyncio.run(both())
    assert aborted["text"].startswith("no program runs")
    assert slow["data"] == {"waited": True}


def test_what_fails_inside_pbonet_is_answered(made, monkeypatch):
    def fails(*_):
        raise KeyError("lost")

    monkeypatch.setattr(made._edits, "do", fails)
    answer = ask(made, orders.Edit(5, "undo"))
    assert (answer["id"], answer["ok"]) == (5, False)
    assert answer["text"].startswith("it failed inside pbonet: KeyError: 'lost'")


_JSON = st.recursive(
    st.none() | st.booleans() | st.integers() | st.text(max_size=9),
    lambda inner: (
        st.lists(inner, max_size=3)
        | st.dictionaries(
            st.sampled_from(["do", "id", "line", "command", "args", "variables", "x"]),
            inner | st.sampled_from(["watch", "line", "command", "stop"]),
            max_size=5,
        )
    ),
    max_leaves=8,
)


@given(_JSON.map(lambda data: orders.msgspec.json.encode(data).decode()) | st.text())
def test_any_text_is_a_request_or_refused(text):
    with contextlib.suppress(ProtocolError):
        assert isinstance(orders.decode(text), orders.Request)
