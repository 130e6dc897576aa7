"""One change, one round trip: how many requests a verb sends, and to which RTPUs."""

from __future__ import annotations

import pytest

from pbonet.errors import ClaimError, UnknownTaskError
from pbonet.master.configuration import Place
from pbonet.master.console import oneshot
from pbonet.master.subsystem.subsystem import Subsystem


@pytest.fixture
def sent(agents):
    """Return what each agent was sent since the last call, by name of request."""
    seen: dict[str, int] = {}

    def take():
        found = {}
        for name, agent in sorted(agents.items()):
            new = agent.requests[seen.get(name, 0) :]
            seen[name] = len(agent.requests)
            if new:
                found[name] = [type(one).__struct_config__.tag for one in new]
        return found

    return take


@pytest.fixture
def verb(world, agents, puma, sent):
    """Give one-shot verbs to a job that runs; each returns what it sent."""
    agents("arm0", "arm1")
    with Subsystem(puma, domain=world.domain) as arm:
        arm.start("puma")
        arm.detach()
    sent()

    def give(command, **args):
        oneshot.run(puma, command, args, Place(domain=world.domain))
        return sent()

    return give


def test_set_asks_the_rtpu_of_its_task_alone(verb):
    asked = verb(
        "set", task="puma_pidg", param="SPEED", value=["1", "1", "1", "2", "2", "2"]
    )
    assert asked == {"arm0": ["claim", "set"]}


def test_freq_asks_the_rtpu_of_its_task_alone(verb):
    assert verb("freq", task="jttrace", hz=20.0) == {"arm1": ["claim", "freq"]}


def test_get_needs_no_claim(verb):
    assert verb("get", task="jttrace") == {"arm1": ["get"]}
    assert verb("freq", task="jttrace") == {"arm1": ["freq"]}


def test_task_that_is_not_where_its_files_say_is_found(verb, agents):
    agents["arm0"].tasks["jttrace"] = agents["arm1"].tasks.pop("jttrace")
    assert verb("get", task="jttrace") == {
        "arm0": ["status", "get"],
        "arm1": ["get", "status"],
    }
    assert verb("freq", task="jttrace", hz=20.0) == {
        "arm0": ["claim", "freq"],
        "arm1": ["claim"],
    }


def test_signal_asks_each_rtpu_once_how_its_tasks_stand(verb):
    assert verb("off", task=["jttrace"])["arm1"][:2] == ["claim", "control"]
    asked = verb("on", task=["jttrace"])
    assert asked["arm1"] == ["claim", "control"]
    assert asked["arm0"][0] == "claim"
    assert len(asked["arm0"]) <= 2, "the flag of the inputs, which goes down again"


def test_status_asks_each_rtpu_once(verb):
    assert verb("status") == {"arm0": ["status"], "arm1": ["status"]}
    assert verb("status", task=["jttrace"]) == {"arm0": ["status"], "arm1": ["status"]}


def test_status_restarts_the_extremes_of_the_tasks_that_it_shows(verb, world):
    assert verb("status", task=["jttrace"], reset=True) == {
        "arm0": ["status"],
        "arm1": ["status", "status"],
    }
    resets = [done for done in world.log if done[1].startswith("reset")]
    assert resets == [("arm1", "reset jttrace")]


def test_swap_on_one_rtpu_takes_five(verb):
    asked = verb("swap", old="jttrace", new="jtball")
    assert asked["arm0"] == ["claim"]
    assert asked["arm1"][0] == "claim"
    assert len(asked["arm1"]) <= 5
    assert verb("swap", old="jtball", new="jttrace") == {
        "arm0": ["claim"],
        "arm1": ["claim", "reconfig"],
    }


def test_master_claims_once_for_all_its_commands(world, agents, puma, sent):
    agents("arm0", "arm1")
    with Subsystem(puma, domain=world.domain) as arm:
        arm.start("puma")
        sent()
        arm.set("puma_pidg", "SPEED", [1, 1, 1, 2, 2, 2])
        assert sent() == {"arm0": ["set"]}
        arm.get("jttrace")
        assert sent() == {"arm1": ["get"]}
        arm.freq("jttrace", 20.0)
        assert sent() == {"arm1": ["status", "freq"]}
        arm.status()
        assert sent() == {"arm0": ["status"], "arm1": ["status"]}


def test_signal_asks_only_rtpus_with_which_it_shares_variables(
    world, agents, puma, sent
):
    agents("arm0", "arm1")
    with Subsystem(puma, domain=world.domain, warned=lambda _: None) as arm:
        arm.spawn("puma_pidg", "arm0")
        arm.spawn("grav_comp", "arm1")
        arm.spawn("jttrace", "arm1")
        sent()
        arm.control("jttrace", "on")
        assert sent()["arm0"][0] == "status", "its constant comes from there"
        arm.control("jttrace", "off")
        arm.kill("puma_pidg")
        sent()
        arm.control("jttrace", "on")
        assert sent() == {"arm1": ["status", "control"]}
        arm.control("jttrace", "off")
        assert sent() == {"arm1": ["status", "control"]}


def test_set_is_refused_while_another_master_lives(world, agents, puma, sent):
    agents("arm0", "arm1")
    place = Place(domain=world.domain)
    args = {"task": "puma_pidg", "param": "SPEED", "value": ["1"] * 6}
    with Subsystem(puma, domain=world.domain) as arm:
        arm.start("puma")
        sent()
        with pytest.raises(ClaimError, match="another master steers"):
            oneshot.run(puma, "set", args, place)
        assert sent() == {"arm0": ["claim"]}
        over = Place(domain=world.domain, take_over=True, confirm=lambda _: True)
        oneshot.run(puma, "set", args, over)
        assert sent() == {"arm0": ["claim", "claim", "set"], "arm1": ["claim"] * 2}
        for task in ("puma_pidg", "jttrace"):
            with pytest.raises(ClaimError, match="another master has taken over"):
                arm.control(task, "off")
        stopped = arm.stop()
        arm.detach()
        assert set(stopped.off) == {"puma_pidg", "grav_comp", "qrdiff", "jttrace"}


def test_unknown_task_is_said_after_all_were_asked(verb, sent):
    with pytest.raises(UnknownTaskError, match="no task nobody"):
        verb("set", task="nobody", param="SPEED", value=["1", "1", "1", "2", "2", "2"])
    assert sent() == {"arm0": ["claim"], "arm1": ["claim"]}
