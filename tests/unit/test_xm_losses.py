"""What is said of agents that others have seen, and see no more."""

from __future__ import annotations

import pytest

from pbonet.master import doctor
from pbonet.xm import losses
from pbonet.xm.agents import AgentInfo, Lost


def lost(rtpu, host, ago, *, near=True):
    return Lost(rtpu=rtpu, host=host, near=near, ago=ago)


def agent(name, host, *gone):
    return AgentInfo(
        name=name,
        domain="d",
        host=host,
        machine=host,
        core=1,
        cores=2,
        pid=1,
        rtpu_pid=2,
        backend="fifo",
        version="0",
        python="3",
        lost=list(gone),
    )


BEHIND = lost("arm2", "c", 11.5, near=False)
NEIGHBOUR = lost("arm1", "b", 12.2)
LONGER = lost("arm3", "d", 60.0, near=False)


def test_who_was_behind_a_neighbour_is_lost_with_it():
    found = list(losses.grouped([NEIGHBOUR, BEHIND, LONGER]))
    assert found == [(NEIGHBOUR, [BEHIND]), (LONGER, [])]


def test_doctor_tells_which_machines_and_since_when():
    infos = [agent("arm0", "a", NEIGHBOUR, BEHIND, LONGER), agent("arm4", "a")]
    assert [str(one) for one in doctor.losses(infos)] == [
        "WARN arm0 of a has not seen arm1 of b for 12 s, to which it had a link, and "
        "with it arm2 of c; look at the network between a and b, and whether arm1 runs "
        "on b; they link again by themselves",
        "WARN arm0 of a has not seen arm3 of d for 60 s; look at the network between a "
        "and d, and whether arm3 runs on d; they link again by themselves",
    ]
    (same,) = doctor.losses([agent("arm0", "a", lost("arm1", "a", 3.0))])
    assert same.remedy == "see whether arm1 runs on a"


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
    found = losses.first(rtpu, infos)
    assert (found and (found[0].name, found[1].rtpu)) == (by and (by, of))


def test_the_error_says_so():
    loss = losses.loss(agent("arm0", "a"), NEIGHBOUR)
    remedy = losses.remedy(agent("arm0", "a"), NEIGHBOUR)
    error = losses.unreachable("arm1", "d", ["arm0"], (loss, remedy))
    assert str(error) == (
        "arm1: the agent is out of reach (got arm0 of a has not seen arm1 of b for 12 "
        "s, to which it had a link; RTPUs that can be reached: arm0); look at the "
        "network between a and b, and whether arm1 runs on b; they link again by "
        "themselves"
    )
