"""The plan for a machine, of what it has and what it is to have."""

import hashlib

import pytest
from msgspec import structs

from pbonet.deploy import read_hosts, steps
from pbonet.deploy.host_facts import Facts, File, Unit, paths_of
from pbonet.deploy.host_keys import HostKeys
from pbonet.deploy.plan_host import Plan
from pbonet.deploy.release import fitting, release_of
from pbonet.errors import NodeError

TEXT = """
[hosts.pc.rtpus.arm0]
core = 1
"""
UNIT = steps.unit_of("arm0")
KEYS = HostKeys(
    files={name: name.encode() for name in ("ca.pem", "cert.pem", "key.pem")}, lacks=""
)


@pytest.fixture
def machine(tmp_path):
    (tmp_path / "lab.toml").write_text(TEXT)
    return read_hosts(tmp_path / "lab.toml").machines[0]


@pytest.fixture
def release(make_wheel):
    return release_of(make_wheel())


def nothing(machine):
    """What a machine has that has never seen pbonet."""
    return Facts(
        hostname="pc",
        machine="x86_64",
        python=(3, 11),
        venv=True,
        systemctl=True,
        systemd=True,
        groups=None,
        files=dict.fromkeys(paths_of(machine)),
        secrets={},
        run_folder=False,
        folder=False,
        current="",
        previous="",
        releases=[],
        free=10 << 30,
        units={UNIT: Unit("inactive", enabled=False)},
        enabled=[],
        online=[0, 1, 2, 3],
        isolated=[2],
    )


def file(data, mode=0o644, owner="root"):
    return File(hashlib.sha256(data).hexdigest(), mode, owner, data.decode())


def after(machine, facts, release):
    """What the machine has when the plan was carried out."""
    plan = Plan(machine, facts, release, KEYS).steps()
    puts = [a for step in plan for a in step.actions if isinstance(a, steps.Put)]
    there = {
        a.path: file(a.data, a.mode, a.owner) for a in puts if a.path[:5] != "/opt/"
    }
    return structs.replace(
        facts,
        groups=["dialout", "pbonet"],
        run_folder=True,
        current=release.name,
        releases=[release.name],
        units={UNIT: Unit("active", enabled=True)},
        enabled=["arm0"],
        files={**facts.files, **there},
        secrets={path: one for path, one in there.items() if "key.pem" in path},
    )


def test_what_was_done_need_not_be_done_again(machine, release):
    facts = nothing(machine)
    plan = Plan(machine, facts, release, KEYS).steps()
    assert {step.state for step in plan} == {"change"}
    cores = next(a for step in plan for a in step.actions if "cores.conf" in str(a))
    assert b"CPUAffinity=0 3 1" in cores.data  # 2 is kept free by the kernel
    done = after(machine, facts, release)
    plan = Plan(machine, done, release, KEYS).steps()
    assert {step.state for step in plan} == {"same"}


def state(plan, name):
    return [step.state for step in plan if step.name == name]


def test_an_agent_that_runs_keeps_its_release(machine, release, make_wheel):
    done = after(machine, nothing(machine), release)
    other = release_of(make_wheel(version="0.3.0"))
    plan = Plan(machine, done, other, KEYS).steps()
    assert state(plan, "release") == ["change"]
    assert state(plan, "in use") == ["waits"]
    assert not any("stop" in str(step.actions) for step in plan)
    idle = structs.replace(done, units={UNIT: Unit("failed", enabled=True)})
    plan = Plan(machine, idle, other, KEYS).steps()
    assert state(plan, "in use") == ["change"]
    assert "previous" in str(next(s for s in plan if s.name == "in use").actions)


def test_what_host_setup_installed_is_kept_as_a_release(machine, release):
    facts = structs.replace(nothing(machine), folder=True)
    plan = Plan(machine, facts, release, None).steps()
    use = next(step for step in plan if step.name == "in use")
    words = [" ".join(action.words) for action in use.actions]
    assert "mv -T /opt/pbonet /opt/pbonet-releases/before-deploy" in words
    assert "ln -sfnT before-deploy /opt/pbonet-releases/previous" in words


