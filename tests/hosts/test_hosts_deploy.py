"""Machines that are set up over ssh, upgraded while they run, and restored."""

from __future__ import annotations

import json
import os
import subprocess
import sys
import tomllib

import pytest
import sshhosts
from nodekit import rmod, svar
from sshhosts import MODULES, PYTHON, SshHost, make_wheel, make_wheelhouse

HOSTS = {"arm-pc": ("b", "arm0"), "cam-pc": ("c", "arm1"), "desk": ("a", "arm2")}
NEXT = 'LAYERS.update(table=Range(1, 2), commands=Range(1, 2))\n'
AFTER = 'LAYERS.update(table=Range(2, 2), commands=Range(2, 2))\n'


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
            lines += [f"port = {sshhosts.PORT}", 'user = "root"', f'role = "{role}"']
            lines += [f"names = {json.dumps(others if name == 'desk' else [])}"]
            lines += [f'python = "{PYTHON}/bin/python3"', f"[hosts.{name}.rtpus.{rtpu}]"]
            lines += [f'libraries = ["{MODULES}"]']
            if name == "desk":
                lines += ['listen = ["tls/[::]:7447"]']
            else:
                lines += [f'connect = ["tls/{self.lan["a"].address(at)}:7447"]']
            lines += more.get(name.replace("-", "_"), [])
        self.desk = desk
        self.file.write_text("\n".join([*lines, ""]))
        tomllib.loads(self.file.read_text())

    def job(self, text):
        tasks = {
            "src": ("arm0", rmod("counts", "Y0")),
            "mid": ("arm1", rmod("holds", "Y2", invar="Y0", local={"level": 2.0})),
        }
        rtpus = "\n".join(
            f"RTPU {r}\nSCHEDULER MUF\nUSAGE exclusive\nMINFREQ 1\nMAXFREQ 1000\n"
            for _, r in HOSTS.values()
        )
        (self.folder / "run.job").write_text(text)
        head = "SUBSYSTEM cell\nSVARFILE cell.svar\nMASTER arm2\n"
        (self.folder / "cell.sbs").write_text(f"{head}{rtpus}\nEOF\n")
        (self.folder / "cell.svar").write_text(svar())
        for name, (_, rmod_text) in tasks.items():
            (self.folder / f"{name}.rmod").write_text(rmod_text)

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
        if done.returncode != status:
            for host in self.hosts.values():
                print(host.inside("journalctl", "-n", "30", "--no-pager", check=False))
        assert done.returncode == status, done.stdout + done.stderr
        return done.stdout + done.stderr

    def reach(self):
        """The words with which the agents are reached."""
        return "--connect", self.desk, "--keys", self.folder / "keys" / "anna"

    def hosts_told(self, *words, status=0):
        """Return by machine what a verb told as data."""
        told = json.loads(self.run(*words, "--json", status=status))
        return {one["host"]: one for one in told}

    def on(self):
        """Return the tasks that are ON."""
        told = json.loads(self.run("status", "run.job", "--json", *self.reach()))
        tasks = {t["task"]: t["fields"]["state"] for t in told["tasks"]}
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


JOB = "JOB run\nDESC a job\nSBS cell.sbs\nTASK src arm0 RESTART on\nTASK mid arm1\nEOF\n"


def states(one, name):
    return [step["state"] for step in one["steps"] if step["name"] == name]


def test_machines_are_set_up_upgraded_and_restored(operator, tmp_path):
    old = make_wheel(tmp_path, "0.1.0")
    operator.job(JOB)
    operator.boot()
    operator.write()
    operator.run("keys", "ca", "--ca", "keys")
    operator.run("keys", "master", "anna", "--ca", "keys")

    # A host key that nobody has seen is not accepted.
    told = operator.hosts_told("deploy", "lab.toml", "--wheel", old, status=1)
    assert all("host key is not known" in one["error"] for one in told.values())
    operator.trust()

    # The plan does nothing; what it says is done, and then there is nothing to do.
    told = operator.hosts_told("deploy", "lab.toml", "--wheel", old)
    assert {one["state"] for one in told.values()} == {"change"}
    assert not operator.hosts["arm-pc"].inside("find", "/opt", "/etc", "-name", "*pbonet*")
    apply = ("deploy", "lab.toml", "--wheel", old, "--apply")
    print(operator.run(*apply))
    told = operator.hosts_told("deploy", "lab.toml", "--wheel", old)
    assert {one["state"] for one in told.values()} == {"same"}, told

    print(operator.run("deploy", "lab.toml", "--wheel", old))
    print(operator.run("fleet", *operator.reach()))
    print(operator.run("start", "run.job", *operator.reach()))
    print(operator.on())
    new = make_wheel(tmp_path, "0.2.0", NEXT)
    up = ("upgrade", "lab.toml", "--wheel", new, *operator.reach())
    print(operator.run(*up))
    print(operator.run(*up, "--apply", status=1))
    print(operator.run(*up, "--apply", "--yes"))
    print(operator.on())
    print(operator.run("fleet", *operator.reach()))
