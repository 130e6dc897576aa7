"""The agent's link to its RTPU process when either of them stands still or fails."""

import errno
import os
import signal
import socket
import subprocess
import threading
from types import SimpleNamespace

import msgspec
import pytest
from long_limits import LIMIT

import pbonet
from pbonet.config.model import AgentConfig
from pbonet.errors import NodeError
from pbonet.node.agent import agent as agents, rtpu_link, start_rtpu
from pbonet.node.wire import rtpu_messages
from pbonet.xm.net import run_folder

CONFIG = rtpu_messages.RtpuConfig(domain="d", name="arm0", core=0)


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

    def lost(self, how, *, again, orderly):  # noqa: ARG002
        self.how = how
        self._note("lost" if again else "ended")


@pytest.fixture
def info():
    """What an RTPU process says of itself, with the number of one that only sleeps."""
    with subprocess.Popen(["sleep", "1000"]) as process:
        try:
            yield rtpu_messages.RtpuInfo(
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
            hello = msgspec.msgpack.decode(
                rtpu_messages.receive_frame(end), type=rtpu_messages.FromAgent
            )
            assert isinstance(hello, rtpu_messages.Attach)
            end.sendall(rtpu_messages.frame(info))
            return end

        hears = Hears()
        link = rtpu_link.RtpuLink(SimpleNamespace(ctl=path), CONFIG, hears)
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
        message = msgspec.msgpack.decode(
            rtpu_messages.receive_frame(end), type=rtpu_messages.FromAgent
        )
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
            link.send(rtpu_messages.Note(20, "X", text))
            sent.append(text)

    with pytest.raises(NodeError, match="does not take requests"):
        fill()
    assert notes(far, len(sent)) == sent
    link.send(rtpu_messages.Note(20, "X", "the next"))
    assert notes(far, 1) == ["the next"]


def test_a_link_that_breaks_is_made_anew(ends):
    link, hears, far, attached = ends
    far.shutdown(socket.SHUT_RDWR)
    again = attached()
    hears.wait("broke")
    again.sendall(rtpu_messages.frame(rtpu_messages.Published(b"news")))
    hears.wait(b"news")
    link.send(rtpu_messages.Note(20, "X", "hello"))
    assert notes(again, 1) == ["hello"]
    assert not {"ended", "lost", "let go"} & set(hears.heard)


UNREADABLE = rtpu_messages.LENGTH.pack(3) + b"\xc1\xc1\xc1"


def test_messages_that_cannot_be_read_are_borne_for_a_while_only(ends, info, caplog):
    """Of another version, say; the tasks of the RTPU process must not pay for it."""
    _, hears, far, attached = ends
    for _ in range(rtpu_link.UNREAD):
        far.sendall(UNREADABLE)
        far = attached()
    far.sendall(UNREADABLE)
    hears.wait("ended")
    assert hears.heard.count("broke") == rtpu_link.UNREAD
    assert "the RTPU process cannot be understood: arm0, process" in hears.how
    assert "must be of one installation" in hears.how
    assert [one.levelname for one in caplog.records] == ["WARNING"]
    os.kill(info.pid, 0)  # it goes on for its grace


class Lacking:
    """Calls that the system refuses so often, then lets pass."""

    def __init__(self, call, count):
        self.call, self.left = call, count

    def __call__(self, *args):
        if self.left:
            self.left -= 1
            raise OSError(errno.EMFILE, os.strerror(errno.EMFILE))
        return self.call(*args)


def told(caplog):
    return [one for one in caplog.records if "cannot be opened again" in one.message]


def test_a_link_is_made_anew_when_there_are_descriptors_again(
    ends, monkeypatch, caplog
):
    _, hears, far, attached = ends
    pidfd, sock = Lacking(os.pidfd_open, 3), Lacking(socket.socket, 3)
    monkeypatch.setattr(os, "pidfd_open", pidfd)
    names = {**vars(socket), "socket": sock}
    monkeypatch.setattr(rtpu_link, "socket", SimpleNamespace(**names))
    far.shutdown(socket.SHUT_RDWR)
    again = attached()
    hears.wait("broke")
    again.sendall(rtpu_messages.frame(rtpu_messages.Published(b"news")))
    hears.wait(b"news")
    assert (pidfd.left, sock.left) == (0, 0)
    (record,) = told(caplog)
    assert "Too many open files; this is retried" in record.message


def test_an_end_is_told_though_descriptors_lack(ends, info, monkeypatch, caplog):
    _, hears, far, _ = ends
    monkeypatch.setattr(rtpu_link.cleanup, "clean_after", lambda _: [])
    pidfd = Lacking(os.pidfd_open, 3)
    monkeypatch.setattr(os, "pidfd_open", pidfd)
    os.kill(info.pid, signal.SIGKILL)
    far.sendall(rtpu_messages.frame(rtpu_messages.Ending("it was asked to")))
    hears.wait("ended")
    assert hears.how == "the RTPU process ended: it was asked to"
    assert pidfd.left == 0
    assert len(told(caplog)) == 1


def test_a_listener_that_fails_ends_no_link(ends, info):
    _, hears, far, _ = ends
    hears.fails = {"informed", b"one"}
    far.sendall(
        rtpu_messages.frame(info) + rtpu_messages.frame(rtpu_messages.Published(b"one"))
    )
    far.sendall(rtpu_messages.frame(rtpu_messages.Published(b"two")))
    hears.wait(b"two")


def test_an_agent_that_cannot_start_its_rtpu_process_again_ends(monkeypatch, tmp_path):
    def refused(*_):
        raise BlockingIOError(11, "Resource temporarily unavailable")

    monkeypatch.setenv("PBONET_RUN_DIR", str(tmp_path))
    monkeypatch.setattr(agents.RtpuLink, "open", refused)
    config = AgentConfig(name="arm0", domain="d")
    agent = agents.Agent(config)
    agent.lost("the RTPU process ended: killed", again=True, orderly=False)
    assert agent.wait(30.0)
    assert "does not start again" in agent.reason
    assert "temporarily unavailable" in agent.reason


def test_who_stops_lets_go_of_tables_before_they_are_removed(ends, info, monkeypatch):
    """Else they stood, when the RTPU process is killed and cannot remove them."""
    link, hears, _, _ = ends
    monkeypatch.setattr(rtpu_link.cleanup, "clean_after", lambda _: hears._note("c"))
    os.kill(info.pid, signal.SIGKILL)
    assert link.shut_down(LIMIT)
    assert hears.heard[-2:] == ["let go", "c"]


@pytest.mark.usefixtures("run_dir")
def test_a_start_ends_with_an_agent_that_is_refused(monkeypatch):
    """Its session cannot be opened, or its name is taken; nothing of it is left."""
    started = []

    class Noted(subprocess.Popen):
        def __init__(self, *words, **more):
            super().__init__(*words, **more)
            started.append(self)

    monkeypatch.setattr(start_rtpu.subprocess, "Popen", Noted)
    places = run_folder.Places("d", "arm0")
    link = rtpu_link.RtpuLink(places, CONFIG, Hears())
    link.begin()
    assert started[0].poll() is None
    assert link.shut_down(LIMIT)
    assert started[0].returncode is not None
    assert not any(path.exists() for path in (places.ctl_lock, places.log, places.ctl))


@pytest.mark.usefixtures("run_dir")
@pytest.mark.parametrize("lives", [True, False])
def test_an_rtpu_process_waits_for_the_agent_that_starts_it(monkeypatch, lives):
    """However long its session takes; without that agent it ends after the grace."""
    if not lives:
        monkeypatch.setattr(start_rtpu.os, "getpid", lambda: 1)
    places = run_folder.Places("d", "arm0")
    config = msgspec.structs.replace(CONFIG, grace=0.05)
    link = rtpu_link.RtpuLink(places, config, Hears())
    link.begin()
    starting = link._starting
    assert start_rtpu.readable(starting._read, LIMIT)
    if lives:
        with pytest.raises(subprocess.TimeoutExpired):
            starting.process.wait(0.5)
        assert link.open().pid == starting.process.pid
    assert link.shut_down(LIMIT) or not lives
    assert starting.process.wait(LIMIT) == 0


@pytest.mark.usefixtures("run_dir")
def test_a_start_that_was_given_up_is_not_waited_for(monkeypatch):
    """An agent that ends needs no RTPU process any more."""
    monkeypatch.setattr(start_rtpu, "START_TIME", float("inf"))
    started = []

    class Stopped(subprocess.Popen):
        def __init__(self, *words, **more):
            super().__init__(*words, **more)
            self.send_signal(signal.SIGSTOP)  # so that it never gets ready
            started.append(self)

    monkeypatch.setattr(start_rtpu.subprocess, "Popen", Stopped)
    places = run_folder.Places("d", "arm0")
    with pytest.raises(NodeError, match="did not start"):
        start_rtpu.Starting(places, CONFIG).wait(lambda: bool(started))
    assert started[0].returncode == -signal.SIGKILL
