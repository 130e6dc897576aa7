"""Three machines are upgraded one after the other; docs/deployment.md has the steps.

Releases are made of this pbonet: `sitecustomize` of a host tells every process there
which versions it understands, before it runs anything else.
"""

from __future__ import annotations

import contextlib
import json

import pytest
from nodekit import MISBEHAVING, rmod, svar
from watching import wait_for

from pbonet.errors import PbonetError
from pbonet.versions import LAYERS, Range
from pbonet.xm.net import messages as m

HOSTS = {"arm0": "a", "arm1": "b", "arm2": "c"}
OLD, BOTH, NEW = (1, 1), (1, 2), (2, 2)
RTPU = "RTPU {}\nSCHEDULER MUF\nUSAGE exclusive\nMINFREQ 1\nMAXFREQ 1000\n"
TASKS = {
    "src": ("arm0", rmod("counts", "Y0")),
    "sink": ("arm2", rmod("holds", "Y1", invar="Y0", local={"level": 1.0})),
    "mid": ("arm1", rmod("holds", "Y2", invar="Y0", local={"level": 2.0})),
}


FORMAT = """
import importlib.util, sys

class Format:
    # It is changed when somebody imports it; most processes do not.
    def find_spec(self, name, path, target=None):
        if name != "pbonet.svar.mirror.packets":
            return None
        sys.meta_path.remove(self)
        spec = importlib.util.find_spec(name)
        load = spec.loader.exec_module
        def loaded(module):
            load(module)
            change(module)
        spec.loader.exec_module = loaded
        return spec

def change(module):
    from msgspec import structs
    def turned(packet):
        if packet is None or packet.v == 1:
            return packet
        news = [structs.replace(n, data=bytes(n.data)[::-1]) for n in packet.news]
        return structs.replace(packet, news=news)
    pack, unpack = module.pack, module.unpack
    module.pack = lambda packet: pack(turned(packet))
    module.unpack = lambda data: turned(unpack(data))

sys.meta_path.insert(0, Format())
"""
"""From version 2 on, the bytes of values come in packets in reverse order."""


class Plant:
    """A job on three hosts, and what is asked from host a about it."""

    def __init__(self, lab, folder):
        self.lab, self.folder = lab, folder
        lines = [f"TASK {name} {rtpu}" for name, (rtpu, _) in TASKS.items()]
        job = ["JOB run", "DESC a job", "SBS cell.sbs", *lines, "EOF", ""]
        (folder / "run.job").write_text("\n".join(job))
        rtpus = "\n".join(map(RTPU.format, HOSTS))
        head = "SUBSYSTEM cell\nSVARFILE cell.svar\nMASTER arm0\n"
        (folder / "cell.sbs").write_text(f"{head}{rtpus}\nEOF\n")
        (folder / "cell.svar").write_text(svar())
        for name, (_, text) in TASKS.items():
            (folder / f"{name}.rmod").write_text(text)

    def install(self, host, **layers):
        """Install a release: by layer, the oldest and newest version that it knows."""
        folder = self.folder / f"release-{host}"
        folder.mkdir(exist_ok=True)
        lines = [f"LAYERS['{layer}'] = Range{both}" for layer, both in layers.items()]
        text = "\n".join(["from pbonet.versions import LAYERS, Range", *lines, ""])
        (folder / "sitecustomize.py").write_text(text + FORMAT)
        self.lab.releases[host] = folder

    def agent(self, name):
        """Start a host's agent, linked to those of all others that run."""
        host = HOSTS[name]
        others = [at for at, _ in self.lab.agents.values()]
        ways = [self.lab.endpoint(other, host) for other in others]
        self.lab.start(name, host, connect=ways, wait=False)
        self.lab.wait_all()

    def verb(self, verb, file="cell.sbs", *more):
        library = ["--library", str(MISBEHAVING)]
        words = (verb, str(self.folder / file), *library, *more)
        return self.lab.cli("a", *words)

    def stop(self):
        """Stop everything from host a; return what was done, as text."""
        got = self.lab.cli("a", "stop")
        assert got.returncode == 0, got
        return got.stdout + got.stderr

    def start(self):
        """Start the job, or what is missing of it; return what was printed."""
        got = self.verb("start", "run.job")
        assert got.returncode == 0, got
        return got.stdout + got.stderr

    def read(self):
        """Return the first readings of Y1 and Y2: what src has counted, on c and b."""
        found = {}
        for rtpu, name in (("arm2", "Y1"), ("arm1", "Y2")):
            ask = m.Display(subsystem="cell", names=[name])
            client = self.lab.client(HOSTS[rtpu])
            value = client.call(rtpu, ask, list[m.VarValue])[0].values[1]
            assert value == round(min(abs(value), 1e9)), "not what src has counted"
            found[name] = value
        return found

    def flows(self):
        """Wait until what src counts reaches both other machines, and nothing is up."""
        first = wait_for(self.looked, "values")

        def more():
            now = self.looked()
            return now and all(now[name] > first[name] for name in now)

        wait_for(more, "news of src on both other machines")
        wait_for(lambda: not self.illegal(), "the end of the flag")

    def looked(self):
        with contextlib.suppress(PbonetError):
            return self.read()
        return None

    def status(self):
        got = self.verb("status", "run.job", "--json")
        assert got.returncode == 0, got
        return json.loads(got.stdout)

    def all_are_on(self):
        states = {t["task"]: t["fields"]["state"] for t in self.status()["tasks"]}
        return states == dict.fromkeys(TASKS, "ON")

    def illegal(self):
        return [cause for rtpu in self.status()["rtpus"] for cause in rtpu["illegal"]]

    def upgrade(self, machine, *said):
        """Upgrade the tables of a machine, and see what is told of versions then."""
        name, table = machine
        self.lab.stop(name)
        self.install(HOSTS[name], commands=BOTH, table=table)
        self.agent(name)
        printed = " ".join(self.start().split())
        assert all(text in printed for text in said), printed
        assert self.status()["versions"] == [*said]
        assert [any(t in line for t in said) for line in self.doctor()] == [True] * len(
            said
        )
        shown = self.verb("status").stdout
        remedy = "run the same pbonet version on every machine"
        assert all(f"VERSIONS> {text}: {remedy}" in shown for text in said)

    def is_apart(self):
        """See that nothing of src arrives on c, which is told, and all of it on b.

        Before all three have met, two of them may have had a version in common.
        """
        cause = "is of version"
        wait_for(lambda: any(cause in one for one in self.illegal()), "the flag")

        def stands():
            first = self.read()
            wait_for(lambda: self.read()["Y2"] > first["Y2"] + 20, "news of src on b")
            return self.read()["Y1"] == first["Y1"]

        wait_for(stands, "no more news of src on c")

    def doctor(self):
        """Return what doctor tells of versions."""
        lines = self.lab.cli("a", "doctor").stdout.splitlines()
        words = "no common version", "cannot read"
        return [line for line in lines if any(word in line for word in words)]


