"""What is interrupted leaves no half file, and is completed when it is repeated."""

import asyncio
import getpass
import json
import os
import subprocess

import pytest
from msgspec import structs
from test_plan_host import KEYS, UNIT, after, machine, nothing, release, state

from pbonet.deploy import (
    backup,
    host_keys,
    read_hosts,
    rolling_upgrade,
    running_tasks,
    steps,
)
from pbonet.deploy.host_facts import Unit
from pbonet.deploy.host_reports import Report
from pbonet.deploy.plan_host import ALONE, Plan, install, use
from pbonet.deploy.ssh import Done, Shell
from pbonet.errors import ConfigFileError, NodeError, UnreachableError
from pbonet.master.configuration import Place
from pbonet.xm.net import pki

__all__ = ["machine", "release"]


@pytest.fixture
def hosts(machine, tmp_path):  # noqa: ARG001 - it writes the file
    return read_hosts(tmp_path / "lab.toml")


class Cut(Shell):
    """A shell on this machine that transmits the first bytes, and then is closed."""

    left = 1 << 20

    async def run(self, *words, data=b"", check=True):  # noqa: ARG002
        done = subprocess.run(  # noqa: ASYNC221
            words, input=data[: self.left], check=False, stderr=subprocess.PIPE
        )
        return Done(done.returncode, "", done.stderr.decode())


def test_a_file_that_came_in_part_is_not_used(hosts, tmp_path):
    """sshd closes the input of a command whose connection is lost, as at its end."""
    shell = Cut(hosts.machines[0], hosts)
    path, user = tmp_path / "etc" / "arm0.toml", getpass.getuser()

    def put(data):
        file = steps.Put(path=str(path), data=data, mode=0o640, owner=user)
        asyncio.run(shell.put(file))

    put(b"core = 1\n")
    assert path.read_bytes() == b"core = 1\n"
    assert path.stat().st_mode & 0o777 == 0o640
    shell.left = 7
    with pytest.raises(NodeError, match=r"pc: /.*arm0.toml cannot be written"):
        put(b'core = 2\nkeys = "k"\n')
    assert path.read_bytes() == b"core = 1\n"
    assert [*path.parent.iterdir()] == [path]


@pytest.mark.parametrize("owner", ["nobody-of-this-name", "--reference=/etc/shadow"])
def test_a_file_of_an_owner_that_does_not_exist_is_not_written(hosts, tmp_path, owner):
    shell, path = Cut(hosts.machines[0], hosts), tmp_path / "etc" / "arm0.toml"
    file = steps.Put(path=str(path), data=b"core = 1\n", owner=owner, group="root")
    with pytest.raises(NodeError, match=r"cannot be written .*invalid user.*make this"):
        asyncio.run(shell.put(file))
    assert not [*path.parent.iterdir()]


@pytest.mark.parametrize("path", ["etc/pbonet/arm0.toml", "etc/pbonet/keys/key.pem"])
def test_agents_read_what_was_written_before_the_connection_was_lost(
    machine, release, path
):
    done = after(machine, nothing(machine), release)
    there = {**done.files, **done.secrets}
    there[f"/{path}"] = structs.replace(there[f"/{path}"], written=20.0)
    facts = structs.replace(done, files=there, secrets=there)
    for since, expected in ((10.0, "change"), (21.0, "same")):
        unit = Unit("active", enabled=True, since=since)
        facts = structs.replace(facts, units={UNIT: unit})
        plan = Plan(machine, facts, release, KEYS).steps()
        assert state(plan, "service") == [expected]
        assert state(plan, "keys") == state(plan, "arm0")[:1] == ["same"]


def test_systemd_reads_units_that_were_written_before(machine, release):
    done = after(machine, nothing(machine), release)
    unread = Unit("active", enabled=True, unread=True)
    facts = structs.replace(done, units={UNIT: unread})
    plan = Plan(machine, facts, release, KEYS).steps()
    (step,) = [one for one in plan if one.state == "change"]
    assert step.actions == (steps.Run(("systemctl", "daemon-reload")),)


