"""Verbs about a whole domain: requests for N agents, and agents that are away."""

from __future__ import annotations

import json
import threading
from collections import Counter

import pytest

from pbonet.errors import Severity
from pbonet.master.tools import doctor
from pbonet.xm.net import messages as m

AWAY = "r1: the agent is registered but does not respond"


@pytest.fixture
def sent(agents):
    """Return the number of requests since the last call, by name of request."""
    seen: dict[str, int] = {}

    def take():
        found = Counter()
        for name, one in agents.items():
            new = one.requests[seen.get(name, 0) :]
            seen[name] = len(one.requests)
            found.update(type(each).__struct_config__.tag for each in new)
        return dict(found)

    return take


def happened(agent, text, n=1):
    agent.told.append(
        m.Event(
            n=n,
            time=n,
            wall=float(n),
            severity=int(Severity.WARNING),
            code="WARNING",
            rtpu=agent.name,
            text=text,
        )
    )


def system(folder, names):
    """Write a subsystem with these RTPUs."""
    lines = "".join(f"RTPU {name}\n" for name in names)
    (folder / "s.svar").write_text("NAME X\nTYPE int\nDESC\nUNITS none\nNELEM 1\nEOF\n")
    path = folder / "s.sbs"
    path.write_text(f"SUBSYSTEM s\nSVARFILE s.svar\n{lines}EOF\n")
    return path


@pytest.fixture(params=[3, 30])
def many(request, agents):
    """So many agents; their names."""
    names = [f"r{n}" for n in range(request.param)]
    agents(*names)
    return names


@pytest.fixture
def subsystem(agents, many, tmp_path):
    """The file of a subsystem on all of them; each has an event."""
    for name in many:
        happened(agents[name], f"by {name}")
    return system(tmp_path, many)


def test_requests_grow_with_the_number_of_agents_only(
    world, many, sent, call, subsystem
):
    path, count = subsystem, len(many)
    sent()
    status, out, err = call("events", path, "99", "--domain", world.domain)
    assert (status, err) == (0, "")
    assert len(out.splitlines()) == count
    assert sent() == {"status": count, "events": count}

    found = list(doctor.agents(world.domain, (), []))
    assert all(one.level is not doctor.Level.FAIL for one in found)
    assert sent() == {"hello": 2 * count, "status": count, "links": count}
    pairs = [one for one in found if "round trip" in one.what]
    assert len(pairs) == (3 if count == 3 else 1), "many pairs have one line"
    told = f"{count * (count - 1) // 2} pairs of {count} agents see each other"
    assert count == 3 or told in pairs[0].what


def test_events_of_the_others_are_shown_when_one_is_away(world, agents, call, tmp_path):
    agents("r0", "r1")
    happened(agents["r0"], "seen")
    agents["r1"].silent = True
    path = system(tmp_path, ["r0", "r1", "r2"])
    status, out, err = call("events", path, "--domain", world.domain)
    assert status == 0
    assert "seen" in out
    assert AWAY in err
    assert "r2: no agent of this name can be reached" in err
    words = ("events", path, "--json", "--domain", world.domain)
    status, out, _ = call(*words)
    data = json.loads(out)
    assert (status, len(data["events"]), len(data["warnings"])) == (0, 1, 2)


def test_events_fail_when_all_are_away(world, agents, call, tmp_path):
    agents("r0")
    status, _, err = call("events", system(tmp_path, ["r1"]), "--domain", world.domain)
    assert status == 1
    assert "r1: no agent of this name can be reached" in err


def test_doctor_names_an_agent_that_is_away_and_judges_the_others(world, agents):
    agents("r0", "r1", "r2")
    agents["r0"].lost = [m.Lost(rtpu="r9", host="lab9", near=True, ago=7.0)]
    agents["r1"].silent = True
    infos = []
    found = [*map(str, doctor.agents(world.domain, (), infos))]
    assert [one.name for one in infos] == ["r0", "r2"]
    failed = [one for one in found if one.startswith("FAIL")]
    assert len(failed) == 1
    assert failed[0].startswith(f"FAIL {AWAY}")
    assert any(one.startswith("PASS r0 - r2: round trip") for one in found)
    assert any("has not seen r9 of lab9 for 7 s" in one for one in found)


