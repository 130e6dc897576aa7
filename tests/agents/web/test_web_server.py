"""``pbonet web`` over real agents, as clients of the socket find it."""

from __future__ import annotations

import contextlib
import http.client
import json
import os
import signal
import socket
import subprocess
import sys

import pytest
from watching import wait_for
from websockets.exceptions import ConnectionClosed, InvalidStatus
from websockets.sync.client import connect

from pbonet.errors import PbonetError
from pbonet.master.configuration import Place
from pbonet.master.console import CommandSession, Port, oneshot, render
from pbonet.master.subsystem import Subsystem

LEVEL = """
    from typing import Annotated as A
    from pbonet import OutVar, Params, PortBasedObject, Vector, param

    class Of(Params):
        value: A[float, param("m", "the level", ge=-9, le=9)] = 1.5

    class Level(PortBasedObject[Of]):
        '''A level that is set.'''

        level: A[Vector, OutVar("LEVEL", "2", "m", "level and twice that")]

        def cycle(self, dt: float) -> None:
            self.level[:] = self.params.value, 2 * self.params.value
"""
SVAR = "NAME LEVEL\nTYPE double\nDESC a level\nUNITS m\nNELEM 2\n\nEOF\n"
RMOD = (
    "MODULE level\nDESC a test\nINCONST none\nOUTCONST none\nINVAR none\n"
    "OUTVAR LEVEL\nTASKTYPE periodic\nFREQ 100\nEOF\n"
)


@pytest.fixture
def levels(nodes, tmp_path):
    """A subsystem with one task that is ON, and no master."""
    nodes.write_module("level", LEVEL)
    for name, text in (
        ("l.svar", SVAR),
        ("l.sbs", "SUBSYSTEM levels\nSVARFILE l.svar\nRTPU arm0\nEOF\n"),
        ("level.rmod", RMOD),
        ("other.rmod", RMOD),
    ):
        (tmp_path / name).write_text(text)
    nodes.agent("arm0")
    place = Place(domain=nodes.domain)
    file = tmp_path / "l.sbs"
    oneshot.run(file, "spawn", {"rmod": "level"}, place)
    oneshot.run(file, "on", {"task": ["level"]}, place)
    yield file, place
    with contextlib.suppress(PbonetError):
        oneshot.run(file, "kill", {"task": ["level"]}, place)


class Server:
    """``pbonet web`` as a process of its own, and browsers' connections to it."""

    def __init__(self, file, place, *words, port=0):
        command = [sys.executable, "-m", "pbonet.cli", "web", str(file)]
        command += ["--domain", place.domain, "--port", str(port), "--json", *words]
        self.process = subprocess.Popen(
            command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True
        )
        self.links = json.loads(self.process.stdout.readline())
        self.url = next(iter(self.links.values())).partition("/?")[0]
        self.address = self.url.removeprefix("http://")
        self.port = int(self.address.rpartition(":")[2])

    def cookie(self, role):
        asking = http.client.HTTPConnection(self.address)
        with contextlib.closing(asking):
            asking.request("GET", self.links[role].removeprefix(self.url))
            answer = asking.getresponse()
            assert answer.status == 200
        self.links |= json.loads(self.process.stdout.readline())
        return answer.getheader("set-cookie").partition(";")[0]

    def connect(self, cookie, **more):
        url = f"ws://{self.address}/ws"
        return connect(
            url, origin=self.url, additional_headers={"Cookie": cookie}, **more
        )

    def end(self):
        self.process.send_signal(signal.SIGINT)
        self.process.communicate(timeout=60)
        return self.process.returncode


@pytest.fixture
def server(levels):
    server = Server(*levels)
    yield server
    if server.process.poll() is None:
        assert server.end() == 0


def wait(socket_, kind, good=lambda _: True):
    """Return the first message of a kind that is good."""
    while True:
        message = json.loads(socket_.recv(timeout=60))
        if message["kind"] == kind and good(message):
            return message


def read_to_the_end(socket_):
    """Read until the connection is closed."""
    with contextlib.suppress(ConnectionClosed):
        while True:
            socket_.recv(timeout=60)


def events_of(socket_):
    """Return the codes of the first events that a browser is told."""
    told = []
    while not told:
        message = json.loads(socket_.recv(timeout=60))
        told = message.get("events", [])
    return {one["code"] for one in told}


