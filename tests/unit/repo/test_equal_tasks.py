"""The benchmark of equal tasks says where the time of a period went."""

from types import SimpleNamespace

import pytest

from benchmarks import swap
from benchmarks.equal_tasks import REASONS, Found, Parts, Witnesses, run_tasks
from pbonet.analysis.schedule.events import Event

PERIOD, WORK, GAP = 1_000_000, 157_000, 10_000
USED, LOST, FIRST, LATER = REASONS


def cycles(begin, *, first=0, gaps=(GAP, GAP, GAP), work=WORK, held=0):
    """Return the records of four cycles of a period; the second is held up."""
    found, at = [], begin + GAP + first
    for k, gap in enumerate((*gaps, 0)):
        end = at + work + (held if k == 1 else 0)
        found.append(SimpleNamespace(kind=0, start_ns=at, end_ns=end, cpu_ns=work))
        at = end + gap
    return found


def witnesses(*last):
    """Return those of a hundred ordinary periods and of these records."""
    usual = [one for k in range(100) for one in cycles(k * PERIOD)]
    rings = [usual, list(last), [], []]
    made = Witnesses([SimpleNamespace(drain=one.copy) for one in rings])
    made.look()
    made.settle()
    return made


@pytest.mark.parametrize(
    ("how", "why"),
    [
        ({"held": 300_000}, LOST),
        ({"first": 300_000}, FIRST),
        ({"gaps": (GAP, 310_000, GAP)}, LATER),
        ({"work": 230_000}, USED),
        ({"gaps": (20_000, 20_000, 20_000)}, ""),
    ],
)
def test_a_miss_is_explained_by_the_part_that_took_longest(how, why):
    made = witnesses(*cycles(100 * PERIOD, **how))
    assert made.explain(100 * PERIOD, 101 * PERIOD - 1) == why


def test_a_core_that_stood_still_began_late():
    made = witnesses(*cycles(101 * PERIOD))
    assert made.parts(100) == Parts(0, 0, PERIOD, 0)
    assert made.explain(100 * PERIOD, 101 * PERIOD - 1) == FIRST


def test_tasks_that_did_not_run_beside_the_first_began_late():
    made = witnesses(cycles(100 * PERIOD)[0])
    assert made.parts(100) == Parts(WORK, 0, GAP, PERIOD - GAP - WORK)
    assert made.explain(100 * PERIOD, 101 * PERIOD - 1) == LATER


def test_a_cycle_over_the_end_of_a_period_counts_in_both():
    (whole, *_) = cycles(100 * PERIOD, first=900_000)
    made = witnesses(whole)
    inside = 101 * PERIOD - whole.start_ns
    assert made.parts(100).used == pytest.approx(inside)
    assert made.parts(101).used == pytest.approx(WORK - inside)
    assert made.parts(101).late == 0


class Core:
    """A core whose four tasks are released by one turn whenever its trace is read."""

    records: list

    def slots(self):
        return range(4)

    def snapshot(self, slot):
        return SimpleNamespace(task=f"b/task{slot}")

    def trace(self, since=0):
        kinds = [(Event.TURN, 0), *((Event.RELEASE, slot) for slot in range(4))]
        self.records += [SimpleNamespace(kind=k, slot=i, a=0, arg=0) for k, i in kinds]
        return len(self.records), 1, self.records[since:]

    def close(self):
        pass


def test_all_tasks_are_counted_over_the_same_time(monkeypatch):
    monkeypatch.setattr(Core, "records", [], raising=False)
    monkeypatch.setattr(swap.rt, "CoreTable", lambda _core, **_: Core())
    to, looks = Found(4), []
    run_tasks(
        SimpleNamespace(wait=lambda _: None),
        0,
        ("task0", "task1", "task2", "task3"),
        0.001,
        witnesses=SimpleNamespace(look=lambda: looks.append(1)),
        to=to,
    )
    assert to.releases == [len(looks)] * 4
    assert to.lost == len(looks), "of what was read while it counted"
