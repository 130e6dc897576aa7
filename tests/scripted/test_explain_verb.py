"""`pbonet explain` asks agents, each a few times, and explains without those away."""

from __future__ import annotations

import json
from collections import Counter

import pytest

from pbonet.errors import StateError, SvarMissingError
from pbonet.master import diagnosis
from pbonet.master.configuration import Place
from pbonet.master.diagnosis import ask_facts
from pbonet.master.subsystem.subsystem import Subsystem


@pytest.fixture
def running(world, agents, puma, monkeypatch):
    """Give an answer to words; the PUMA's job runs on two fake agents."""
    monkeypatch.setattr(ask_facts, "PAUSE", 0.0)
    agents("arm0", "arm1")
    with Subsystem(puma, domain=world.domain) as arm:
        arm.start("puma")
        arm.detach()

    def answer(*words):
        return diagnosis.answer(
            puma.with_suffix(".job"), words, Place(domain=world.domain)
        )

    return answer


def test_a_task_in_error_is_the_cause_of_the_flag(running, agents):
    trace = agents["arm1"].tasks["jttrace"]
    trace.state, trace.error = "ERROR", "cycle failed: no path"
    agents["arm0"].flags = ["jttrace is in ERROR (arm1/jttrace)"]
    found = running()
    assert found.found
    text = str(found)
    assert "task jttrace on arm1 is ERROR" in text
    assert "because cycle failed: no path [status]" in text
    assert "do: 'clear jttrace' brings it out of ERROR" in text


def test_a_variable_of_a_subsystem_that_was_not_started(running, agents):
    refused = SvarMissingError("the table of subsystem 'arm' is not open here")
    for one in agents.values():
        one.tasks.clear()
        one.fail["display", ""] = refused
    text = str(running("Q_REF"))
    assert "because the table of subsystem 'arm' is not open here, on arm0" in text
    assert "do: start the job: `pbonet start`" in text
    assert "not read" not in text


def test_each_agent_is_asked_once_for_each_fact(running, agents):
    before = {name: len(agent.requests) for name, agent in agents.items()}
    running("jttrace")
    asked = {
        name: [type(one).__struct_config__.tag for one in agent.requests[n:]]
        for (name, agent), n in zip(agents.items(), before.values(), strict=True)
    }
    facts = {"status": 2, "hello": 1, "events": 1}  # the status again, after a while
    for name, tags in asked.items():
        counted = Counter(tags)
        tasks = counted.pop("modules")
        assert tasks == len(agents[name].tasks), "the module of each task"
        assert counted == facts | ({"display": 1} if name == "arm0" else {})


def test_an_rtpu_that_is_silent_is_named(running, agents):
    agents["arm1"].silent = True
    text = str(running("jttrace"))
    assert "the state of task jttrace on arm1 is not known" in text
    assert "RTPU arm1 does not answer" in text
    assert "do: if its machine is busy, wait and try again; else see its output" in text


def test_all_are_away(running, agents):
    for agent in agents.values():
        agent.close()
    text = str(running("jttrace"))
    assert "RTPU arm1 does not answer" in text
    assert "do: start one with `pbonet agent" in text


@pytest.mark.usefixtures("running")
def test_the_verb_has_a_status_and_data(world, puma, call):
    status, out, _ = call("explain", puma, "--domain", world.domain)
    assert (status, out.splitlines()[0]) == (0, "the flag of puma is down")
    words = ("explain", puma, "start", "puma", "--json", "--domain", world.domain)
    status, out, _ = call(*words)
    data = json.loads(out)
    assert (status, data["kind"], data["causes"]) == (0, "start", [])
    assert data["healthy"][0].startswith("nothing is wrong: the files are right")


def test_a_start_that_would_be_refused(running, puma):
    text = puma.with_suffix(".job").read_text("utf-8")
    puma.with_suffix(".job").write_text(text.replace("jttrace", "nosuch"))
    found = str(running("start"))
    assert "would be refused now" in found
    assert "nosuch" in found
    with pytest.raises(StateError, match="no task, variable or RTPU nothing"):
        running("nothing")
