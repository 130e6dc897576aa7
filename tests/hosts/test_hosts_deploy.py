"""Machines that are set up over ssh, upgraded while they run, and restored."""

from __future__ import annotations

import json
import os
import re
import subprocess
import sys

import pytest
import sshhosts
from nodekit import rmod, svar
from sshhosts import MODULES, PYTHON, SshHost, make_wheel, make_wheelhouse
from watching import wait_for

from pbonet.node import rt

HOSTS = {"arm-pc": ("b", "arm0"), "cam-pc": ("c", "arm1"), "desk": ("a", "arm2")}
NEXT = "LAYERS.update(table=Range(1, 2), commands=Range(1, 2))\n"
BROKEN = '\nraise RuntimeError("broken on purpose")\n'
AFTER = "LAYERS.update(table=Range(2, 2), commands=Range(2, 2))\n"


class Operator:
    """Who types on host a, and the files that are there."""

    def __init__(self, lan, folder):
        self.lan, self.folder = lan, folder
        self.host = lan["a"]
        self.hosts = {}
        self.file = folder / "lab.toml"
        key = folder / "id"
        make = ["ssh-keygen", "-q", "-t", "ed25519", "-N", "", "-f", str(key)]
        subprocess.run(make, check=True)
        self.wheelhouse = make_wheelhouse(folder / "wheelhouse")
        (folder / "known").write_text("")

    def address(self, name):
        at = HOSTS[name][0]
        return self.lan[at].address("a" if at != "a" else "b")

    def boot(self):
        """Start the three machines."""
        for name, (at, _) in HOSTS.items():
            folder = self.folder / f"pbonet-{self.lan.tag}{at}"
            host = SshHost(self.lan[at], folder, self.folder / "id.pub")
            self.hosts[name] = host
        for name, host in self.hosts.items():
            host.wait(self.host, self.address(name))

    def trust(self):
        """Know the machines' host keys."""
        lines = [h.known.format(self.address(n)) for n, h in self.hosts.items()]
        (self.folder / "known").write_text("".join(lines))

    def write(self, **more):
        """Write the file of hosts; the desk's agent is where commands come in."""
        lines = ['authority = "keys"', 'known_hosts = "known"', 'identity = "id"']
        lines += ['jobs = ["run.job"]', 'wheelhouse = "wheelhouse"']
        desk = f"tls/{self.address('desk')}:7447"
        for name, (at, rtpu) in HOSTS.items():
            role = "gateway" if name == "desk" else "agent"
            others = [self.lan["a"].address(at)] if name != "desk" else ["10.77.3.1"]
            lines += [f"[hosts.{name}]", f'address = "{self.address(name)}"']
            user = sshhosts.OPERATOR if name == "cam-pc" else "root"
            lines += [f"port = {sshhosts.PORT}", f'user = "{user}"', f'role = "{role}"']
            lines += [f"names = {json.dumps(others if name == 'desk' else [])}"]
            lines += [f'python = "{PYTHON}/bin/python3"']
            lines += [f"[hosts.{name}.rtpus.{rtpu}]"]
            lines += [f'libraries = ["{MODULES}"]']
            if name == "desk":
                lines += ['listen = ["tls/[::]:7447"]']
            else:
                lines += [f'connect = ["tls/{self.lan["a"].address(at)}:7447"]']
            lines += more.get(name.replace("-", "_"), [])
        self.desk = desk
        self.file.write_text("\n".join([*lines, ""]))

    def job(self, text):
        tasks = {
            "src": ("arm0", rmod("counts", "Y0")),
            "mid": ("arm1", rmod("holds", "Y2", invar="Y0", local={"level": 2.0})),
            "spare": ("arm0", rmod("holds", "Y2", invar="Y0", local={"level": 3.0})),
        }
        rtpus = "\n".join(
            f"RTPU {r}\nSCHEDULER MUF\nUSAGE exclusive\nMINFREQ 1\nMAXFREQ 1000\n"
            for _, r in HOSTS.values()
        )
        (self.folder / "run.job").write_text(text)
        head = "SUBSYSTEM cell\nSVARFILE cell.svar\nMASTER arm2\n"
        (self.folder / "cell.sbs").write_text(f"{head}{rtpus}\nEOF\n")
        (self.folder / "cell.svar").write_text(svar())
        for name, (rtpu, lines) in tasks.items():
            at = lines.replace("FREQ 200\n", f"FREQ 200\nRTPU {rtpu}\n")
            (self.folder / f"{name}.rmod").write_text(at)

    def run(self, *words, status=0):
        """Type a command of pbonet; return what it printed."""
        env = {
            **os.environ,
            "HOME": str(self.folder),
            "PBONET_RUN_DIR": str(self.folder / "run"),
            "PBONET_LIBRARY": str(sshhosts.MISBEHAVING),
        }
        done = subprocess.run(
            self.host.command(sys.executable, "-m", "pbonet.cli", *map(str, words)),
            env=env,
            cwd=self.folder,
            capture_output=True,
            text=True,
            check=False,
        )
        if status is not None and done.returncode != status:
            for host in self.hosts.values():  # pytest shows it
                print(host.inside("journalctl", "-n", "60", "--no-pager", check=False))
        assert done.returncode == status or status is None, done.stdout + done.stderr
        return done.stdout + done.stderr

    def start(self):
        """Start the job, however slowly the machines answer now; see that it is ON."""

        def on():
            self.run("start", "run.job", *self.reach(), status=None)
            return self.on() == {"src", "mid"}

        wait_for(on, "the job")

    def reach(self):
        """The words with which the agents are reached."""
        return "--connect", self.desk, "--keys", self.folder / "keys" / "anna"

    def hosts_told(self, *words, status=0):
        """Return by machine what a verb told as data."""
        told = json.loads(self.run(*words, "--json", status=status))
        return {one["host"]: one for one in told}

    def on(self):
        """Return the tasks that are ON."""
        status = ("status", "run.job", "--json", *self.reach())
        told = json.loads(self.run(*status, status=None))
        tasks = {t["task"]: t["fields"]["state"] for t in told.get("tasks", ())}
        return {name for name, state in tasks.items() if state == "ON"}

    def close(self):
        for host in self.hosts.values():
            host.close()


