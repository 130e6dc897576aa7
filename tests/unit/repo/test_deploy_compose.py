"""The compose file: valid, and its commands are understood by those who get them."""

import importlib.util
from pathlib import Path

import pytest
import yaml
from test_deploy_files import DEPLOY, ROOT, judge, parsed

from pbonet.xm.net.session import check_endpoint

ANY = "0.0.0.0"  # noqa: S104 - as the containers say it
SERVICES = yaml.safe_load((DEPLOY / "compose.yaml").read_text())["services"]
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
