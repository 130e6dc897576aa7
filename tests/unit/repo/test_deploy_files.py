"""The files in deploy/: each judged by its own tool, and their commands by pbonet's."""

import importlib.util
import json
import os
import re
import shlex
import shutil
import socket
import subprocess
import sys
from pathlib import Path

import dockerfile
import pytest
import yaml

from pbonet.cli import parser, verbs
from pbonet.config import read_agent
from pbonet.node.agent import systemd_notify
from pbonet.router import router_config
from pbonet.xm.net import pki
from pbonet.xm.net.credentials import Role
from pbonet.xm.net.session import check_endpoint

ROOT = Path(__file__).resolve().parents[3]
DEPLOY = ROOT / "deploy"
CORES = Path("/sys/devices/system/cpu")
UNIT = DEPLOY / "systemd" / "pbonet-agent@.service"
ROUTER_UNIT = DEPLOY / "systemd" / "pbonet-router.service"
ROUTER = DEPLOY / "router.json5"


def judge(tool, *words):
    """Run a tool that an extra package brings; it says nothing, or the test fails."""
    found = shutil.which(tool, path=Path(sys.executable).parent) or shutil.which(tool)
    if found is None:
        if os.environ.get("CI"):
            pytest.fail(f"{tool} is missing")
        pytest.skip(f"{tool} is not installed (pip install --group deploy)")
    result = subprocess.run(
        [found, *map(str, words)],
        stdout=subprocess.PIPE,
        stderr=subprocess.STDOUT,
        text=True,
        check=False,
    )
    assert result.returncode == 0, result.stdout
    return result.stdout


def parsed(words):
    """Return the verb and its options, as the command line understands the words."""
    verb, rest = verbs.find(list(words))
    return verb.name, parser.parse(verb, rest)


def settings(section, unit=UNIT):
    """Return the settings of a section of a unit file, one value each."""
    found, here = {}, ""
    for line in unit.read_text().splitlines():
        if line.startswith("["):
            here = line.strip("[]")
        elif "=" in line and not line.startswith("#") and here == section:
            key, _, value = line.partition("=")
            found[key] = value
    return found


def test_dockerfile_has_no_fault():
    judge("hadolint", DEPLOY / "Dockerfile")


def test_scripts_have_no_fault():
    judge("shellcheck", DEPLOY / "host-setup.sh")
    judge("shellcheck", "--shell=sh", ROOT / "pbonet" / "deploy" / "install_release.sh")


def unit_in(folder, of=UNIT):
    """Return a unit, with a program that is there."""
    program = folder / "pbonet"
    program.write_text("#!/bin/sh\n")
    program.chmod(0o755)
    unit = folder / of.name
    unit.write_text(of.read_text().replace("/opt/pbonet/bin/pbonet", str(program)))
    return unit


@pytest.mark.slow
@pytest.mark.parametrize("unit", [UNIT, ROUTER_UNIT], ids=lambda unit: unit.stem)
def test_unit_is_valid(tmp_path, unit):
    """Its program is put where the host's set-up would, in a root of its own."""
    assert judge("systemd-analyze", "verify", "--man=no", unit_in(tmp_path, unit)) == ""


def test_units_start_a_router_that_systemd_hears_of():
    service_ = settings("Service", ROUTER_UNIT)
    assert (service_["Type"], service_["Restart"]) == ("notify", "always")
    in_container = SERVICES["router"]["command"]
    for words in (shlex.split(service_["ExecStart"])[1:], in_container):
        name, options = parsed(words)
        assert name == "router"
        assert str(options["config"]) == "/etc/pbonet/router.json5"


def test_router_file_is_what_pbonet_would_write(tmp_path):
    """With mutual TLS and the access control of this version."""
    pki.make_authority(tmp_path)
    keys = pki.issue(tmp_path, Role.GATEWAY, "router", hosts=["router.lab"])
    own = router_config.read(listen=["tls/[::]:7447"], key_folder=keys)
    said = router_config.show(own).replace(str(keys), "/etc/pbonet/keys")
    told = router_config.read(ROUTER)
    assert json.loads(router_config.show(told)) == json.loads(said)
    lines = ROUTER.read_text().splitlines(keepends=True)
    assert "".join(one for one in lines if not one.startswith("//")) == said


MOST_EXPOSED = 2.5
"""What `systemd-analyze security` may say of the unit, of 10."""


def test_unit_is_closed_but_for_what_control_needs():
    said = judge("systemd-analyze", "security", "--offline=true", "--no-pager", UNIT)
    found = re.search(r"Overall exposure level for \S+: ([\d.]+)", said)
    assert float(found[1]) <= MOST_EXPOSED, said
    open_ = settings("Service")
    assert open_["RestrictRealtime"] == open_["PrivateDevices"] == "no"
    assert open_["DeviceAllow"] == "char-* rw"
    assert open_["ReadWritePaths"].endswith("/shm")
    assert {"AF_INET", "AF_UNIX", "AF_CAN"} <= {
        *open_["RestrictAddressFamilies"].split()
    }


