"""Critical and timed sections, and what a handler of timing failures may set."""

import tracemalloc

import pytest

from pbonet import TaskContext, TimingFailure
from pbonet.errors import MethodError
from pbonet.pbo import Counted, PythonWatch, Section


class Ticking:
    """A clock of CPU time that goes on by a step at every look."""

    def __init__(self):
        self.now = 0
        self.step = 10

    def __call__(self):
        self.now += self.step
        return self.now


@pytest.fixture
def task():
    source = Counted(lambda: 5_000, crit=7)
    return TaskContext("arm", freq=200.0, source=source, handler=9)


def timed(task):
    clock = Ticking()
    task.watch = PythonWatch(task, clock)
    return clock


def test_a_timed_section_is_counted_and_measured(task):
    clock = timed(task)
    for clock.step in (10, 30, 20):
        with task.timed("jacobian"):
            pass
    assert task.watch.sections() == {"jacobian": Section(3, 60, 10, 30)}


def test_a_section_within_itself_counts_once(task):
    timed(task)
    with task.timed("outer"), task.timed("inner"), task.timed("outer"):
        pass
    assert task.watch.sections() == {
        "outer": Section(1, 30, 30, 30),
        "inner": Section(1, 10, 10, 10),
    }


def test_a_section_that_raised_is_measured_too(task):
    timed(task)
    with pytest.raises(ZeroDivisionError), task.timed("law"):
        _ = 1 / 0
    assert task.watch.sections()["law"].count == 1


def test_a_section_measures_the_cpu_time_of_this_thread(task):
    with task.timed("sum"):
        sum(range(100_000))
    assert task.watch.sections()["sum"].total_ns > 0


def test_a_section_that_was_not_left_is_not_shown(task):
    with task.timed("law"):
        assert task.watch.sections() == {}


@pytest.mark.parametrize("name", ["", "x" * 24, "ä" * 12, 5, None])
def test_a_section_has_a_proper_name(task, name):
    with pytest.raises(MethodError) as caught:
        task.timed(name)
    assert str(caught.value) == (
        "arm: a timed section cannot have this name (expected text of 1 to 23 bytes, "
        f"got {name!r}); shorten it"
    )


def test_a_name_of_twenty_three_bytes_will_do(task):
    with task.timed("ä" * 11 + "x"):
        pass
    assert list(task.watch.sections()) == ["ä" * 11 + "x"]


def test_a_task_has_sixteen_sections(task):
    for number in range(16):
        task.timed(f"s{number}")
    with pytest.raises(MethodError) as caught:
        task.timed("one_more")
    assert str(caught.value) == (
        "arm: there is no room for the timed section one_more (expected at most 16 "
        f"names in a task, got one more than {', '.join(f's{n}' for n in range(16))})"
        "; use a name again, and make none up while the task runs"
    )
    task.timed("s3")


def test_critical_sections_nest_and_are_counted(task):
    watch = task.watch
    with task.critical():
        with task.critical():
            assert watch.in_critical
        assert watch.in_critical
    assert not watch.in_critical
    assert watch.criticals == 1


def test_what_is_held_off_happens_at_the_end_of_the_outermost_section(task):
    seen = []
    with task.critical():
        task.watch.when_free(lambda: seen.append("one"))
        with task.critical():
            task.watch.when_free(lambda: seen.append("two"))
        assert seen == []
    assert seen == ["one", "two"]
    task.watch.when_free(lambda: seen.append("three"))
    assert seen == ["one", "two", "three"]


def test_sections_make_nothing(task):
    with task.critical(), task.timed("law"):
        pass
    assert task.critical() is task.critical()
    assert task.timed("law") is task.timed("law")
    many = list(range(1000))
    tracemalloc.start()
    before = tracemalloc.get_traced_memory()[0]
    for _ in many:
        with task.critical(), task.timed("law"):
            pass
    after = tracemalloc.get_traced_memory()[0]
    tracemalloc.stop()
    assert after - before < 1000, "less than a byte a time"


def test_criticality_and_deadline_are_those_of_the_task(task):
    assert task.criticality == 7
    assert task.deadline == 0.005
    assert TaskContext("free").deadline == 0.0


def test_they_are_set_by_a_handler_only(task):
    for what, value in (("criticality", 3), ("deadline", 0.01)):
        with pytest.raises(MethodError) as caught:
            setattr(task, what, value)
        assert str(caught.value) == (
            f"arm: self.task.{what} is set by a handler of timing failures only; set "
            "it in `timing_failure`; CRIT and FREQ in the .rmod file hold for every "
            "cycle"
        )


def handle(task, release):
    task.source.release = release
    task.handling = TimingFailure.MAXEXEC


def test_what_a_handler_sets_holds_until_the_next_release(task):
    handle(task, 1_000)
    task.criticality = 9
    task.deadline = 0.0075
    task.handling = None
    assert (task.criticality, task.deadline) == (9, 0.0075)
    task.source.release, task.source.cyclecount = 2_000, 1
    assert (task.criticality, task.deadline) == (7, 0.005)
    task.source.cyclecount = 0
    assert (task.criticality, task.deadline) == (7, 0.005), "turned off and on"


@pytest.mark.parametrize("crit", [0, 10, 63, -1, 3.0, True, "3"])
def test_a_criticality_above_the_tasks_and_its_handlers_is_refused(task, crit):
    handle(task, 1_000)
    with pytest.raises(MethodError) as caught:
        task.criticality = crit
    assert str(caught.value) == (
        "arm: a handler cannot set this criticality (expected a whole number from 1 "
        "to 9, the larger of the task's own and its handler's, got "
        f"{crit!r}); choose a lower one, or raise CRIT or HANDLER in the .rmod file"
    )


def test_without_a_criticality_for_the_handler_the_tasks_own_is_the_bound():
    task = TaskContext("arm", source=Counted(crit=7))
    handle(task, 1_000)
    task.criticality = 7
    with pytest.raises(MethodError, match="from 1 to 7"):
        task.criticality = 8


@pytest.mark.parametrize("deadline", [0.0, -1.0, float("inf"), float("nan"), "1", True])
def test_a_deadline_is_a_time(task, deadline):
    handle(task, 1_000)
    with pytest.raises(MethodError) as caught:
        task.deadline = deadline
    assert str(caught.value) == (
        "arm: a handler cannot set this deadline (expected seconds after the release "
        f"of this cycle, above 0, got {deadline!r})"
    )


def test_the_kinds_of_failure_say_what_they_mean():
    assert [kind.meaning for kind in TimingFailure] == [
        "the deadline was reached with the cycle unfinished",
        "the cycle used up its CPU time and is unfinished",
        "the least CPU time of a cycle cannot be granted any more",
    ]
