"""Which criticality a task gets: the rule fills in what nobody says."""

from pbonet.node.ranking import Ranked, Wish, rank


def ranked(*wishes, scheduler="MUF", minfreq=1.0, maxfreq=1000.0):
    return rank(scheduler, wishes, minfreq=minfreq, maxfreq=maxfreq)


def test_muf_assumes_what_it_does_not_know():
    found = ranked(Wish(name="a", freq=100.0, maxc=0.001), Wish(name="b", freq=50.0))
    assert found == {
        "a": Ranked(5, 0, assumed=False),
        "b": Ranked(5, 0, assumed=True),
    }


def test_muf_leaves_out_what_does_not_fit():
    found = ranked(
        Wish(name="a", freq=100.0, maxc=0.006), Wish(name="b", freq=50.0, maxc=0.01)
    )
    assert [found[name].crit for name in "ab"] == [5, 3]


def test_rm_goes_by_rate():
    found = ranked(
        Wish(name="slow", freq=1.0), Wish(name="fast", freq=1000.0), scheduler="RM"
    )
    assert (found["slow"].crit, found["fast"].crit) == (1, 62)


def test_edf_gives_all_the_same():
    found = ranked(
        Wish(name="a", freq=1.0), Wish(name="b", freq=500.0), scheduler="EDF"
    )
    assert found["a"].crit == found["b"].crit


def test_who_is_asked_first():
    """The master's last word, then the spawn, then the RMOD, then the rule."""
    wish = Wish(name="a", freq=10.0, maxc=0.001, rmod_crit=20, priority=7)
    assert ranked(wish)["a"] == Ranked(20, 7, assumed=False)
    wish.spawn_crit = 30
    assert ranked(wish)["a"].crit == 30
    wish.told = (40, 8)
    assert ranked(wish)["a"] == Ranked(40, 8, assumed=False)
    wish.told = (None, 9)
    assert ranked(wish)["a"] == Ranked(20, 9, assumed=False)


def test_a_task_without_a_frequency():
    assert ranked(Wish(name="a", freq=0.0))["a"].crit == 5


def test_nobody():
    assert ranked() == {}
