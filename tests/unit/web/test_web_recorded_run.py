"""A recorded run as its page is told of it."""

from __future__ import annotations

import asyncio
import json
import queue
import shutil
import threading
from importlib import resources
from pathlib import Path

import numpy as np
import pytest
from mcap.reader import make_reader
from starlette.testclient import TestClient

from pbonet.cli import main
from pbonet.errors import LogError
from pbonet.log import Log, last_run
from pbonet.master import diagnosis
from pbonet.master.configuration import Place
from pbonet.master.web import application
from pbonet.master.web.access import Access, Role
from pbonet.master.web.orders import Line, Order, Stop
from pbonet.master.web.recorded_questions import RecordedQuestions
from pbonet.master.web.recorded_run import RecordedRun

PUMA = Path(__file__).parents[3] / "examples" / "puma" / "puma.job"


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    """The recording of two seconds of the PUMA's job."""
    runs = tmp_path_factory.mktemp("runs")
    with pytest.raises(SystemExit) as ended:
        main(["run", str(PUMA), "--sim", "--seconds", "2", "--runs", str(runs)])
    assert not ended.value.code
    return last_run(runs)


@pytest.fixture
def shown(folder):
    """The run, and what browsers were told."""
    run, told = RecordedRun(folder), queue.SimpleQueue()
    run.want(["Q_MEZ"])
    run.start(told.put)
    yield run, told
    run.close()


def wait(told, kind, good=lambda _: True):
    while True:
        message = told.get(timeout=60)
        if message["kind"] == kind and good(message):
            return message


def test_it_is_drawn_from_the_files_in_the_log(folder):
    run = RecordedRun(folder)
    assert (run.about["name"], run.about["job"]) == ("puma", "teleop")
    log = run.about["log"]
    assert 1.9 < log["end"] - log["begin"] < 3.0
    assert {"Q_MEZ", "T_GRAV"} <= run.variables
    graph, status, *_ = run.first()
    names = {one["name"] for one in graph["graph"]["tasks"]}
    assert names == {"puma_pidg", "grav_comp", "qrdiff", "jttrace"}
    assert {one["task"] for one in status["tasks"]} == names


def test_values_states_and_events_are_those_of_the_chosen_time(shown, folder):
    run, told = shown
    log = Log(folder)
    begin = log.begin_time_ns * 1e-9
    run.seek(begin + 1.0)
    value = wait(told, "values", lambda one: one["values"])["values"]["Q_MEZ"]
    seconds, numbers = log.series("Q_MEZ")
    row = int(np.searchsorted(seconds + begin, begin + 1.0, side="right")) - 1
    assert value["v"] == numbers[row].tolist()
    assert value["t"] == pytest.approx(begin + seconds[row])
    _, status, history, _, at = run.first()
    puma = next(one for one in status["tasks"] if one["task"] == "puma_pidg")
    assert (puma["state"], puma["signals"]) == ("ON", [])
    assert puma["fields"]["mezF"] == pytest.approx(500, abs=2)
    assert all(one["t"] <= begin + 1.0 for one in history["events"])
    assert {one["code"] for one in history["events"]} >= {"STATE"}
    assert at["t"] == pytest.approx(begin + 1.0)


def test_a_value_is_stale_after_its_maxage_and_unknown_before_it_was_written(shown):
    run, _ = shown
    run.seek(run.about["log"]["end"])
    history, now = run.history(["Q_REF"])
    last = now["values"]["Q_REF"]
    assert (last["stale"], last["writer"]) == (False, "jttrace")
    assert run._values(["Q_REF"], last["t"] + 5.0)["Q_REF"]["stale"]
    first = history["values"]["Q_REF"]["t"][0]
    before = run._values(["Q_REF", "QCMD", "N"], first - 0.001)
    assert before.keys() == {"Q_REF"}  # no task of the log has written the others
    assert before["Q_REF"] == {
        "t": None, "v": [], "writer": "", "age": None, "stale": True
    }  # fmt: skip