def test_a_pair_without_a_path_is_measured_again_and_named(world, agents, sent):
    names = [f"r{n}" for n in range(8)]
    agents(*names)
    agents["r2"].deaf = {"r5"}
    agents["r5"].deaf = {"r2"}
    sent()
    found = [*map(str, doctor.agents(world.domain, (), []))]
    failed = [one for one in found if one.startswith("FAIL")]
    assert len(failed) == 1
    assert failed[0].startswith("FAIL r2 - r5: they do not see each other")
    assert any("27 pairs of 8 agents see each other" in one for one in found)
    assert sent()["links"] == len(names) + 1, "the first of the pair measures anew"


# -- fleet -----------------------------------------------------------------------------


def test_fleet_asks_each_agent_the_same_few_things(world, agents, many, sent, call):
    for one in agents.values():
        one.claims = {"s": (1, "")}
    sent()
    status, out, err = call("fleet", "--json", "--domain", world.domain)
    assert (status, err) == (0, "")
    count = len(many)
    assert sent() == {"hello": count, "machine": count, "status": count}
    data = json.loads(out)
    (machine,) = data["machines"]
    assert (machine["host"], len(machine["rtpus"])) == ("fakehost", count)
    assert machine["disk_free"] == 5 << 30
    (subsystem,) = data["subsystems"]
    assert (subsystem["name"], len(subsystem["rtpus"])) == ("s", count)


def test_fleet_names_what_is_away_and_what_is_amiss(world, agents, call, tmp_path):
    agents("r0", "r1")
    agents["r0"].lost = [m.Lost(rtpu="r9", host="lab9", near=True, ago=7.0)]
    agents["r0"].ahead = 90.0
    agents["r0"].claims = {"s": (1, "")}
    agents["r0"].flags = ["pid is in ERROR (r0/pid)"]
    agents["r1"].silent = True
    path = system(tmp_path, ["r0", "r5"])
    status, out, _ = call("fleet", path, "--domain", world.domain)
    assert status == 1
    lines = out.splitlines()
    assert lines[1].split()[:4] == ["fakehost", "r0", "0", "1"]
    assert "5.0 GiB" in lines[1]
    assert any(line.split() == ["s", "r0", "none", "UP"] for line in lines)
    assert "ILLEGAL> s: pid is in ERROR (r0/pid)" in lines
    away = [line for line in lines if line.startswith("AWAY>")]
    assert len(away) == 3
    assert away[0].startswith(f"AWAY> {AWAY}")
    assert away[1].startswith("AWAY> r5: no agent of this name can be reached; start")
    assert "has not seen r9 of lab9 for 7 s" in away[2]
    assert any("its clock is +90.0 s off" in line for line in lines)


def test_fleet_asks_about_all_subsystems_at_once(world, agents, call):
    """Each agent answers about its own subsystem only when all have been asked."""
    agents("r0", "r1", "r2")
    asked = threading.Barrier(len(agents))
    for name, one in agents.items():
        one.claims = {f"of-{name}": (1, "")}
        one.held["status"] = asked
    status, out, err = call("fleet", "--json", "--domain", world.domain)
    assert (status, err) == (0, "")
    found = json.loads(out)["subsystems"]
    assert [one["name"] for one in found] == ["of-r0", "of-r1", "of-r2"]
    assert not any(one["unknown"] for one in found)


def test_fleet_of_a_domain_without_agents(world, agents, call):
    agents("r0")
    status, _, err = call("fleet", "--domain", f"{world.domain}x")
    assert status == 1
    assert "no agent of domain" in err
