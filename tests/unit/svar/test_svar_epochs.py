"""Whose claim counts: in order, out of order, after a split, after a restart."""

from __future__ import annotations

from hypothesis import given, strategies as st

from pbonet.svar.mirror.epochs import HERE, Claim, Epochs

V = 3


def never(_variable, _machine):
    return False


def machine(*, epoch=None, live=True, uid=7):
    """Return what one knows whose task has claimed V."""
    one = Epochs()
    if epoch is not None:
        one.ended[V] = epoch - 1
        one.here({V: (uid, live)})
    return one


def tell(one, other, name="b", fights=()):
    """Let `one` know what stands on `other`, which it calls `name`."""
    one.there(name, other.own, other.ended.items(), fights)


def test_a_first_claim():
    one = machine(epoch=1)
    assert one.own[V] == Claim(1, live=True, uid=7)
    assert one.winner(V) == HERE
    assert one.winner(V + 1) is None


def test_who_takes_over_in_order_is_newer():
    one, other = machine(epoch=1), Epochs()
    tell(other, one, "a")
    assert other.winner(V) == "a"
    one.here({V: (7, False)})
    tell(other, one, "a")
    other.here({V: (9, True)})
    assert other.own[V].epoch == 2
    tell(one, other)
    assert one.winner(V) == "b"
    assert not one.own_fights(never)


def test_news_that_cross_do_not_fight_elsewhere():
    """c hears of the successor before it hears that the first one has ended."""
    first, second, third = machine(epoch=1), machine(epoch=2, uid=9), Epochs()
    tell(third, first, "a")
    tell(third, second, "b")
    assert third.winner(V) == "b"
    assert not third.fought_over(third.own_fights(never))


def test_two_that_claim_apart_fight():
    one, other = machine(epoch=1), machine(epoch=1, uid=9)
    tell(one, other)
    tell(other, one, "a")
    assert one.own_fights(never) == other.own_fights(never) == [V]
    third = Epochs()
    tell(third, one, "a", fights=[V])
    assert third.fought_over([]) == {V}


def test_a_successor_does_not_win_against_one_left_behind():
    """On the other side two tasks in turn have claimed; the one here never ended."""
    here, there = machine(epoch=1), machine(epoch=1, uid=9)
    there.here({V: (9, False)})
    there.here({V: (11, True)})
    assert there.own[V].epoch == 2
    tell(here, there)
    assert here.own_fights(never) == [V]


def test_a_fight_ends_when_one_is_turned_off():
    one, other = machine(epoch=1), machine(epoch=1, uid=9)
    tell(one, other)
    tell(other, one, "a")
    other.here({V: (9, False)})
    tell(one, other)
    assert not one.own_fights(never)
    assert one.winner(V) == HERE


def test_equal_constants_do_not_fight():
    one, other = machine(epoch=1), machine(epoch=1, uid=9)
    tell(one, other)
    assert not one.own_fights(lambda variable, who: (variable, who) == (V, "b"))


def test_the_living_count_more_than_the_ended():
    """A carrier that has lost its memory claims with a low epoch."""
    one = machine(epoch=5, live=False)
    fresh = machine(epoch=1, uid=9)
    tell(one, fresh)
    assert one.winner(V) == "b"


def test_a_machine_out_of_sight_is_no_owner():
    one, other = Epochs(), machine(epoch=4)
    tell(one, other)
    one.forget("b")
    assert one.winner(V) is None
    one.here({V: (1, True)})
    assert one.own[V].epoch == 4  # it has not been seen to end
    tell(one, other)
    assert one.own_fights(never) == [V]


def test_what_was_turned_on_again_is_newer():
    one = machine(epoch=1)
    one.here({V: (7, False)})
    assert one.own[V] == Claim(1, live=False, uid=7)
    one.here({V: (7, True)})
    assert one.own[V] == Claim(2, live=True, uid=7)
    one.here({})
    assert V not in one.own
    assert one.ended[V] == 2


STEPS = st.lists(st.tuples(st.sampled_from("abc"), st.booleans()), max_size=12)


@given(STEPS)
def test_all_agree_when_all_have_told(steps):
    """Tasks are turned on and off in order, as tables that see each other allow."""
    machines = {name: Epochs() for name in "abc"}
    uid = 0

    def tell_all():
        for name, one in machines.items():
            for other, known in machines.items():
                if name != other:
                    tell(one, known, other)

    for name, on in steps:
        mine = machines[name]
        owner = mine.winner(V)
        live = owner is not None and _live(machines, name, owner)
        if on and not live:
            uid += 1
            mine.here({V: (uid, True)})
        elif not on and owner == HERE and mine.own[V].live:
            mine.here({V: (mine.own[V].uid, False)})
        tell_all()
        owners = {
            n if (w := one.winner(V)) == HERE else w for n, one in machines.items()
        }
        assert len(owners) == 1
        assert not any(one.own_fights(never) for one in machines.values())


def _live(machines, name, owner):
    return machines[name if owner == HERE else owner].own[V].live
