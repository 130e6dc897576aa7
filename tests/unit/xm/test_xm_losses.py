"""What is said of agents that others have seen, and see no more."""

from __future__ import annotations

from types import SimpleNamespace

import pytest
from xm_rig import agent_info

from pbonet.master.tools import doctor
from pbonet.xm.net import messages as m, unreachable_reason
from pbonet.xm.net.agents import LinkReport, Lost, Way


def lost(rtpu, host, ago, *, near=True):
    return Lost(rtpu=rtpu, host=host, near=near, ago=ago)


def agent(name, host, *gone):
    return agent_info(name, host=host, lost=list(gone))


BEHIND = lost("arm2", "c", 11.5, near=False)
NEIGHBOUR = lost("arm1", "b", 12.2)
LONGER = lost("arm3", "d", 60.0, near=False)


def test_who_was_behind_a_neighbour_is_lost_with_it():
    found = list(unreachable_reason.grouped([NEIGHBOUR, BEHIND, LONGER]))
    assert found == [(NEIGHBOUR, [BEHIND]), (LONGER, [])]


def test_doctor_tells_which_machines_and_since_when():
    infos = [agent("arm0", "a", NEIGHBOUR, BEHIND, LONGER), agent("arm4", "a")]
    assert [str(one) for one in doctor.losses(infos)] == [
        "WARN arm0 of a has not seen arm1 of b for 12 s, to which it had a link, and "
        "with it arm2 of c; check the network between a and b, and whether arm1 runs "
        "on b; they link again by themselves",
        "WARN arm0 of a has not seen arm3 of d for 60 s; check the network between a "
        "and d, and whether arm3 runs on d; they link again by themselves",
    ]
    (same,) = doctor.losses([agent("arm0", "a", lost("arm1", "a", 3.0))])
    starts = "'pbonet agent --name arm1' starts it"
    assert same.remedy == f"see whether arm1 runs on a; {starts}"


def test_a_machine_of_which_nothing_is_used_is_named_with_the_cause():
    """The flag says only that its variables have no writer."""
    desk, eye = agent("arm0", "a"), agent("eye1", "b")
    desk.due = {"arm1": [("s1", "arm"), ("s2", "")], "arm7": [("s1", "arm")]}
    eye.here = ["arm1", "eye1"]
    said = (
        "arm1 of b does not answer, and has not carried out the stop of {}: until then "
        "nothing of b is used"
    )
    assert m.held([desk, eye]) == [said.format("all subsystems"), said.format("arm")]
    assert m.held([desk, eye, agent("arm1", "b")]) == [], "it is being stopped"
    eye.here = ["eye1"]
    assert m.held([desk, eye]) == [], "it has no process any more"


@pytest.mark.parametrize(
    ("rtpu", "by", "of"),
    [
        ("arm1", "arm0", "arm1"),
        ("arm2", "arm0", "arm1"),
        ("arm3", "arm4", "arm3"),
        ("arm5", None, None),
    ],
)
def test_who_had_a_link_knows_best(rtpu, by, of):
    """What is behind a neighbour is told of by the loss of that; others don't know."""
    infos = [
        agent("arm0", "a", NEIGHBOUR, BEHIND, LONGER),
        agent(
            "arm4", "e", lost("arm3", "d", 61.0), lost("arm1", "b", 12.0, near=False)
        ),
    ]
    found = unreachable_reason.first(rtpu, infos)
    assert (found and (found[0].name, found[1].rtpu)) == (by and (by, of))


def test_the_error_says_so():
    loss = unreachable_reason.loss(agent("arm0", "a"), NEIGHBOUR)
    remedy = unreachable_reason.remedy(agent("arm0", "a"), NEIGHBOUR)
    error = unreachable_reason.unreachable("arm1", "d", ["arm0"], (loss, remedy))
    assert str(error) == (
        "arm1: the agent cannot be reached (got arm0 of a has not seen arm1 of b for "
        "12 s, to which it had a link; RTPUs that can be reached: arm0); check the "
        "network between a and b, and whether arm1 runs on b; they link again by "
        "themselves"
    )