@pytest.fixture
def operator(lan, tmp_path):
    if reason := sshhosts.missing():
        pytest.skip(reason)
    made = Operator(lan, tmp_path)
    try:
        yield made
    finally:
        made.close()


JOB = """JOB run
DESC a job
SBS cell.sbs
TASK src arm0 RESTART on
TASK mid arm1 FALLBACK spare
EOF
"""


def states(told, name):
    """Return by machine the states of the steps of a name."""
    return {
        host: [step["state"] for step in one["steps"] if step["name"] == name]
        for host, one in told.items()
    }


def all_are(told, state):
    return {one["state"] for one in told.values()} == {state}


@pytest.fixture
def laboratory(operator, tmp_path):
    """Three machines that were set up, with a job that runs."""
    old = make_wheel(tmp_path, "0.1.0")
    operator.job(JOB)
    operator.boot()
    operator.write()
    operator.run("keys", "ca", "--ca", "keys")
    operator.run("keys", "master", "anna", "--ca", "keys")
    deploy = ("deploy", "lab.toml", "--wheel", old)

    told = operator.hosts_told(*deploy, status=1)
    assert all("host key is not known" in one["error"] for one in told.values())
    operator.trust()
    told = operator.hosts_told(*deploy)
    assert all_are(told, "change")
    find = ("find", "/opt", "/etc", "-name", "*pbonet*", "-not", "-name", "*.d")
    assert not operator.hosts["arm-pc"].inside(*find)
    told = operator.hosts_told(*deploy, "--apply")
    assert all_are(told, "changed")
    assert states(told, "check") == {name: ["same"] for name in HOSTS}
    assert all_are(operator.hosts_told(*deploy), "same")

    operator.start()
    must_have_real_time(operator.hosts["arm-pc"], "src")
    return operator


def must_have_real_time(host, task):
    """Judge that a task of an agent under the unit has SCHED_FIFO, if root may."""
    if rt.probe().fifo:
        threads = host.inside("ps", "-eLo", "comm=,cls=,rtprio=")
        assert re.search(rf"^{task} +FF +\d+$", threads, re.MULTILINE), threads


