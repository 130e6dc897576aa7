"""Who may command an RTPU: the rules of claims, without any process."""

import pytest

from pbonet.errors import ClaimError
from pbonet.node.rtpu.claims import Claims
from pbonet.xm.net import messages as m


def claim(claims, subsystem, client, *, masters=None, busy=(), **more):
    request = m.Claim(subsystem=subsystem, client=client, **more)
    return claims.claim(request, masters=masters, busy=busy)


def alive(*pairs):
    return [tuple(pair.split("/")) for pair in pairs]


@pytest.fixture
def claims():
    return Claims("arm0", epoch=10)


def test_the_first_claim_is_granted(claims):
    assert claim(claims, "arm", "a").epoch == 11
    assert claims.epochs() == {"arm": 11}


def test_the_same_master_keeps_its_epoch_and_may_change_its_wishes(claims):
    first = claim(claims, "arm", "a")
    again = claim(claims, "arm", "a", usage="shared", scheduler="RM")
    assert again.epoch == first.epoch
    assert (again.usage, again.scheduler) == ("shared", "RM")


def test_another_master_is_refused_while_the_first_lives(claims):
    claim(claims, "arm", "a")
    for masters in (None, alive("arm/a", "arm/b")):
        with pytest.raises(ClaimError) as caught:
            claim(claims, "arm", "b", masters=masters)
        assert str(caught.value) == (
            "arm0: subsystem arm has a master already (got master a, epoch 11); "
            "if it is just starting, wait; else end it, or take over with --take-over"
        )


def test_another_master_follows_one_that_is_gone(claims):
    claim(claims, "arm", "a")
    assert claim(claims, "arm", "b", masters=alive("arm/b")).epoch == 12


def test_take_over_replaces_a_living_master(claims):
    claim(claims, "arm", "a")
    new = claim(claims, "arm", "b", masters=alive("arm/a"), take_over=True)
    assert new.epoch == 12
    old = m.Control(subsystem="arm", client="a", epoch=11, task="t", signal="on")
    with pytest.raises(ClaimError, match="another master controls subsystem arm now"):
        claims.check(old)
    assert claims.check(m.Release(subsystem="arm", client="b", epoch=12)) is new


def test_a_claim_that_is_only_judged_changes_nothing(claims):
    claim(claims, "arm", "a")
    before = claims.entries()
    wanted = m.Claim(subsystem="arm", client="b", take_over=True)
    claims.judge(wanted, masters=alive("arm/a"), busy=())
    assert claims.holder(wanted, alive("arm/a")) == "a"
    assert claims.holder(wanted, None) == "a"
    assert claims.holder(wanted, []) == ""
    with pytest.raises(ClaimError, match="has a master already"):
        claims.judge(m.Claim(subsystem="arm", client="b"), masters=None, busy=())
    other = m.Claim(subsystem="leg", client="c")
    claims.judge(other, masters=[], busy=())
    assert claims.holder(other, None) == ""
    with pytest.raises(ClaimError, match="subsystem arm uses the RTPU"):
        claims.judge(other, masters=[], busy=["arm"])
    assert claims.entries() == before


def test_a_namesake_of_another_subsystem_does_not_count_as_alive(claims):
    claim(claims, "arm", "a")
    assert claim(claims, "arm", "b", masters=alive("leg/a")).epoch == 12


@pytest.mark.parametrize(
    ("first", "second", "granted"),
    [
        ("exclusive", "exclusive", False),
        ("exclusive", "shared", False),
        ("shared", "exclusive", False),
        ("shared", "shared", True),
    ],
)
def test_use_by_two_subsystems(claims, first, second, granted):
    claim(claims, "arm", "a", usage=first)
    masters = alive("arm/a", "leg/b")
    if granted:
        assert claim(claims, "leg", "b", usage=second, masters=masters).epoch == 12
    else:
        with pytest.raises(ClaimError, match="subsystem arm uses the RTPU"):
            claim(claims, "leg", "b", usage=second, masters=masters)
        assert claims.epochs() == {"arm": 11}


def test_a_shared_rtpu_has_one_scheduler(claims):
    claim(claims, "arm", "a", usage="shared", scheduler="MUF")
    with pytest.raises(ClaimError, match="has one scheduler"):
        claim(claims, "leg", "b", usage="shared", scheduler="EDF")


def test_a_dead_claim_stands_only_while_it_has_tasks(claims):
    claim(claims, "arm", "a")
    with pytest.raises(ClaimError):
        claim(claims, "leg", "b", masters=alive("leg/b"), busy={"arm"})
    assert claim(claims, "leg", "b", masters=alive("leg/b")).epoch == 12
    assert claims.epochs() == {"leg": 12}


def test_no_claim_lapses_while_nobody_knows_who_lives(claims):
    claim(claims, "arm", "a")
    with pytest.raises(ClaimError):
        claim(claims, "leg", "b", masters=None)


def test_commands_without_a_claim(claims):
    with pytest.raises(ClaimError) as caught:
        claims.check(m.Release(subsystem="arm"))
    assert str(caught.value) == (
        "arm0: subsystem 'arm' has not claimed the RTPU; claim it first"
    )


def test_a_released_claim_is_gone_and_its_epoch_never_comes_again(claims):
    old = claim(claims, "arm", "a").epoch
    claims.release("arm")
    claims.release("arm")
    assert claims.epochs() == {}
    assert claim(claims, "arm", "a").epoch > old


@pytest.mark.parametrize(
    "wish",
    [
        {"usage": "mine"},
        {"scheduler": "muf"},
        {"errprint": "all"},
        {"minfreq": 0.0},
        {"minfreq": 5.0, "maxfreq": 5.0},
        {"maxfreq": float("inf")},
        {"minfreq": float("nan")},
        {"hangtime": 0.0},
        {"hangtime": float("inf")},
        {"alone": -1.0},
        {"alone": float("nan")},
    ],
)
def test_wishes_that_cannot_be(claims, wish):
    with pytest.raises(ClaimError):
        claim(claims, "arm", "a", **wish)
    assert claims.epochs() == {}


@pytest.mark.parametrize(("subsystem", "client"), [("", "a"), ("arm", "")])
def test_names_are_needed(claims, subsystem, client):
    with pytest.raises(ClaimError, match="needs the names"):
        claim(claims, subsystem, client)