def test_unit_lets_a_task_stop_the_dispatchers_timer():
    """systemd counts the call for that among @debug, which is closed as a whole."""
    lines = UNIT.read_text("utf-8").splitlines()
    rules = [
        one.partition("=")[2] for one in lines if one.startswith("SystemCallFilter")
    ]
    closed = next(n for n, one in enumerate(rules) if "@debug" in one)
    assert rules[closed].startswith("~")
    assert "pidfd_getfd" in " ".join(rules[closed + 1 :]).split()


def test_unit_starts_an_agent():
    command = shlex.split(settings("Service")["ExecStart"])
    name, options = parsed(command[1:])
    assert name == "agent"
    assert (options["name"], str(options["config"])) == ("%i", "/etc/pbonet/%i.toml")


def test_unit_lets_control_outlive_the_agent():
    """systemd would otherwise kill the RTPU process that the next agent takes over."""
    service_ = settings("Service")
    assert service_["KillMode"] == "process"
    assert service_["Restart"] == "on-failure"
    assert service_["Type"] == "notify"
    assert service_["LimitRTPRIO"] == "95"
    assert service_["LimitMEMLOCK"] == "infinity"


def test_agent_file_of_the_host_is_read():
    config = read_agent(DEPLOY / "agent.toml")
    assert config.name is None


def test_every_key_of_the_agent_file_is_read(tmp_path):
    """Also those that are shown as comments."""
    text = (DEPLOY / "agent.toml").read_text()
    lines = [line.removeprefix("# ") for line in text.splitlines() if " = " in line]
    file = tmp_path / "agent.toml"
    file.write_text("\n".join(lines))
    config = read_agent(file)
    assert config.core is not None
    assert config.connect
    assert config.libraries
    for endpoint in (*config.listen, *config.connect):
        check_endpoint(endpoint)


def test_image_runs_as_nobody_special():
    steps = dockerfile.parse((DEPLOY / "Dockerfile").read_text())
    users = [step.rest for step in steps if step.word == "USER"]
    assert users[-1].isdigit()
    assert int(users[-1]) > 0


def host_setup(*words, **kernel):
    """Have the set-up script say what it would do; skip where it has nothing to set up.

    Args:
        words: Its words.
        kernel: What it shall read of this machine's cores.
    """
    command = [str(DEPLOY / "host-setup.sh"), *words]
    if kernel:
        if os.geteuid():
            pytest.skip("only root may show a script other cores")
        binds = [
            f"mount --bind '{file}' {CORES / name}" for name, file in kernel.items()
        ]
        shell = " && ".join([*binds, 'exec "$@"'])
        command = ["unshare", "--mount", "sh", "-ec", shell, "sh", *command]
    shown = subprocess.run(command, capture_output=True, text=True, check=False)
    if "has no systemd" in shown.stderr:
        pytest.skip("this machine has no systemd")
    return shown


def test_host_setup_shows_and_does_nothing():
    shown = host_setup("arm0", "arm-1")
    assert shown.returncode == 0, shown.stderr
    assert "/etc/pbonet/arm-1.toml" in shown.stdout
    assert "Nothing was done" in shown.stdout
    assert not Path("/etc/pbonet").exists()


@pytest.fixture
def eight(tmp_path):
    """What the kernel says of a machine with eight cores, of which it keeps three."""
    files = {"online": "0-7", "isolated": "2,6-7"}
    for name, text in files.items():
        (tmp_path / name).write_text(f"{text}\n")
    return {name: tmp_path / name for name in files}


def test_rtpus_get_the_cores_that_are_kept_free(eight):
    """Unless a word names another; each leaves the others' cores alone."""
    lines = host_setup("arm0", "eye0=5", "arm1", "arm2", "desk", **eight).stdout.split(
        "\n"
    )
    own = [line.strip() for line in lines if line.startswith("    core = ")]
    assert own == ["core = 2", "core = 5", "core = 6", "core = 7"]
    cores = [line.strip() for line in lines if "CPUAffinity=" in line]
    assert cores == [f"CPUAffinity=0 1 3 4 {core}" for core in (2, 5, 6, 7)]
    assert "desk.service.d" not in "".join(lines)  # nothing is kept for it


def test_without_cores_that_are_kept_nothing_is_said_of_them(eight):
    eight["isolated"].write_text("\n")
    assert "CPUAffinity" not in host_setup("arm0", **eight).stdout


def test_a_core_that_is_not_there_is_refused(eight):
    shown = host_setup("arm0=8", **eight)
    assert shown.returncode == 2
    assert "'arm0=8': this machine has the cores 0 1 2 3 4 5 6 7" in shown.stderr