@pytest.mark.timeout(900)  # twelve environments are made, on a machine that may be busy
def test_machines_are_upgraded_while_others_run_and_restored(laboratory, tmp_path):
    operator = laboratory
    # Releases that cannot speak with each other are refused before anything is done.
    far = make_wheel(tmp_path, "0.3.0", AFTER)
    up = ("upgrade", "lab.toml", *operator.reach(), "--wheel")
    said = operator.run(*up, far, "--apply", status=1)
    assert "no common version of commands" in said
    releases = operator.hosts["arm-pc"].inside("ls", "/opt/pbonet-releases")
    assert "0.3.0" not in releases

    # One whose agent does not start stops the upgrade, and the way back is told.
    bad = make_wheel(tmp_path, "0.1.9", node__agent__agent_main=BROKEN)
    told = operator.hosts_told(*up, bad, "--apply", "--host", "arm-pc", status=1)
    assert states(told, "check") == {"arm-pc": ["failed"]}
    assert "broken on purpose" in json.dumps(told), told
    assert "--back --host arm-pc --apply" in json.dumps(told)
    back = ("upgrade", "lab.toml", "--back", "--host", "arm-pc", *operator.reach())
    assert all_are(operator.hosts_told(*back, "--apply"), "changed")
    operator.start()

    # A task that nobody has declared to be interrupted is not, without --yes.
    new = make_wheel(tmp_path, "0.2.0", NEXT)
    operator.job(JOB.replace(" RESTART on", ""))
    said = operator.run(*up, new, "--host", "arm-pc", "--apply", status=1)
    assert "src of cell on arm0 is turned off" in said
    operator.job(JOB)
    told = operator.hosts_told(*up, new, "--apply")
    assert [*told] == ["arm-pc", "cam-pc", "desk"]  # gateway and keeper come last
    assert all_are(told, "changed"), told
    assert "spare takes its place" in json.dumps(told["cam-pc"])
    assert operator.on() == {"src", "mid"}
    infos = json.loads(operator.run("fleet", "--json", *operator.reach()))["machines"]
    assert [one["versions"] for one in infos] == [["0.2.0"]] * len(HOSTS)

    # What is configured is copied, and put back.
    operator.run("backup", "lab.toml", "saved")
    kept = {path.name for path in (tmp_path / "saved").rglob("*") if path.is_file()}
    assert {"hosts.toml", "run.job", "arm0.toml", "cert.pem"} <= kept
    assert "key.pem" not in kept
    config, users = "/etc/pbonet/arm0.toml", "/etc/sysusers.d/pbonet.conf"
    shell = f"echo grace = 9.0 >> {config}; rm /etc/security/limits.d/pbonet.conf"
    shell += f"; chown pbonet:users {users}; chmod 600 {users}"
    operator.hosts["arm-pc"].inside("sh", "-ec", shell)
    told = operator.hosts_told("restore", "lab.toml", "saved")
    changes = [s for s in told["arm-pc"]["steps"] if s["state"] == "change"]
    assert [s["name"] for s in changes] == ["file", "file", "file", "service"]
    assert "-grace = 9.0" in changes[0]["diff"]
    assert told["cam-pc"]["state"] == told["desk"]["state"] == "same"
    told = operator.hosts_told("restore", "lab.toml", "saved", "--apply")
    assert told["arm-pc"]["state"] == "changed"
    assert "grace" not in operator.hosts["arm-pc"].inside("cat", config)
    stat = ("stat", "-c", "%U:%G %a", users)
    assert operator.hosts["arm-pc"].inside(*stat) == "root:root 644\n"

    # What was written, and not read as the connection was lost then, is read.
    operator.hosts["arm-pc"].inside("touch", config)
    again = ("deploy", "lab.toml", "--host", "arm-pc", "--apply")
    for expected in ("changed", "same"):
        told = operator.hosts_told(*again)
        assert states(told, "service") == {"arm-pc": [expected]}, told
    assert operator.on() == {"src", "mid"}
