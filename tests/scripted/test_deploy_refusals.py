"""Machines that refuse: their errors say what to do, and others are not held up."""

from __future__ import annotations

import asyncio
import socket
import threading

import asyncssh
import pytest

from pbonet.deploy import host_reports, read_hosts, set_up_hosts

HOSTS = """
known_hosts = "known"
identity = "id"
[hosts.pc]
address = "127.0.0.1"
port = {port}
user = "{user}"
[hosts.gone]
address = "127.0.0.1"
port = {closed}
user = "root"
"""
ANSWERS = {
    "plain": {"id -u": (0, "1000\n"), "sudo": (1, ""), "id -un": (0, "plain\n")},
    "bare": {"id -u": (0, "0\n"), "python3": (127, "")},
    "odd": {"id -u": (0, "0\n"), "python3": (0, "no JSON")},
    "dying": {"id -u": (0, "0\n"), "python3": (None, "")},
}
"""By user, what the machine answers to commands that begin so; None: it dies."""


class Server(asyncssh.SSHServer):
    """One that lets those in whose answers are known, with any key."""

    def begin_auth(self, _username):
        return True

    def public_key_auth_supported(self):
        return True

    def validate_public_key(self, username, _key):
        return username in ANSWERS


async def answer(process):
    name = process.get_extra_info("username")
    words = process.command.removeprefix("umask 022; ")
    known = sorted(ANSWERS[name], key=len, reverse=True)
    status, out = next(ANSWERS[name][k] for k in known if words.startswith(k))
    process.stdout.write(out)
    if status is None:
        process.get_extra_info("connection").abort()
    else:
        process.exit(status)


@pytest.fixture
def machine(tmp_path):
    """The port of an sshd that answers so, whose host key is known."""
    key, own = (asyncssh.generate_private_key("ssh-ed25519") for _ in range(2))
    own.write_private_key(tmp_path / "id")
    loop = asyncio.new_event_loop()

    async def serve():
        return await asyncssh.listen(
            "127.0.0.1",
            0,
            server_factory=Server,
            server_host_keys=[key],
            process_factory=answer,
        )

    server = loop.run_until_complete(serve())
    port = server.get_port()
    public = key.export_public_key().decode().strip()
    (tmp_path / "known").write_text(f"[127.0.0.1]:{port} {public}\n")
    thread = threading.Thread(target=loop.run_forever)
    thread.start()
    yield port
    loop.call_soon_threadsafe(server.close)
    loop.call_soon_threadsafe(loop.stop)
    thread.join()
    loop.close()


@pytest.mark.parametrize(
    ("user", "said"),
    [
        ("stranger", "refuses the login"),
        ("plain", "may not become root there without a password"),
        ("bare", "the machine has no python3"),
        ("odd", "could not tell what the machine has"),
        ("dying", "cannot be reached over ssh (got the connection was lost during"),
    ],
)
def test_a_machine_that_refuses_says_what_to_do(machine, tmp_path, user, said):
    with socket.create_server(("127.0.0.1", 0)) as other:
        closed = other.getsockname()[1]
    file = tmp_path / "lab.toml"
    file.write_text(HOSTS.format(port=machine, user=user, closed=closed))
    hosts = read_hosts(file)
    reports = set_up_hosts.deploy(hosts, None, apply=True)
    assert [one.state for one in reports] == ["failed", "failed"]
    assert host_reports.status(reports) == 1
    assert said in reports[0].error
    assert "cannot be reached over ssh" in reports[1].error
    assert all("; " in one.error for one in reports), "with what to do"
    first, second = set_up_hosts.deploy(hosts, None, apply=True, fail_fast=True)
    assert first.state == "failed"
    assert second.state == "waits"


@pytest.mark.parametrize(
    ("key", "text", "got"),
    [
        ("identity", None, "No such file"),
        ("identity", "no key", "Invalid private key"),
        ("known_hosts", None, "No such file"),
    ],
)
def test_files_of_the_operator_that_cannot_be_used_are_named(tmp_path, key, text, got):
    """The machine is not what cannot be reached."""
    path = tmp_path / "missing"
    if text is not None:
        path.write_text(text)
    file = tmp_path / "lab.toml"
    file.write_text(f'{key} = "missing"\n[hosts.pc]\naddress = "127.0.0.1"\n')
    (report,) = set_up_hosts.deploy(read_hosts(file), [], apply=True)
    assert report.error.startswith(f"{path}: {key} of lab.toml cannot be used")
    assert got in report.error
    assert "ssh-add" in report.error


def test_after_it_was_done_nothing_says_that_it_was_not():
    report = host_reports.Report(host="pc")
    report.add("keys", "change", "a step after the one that failed")
    assert "Nothing was done" in host_reports.text([report], planned=True)
    assert "Nothing was done" not in host_reports.text([report])