def say(socket_, **message):
    socket_.send(json.dumps(message))


def answer(socket_, line, number=1):
    say(socket_, do="line", id=number, line=line)
    return wait(socket_, "answer", lambda one: one["id"] == number)


def state_of(message):
    return {one["task"]: one["state"] for one in message["tasks"]}


def test_a_browser_watches_steers_and_stops(server, levels) -> None:
    with server.connect(server.cookie("operator")) as page:
        wait(page, "graph", lambda one: one["graph"]["tasks"])
        say(page, do="watch", variables=["LEVEL"])
        wait(page, "values", lambda one: one["values"]["LEVEL"]["v"] == [1.5, 3.0])
        assert answer(page, "set level value -2")["ok"]
        wait(page, "values", lambda one: one["values"]["LEVEL"]["v"] == [-2.0, -4.0])
        refused = answer(page, "on level", 2)
        assert not refused["ok"]
        with pytest.raises(PbonetError) as prompt:
            oneshot.run(levels[0], "on", {"task": ["level"]}, levels[1])
        assert refused["text"] == str(prompt.value)
        with server.connect(server.cookie("observer")) as looker:
            assert {"CLAIM", "SPAWNED", "SET"} <= events_of(looker)
            say(looker, do="watch", variables=["LEVEL"])
            past = wait(looker, "history", lambda one: one["values"])["values"]
            assert [1.5, 3.0] in past["LEVEL"]["v"]  # from before it came
            assert not answer(looker, "off level")["ok"]
            say(page, do="stop", id=3)
            stopped = wait(page, "answer", lambda one: one["id"] == 3)
            assert (stopped["ok"], stopped["text"]) == (True, "turned off: level")
            wait(looker, "status", lambda one: "level" in one["gone"])


def test_commands_of_the_page_and_of_the_prompt_are_the_same(server, levels) -> None:
    """Each line twice, from the same state: texts, data and refusals are equal."""
    lines = [
        "get level value", "set level value 3", "set level value 99", "freq level 50",
        "freq level 1e9", "off level", "off level", "on level", "spawn other",
        "on other", "swap level other dry_run=yes", "kill other", "kill nobody",
        "write LEVEL 1 2", "reconfig level:off level:on", "bogus", "on", "sigmask",
    ]  # fmt: skip
    file, place = levels

    def prompt(line):
        with Subsystem(file, domain=place.domain, record="off") as subsystem:
            session = CommandSession(subsystem)
            try:
                reply = session.execute(line)
            except PbonetError as error:
                result = False, str(error), None
            else:
                result = True, render.text(reply.command, reply.data), reply.data
            subsystem.detach()
        return result

    def reset():
        for line in ("kill other", "spawn level", "set level value 1.5",
                     "freq level 100", "on level"):  # fmt: skip
            prompt(line)

    with server.connect(server.cookie("operator")) as page:
        for number, line in enumerate(lines):
            reset()
            at_prompt = prompt(line)
            reset()
            told = answer(page, line, number)
            data = json.loads(json.dumps(at_prompt[2]))
            assert (told["ok"], told["text"], told["data"]) == (*at_prompt[:2], data)


def test_the_end_of_the_server_leaves_what_another_master_carries_out(
    server, levels
) -> None:
    """A job whose condition never holds is started by a living master, for an hour."""
    file, place = levels
    job = file.with_name("never.job")
    job.write_text(
        "JOB never\nDESC\nSBS l.sbs\nPRE LEVEL[0] > 99 [m]\nTASK level arm0\nEOF\n"
    )
    with Subsystem(file, domain=place.domain, record="off") as master:
        port = Port(master, master.name, handover=False, told=lambda _: None)
        port.open()
        try:
            with server.connect(server.cookie("operator")) as page:
                say(page, do="line", id=1, line="switch never wait=3600")
                wait(page, "progress")
                server.process.terminate()
                _, errors = server.process.communicate(timeout=60)
        finally:
            master.stopped.set()
            port.close()
            master.detach()
    assert server.process.returncode == 0
    said = "switch was still being carried out elsewhere: it goes on there"
    assert said in errors


