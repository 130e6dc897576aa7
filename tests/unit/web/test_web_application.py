"""The server as browsers and other programs find it; no agent runs."""

from __future__ import annotations

import json
from pathlib import Path

import pytest
from starlette.testclient import TestClient
from starlette.websockets import WebSocketDisconnect

from pbonet.errors import UnreachableError
from pbonet.master.configuration import Place
from pbonet.master.console import stop_all
from pbonet.master.web import application, browsers
from pbonet.master.web.access import Access, Role
from pbonet.master.web.orders import Orders, Steered
from pbonet.master.web.watcher import Watcher

PUMA = Path(__file__).parents[3] / "examples" / "puma" / "puma.job"
URL = "http://127.0.0.1:8080"
HOST = {"host": "127.0.0.1:8080"}
ORIGIN = {"origin": URL, **HOST}


class Served:
    """A page's server, and clients of it."""

    def __init__(self, monkeypatch, roles=tuple(Role)):
        self.access = Access(["127.0.0.1"], 8080, b"key", roles=roles)
        self.renewed = []
        watcher = Watcher(PUMA, Place())
        self.page = application.Page(
            watcher,
            lambda told: Orders(
                Steered(PUMA, "puma", Place()), watcher.knows, told=told
            ),
            self.access,
            linked=lambda *link: self.renewed.append(link),
        )

        def away():
            raise UnreachableError("no agent can be reached", remedy="start one")

        monkeypatch.setattr(watcher, "_made", away)
        self.client = TestClient(self.page.app(), base_url=URL)

    def open(self, role=Role.OPERATOR):
        """Open the page by its link, as a browser does."""
        self.client.cookies.clear()
        return self.client.get(self.access.links[role].removeprefix(URL))

    def connect(self, headers=ORIGIN):
        url = f"{URL.replace('http', 'ws')}/ws"
        return self.client.websocket_connect(url, headers=headers)


@pytest.fixture
def served(monkeypatch):
    served = Served(monkeypatch)
    with served.client:
        yield served


def told(socket, *kinds):
    """Return the next message of one of these kinds."""
    while True:
        message = json.loads(socket.receive_text())
        if message["kind"] in kinds:
            return message


def test_a_link_opens_the_page_once_and_a_cookie_opens_it_again(served):
    link = served.access.links[Role.OPERATOR].removeprefix(URL)
    assert served.client.head(link).status_code == 401  # what only looks uses no link
    first = served.client.get(link)
    assert first.status_code == 200
    cookie = first.headers["set-cookie"]
    assert "HttpOnly" in cookie
    assert "SameSite=strict" in cookie
    assert served.renewed[0][0] is Role.OPERATOR
    assert served.client.get("/").status_code == 200
    served.client.cookies.clear()
    assert served.client.get(link).status_code == 401
    assert served.client.get("/").status_code == 401


def test_every_answer_has_the_headers_that_keep_scripts_of_others_out(served):
    for answer in (served.open(), served.client.get("/nothing")):
        policy = answer.headers["content-security-policy"]
        assert "default-src 'self'" in policy
        assert "unsafe-eval" not in policy
        assert "script-src" not in policy
        assert answer.headers["x-content-type-options"] == "nosniff"


@pytest.mark.parametrize("name", ["../server.py", "..%2fserver.py", "x", "%00"])
def test_only_built_files_are_served(served, name):
    served.open()
    assert served.client.get(f"/{name}").status_code == 404


def test_a_foreign_host_is_refused(served):
    served.open()
    answer = served.client.get("/", headers={"host": "evil.example:8080"})
    assert answer.status_code == 403
    with pytest.raises(WebSocketDisconnect) as closed:
        served.connect({"host": "evil.example:8080", "origin": URL}).__enter__()
    assert closed.value.code == 4403


@pytest.mark.parametrize("origin", ["http://evil.example", "null", "", f"{URL}.evil"])
def test_a_foreign_origin_is_refused(served, origin):
    served.open()
    with pytest.raises(WebSocketDisconnect) as closed:
        served.connect({**HOST, "origin": origin}).__enter__()
    assert closed.value.code == 4403


def test_without_a_cookie_there_is_no_connection(served):
    with pytest.raises(WebSocketDisconnect) as closed:
        served.connect().__enter__()
    assert closed.value.code == 4403


def test_many_attempts_to_guess_a_link_are_slowed_down(served):
    answers = [served.client.get("/?token=guess").status_code for _ in range(40)]
    assert set(answers[:10]) == {401}
    assert answers[-1] == 429
    assert served.open().status_code == 200  # nobody's guesses close a valid link