PYTHON = """#!/bin/sh
echo "$@" >> {log}
case "$1 $2 $3" in
"-m venv "*)
  mkdir -p "$3/bin"
  cp "$0" "$3/bin/python"
  printf '#!/bin/sh\n' > "$3/bin/pbonet"
  chmod +x "$3/bin/pbonet" ;;
"-m pip "*) test ! -e {bad} || exit 3 ;;
esac
"""
"""Stands for a machine's Python."""


@pytest.fixture
def installing(tmp_path):
    """Return what installs a release here, with a Python that keeps its words."""
    python, log, bad = (tmp_path / name for name in ("python", "log", "bad"))
    python.write_text(PYTHON.format(log=log, bad=bad))
    python.chmod(0o755)
    log.touch()

    def install_release():
        folder, incoming = tmp_path / "rel" / "r-1", tmp_path / "incoming"
        incoming.mkdir()
        here = (folder, incoming, steps.COMPLETE, python, incoming / "x.whl")
        done = subprocess.run(
            ["sh", "-s", "--", *map(str, here)],
            input=steps.packaged("install_release.sh"),
            text=True,
            check=False,
        )
        assert not incoming.exists()
        return done.returncode, folder / steps.COMPLETE, log.read_text()

    install_release.bad = bad
    return install_release


def test_a_release_that_somebody_else_has_completed_is_not_made_again(installing):
    status, complete, log = installing()
    assert (status, complete.exists(), "-m venv" in log) == (0, True, True)
    assert installing() == (0, complete, log)
    complete.unlink()  # half a release is
    assert installing() == (0, complete, log * 2)
    assert complete.exists()


def test_a_release_that_cannot_be_installed_leaves_its_room_free(installing):
    installing.bad.touch()
    status, complete, _ = installing()
    assert status
    assert not complete.parent.exists()


def test_two_operators_who_install_at_once_share_no_files(machine, release):
    """What one of them removes, the other one does not need."""
    (clear, *puts, run), (_, *others, _) = (
        [*install(machine, release)] for _ in range(2)
    )
    assert run.words[:2] == ALONE
    assert not {put.path for put in puts} & {put.path for put in others}
    assert all(put.path.startswith(clear.words[-1]) for put in puts)


def test_wheels_that_are_being_sent_are_not_removed(machine, release, tmp_path):
    clear = next(install(machine, release))
    new, old = tmp_path / "incoming" / "new", tmp_path / "incoming" / "old"
    for path in (new, old):
        path.mkdir(parents=True)
    os.utime(old, (0, 0))
    subprocess.run([*clear.words[:-1], new.parent], check=True)
    assert (new.exists(), old.exists()) == (True, False)


def test_a_release_is_not_exchanged_for_one_that_was_not_in_the_plan(
    machine, release, tmp_path
):
    """Another operator has used one since this plan was made."""
    facts = after(machine, nothing(machine), release)
    link = tmp_path / "opt"
    for current in ("", "r-1"):
        guard = next(use(structs.replace(facts, current=current), "new"))
        assert f"is not {current or 'none'} any more" in guard.what
        words = [str(link) if word == steps.OPT else word for word in guard.words]
        for there in ("", "r-1", "r-2"):
            link.unlink(missing_ok=True)
            if there:
                link.symlink_to(tmp_path / there)
            done = subprocess.run(words, check=False, capture_output=True, text=True)
            same = there == current
            said = "" if same else f"{there or 'none'}\n"
            assert (done.returncode, done.stdout) == (int(not same), said)


def test_keys_that_cannot_be_written_are_an_error_of_their_machine(machine, tmp_path):
    pki.make_authority(tmp_path / "keys")
    (tmp_path / "keys" / "pc").touch()
    with pytest.raises(ConfigFileError, match=r"keys/pc: the keys .* be written"):
        host_keys.make(tmp_path / "keys", machine)


class Told:
    """A shell whose machine gives one answer."""

    def __init__(self, machine, answer):
        self.machine, self.answer = machine, answer

    async def run(self, *_words, **_how):
        return Done(0, json.dumps(self.answer), "")


@pytest.mark.parametrize("path", ["/etc/../root/.profile", "/home/anna/.profile"])
def test_a_machine_writes_nothing_out_of_its_folder_of_a_backup(machine, path):
    one = {"path": path, "mode": 420, "owner": "root", "digest": "", "data": "eA=="}
    answer = {"files": [one], "enabled": [], "release": ""}
    with pytest.raises(NodeError, match="could not tell which files"):
        asyncio.run(backup._collect(Told(machine, answer)))