def test_what_the_log_does_not_hold_is_said(shown):
    run, _ = shown
    status, complaints = (
        next(one for one in run.first() if one["kind"] == kind)
        for kind in ("status", "complaints")
    )
    assert complaints["texts"] == ["the log holds no CPU times"]  # in virtual time
    assert all(one["fields"]["avgU"] is None for one in status["tasks"])


def test_it_goes_on_to_the_end_and_stands_there(shown):
    run, told = shown
    log = run.about["log"]
    run.seek(log["end"] - 0.5)
    run.play(2.0)
    last = wait(told, "at", lambda one: one["t"] == log["end"] and not one["speed"])
    assert last["speed"] == 0.0
    run.play(1.0)  # from the beginning again
    assert wait(told, "at", lambda one: one["speed"])["t"] < log["begin"] + 1.0


def test_times_outside_the_run_and_senseless_speeds_are_bounded(shown):
    run, told = shown
    log = run.about["log"]
    run.seek(0.0)
    assert wait(told, "at")["t"] == log["begin"]
    run.seek(1e12)
    assert wait(told, "at", lambda one: one["t"] > log["begin"])["t"] == log["end"]
    for speed in (-1.0, 1e9, float("nan")):
        run.play(speed)
    run.seek(float("nan"))
    run.seek(log["begin"])
    assert wait(told, "at")["speed"] == 0.0


def test_values_come_before_a_browser_that_watches_later(shown):
    run, _ = shown
    run.seek(run.about["log"]["end"])
    history, now = run.history(["Q_REF", "T_GRAV"])
    assert history["values"]["Q_REF"]["t"]
    assert len(history["values"]["T_GRAV"]["t"]) <= 1200
    assert now["values"].keys() == {"Q_REF", "T_GRAV"}


def test_a_log_without_files_is_refused(tmp_path):
    with pytest.raises(LogError):
        RecordedRun(tmp_path / "none.mcap")


def test_a_log_without_one_of_its_files_says_so(folder, monkeypatch):
    files = {
        name: one for name, one in Log(folder).attached.items() if "svar" not in name
    }
    monkeypatch.setattr(Log, "attached", files)
    with pytest.raises(
        LogError, match=r"cannot be drawn.*got puma\.sbs:\d+: puma\.svar"
    ):
        RecordedRun(folder)


def test_a_run_of_several_jobs_has_the_tasks_of_all(tmp_path):
    example = PUMA.parent
    for name in ("puma.sbs", "puma.svar"):
        shutil.copy(example / name, tmp_path / name)
    module = resources.files("pbonet") / "modules" / "teleoperation" / "jttrace.rmod"
    (tmp_path / "other.rmod").write_text(module.read_text())
    tasks = ["puma_pidg", "grav_comp", "qrdiff", "jttrace", "other"]
    for job, last in (("one", tasks[-2]), ("two", tasks[-1])):
        lines = [f"JOB {job}", "DESC", "SBS puma.sbs"]
        lines += [f"TASK {task} arm1" for task in [*tasks[:3], last]]
        (tmp_path / f"{job}.job").write_text("\n".join([*lines, "EOF", ""]))
    (tmp_path / "both.seq").write_text(
        "SEQUENCE both\nDESC\nSBS puma.sbs\nSTEP one FOR 0.2\nSTEP two FOR 0.2\nEOF\n"
    )
    words = ["run", str(tmp_path / "both.seq"), "--sim", "--runs", str(tmp_path / "r")]
    with pytest.raises(SystemExit) as ended:
        main(words)
    assert not ended.value.code
    run = RecordedRun(last_run(tmp_path / "r"))
    graph, status, *_ = run.first()
    assert run.about["job"] == "one, two"
    assert {one["name"] for one in graph["graph"]["tasks"]} == {*tasks}
    assert {one["task"] for one in status["tasks"]} == {*tasks}