def test_a_browser_that_is_killed_frees_its_places(server) -> None:
    cookie = server.cookie("operator")
    script = (
        "import socket, sys, time\n"
        "kept = []\n"
        "for _ in range(40):\n"
        "    one = socket.create_connection(('127.0.0.1', int(sys.argv[1])))\n"
        "    one.sendall(sys.argv[2].encode())\n"
        "    kept.append((one, one.recv(12)))\n"
        "print(len([1 for _, said in kept if b'101' in said]), flush=True)\n"
        "time.sleep(3600)\n"
    )
    command = [sys.executable, "-c", script, str(server.port)]
    browsers = subprocess.Popen(
        [*command, _upgrade(server, cookie)], stdout=subprocess.PIPE, text=True
    )
    try:
        assert browsers.stdout.readline() == "32\n"
        with pytest.raises(InvalidStatus):
            server.connect(cookie).close()
    finally:
        browsers.kill()
        browsers.communicate(timeout=60)

    def served():
        try:
            with server.connect(cookie) as page:
                return answer(page, "status")["ok"]
        except InvalidStatus:
            return False

    wait_for(served, "a place for a browser")


def test_a_server_that_is_killed_comes_back_and_knows_its_browsers(levels) -> None:
    first = Server(*levels)
    cookie = first.cookie("operator")
    with first.connect(cookie) as page:
        wait(page, "hello")
        before = oneshot.run(levels[0], "status", {}, levels[1]).data
        first.process.kill()
        first.process.communicate(timeout=60)
        read_to_the_end(page)
    again = Server(*levels, port=first.port)
    with again.connect(cookie) as page:
        assert wait(page, "hello")["role"] == "operator"
        assert events_of(page)
        say(page, do="watch", variables=["LEVEL"])
        wait(page, "values", lambda one: one["values"].get("LEVEL"))
    assert again.end() == 0
    after = oneshot.run(levels[0], "status", {}, levels[1]).data

    def counted(data):
        (task,) = data["tasks"]
        return {name: task["fields"][name] for name in ("miss", "failed", "tid")}

    assert counted(after) == counted(before)  # its tasks noticed nothing
    last = Server(*levels, port=first.port)  # it ended in order: cookies are void
    with pytest.raises(InvalidStatus):
        last.connect(cookie).close()
    assert last.end() == 0


def test_sockets_that_never_read_and_messages_that_say_nothing(server) -> None:
    cookie = server.cookie("operator")
    with contextlib.ExitStack() as stack:
        for _ in range(250):  # nobody says a word: they keep no browser away
            idle = socket.create_connection(("127.0.0.1", server.port), timeout=60)
            stack.enter_context(idle)
        server.cookie("observer")
        answers = []
        for _ in range(50):  # nobody reads more of them than their answer's first line
            raw = stack.enter_context(
                socket.create_connection(("127.0.0.1", server.port), timeout=60)
            )
            raw.sendall(_upgrade(server, cookie))
            answers.append(raw.recv(12))
        assert answers.count(b"HTTP/1.1 101") == 32
        assert answers.count(b"HTTP/1.1 403") == 18
    with server.connect(cookie) as page:
        wait(page, "hello")
        for junk in (os.urandom(300), "{" * 5000, '{"do":' + "[" * 5000, "x" * 60000):
            page.send(junk)
        assert answer(page, "status")["ok"]
        with contextlib.suppress(ConnectionClosed):  # it may end while this is sent
            page.send("x" * 200_000)  # longer than any message may be
        read_to_the_end(page)
    with server.connect(cookie) as page:
        assert answer(page, "status")["ok"]


def _upgrade(server, cookie):
    lines = (
        "GET /ws HTTP/1.1", f"Host: {server.address}", "Upgrade: websocket",
        "Connection: Upgrade", "Sec-WebSocket-Key: AAAAAAAAAAAAAAAAAAAAAA==",
        "Sec-WebSocket-Version: 13", f"Origin: {server.url}", f"Cookie: {cookie}",
    )  # fmt: skip
    return "\r\n".join([*lines, "", ""]).encode()


def test_nothing_is_served_beyond_this_machine_without_tls(levels) -> None:
    file, place = levels
    command = [sys.executable, "-m", "pbonet.cli", "web", str(file), "--port", "0"]
    done = subprocess.run(
        [*command, "--domain", place.domain, "--host", "0.0.0.0"],  # noqa: S104
        capture_output=True,
        text=True,
        check=False,
    )
    assert done.returncode == 1
    assert "serving the page beyond this machine needs TLS" in done.stderr