def test_other_keys_and_configurations_are_read_without_an_end(machine, release):
    done = after(machine, nothing(machine), release)
    path = steps.config_of("arm0")
    files = {**done.files, path: file(b"core = 2\n")}
    plan = Plan(machine, structs.replace(done, files=files), release, KEYS).steps()
    changed = [step for step in plan if step.state == "change"]
    assert [step.name for step in changed] == ["arm0", "service"]
    assert "-core = 2" in changed[0].diff
    assert changed[1].actions == (steps.Run(("systemctl", "reload", UNIT)),)
    new = HostKeys(files={**KEYS.files, "key.pem": b"another"}, lacks="")
    plan = Plan(machine, done, release, new).steps()
    keys = next(step for step in plan if step.name == "keys")
    assert [(a.path, a.mode, a.owner) for a in keys.actions] == [
        ("/etc/pbonet/keys/key.pem", 0o600, "pbonet")
    ]
    assert not keys.diff
    assert state(plan, "service") == ["change"]


def test_an_rtpu_that_nobody_names_is_told_and_left_alone(machine, release):
    facts = structs.replace(after(machine, nothing(machine), release))
    facts = structs.replace(facts, enabled=["arm0", "old"])
    plan = Plan(machine, facts, release, KEYS).steps()
    assert {step.state for step in plan} == {"same"}
    assert "the agent of old is not in the file" in plan[-1].what


@pytest.mark.parametrize(
    ("change", "said"),
    [
        ({"python": (3, 9)}, r"is Python 3\.9 .*python = "),
        ({"python": (3, 13)}, r"is Python 3\.13 \(expected Python 3\.11"),
        (
            {"machine": "aarch64"},
            r"processor is aarch64 \(expected x86_64, for pbonet.*--wheel",
        ),
        ({"venv": False}, "apt-get install python3-venv"),
        ({"systemctl": False}, "has no systemd"),
        ({"free": 1 << 10}, "no room for another release .*remove"),
        ({"online": [0]}, "arm0 is to have core 1"),
    ],
)
def test_a_machine_that_cannot_take_it_says_why(machine, release, change, said):
    facts = structs.replace(nothing(machine), **change)
    with pytest.raises(NodeError, match=said):
        Plan(machine, facts, fitting(machine, facts, [release]), None).steps()


def test_each_machine_gets_the_wheel_for_its_processor(machine, release, make_wheel):
    arm = release_of(make_wheel(tag="cp311-cp311-manylinux_2_17_aarch64"))
    newer = release_of(make_wheel(tag="cp312-cp312-linux_x86_64"))
    facts = nothing(machine)
    for change, expected in (
        ({}, release),
        ({"machine": "aarch64"}, arm),
        ({"python": (3, 12)}, newer),
    ):
        one = structs.replace(facts, **change)
        assert fitting(machine, one, [arm, newer, release]) is expected
    assert fitting(machine, facts, []) is None


def test_an_rtpu_that_names_no_core_any_more_may_use_all(machine, release, tmp_path):
    done = after(machine, nothing(machine), release)
    (tmp_path / "lab.toml").write_text(TEXT.replace("core = 1", ""))
    (free,) = read_hosts(tmp_path / "lab.toml").machines
    plan = Plan(free, done, release, KEYS).steps()
    (step,) = [one for one in plan if "cores.conf" in str(one.actions)]
    remove, read = step.actions
    assert remove.words == ("rm", "-f", steps.cores_of("arm0"))
    assert read.words == ("systemctl", "daemon-reload")
    assert "-CPUAffinity=0 3 1" in step.diff
    assert "when its agent is started again" in step.what
    files = {**done.files, steps.cores_of("arm0"): None}
    files[steps.config_of("arm0")] = file(free.configs["arm0"].encode())
    again = Plan(free, structs.replace(done, files=files), release, KEYS).steps()
    assert {step.state for step in again} == {"same"}