@pytest.fixture
def plant(own_lab, tmp_path, monkeypatch):
    """The plant; the test itself, a client, speaks both versions of commands."""
    monkeypatch.setitem(LAYERS, "commands", Range(*BOTH))
    made = Plant(own_lab, tmp_path)
    try:
        yield made
    finally:
        made.lab.cli("a", "stop")


def test_a_rolling_upgrade(plant):
    """All machines first to a release that knows both versions, then to the new one."""
    for name, host in HOSTS.items():
        plant.install(host, commands=OLD, table=OLD)
        plant.agent(name)
    plant.start()
    plant.flows()
    for release in (BOTH, NEW):
        for name in reversed(HOSTS):  # the master's machine, a, comes last
            step = f"{name} becomes {release}"
            wait_for(plant.all_are_on, f"all tasks before {step}")
            plant.lab.stop(name)
            plant.install(HOSTS[name], commands=release, table=release)
            plant.agent(name)
            assert "no common version" not in plant.start(), step
            plant.flows()
            assert plant.status()["versions"] == plant.doctor() == [], step


def test_a_machine_that_is_upgraded_too_far(plant):
    """Its tables have another format, and no version in common with the others'.

    It is told at start, by doctor and in status, and the flag is up where values are
    missing. Nothing of the other format is taken for a value. It heals when the others
    have a release that knows both versions.
    """
    for name, host in HOSTS.items():
        plant.install(host, commands=BOTH, table=OLD)
        plant.agent(name)
    plant.start()
    plant.flows()
    nothing = "no values are exchanged between them"
    plant.upgrade(
        ("arm2", NEW),
        "no common version of table: arm0 of host-a, arm1 of host-b version 1; "
        f"arm2 of host-c version 2; {nothing}",
    )
    plant.is_apart()
    plant.upgrade(
        ("arm0", BOTH),
        "no common version of table: arm1 of host-b version 1; "
        f"arm2 of host-c version 2; {nothing}",
        "arm0 of host-a sends tables in version 1, for all at once, which "
        "arm2 of host-c cannot read; no values of it arrive there",
    )
    plant.is_apart()
    plant.upgrade(("arm1", BOTH))
    plant.flows()


def test_commands_without_a_common_version_are_told(plant):
    """At start, by doctor and in status; and a stop ends what runs there."""
    for name, host in HOSTS.items():
        plant.install(host, commands=OLD)
        plant.agent(name)
    plant.start()
    plant.lab.stop("arm0")
    plant.install("a", commands=NEW)
    plant.agent("arm0")
    said = (
        "no common version of commands: arm1 of host-b, arm2 of host-c version 1; "
        "this program, arm0 of host-a version 2; between them only hello and stop work"
    )
    assert any(said in line for line in plant.doctor())
    assert any(said in text for text in plant.status()["versions"])
    got = plant.verb("start", "run.job")
    assert got.returncode == 1
    text = " ".join((got.stdout + got.stderr).split())
    assert "arm2" in text
    assert "the agent speaks another protocol version: only hello and stop work" in text
    assert "expected version 2" in text.replace(":", "")
    assert "docs/deployment.md" in text
    assert plant.lab.info("arm2").on == {"cell": ["sink"]}
    assert "sink" in plant.stop()
    wait_for(lambda: not plant.lab.info("arm2").on.get("cell"), "the end of sink")
