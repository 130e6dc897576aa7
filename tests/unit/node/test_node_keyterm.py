"""How long keys are valid for, as agents and doctor tell it."""

from __future__ import annotations

import contextlib
import socket
import ssl
import threading

import pytest
from long_limits import LIMIT
from watching import wait_for

from pbonet.errors import Severity
from pbonet.master.tools import doctor
from pbonet.node.agent import certificate_expiry
from pbonet.xm.net import credentials, pki
from pbonet.xm.net.credentials import Role

DAY = 86400.0


@pytest.fixture
def lab(tmp_path):
    pki.make_authority(tmp_path / "lab")
    return tmp_path / "lab"


@pytest.fixture
def clock(monkeypatch):
    """Set the clock forward by seconds."""
    ahead = [0.0]
    real = credentials.left
    monkeypatch.setattr(credentials, "left", lambda until: real(until) - ahead[0])
    monkeypatch.setattr(certificate_expiry, "LOOK", 0.005)

    def forward(seconds):
        ahead[0] += seconds

    return forward


def test_it_is_told_once_a_day_and_when_it_is_over(lab, clock):
    """Not before 30 days are left; a clock that is set is seen at the next look."""
    folder = pki.issue(lab, Role.AGENT, "pc", hosts=["arm-pc"], days=40.5)
    told = []
    term = certificate_expiry.KeyTerm(folder, "arm0", told.append)
    term.start()
    try:
        assert told == []
        clock(12 * DAY)
        wait_for(lambda: told, "the first warning")
        for days in (1, 1):
            before = len(told)
            clock(days * DAY)
            wait_for(lambda n=before: len(told) > n, "the next one")
        clock(30 * DAY)
        wait_for(lambda: told[3:], "the end")
    finally:
        term.stop()
    assert [note.text.partition(";")[0] for note in told] == [
        "the keys expire in 28 days",
        "the keys expire in 27 days",
        "the keys expire in 26 days",
        "the keys have expired: no other machine can be reached",
    ]
    kinds = [Severity.WARNING] * 3 + [Severity.ERROR]
    assert [(note.code, note.severity) for note in told] == [
        ("KEYS_EXPIRE", int(kind)) for kind in kinds
    ]
    assert all(f"put them into {folder}, " in note.text for note in told)


def test_links_are_cut_again_and_again_when_the_keys_have_expired(lab, clock):
    """And not before: zenoh keeps one that is opened in the second of the end."""
    folder = pki.issue(lab, Role.AGENT, "pc", hosts=["arm-pc"], days=1.0)
    told, cuts = [], []
    term = certificate_expiry.KeyTerm(
        folder, "arm0", told.append, cut=lambda: cuts.append(len(told))
    )
    term.start()
    try:
        wait_for(lambda: told, "the warning")
        clock(DAY)
        wait_for(lambda: cuts[1:], "two cuts")
    finally:
        term.stop()
    assert cuts[0] == len(("warning", "end"))


def test_without_keys_there_is_nothing_to_tell():
    term = certificate_expiry.KeyTerm(None, "arm0", pytest.fail)
    term.start()
    term.stop()
    assert term.left is None


def test_keys_that_others_refuse_are_told_once(lab, tmp_path, monkeypatch):
    """By who dials: whose certificate is not taken, where, and what to do."""
    monkeypatch.setattr(certificate_expiry, "LINK_LOOK", 0.005)
    pki.make_authority(tmp_path / "other")
    mine = pki.issue(lab, Role.AGENT, "pc", hosts=["127.0.0.1"])
    theirs = pki.issue(tmp_path / "other", Role.AGENT, "pc", hosts=["127.0.0.1"])
    told, looks = [], []
    with listening(theirs) as port:
        endpoint = f"tls/127.0.0.1:{port}"

        def unlinked():
            looks.append(endpoint)
            return [endpoint]

        term = certificate_expiry.KeyTerm(mine, "arm0", told.append, unlinked)
        term.start()
        try:
            wait_for(lambda: looks[3:], "some looks")
        finally:
            term.stop()
    (note,) = told
    assert (note.code, note.severity) == ("KEYS_REFUSED", int(Severity.ERROR))
    why = "its certificate was not signed by the authority of these keys"
    assert note.text.startswith(f"no link to {endpoint}: {why}; ")
    assert f"(here in {mine})" in note.text


@contextlib.contextmanager
def listening(folder):
    """Take links over mutual TLS with keys, as an agent does."""
    context = ssl.SSLContext(ssl.PROTOCOL_TLS_SERVER)
    context.load_cert_chain(folder / "cert.pem", folder / "key.pem")
    context.load_verify_locations(folder / "ca.pem")
    context.verify_mode = ssl.CERT_REQUIRED
    with socket.create_server(("127.0.0.1", 0)) as server:
        thread = threading.Thread(target=accept, args=(server, context))
        thread.start()
        try:
            yield server.getsockname()[1]
        finally:
            server.shutdown(socket.SHUT_RDWR)
            thread.join()


def accept(server, context):
    with contextlib.suppress(OSError):  # it is shut down
        while True:
            plain, _ = server.accept()
            with contextlib.suppress(OSError), plain:
                context.wrap_socket(plain, server_side=True).close()


def test_keys_that_go_together_are_not_doubted(lab):
    mine = pki.issue(lab, Role.AGENT, "pc", hosts=["127.0.0.1"])
    old = pki.issue(lab, Role.AGENT, "old", hosts=["127.0.0.1"], days=-0.01)
    with listening(mine) as port:
        assert credentials.doubted(mine, "127.0.0.1", port, LIMIT) == ""
        refused = credentials.doubted(old, "127.0.0.1", port, LIMIT)
    assert refused == "it refuses the certificate of these keys"
    with listening(old) as port:
        found = credentials.doubted(mine, "127.0.0.1", port, LIMIT)
    assert found == "its certificate has expired"
    assert credentials.doubted(mine, "127.0.0.1", port, LIMIT) == "", "nobody is there"


@pytest.mark.parametrize(
    ("seconds", "said"),
    [
        (45.4, "45 seconds"),
        (600, "10 minutes"),
        (5 * 3600, "5 hours"),
        (29.2 * DAY, "29 days"),
    ],
)
def test_times_are_said_as_people_do(seconds, said):
    assert credentials.days(seconds) == said


@pytest.mark.parametrize(
    ("days", "line"),
    [
        (100.5, "PASS your keys in {} are valid for 100 days"),
        (5.2, "WARN your keys in {} are valid for 5 days; make others with "),
        (-0.01, "FAIL {}/cert.pem: the certificate has expired; `pbonet keys "),
    ],
)
def test_doctor_looks_at_ones_own_keys(lab, monkeypatch, days, line):
    folder = pki.issue(lab, Role.MASTER, "anna", days=days)
    monkeypatch.setenv(credentials.VARIABLE, str(folder))
    (found,) = doctor.own_keys()
    assert str(found).startswith(line.format(folder))


def test_doctor_tells_who_cannot_be_reached(run_dir, monkeypatch):  # noqa: ARG001 - an empty folder
    """Nobody being there is no fault; who was named, or runs, has to answer."""
    monkeypatch.delenv(credentials.VARIABLE, raising=False)
    (alone,) = doctor.agents("d", [], [])
    assert alone.level is doctor.Level.PASS
    (named,) = doctor.agents("d", ["tcp/127.0.0.1:9"], [])
    assert str(named).startswith(
        "FAIL tcp/127.0.0.1:9: no agent of domain d answers; is an agent running there"
    )