def test_a_browser_learns_what_there_is_without_an_agent(served):
    served.open()
    with served.connect() as socket:
        hello = told(socket, "hello")
        assert (hello["role"], hello["name"], hello["job"]) == (
            "operator", "puma", "teleop"
        )  # fmt: skip
        names = {one["name"] for one in hello["commands"]}
        assert {"on", "off", "swap", "set", "start"} <= names
        assert not names & {"quit", "network", "sigwait"}
        graph = told(socket, "graph")["graph"]
        assert [one["name"] for one in graph["tasks"]] == [
            "puma_pidg", "grav_comp", "qrdiff", "jttrace"
        ]  # fmt: skip
        texts = []
        while not texts:  # the first ones may come before the watcher has tried
            texts = told(socket, "complaints")["texts"]
        assert texts == ["no agent can be reached; start one"]


def test_an_observers_link_and_server(served, monkeypatch):
    served.open(Role.OBSERVER)
    with served.connect() as socket:
        assert told(socket, "hello")["role"] == "observer"
        socket.send_text(json.dumps({"do": "line", "id": 1, "line": "on qrdiff"}))
        assert "this page is an observer's" in told(socket, "answer")["text"]
    only = Served(monkeypatch, roles=(Role.OBSERVER,))
    assert only.access.links.keys() == {Role.OBSERVER}


@pytest.mark.parametrize(
    "text",
    [
        "",
        "{",
        "[]",
        "null",
        '{"do":"fly"}',
        '{"do":"line","id":"x","line":1}',
        "9" * 99,
    ],
)
def test_what_is_no_request_is_refused_and_the_connection_stays(served, text):
    served.open()
    with served.connect() as socket:
        socket.send_text(text)
        assert "this is no request" in told(socket, "refused")["text"]
        socket.send_bytes(b"\x00")
        assert "JSON as text" in told(socket, "refused")["text"]
        socket.send_text(json.dumps({"do": "line", "id": 7, "line": "bogus"}))
        assert told(socket, "answer")["id"] == 7


def test_a_flood_of_messages_is_refused(served):
    served.open()
    with served.connect() as socket:
        for _ in range(200):
            socket.send_text("{")
        while "too many messages" not in told(socket, "refused")["text"]:
            pass
        for number, message in enumerate(({"do": "line", "line": "help"},) * 200):
            socket.send_text(json.dumps({**message, "id": number}))
        while "too many messages" not in told(socket, "answer")["text"]:
            pass


def test_a_stop_is_carried_out_in_a_flood_of_messages(served, monkeypatch):
    stopped = {"off": ["pid"], "killed": [], "rtpus": ["arm0"]}
    monkeypatch.setattr(stop_all, "stop", lambda *_, **__: stopped)
    served.open()
    with served.connect() as socket:
        for _ in range(150):
            socket.send_text("{")
        socket.send_text(json.dumps({"do": "stop", "id": 9}))
        assert told(socket, "answer")["ok"]


def test_only_variables_of_the_table_are_watched_and_not_too_many(served):
    served.open()
    with served.connect() as socket:
        socket.send_text(json.dumps({"do": "watch", "variables": ["Q_MEZ", "<b>"]}))
        assert told(socket, "values")["values"] == {}
        (browser,) = served.page._browsers._browsers
        assert browser.watched == {"Q_MEZ"}
        names = [f"V{n}" for n in range(browsers.MOST_WATCHED + 1)]
        socket.send_text(json.dumps({"do": "watch", "variables": names}))
        assert "may watch 200 variables" in told(socket, "refused")["text"]


def test_so_many_browsers_and_no_more(served, monkeypatch):
    monkeypatch.setattr(browsers, "MOST", 2)  # of 32
    served.open()
    with served.connect() as one, served.connect() as two:
        told(one, "hello")
        told(two, "hello")
        with pytest.raises(WebSocketDisconnect) as closed:
            served.connect().__enter__()
        assert closed.value.code == 4429
    with served.connect() as again:
        told(again, "hello")


def test_observers_keep_no_operator_out(served, monkeypatch):
    monkeypatch.setattr(browsers, "MOST", 1 + browsers.FOR_OPERATORS)
    served.open(Role.OBSERVER)
    with served.connect() as one:
        told(one, "hello")
        with pytest.raises(WebSocketDisconnect):
            served.connect().__enter__()
        served.open(Role.OPERATOR)
        with served.connect() as steering:
            assert told(steering, "hello")["role"] == "operator"