def test_what_is_damaged_is_told(folder, tmp_path):
    log = folder / "arm0.mcap"
    with log.open("rb") as file:
        summary = make_reader(file).get_summary()
    chunk = max(summary.chunk_indexes, key=lambda one: one.chunk_length)
    data = bytearray(log.read_bytes())
    data[chunk.chunk_start_offset + chunk.chunk_length // 2] ^= 0xFF
    (tmp_path / "damaged.mcap").write_bytes(data)
    run = RecordedRun(tmp_path / "damaged.mcap")
    complaints = next(one for one in run.first() if one["kind"] == "complaints")
    assert "damaged chunk" in complaints["texts"][0]


def ask(folder, request):
    questions = RecordedQuestions(folder)
    try:
        return asyncio.run(questions.answer(request, Role.OBSERVER, lambda _: None))
    finally:
        questions.close()


@pytest.mark.parametrize(
    "request_",
    [Order(7, "explain", {"what": ["puma_pidg"]}), Line(7, "explain puma_pidg")],
)
def test_it_is_explained_as_the_command_line_does(folder, request_):
    answer = ask(folder, request_)
    assert (answer["kind"], answer["id"], answer["ok"]) == ("answer", 7, True)
    assert answer["text"] == str(diagnosis.answer(folder, ["puma_pidg"], Place()))
    assert answer["text"].startswith("task puma_pidg on arm0 is ON")
    assert answer["data"]["kind"] == "task"


@pytest.mark.parametrize(
    ("request_", "text"),
    [
        (Order(7, "off", {"task": ["puma_pidg"]}), "a recorded run is not steered"),
        (Order(7, "explain", {"trace": 3.0}), "a recorded run is not steered"),
        (Line(7, "on puma_pidg"), "a recorded run is not steered"),
        (Line(7, "explain nobody"), "no task, variable or RTPU nobody"),
        (Stop(7), "a recorded run is not steered"),
    ],
)
def test_what_else_is_asked_of_it_is_refused(folder, request_, text):
    answer = ask(folder, request_)
    assert (answer["id"], answer["ok"]) == (7, False)
    assert text in answer["text"]


def test_a_question_that_is_not_answered_at_the_end_is_named(monkeypatch):
    """The program ends then, and does not wait until a large log is read."""
    begun, go_on = threading.Event(), threading.Event()

    def read(*_):
        begun.set()
        go_on.wait(60)
        return diagnosis.Explanation(kind="flag", name="", what="down")

    async def leave():
        asked = asyncio.ensure_future(
            questions.answer(Order(1, "explain", {}), Role.OBSERVER, lambda _: None)
        )
        await asyncio.to_thread(begun.wait, 60)
        asked.cancel()
        await asyncio.gather(asked, return_exceptions=True)
        questions.close()
        return questions.left

    monkeypatch.setattr(diagnosis, "answer", read)
    questions = RecordedQuestions("a log")
    assert questions.left == []
    try:
        assert asyncio.run(leave()) == ["a question about the run was not answered"]
    finally:
        go_on.set()


def test_its_page_has_the_button_and_the_answer(folder):
    """The page shows the button where the first message has the command."""
    access = Access(["127.0.0.1"], 8080, b"key", roles=(Role.OBSERVER,))
    run = RecordedRun(folder)
    page = application.Page(
        run, lambda _: RecordedQuestions(folder), access, linked=lambda *_: None
    )
    url = "http://127.0.0.1:8080"
    with TestClient(page.app(), base_url=url) as client:
        client.get(access.links[Role.OBSERVER].removeprefix(url))
        origin = {"origin": url, "host": "127.0.0.1:8080"}
        with client.websocket_connect("ws://127.0.0.1:8080/ws", headers=origin) as sock:
            hello = json.loads(sock.receive_text())
            assert [one["name"] for one in hello["commands"]] == ["explain"]
            wish = {"do": "command", "id": 1, "command": "explain", "args": {}}
            sock.send_text(json.dumps(wish))
            messages = iter(lambda: json.loads(sock.receive_text()), None)
            answer = next(one for one in messages if one["kind"] == "answer")
            assert answer["text"].startswith("the flag of puma was not up in this run")
