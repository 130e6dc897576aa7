"""Writers that take each other's place on two machines, and packets out of order."""

from __future__ import annotations

import itertools

import pytest
from test_svar_mirror import Side, carry, meet, on

from pbonet.errors import SvarOwnerError
from pbonet.svar.mirror import mirror_outbox, packets, table_mirror


@pytest.fixture
def strangers():
    """Three machines that have not exchanged anything yet."""
    made = [Side("a", keep=True), Side("b", keep=False), Side("c", keep=False)]
    yield made
    for side in made:
        side.close()


@pytest.fixture
def sides(strangers):
    meet(*strangers)
    return strangers


def told(one, **how):
    """Return what a machine tells, to be taken later."""
    return packets.pack(one.mirror.next_packet(full=True, **how))


def take(one, data):
    return one.mirror.take(packets.unpack(data))


def test_the_count_goes_on_wherever_the_writer_is(sides):
    """Each one begins with what it finds on its machine; nobody sees it go back."""
    a, b, _ = sides
    where = {"one": a, "two": b}
    tasks = {name: side.task(name, "Q") for name, side in where.items()}
    seen = []
    for name, turn in zip(itertools.cycle(where), range(6), strict=False):
        side, task = where[name], tasks[name]
        task.array("Q")[:] = side.table.read("Q")
        task.claim()
        for _ in range(3):
            task.array("Q")[:] += 1.0
            task.commit()
            carry(side, *(other for other in sides if other is not side))
            seen.append([float(one.table.read("Q")[0]) for one in sides])
        task.release()
        carry(side, *(other for other in sides if other is not side))
        assert all(one.table.info("Q").owner is None for one in sides), turn
    assert seen == [[n, n, n] for n in range(1, 19)]


def test_tasks_of_machines_of_one_host_name_take_over_from_each_other(strangers):
    """As robots of one image have it: a machine is known by its boot."""
    sides = a, b, c = strangers
    for side in sides:
        side.mirror.host = "robot"
    one = on(a, "one", "Q")
    two = b.task("two", "Q")
    meet(*sides)
    for old, there, new, here in [(one, a, two, b), (two, b, one, a)] * 2:
        with pytest.raises(SvarOwnerError, match="@robot"):
            new.claim()
        old.release()
        carry(there, here, c)
        new.array("Q")[:] = here.table.read("Q") + 1.0
        new.claim()
        carry(here, there, c)
        assert here.table.info("Q").owner == ("two" if new is two else "one")
        assert c.table.info("Q").owner == f"{here.table.info('Q').owner}@robot"
    assert [side.table.read("Q").tolist() for side in sides] == [[5, 5, 5]] * 3
    assert not any(side.mirror.conflicts() or side.table.illegal for side in sides)


def test_what_the_old_writer_wrote_comes_behind_the_new_one(sides):
    """Samples and states that were under way stay without effect, in any order."""
    a, b, c = sides
    old = on(a, "old", "Q", value=1.0)
    meet(*sides)
    old.array("Q")[:] = 2.0
    old.commit()
    late = packets.pack(a.mirror.next_packet()), told(a)
    old.array("Q")[:] = 3.0
    old.commit()
    old.release()
    last = told(a)
    take(b, last)
    new = b.task("new", "Q")
    new.array("Q")[:] = b.table.read("Q") + 1.0
    new.claim()
    taken_over = told(b)
    for order in itertools.permutations([*late, last, taken_over]):
        for data in order:
            take(c, data)
        assert c.table.read("Q").tolist() == [4, 4, 4]
        assert c.table.info("Q").owner == "new@host-b"
    for data in late:
        take(b, data)
    assert b.table.read("Q").tolist() == [4, 4, 4]
    assert b.table.info("Q").owner == "new"
    for side in sides:
        assert not side.mirror.conflicts()
        assert not side.table.illegal


def test_a_state_that_was_overtaken_brings_nothing_back(sides):
    """A task that has come on again is not taken for one that is off."""
    a, b, _ = sides
    task = on(a, "task", "Q", value=1.0)
    meet(*sides)
    task.release()
    off = told(a)
    task.array("Q")[:] = 2.0
    task.claim()
    a.table.raise_illegal("hand off", "arm0/guard")
    now = told(a)
    assert take(b, now)
    assert take(b, off), "nothing is to be asked for"
    assert b.table.info("Q").owner == "task@host-a"
    assert b.table.read("Q").tolist() == [2, 2, 2]
    assert [cause.cause for cause in b.table.illegal] == ["hand off"]


def test_the_end_of_an_owner_is_known_on_all_machines(sides):
    """Its successor, on its own machine, takes its variables over later, or never."""
    a, b, c = sides
    old = on(a, "old", "Q", value=1.0)
    meet(*sides)
    assert [one.table.written("Q") for one in sides] == [True] * 3
    old.cede()
    news = a.mirror.next_packet()
    assert news is not None, "nothing else has changed"
    assert a.mirror.next_packet() is None
    data = packets.pack(news)
    generation = b.table.generation
    assert take(b, data)
    assert take(c, data)
    assert [one.table.written("Q") for one in sides] == [False] * 3
    assert b.table.info("Q").owner == "old@host-a"
    assert b.table.generation == generation
    new = a.task("new", "Q")
    new.take_over_from(["old"])
    new.claim()
    carry(a, b, c)
    assert [one.table.written("Q") for one in sides] == [True] * 3
    assert b.table.info("Q").owner == "new@host-a"


def test_a_machine_that_comes_later_learns_which_owner_has_ended(sides):
    a, _, c = sides
    old = on(a, "old", "Q", value=1.0)
    old.cede()
    meet(*sides)
    assert c.table.info("Q").owner == "old@host-a"
    assert not c.table.written("Q")
    old.claim()
    carry(a, c)
    assert c.table.written("Q")


def test_a_carrier_that_stood_still_amid_a_look(sides, monkeypatch):
    """It takes a commit for older than the last one, and goes on all the same."""
    a, b, _ = sides
    now, still = 10**12, 0
    monkeypatch.setattr(table_mirror, "now_ns", lambda: now)
    monkeypatch.setattr(mirror_outbox, "now_ns", lambda: now + still)
    task = on(a, "task", "Q")
    meet(*sides)
    for lost in (0, 0, 8_000_000, 0, 0):
        now, still = now + 1_000_000, lost
        task.commit(now, 1)
        carry(a, b)
        assert abs(a.mirror.due()) <= 0.01
