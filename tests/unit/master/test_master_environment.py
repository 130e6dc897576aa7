"""What the environment says counts where a program says nothing."""

from __future__ import annotations

from pathlib import Path

import pytest

from pbonet.master.configuration import environment
from pbonet.master.subsystem import embedded_agents
from pbonet.master.subsystem.subsystem import Subsystem

PUMA = Path(__file__).parents[3] / "examples" / "puma" / "puma.sbs"


@pytest.fixture
def variables(monkeypatch, tmp_path):
    monkeypatch.setenv("PBONET_DOMAIN", "lab")
    monkeypatch.setenv("PBONET_CONNECT", "tcp/10.0.0.5:7447 tcp/[fd00::5]:7447")
    monkeypatch.setenv("PBONET_LIBRARY", f"{tmp_path}:{tmp_path / 'mine'}")
    return tmp_path


def test_a_program_has_what_the_environment_says(variables):
    assert environment.or_environment(None, None, None) == (
        "lab",
        ["tcp/10.0.0.5:7447", "tcp/[fd00::5]:7447"],
        [str(variables), str(variables / "mine")],
    )
    arm = Subsystem(PUMA)
    assert arm.domain == "lab"
    assert arm.files.library.folders == (PUMA.parent, variables, variables / "mine")


@pytest.mark.usefixtures("variables")
def test_what_is_given_goes_before_it():
    assert environment.or_environment("here", (), ("x",)) == ("here", (), ("x",))
    arm = Subsystem(PUMA, domain="here", libraries=["x"])
    assert arm.domain == "here"
    assert arm.files.library.folders == (PUMA.parent, Path("x"))


def test_an_empty_environment_says_nothing(monkeypatch):
    for name in ("DOMAIN", "CONNECT", "LIBRARY"):
        monkeypatch.setenv(f"PBONET_{name}", "")
    assert environment.or_environment(None, None, None) == ("default", [], [])


@pytest.fixture
def started(monkeypatch):
    """The agents that would be started: their words, and how."""
    started = []
    monkeypatch.setattr(
        embedded_agents.subprocess,
        "Popen",
        lambda args, **how: started.append((args, how)),
    )
    return started


@pytest.mark.parametrize("told", [True, False])
def test_agents_of_a_program_have_the_settings_that_it_names(started, told):
    file = PUMA.with_name("agent.toml")
    arm = Subsystem(PUMA, domain="here", embed=file if told else True)
    arm._agents._launch("arm0", 0).output.close()
    ((words, _),) = started
    named = [words[n + 1] for n, word in enumerate(words) if word == "--config"]
    assert named == [str(file)] * told


@pytest.mark.usefixtures("variables")
@pytest.mark.parametrize("connect", [[], ["tcp/10.0.0.9:7447"]])
@pytest.mark.parametrize("libraries", [[], ["/x", "/y"]])
def test_agents_of_a_program_have_what_it_has(monkeypatch, started, connect, libraries):
    """They take from the environment no more than the program did."""
    agents = embedded_agents.Embedded("here", libraries=libraries, connect=connect)
    agents._launch("arm0", 0).output.close()
    ((_, how),) = started
    for name, value in how["env"].items():
        monkeypatch.setenv(name, value)
    assert environment.or_environment(None, None, None) == ("here", connect, libraries)
