"""The agent's link to its RTPU process when either of them stands still or fails."""

import socket
import subprocess
import threading
from types import SimpleNamespace

import msgspec
import pytest

import pbonet
from pbonet.config.model import AgentConfig
from pbonet.errors import NodeError
from pbonet.node import agent as agents
from pbonet.node import supervise, wire

CONFIG = wire.RtpuConfig(domain="d", name="arm0", core=0)


class Hears:
    """A listener that notes what it is told, and may fail at that."""

    def __init__(self):
        self.heard = []
        self.fails = set()
        self.news = threading.Condition()

    def _note(self, what):
        with self.news:
            self.heard.append(what)
            self.news.notify_all()
        if what in self.fails:
            raise BlockingIOError(11, "Resource temporarily unavailable")

    def wait(self, what):
        with self.news:
            assert self.news.wait_for(lambda: what in self.heard, 30.0), self.heard

    def informed(self, _):
        self._note("informed")

    def published(self, data):
        self._note(data)

    def broke(self, _):
        self._note("broke")

    def let_go(self):
        self._note("let go")

    def lost(self, _, *, orderly):
        self._note("ended" if orderly else "lost")


@pytest.fixture
def info():
    """What an RTPU process says of itself, with the number of one that only sleeps."""
    with subprocess.Popen(["sleep", "1000"]) as process:
        try:
            yield wire.RtpuInfo(
                pid=process.pid,
                core=0,
                version=pbonet.__version__,
                backend="park",
                limits=[],
                claims={},
            )
        finally:
            process.kill()


@pytest.fixture
def ends(tmp_path, info):
    """A link, its listener, and a function that gives the far end of it."""
    path = tmp_path / "ctl"
    with socket.socket(socket.AF_UNIX) as server:
        server.bind(str(path))
        server.listen()
        server.settimeout(30.0)
        far = []

        def attached():
            end, _ = server.accept()
            far.append(end)
            hello = msgspec.msgpack.decode(wire.receive_frame(end), type=wire.FromAgent)
            assert isinstance(hello, wire.Attach)
            end.sendall(wire.frame(info))
            return end

        hears = Hears()
        link = supervise.RtpuLink(SimpleNamespace(ctl=path), CONFIG, hears)
        first = threading.Thread(target=attached)
        first.start()
        link.open()
        first.join()
        try:
            yield link, hears, far[0], attached
        finally:
            link.close()
            for end in far:
                end.close()


def notes(end, count):
    """Return the texts of the next so many notes."""
    texts = []
    while len(texts) < count:
        message = msgspec.msgpack.decode(wire.receive_frame(end), type=wire.FromAgent)
        texts.append(message.text)
    return texts


def test_a_frame_that_was_begun_comes_whole(ends):
    """The RTPU process takes nothing for longer than a send may wait, then goes on."""
    link, _, far, _ = ends
    limit = (0).to_bytes(8, "little") + (50_000).to_bytes(8, "little")
    link._sock.setsockopt(socket.SOL_SOCKET, socket.SO_SNDTIMEO, limit)
    sent = []

    def fill():
        for i in range(1000):
            text = f"{i} " + "x" * 100_000
            link.send(wire.Note(20, "X", text))
            sent.append(text)

    with pytest.raises(NodeError, match="does not take requests"):
        fill()
    assert notes(far, len(sent)) == sent
    link.send(wire.Note(20, "X", "the next"))
    assert notes(far, 1) == ["the next"]


def test_a_link_that_breaks_is_made_anew(ends):
    link, hears, far, attached = ends
    far.shutdown(socket.SHUT_RDWR)
    again = attached()
    hears.wait("broke")
    again.sendall(wire.frame(wire.Published(b"news")))
    hears.wait(b"news")
    link.send(wire.Note(20, "X", "hello"))
    assert notes(again, 1) == ["hello"]
    assert not {"ended", "lost", "let go"} & set(hears.heard)


def test_a_listener_that_fails_ends_no_link(ends, info):
    _, hears, far, _ = ends
    hears.fails = {"informed", b"one"}
    far.sendall(wire.frame(info) + wire.frame(wire.Published(b"one")))
    far.sendall(wire.frame(wire.Published(b"two")))
    hears.wait(b"two")


def test_an_agent_that_cannot_start_its_rtpu_process_again_ends(monkeypatch, tmp_path):
    def refused(_):
        raise BlockingIOError(11, "Resource temporarily unavailable")

    monkeypatch.setenv("PBONET_RUN_DIR", str(tmp_path))
    monkeypatch.setattr(agents.RtpuLink, "open", refused)
    config = AgentConfig(name="arm0", domain="d")
    agent = agents.Agent(config)
    agent.lost("killed", orderly=False)
    assert agent.wait(30.0)
    assert "does not start again" in agent.reason
    assert "temporarily unavailable" in agent.reason