def test_of_many_agents_doctor_asks_those_again_that_do_not_see_all():
    """An agent knows the paths to a few others, and how many there are."""
    names = [f"arm{n}" for n in range(10, 30)]
    known = {
        name: LinkReport(rtpu=name, ways=[Way(rtpu=other, trip=0.001)], alive=19)
        for name, other in zip(names, [*names[1:], names[0]], strict=True)
    }
    asked = []

    def call_all(requests, *_, **__):
        asked.append([n for n, one in requests.items() if one.measure])
        return {n: (known, whole)[one.measure][n] for n, one in requests.items()}, []

    whole = {}
    client = SimpleNamespace(call_all=call_all)
    found = [str(one) for one in doctor._pairs(client, names)]
    assert asked == [[], []]
    (line,) = found
    assert line.startswith("PASS 20 pairs of 20 agents see each other: round trips 1")

    def short(name, *unseen):
        known[name].alive = 19 - len(unseen)
        ways = [Way(rtpu=n, trip=0.001) for n in names if n not in {name, *unseen}]
        whole[name] = LinkReport(rtpu=name, ways=ways, alive=19 - len(unseen))

    for name in names[:4]:
        short(name, "arm29")
    del known["arm29"].ways[0]
    asked.clear()
    found = [str(one) for one in doctor._pairs(client, names)][1:]
    assert asked == [[], names[:3]]
    assert [line.partition(";")[0] for line in found] == [
        *(f"FAIL {n} - arm29: they do not see each other" for n in names[:3]),
        "WARN arm13 sees 18 of 19 other agents",
    ]


def test_of_few_agents_doctor_proves_each_pair():
    """Two that see each other have not asked each other yet, just after their start."""
    known = {n: LinkReport(rtpu=n, ways=[], alive=1) for n in ("arm0", "arm1")}
    way = Way(rtpu="arm1", trip=0.001)

    def call_all(requests, *_, **__):
        again = any(one.measure for one in requests.values())
        measured = {"arm0": LinkReport(rtpu="arm0", ways=[way], alive=1)}
        return measured if again else dict(known), []

    found = [str(x) for x in doctor._pairs(SimpleNamespace(call_all=call_all), known)]
    assert found == ["PASS arm0 - arm1: round trip 1 ms"]


def test_doctor_tells_what_agents_say_of_their_links():
    """Of each pair once, by whichever of the two knows; what is amiss with a remedy."""
    unasked = "its agent is seen, but requests do not reach it"
    reports = {
        "arm0": LinkReport(
            rtpu="arm0",
            ways=[Way(rtpu="arm1", trip=0.001, spread=0.0005, hops=2)],
            double=["arm1"],
        ),
        "arm1": LinkReport(rtpu="arm1", ways=[Way(rtpu="arm2", error=unasked)]),
        "arm2": LinkReport(rtpu="arm2", unseen=["arm0"]),
    }
    client = SimpleNamespace(call_all=lambda *_, **__: (reports, []))
    found = [str(one) for one in doctor._pairs(client, list(reports))]
    assert found == [
        "PASS arm0 - arm1: round trip 1 ms, clocks +0.000000 s apart within 500 us, by "
        "way of another agent",
        "FAIL arm0 - arm2: they do not see each other; let one of them --connect to "
        "the other, or both to a third",
        f"FAIL arm1 - arm2: {unasked}; a link that was lost is restored within some "
        "seconds: check again; if it is not, restart arm2 (kill -HUP, "
        "docs/hosts.md)",
        "WARN arm0 has two links to arm1: cuts elsewhere make them stall; let one of "
        "the two name the other with --connect, not both, and start it again",
        "WARN arm2 has a link to arm0, and does not see it; the agent restores "
        "the link within some seconds; check again then",
    ]