def test_private_keys_are_not_copied_whatever_their_name(tmp_path):
    from pbonet.deploy import print_config_files

    old = tmp_path / "old.pem"
    old.write_text("-----BEGIN PRIVATE KEY-----\n")
    assert print_config_files.described(old)["data"] == ""


class Upgrade(rolling_upgrade._Upgrade):
    """An upgrade of one machine, whose commands are kept."""

    def __init__(self, hosts, facts, monkeypatch, current="new"):
        super().__init__(hosts, [], Place(domain="d"), apply=True, yes=False)
        self.words = []
        self.facts = structs.replace(facts, current=current, previous="old")
        self.turn = rolling_upgrade.Turn(
            machine=hosts.machines[0],
            report=Report(host="pc"),
            facts=self.facts,
            target="new",
            version="0.2.0",
            now={},
            then={},
            todo=[],
        )

        async def ask(*_):
            return self.facts

        monkeypatch.setattr(rolling_upgrade.host_facts, "ask", ask)

    async def run(self, *words, **_how):
        self.words.append(" ".join(words[:2]))


def test_agents_that_ended_are_started_when_an_upgrade_is_repeated(
    hosts, machine, release, monkeypatch
):
    facts = after(machine, nothing(machine), release)
    assert not [*use(structs.replace(facts, current="new"), "new")]
    idle = structs.replace(facts, units={UNIT: Unit("inactive", enabled=True)})
    both = Upgrade(hosts, facts, monkeypatch).turn, Upgrade(hosts, idle, monkeypatch)
    assert both[0].done
    assert not both[1].turn.done
    asyncio.run(both[1]._exchange(both[1], both[1].turn))
    assert both[1].words == ["systemctl reset-failed", "systemctl start"]


def test_a_release_that_somebody_else_has_set_is_not_replaced(
    hosts, machine, release, monkeypatch
):
    facts = after(machine, nothing(machine), release)
    up = Upgrade(hosts, facts, monkeypatch, current="mine")
    up.facts = structs.replace(up.facts, current="hers")
    with pytest.raises(NodeError, match="somebody else has changed"):
        asyncio.run(up._exchange(up, up.turn))
    assert not up.words


def test_a_task_that_came_on_meanwhile_is_asked_for(
    hosts, machine, release, monkeypatch
):
    """While other machines had their turn; the way back is not that of an exchange."""
    facts = after(machine, nothing(machine), release)
    up = Upgrade(hosts, facts, monkeypatch, current="mine")
    task = running_tasks.Task(
        name="arm", subsystem="cell", rtpu="arm0", job=None, restart="off", fallback=""
    )
    found = {"pc": running_tasks.Moves(tasks=[task])}
    monkeypatch.setattr(running_tasks, "moves", lambda *_: found)
    assert not asyncio.run(up._take(up.turn))
    assert "would be turned off" in up.turn.report.error
    assert not up.words
    assert "the release of pc was not exchanged" in up.turn.report.warnings[-1]
    up.turn.exchanged = True
    assert "--back --host pc" in up._way_on(up.turn)


def test_a_machine_that_dies_amid_its_turn_leaves_a_word_about_its_fallbacks(
    hosts, machine, release, monkeypatch
):
    """A repeated upgrade knows nothing of a task that has gone with its machine."""
    up = Upgrade(hosts, after(machine, nothing(machine), release), monkeypatch)
    job = hosts.path.with_name("run.job")
    task = running_tasks.Task(
        name="mid", subsystem="cell", rtpu="arm0", job=job, restart="off", fallback="b"
    )
    found = {"pc": running_tasks.Moves(tasks=[task])}
    monkeypatch.setattr(running_tasks, "moves", lambda *_: found)
    monkeypatch.setattr(running_tasks, "move_away", lambda *_: None)

    def lost(*_):
        raise UnreachableError("the machine cannot be reached over ssh", where="pc")

    monkeypatch.setattr(rolling_upgrade, "Shell", lost)
    assert not asyncio.run(up._take(up.turn))
    assert up.turn.report.warnings[-1].endswith(f"'pbonet swap {job} b mid'")
