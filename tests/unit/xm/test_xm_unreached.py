"""Why nobody answers at an endpoint: what is told, and what to do."""

import contextlib
import errno
import socket
import threading
import time
from types import SimpleNamespace

import pytest
import zenoh

from pbonet.errors import UnreachableError
from pbonet.xm.net import probe_endpoint, run_folder, session

LISTENS = "is an agent running there, and does it listen on that address?"


def closed():
    """Return a port that nobody listens on, and whoever keeps it so."""
    held = socket.socket()
    held.bind(("127.0.0.1", 0))
    return held


def test_a_port_that_nobody_listens_on() -> None:
    with closed() as held:
        end = f"tcp/127.0.0.1:{held.getsockname()[1]}#iface=lo"
        told = probe_endpoint.reasons([end])
    assert told == ("from 127.0.0.1: Connection refused", LISTENS)


def test_a_port_on_which_no_agent_listens() -> None:
    with socket.create_server(("127.0.0.1", 0)) as other:
        told = probe_endpoint.reasons([f"tls/localhost:{other.getsockname()[1]}"])
    assert told == ("an open port, but no agent answers there", LISTENS)


@pytest.mark.parametrize("protocol", ["tcp", "udp", "ws"])
def test_a_host_that_nobody_knows(monkeypatch, protocol) -> None:
    def unknown(*_args, **_kwargs):
        raise socket.gaierror(socket.EAI_NONAME, "Name or service not known")

    monkeypatch.setattr(socket, "getaddrinfo", unknown)
    got, remedy = probe_endpoint.reasons([f"{protocol}/lab7:7447"])
    assert got == "the host name lab7 is unknown"
    assert remedy.startswith("is the name right?")


def test_a_host_that_is_silent(monkeypatch) -> None:
    def silent(_where, limit):
        raise TimeoutError(limit)

    monkeypatch.setattr(socket, "create_connection", silent)
    told = probe_endpoint.reasons(["tcp/[::1]:7447"])
    assert told == ("no answer from the host ::1 within 0.5 s", LISTENS)


def test_each_of_several_is_told_and_what_to_do_once() -> None:
    got, remedy = probe_endpoint.reasons(["udp/127.0.0.1:9", "udp/127.0.0.2:9"])
    assert got == "udp/127.0.0.1:9: no answer; udp/127.0.0.2:9: no answer"
    assert remedy == LISTENS


def test_reasons_of_a_socket_of_this_machine(tmp_path):
    path = tmp_path / "x.sock"
    endpoint = f"unixsock-stream/{path}"
    missing, remedy = probe_endpoint.reasons([endpoint])
    assert missing == "No such file or directory"
    assert remedy == "is an agent running there?"
    with socket.socket(socket.AF_UNIX) as silent:
        silent.bind(str(path))
        assert probe_endpoint.reasons([endpoint])[0] == "Connection refused"
        silent.listen(0)
        for _ in range(3):  # the last one finds that too many wait
            got, remedy = probe_endpoint.reasons([endpoint])
            assert got == "a process listens there, but does not answer"
            assert remedy.startswith("try again")


def test_a_socket_of_this_machine_that_may_not_be_opened(monkeypatch, tmp_path):
    """As a test runs as root, the kernel refuses it nothing."""

    def refused(_self, _path):
        raise PermissionError(errno.EACCES, "Permission denied")

    monkeypatch.setattr(socket.socket, "connect", refused)
    told = probe_endpoint.reasons([f"unixsock-stream/{tmp_path}/x.sock"])
    assert told == (
        "Permission denied",
        "run this as the user that started the agent, or as root",
    )


@contextlib.contextmanager
def a_busy_agent(places, tries):
    """Hold an agent's name; answer on its socket only after so many tries."""

    def serve(silent):
        kept = [silent.accept()[0] for _ in range(tries)]
        silent.close()
        places.remove(places.sock)
        opened.append(session.agent(places))
        for one in kept:
            one.close()

    opened = []
    lock = run_folder.NameLock(places.lock, "process 1")
    silent = socket.socket(socket.AF_UNIX)
    silent.bind(str(places.sock))
    silent.listen()
    thread = threading.Thread(target=serve, args=(silent,))
    thread.start()
    try:
        yield
    finally:
        thread.join()
        for one in opened:
            one.close()
        lock.release()


@pytest.mark.usefixtures("run_dir")
def test_an_agent_of_this_machine_that_is_busy_is_waited_for() -> None:
    places = run_folder.Places("busy", "arm0")
    with a_busy_agent(places, tries=4):  # two seconds of silence
        session.client("busy").close()


@pytest.mark.usefixtures("run_dir")
def test_an_agent_of_this_machine_that_stays_silent_is_given_up(monkeypatch) -> None:
    monkeypatch.setattr(session, "BUSY_TIME", 2.0)
    places = run_folder.Places("busy", "arm0")
    lock = run_folder.NameLock(places.lock, "process 1")
    with socket.socket(socket.AF_UNIX) as silent:
        silent.bind(str(places.sock))
        silent.listen()
        before = time.monotonic()
        with pytest.raises(UnreachableError, match="no agent of domain busy answers"):
            session.client("busy")
    assert time.monotonic() - before > session.OPEN_TIME
    lock.release()


@pytest.mark.usefixtures("run_dir")
def test_one_long_try_is_not_the_only_one(monkeypatch) -> None:
    """Each agent that does not answer takes half a second of a try."""
    begins, now = [], 0.0

    def silence(_config):
        nonlocal now
        begins.append(now)
        now += 3.0
        raise zenoh.ZError("silence")

    clock = SimpleNamespace(monotonic=lambda: now, sleep=lambda _seconds: None)
    monkeypatch.setattr(session, "time", clock)
    monkeypatch.setattr(session.zenoh, "open", silence)
    places = run_folder.Places("busy", "arm0")
    lock = run_folder.NameLock(places.lock, "process 1")
    with pytest.raises(UnreachableError):
        session.client("busy")
    assert begins == [0.0, 3.0]
    lock.release()