@pytest.mark.slow
def test_cores_of_an_rtpu_are_valid(tmp_path):
    """systemd reads what the set-up puts beside the unit, and would refuse nonsense."""
    said = host_setup("arm0=0").stdout
    if "CPUAffinity" not in said:
        pytest.skip("this machine has one core")
    unit = unit_in(tmp_path)
    beside = tmp_path / f"{unit.name}.d"
    beside.mkdir()
    cores = re.search(r"CPUAffinity=.*", said)[0]
    (beside / "cores.conf").write_text(f"[Service]\n{cores}\n")
    assert judge("systemd-analyze", "verify", "--man=no", unit) == ""
    (beside / "cores.conf").write_text("[Service]\nCPUAffinity=none\n")
    assert "CPU affinity" in judge("systemd-analyze", "verify", "--man=no", unit)


@pytest.mark.parametrize("name", ["0arm", "../arm", "a" * 32, ""])
def test_host_setup_refuses_what_is_no_name(name):
    shown = subprocess.run(
        [DEPLOY / "host-setup.sh", name], capture_output=True, text=True, check=False
    )
    assert shown.returncode == 2
    assert f"'{name}' is no name of an RTPU" in shown.stderr


# -- what the manager is told ---


@pytest.mark.parametrize("abstract", [False, True])
def test_manager_is_told(tmp_path, monkeypatch, abstract):
    name = f"@pbonet-test-{os.getpid()}" if abstract else str(tmp_path / "notify")
    with socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM) as manager:
        manager.bind(f"\0{name[1:]}" if abstract else name)
        monkeypatch.setenv(systemd_notify.VARIABLE, name)
        assert systemd_notify.notify("READY=1")
        assert manager.recv(100) == b"READY=1"


def test_manager_that_is_gone_is_no_matter(tmp_path, monkeypatch):
    monkeypatch.setenv(systemd_notify.VARIABLE, str(tmp_path / "nobody"))
    assert not systemd_notify.notify("READY=1")
    monkeypatch.delenv(systemd_notify.VARIABLE)
    assert not systemd_notify.notify("READY=1")


ANY = "0.0.0.0"  # noqa: S104 - as the containers say it
DEFAULT = re.compile(r"\$\{\w+:-([^}]*)\}")
"""A variable of the environment in a compose file, and its default value."""
COMPOSE = DEFAULT.sub(r"\1", (DEPLOY / "compose.yaml").read_text())
SERVICES = yaml.safe_load(COMPOSE)["services"]
AGENTS = [name for name, one in SERVICES.items() if "agent" in one["command"]]


class Met(Exception):  # noqa: N818 - no error
    """The master's program has come to where it looks for agents."""


def endpoints(option):
    """Return the endpoints that the agents give with an option."""
    found = set()
    for name in AGENTS:
        _, options = parsed(map(str, SERVICES[name]["command"]))
        for endpoint in options.get(option) or ():
            found.add(check_endpoint(endpoint).replace(ANY, name))
    return found


def test_file_is_valid():
    schema = ("--builtin-schema", "vendor.compose-spec")
    judge("check-jsonschema", *schema, DEPLOY / "compose.yaml")


def test_there_are_three_agents_of_their_services_names():
    assert AGENTS == ["arm0", "arm1", "eye0"]
    for name in AGENTS:
        verb, options = parsed(map(str, SERVICES[name]["command"]))
        assert (verb, options["name"]) == ("agent", name)


def test_each_agent_has_its_own_core_and_leaves_the_first_to_the_system():
    """The agents do not see each other, so that all would choose the same one."""
    given = [parsed(map(str, SERVICES[name]["command"]))[1] for name in AGENTS]
    cores = [options["core"] for options in given]
    assert len(set(cores)) == len(AGENTS)
    assert 0 not in cores


def test_agents_connect_to_where_others_listen():
    assert endpoints("connect") == endpoints("listen") == {"tcp/arm0:7447"}


@pytest.mark.parametrize("name", AGENTS)
def test_agents_have_what_real_time_needs(name):
    one = SERVICES[name]
    assert one["ulimits"] == {"rtprio": 95, "memlock": -1}
    assert one["shm_size"]
    assert one["init"] is True


def test_master_runs_an_example_with_agents_that_are_there(monkeypatch):
    words = SERVICES["master"]["command"]
    path = ROOT / "examples" / words[0].partition("/examples/")[2]
    spec = importlib.util.spec_from_file_location("two_hosts_steer", path)
    steer = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(steer)
    assert set(AGENTS) >= steer.RTPUS
    assert {w for w in words if w.startswith("--connect")} == {
        f"--connect={endpoint}" for endpoint in endpoints("listen")
    }

    def meet(_seconds, **reach):
        raise Met(reach)

    monkeypatch.setattr(steer, "meet", meet)
    with pytest.raises(Met) as caught:
        steer.main(words[1:])
    assert caught.value.args[0] == {"domain": "default", "connect": ["tcp/arm0:7447"]}


def test_image_has_the_example():
    text = Path(DEPLOY / "Dockerfile").read_text()
    assert "COPY examples /opt/pbonet/examples" in text
