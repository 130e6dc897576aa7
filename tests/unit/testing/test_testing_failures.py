"""Timing failures on a bench: what a handler may do, and what follows."""

from pathlib import Path
from typing import Annotated as A

import pytest
from nodekit import rmod

from pbonet import (
    Answer,
    InVar,
    OutVar,
    PortBasedObject,
    Recovery,
    Signal,
    State,
    TimingFailure,
)
from pbonet.errors import MethodError, PortError, StateError
from pbonet.testing import Bench

DEADLINE = TimingFailure.DEADLINE
OVERRUNS = Path(__file__).parents[2] / "misbehaving" / "overruns.py"


class Search(PortBasedObject):
    """Improve y step by step; `slow` is a part that a test may replace."""

    x: A[float, InVar("X", "1", "none", "where to begin")]
    y: A[float, OutVar("Y", "1", "none", "the best so far")]

    hooks = {}  # noqa: RUF012 - each test makes a class of its own

    def on(self):
        self.from_where = (self.x, self.y)
        self.goes_on = self.task.handover
        return self.run("on")

    def cycle(self, dt):
        self.dt = dt
        self.y += 1.0
        self.slow()
        self.y += 10.0

    def stable(self, dt):
        self.y -= dt
        self.slow()

    def slow(self):
        pass

    def error(self, error):
        self.last = error
        return self.run("error") or Answer.ERROR

    def run(self, name, *args):
        hook = self.hooks.get(name)
        return hook(self, *args) if hook else None


def make(handler=None, *, given=None, **hooks):
    body = {"hooks": hooks, "__module__": __name__}
    if handler:
        body["timing_failure"] = handler
    bench = Bench(type("Search", (Search,), body), name="search", **(given or {}))
    bench.on()
    return bench


def answering(answer):
    return lambda _self, _kind: answer


def interrupt(bench, kind=DEADLINE):
    """Have the next cycles fail in the middle; return what the bench answered."""
    answers = []
    bench.module.slow = lambda: answers.append(bench.timing_failure(kind))
    return answers


@pytest.mark.parametrize("kind", TimingFailure)
def test_the_handler_is_told_what_failed(kind):
    seen = []
    bench = make(lambda self, kind: seen.append((kind, self.task.handling)))
    assert bench.timing_failure(kind) is Recovery.CONTINUE
    assert seen == [(kind, kind)]
    assert bench.task.handling is None


@pytest.mark.parametrize("answer", [None, Recovery.CONTINUE])
def test_a_cycle_that_goes_on_is_copied_out(answer):
    bench = make(answering(answer))
    answers = interrupt(bench)
    bench.step()
    assert answers == [Recovery.CONTINUE]
    assert bench.outputs.y == 11.0
    assert bench.notices() == []


def test_without_a_handler_the_failure_is_warned_of():
    bench = make()
    assert bench.timing_failure(TimingFailure.MAXEXEC) is Recovery.CONTINUE
    (notice,) = bench.notices()
    assert (notice.bits, notice.text) == (
        Signal.WARNING,
        "timing failure, maxexec: the cycle used up its CPU time and is unfinished",
    )
    assert bench.task.nwarnings == 1


def test_an_abort_leaves_the_cycle_and_runs_on_again():
    bench = make(answering(Recovery.ABORT))
    bench.step()
    assert not bench.module.goes_on
    answers = interrupt(bench)
    bench.inputs.x = 5.0
    bench.forget()
    assert bench.step() is State.ON
    assert bench.module.goes_on, "it was not interrupted"
    assert answers == [], "the cycle was left before it heard of it"
    assert bench.outputs.y == 11.0, "as the cycle before left it"
    assert bench.module.from_where == (5.0, 11.0)
    assert bench.log == [
        *("in-vars in", "cycle", "timing_failure"),
        *("in-vars and out-vars in", "on"),
    ]
    bench.module.slow = lambda: None
    bench.step()
    assert bench.outputs.y == 22.0
    assert bench.table.owned


def test_an_abort_between_two_steps_discards_what_the_module_has():
    bench = make(answering(Recovery.ABORT))
    bench.step()
    bench.module.y = 99.0
    assert bench.timing_failure(DEADLINE) is Recovery.ABORT
    assert (bench.module.y, bench.outputs.y) == (11.0, 11.0)
    assert bench.state is State.ON


def test_counts_go_on_over_an_abort():
    bench = make(answering(Recovery.ABORT))
    bench.task.warn("before")
    bench.step(n=3)
    bench.timing_failure(DEADLINE)
    assert (bench.task.cyclecount, bench.task.nwarnings) == (3, 1)


def test_a_module_that_cannot_begin_anew_is_off_and_owns_nothing():
    bench = make(answering(Recovery.ABORT))
    bench.step()
    bench.module.hooks["on"] = answering_off
    bench.forget()
    assert bench.timing_failure(DEADLINE) is Recovery.ABORT
    assert bench.state is State.OFF
    assert bench.log[-3:] == ["in-vars and out-vars in", "on", "disown"]
    assert not bench.table.owned
    assert bench.outputs.y == 11.0, "values stand when nobody owns them"


def answering_off(_):
    return Answer.OFF


def boom(*_):
    raise ZeroDivisionError("division by zero")


def test_an_on_that_fails_behind_an_abort_is_an_error():
    bench = make(answering(Recovery.ABORT))
    bench.module.hooks["on"] = boom
    with pytest.raises(MethodError, match=r"^search\.on: ZeroDivisionError"):
        bench.timing_failure(DEADLINE)
    assert bench.state is State.ERROR
    assert not bench.table.owned


def test_an_on_that_fails_behind_an_abort_in_a_cycle_is_an_error():
    bench = make(answering(Recovery.ABORT))
    interrupt(bench)
    bench.module.hooks["on"] = boom
    with pytest.raises(MethodError, match=r"^search\.on: ZeroDivisionError"):
        bench.step()
    assert bench.state is State.ERROR


def test_an_on_that_is_put_right_behind_an_abort_goes_on():
    bench = make(answering(Recovery.ABORT), error=lambda _: Answer.CONTINUE)
    bench.module.hooks["on"] = boom
    assert bench.timing_failure(DEADLINE) is Recovery.ABORT
    assert bench.state is State.ON
    assert bench.table.owned


def test_a_skip_leaves_out_the_next_release():
    bench = make(answering(Recovery.SKIP))
    interrupt(bench)
    bench.step()
    assert bench.outputs.y == 11.0, "the cycle went on"
    bench.module.slow = lambda: None
    assert bench.step(0.01) is State.ON
    assert bench.outputs.y == 11.0
    bench.step(0.01)
    assert bench.outputs.y == 22.0
    assert bench.module.dt == pytest.approx(0.02), "a missed cycle is seen"


def test_a_skip_does_not_outlive_the_task_being_turned_on():
    bench = make(answering(Recovery.SKIP))
    bench.timing_failure(DEADLINE)
    bench.off()
    with pytest.raises(StateError):
        bench.step()
    bench.on()
    bench.step(0.01)
    assert bench.outputs.y == 11.0
    assert bench.module.dt == pytest.approx(0.01)


@pytest.mark.parametrize("within", [True, False])
def test_a_handler_that_raises_is_an_error_by_its_own_name(within):
    bench = make(boom)
    if within:
        interrupt(bench)
        with pytest.raises(MethodError) as caught:
            bench.step()
    else:
        with pytest.raises(MethodError) as caught:
            bench.timing_failure(DEADLINE)
    assert str(caught.value) == (
        "search.timing_failure: ZeroDivisionError: division by zero"
    )
    assert bench.state is State.ERROR
    assert bench.outputs.y == 0.0, "the cycle's outputs are discarded"
    assert bench.task.handling is None


@pytest.mark.parametrize("within", [True, False])
def test_a_handler_that_fails_names_itself_to_error(within):
    bench = make(
        lambda self, _: self.task.fail("too late", 7),
        error=lambda _: Answer.OFF,
    )
    if within:
        interrupt(bench)
        bench.step()
    else:
        bench.timing_failure(DEADLINE)
    assert bench.state is State.OFF
    assert str(bench.executor.failure) == "search.timing_failure: too late"
    assert bench.task.errnum == 7


def test_a_handler_s_error_that_is_put_right_goes_on():
    bench = make(boom, error=lambda _: Answer.CONTINUE)
    assert bench.timing_failure(DEADLINE) is Recovery.CONTINUE
    assert bench.step() is State.ON


@pytest.mark.parametrize("answer", ["abort", Answer.OFF, True])
def test_another_answer_is_an_error(answer):
    bench = make(answering(answer))
    with pytest.raises(MethodError) as caught:
        bench.timing_failure(DEADLINE)
    assert str(caught.value) == (
        "search.timing_failure: timing_failure returned an invalid answer "
        "(expected None or Recovery.CONTINUE or Recovery.ABORT or Recovery.SKIP, got "
        f"{answer!r}); correct what it returns; no return at all means CONTINUE"
    )


def test_a_task_that_is_not_on_does_not_fail_in_time():
    bench = make(answering(None))
    bench.off()
    with pytest.raises(StateError) as caught:
        bench.timing_failure(DEADLINE)
    assert str(caught.value) == (
        "search: only a task that is ON has timing failures (got state OFF); "
        "turn it on first"
    )
    with pytest.raises(StateError, match="signal abort is not valid in state OFF"):
        bench.executor.abort()


def test_what_a_handler_sets_holds_to_the_end_of_the_cycle():
    seen = []

    def handler(self, kind):
        del kind
        self.task.criticality = 6
        self.task.deadline = 0.02

    def look():
        bench.timing_failure(DEADLINE)
        seen.append((bench.task.criticality, bench.task.deadline))

    bench = make(handler, given={"crit": 3, "handler": 6, "freq": 100.0})
    bench.module.slow = look
    bench.step()
    assert seen == [(6, 0.02)]
    assert (bench.task.criticality, bench.task.deadline) == (3, 0.01)


def test_a_critical_section_holds_the_failure_off_to_its_end():
    order = []
    bench = make(lambda _self, kind: order.append(str(kind)))

    def slow():
        with bench.task.critical():
            assert bench.timing_failure(DEADLINE) is None
            assert bench.timing_failure(TimingFailure.MAXEXEC) is None
            order.append("section")
        order.append("behind")

    bench.module.slow = slow
    bench.step()
    assert order == ["section", "deadline", "maxexec", "behind"]


def test_an_abort_at_the_end_of_a_critical_section_ends_the_other_failures_too():
    seen = []

    def handler(_self, kind):
        seen.append(kind)
        return Recovery.ABORT

    bench = make(handler)

    def slow():
        with bench.task.critical():
            bench.timing_failure(DEADLINE)
            bench.timing_failure(TimingFailure.MAXEXEC)

    bench.module.slow = slow
    bench.step()
    assert seen == [DEADLINE]
    with bench.task.critical():
        pass
    assert seen == [DEADLINE], "nothing of an old cycle is left over"


def test_a_handler_runs_in_stable_too():
    bench = make(answering(Recovery.ABORT), given={"critical": True})
    bench.illegal = True
    interrupt(bench)
    assert bench.step() is State.ON
    assert bench.outputs.y == 0.0
    assert bench.log[-4:] == [
        *("stable", "timing_failure"),
        *("in-vars and out-vars in", "on"),
    ]


def test_timed_sections_are_on_the_bench():
    bench = make()

    def slow():
        with bench.task.timed("slow part"):
            pass

    bench.module.slow = slow
    bench.step(n=5)
    assert bench.sections()["slow part"].count == 5


class Torque(PortBasedObject):
    """Count up; a test may have it fail amid its cycle."""

    y: A[float, OutVar("Y", "1", "none", "what acts", safe=-1.0)]

    answer = None

    def on(self):
        self.from_where = self.y

    def cycle(self, dt):
        self.dt = dt
        self.y += 1.0
        self.slow()
        self.y += 10.0

    def slow(self):
        pass

    def timing_failure(self, kind):
        self.seen = (self.y, kind in self.task.safe_at)
        if isinstance(self.answer, Exception):
            raise self.answer
        return self.answer

    def error(self, error):
        self.last = error
        return Answer.CONTINUE


def safe_bench(answer=None, **more):
    body = {"answer": answer, "__module__": __name__}
    bench = Bench(type("Torque", (Torque,), body), safe_at=[DEADLINE], **more)
    bench.on()
    bench.step()
    assert bench.outputs.y == 11.0
    return bench


@pytest.mark.parametrize("answer", [None, Recovery.CONTINUE, Recovery.ABORT])
def test_safe_values_are_there_at_once_and_the_cycle_is_discarded(answer):
    bench = safe_bench(answer)
    seen = []

    def slow():
        try:
            bench.timing_failure(DEADLINE)
        finally:
            seen.append(bench.outputs.y)

    bench.module.slow = slow
    assert bench.step() is State.ON
    assert seen == [-1.0], "while the cycle still runs"
    assert bench.module.seen == (12.0, True), "the module's own value is untouched"
    assert bench.outputs.y == bench.module.from_where == -1.0
    bench.module.slow = lambda: None
    bench.step()
    assert bench.outputs.y == 10.0, "the next cycle is an ordinary one"


def test_after_safe_values_a_skip_still_leaves_out_a_release():
    bench = safe_bench(Recovery.SKIP)
    bench.module.slow = lambda: bench.timing_failure(DEADLINE)
    bench.step()
    assert bench.outputs.y == bench.module.from_where == -1.0
    bench.module.slow = lambda: None
    bench.step()
    assert bench.outputs.y == -1.0, "left out"
    bench.step(dt=0.01)
    assert bench.outputs.y == 10.0
    assert bench.module.dt == pytest.approx(bench.task.period + 0.01)


def test_a_cycle_that_raises_after_safe_values_has_them_in_its_out_vars():
    bench = safe_bench()

    def slow():
        bench.timing_failure(DEADLINE)
        raise ValueError("and then")

    bench.module.slow = slow
    assert bench.step() is State.ON
    assert bench.module.y == bench.outputs.y == -1.0
    bench.module.slow = lambda: None
    bench.step()
    assert bench.outputs.y == 10.0


def test_safe_values_between_two_steps_and_other_failures():
    bench = safe_bench()
    bench.timing_failure(TimingFailure.MAXEXEC)
    assert bench.outputs.y == bench.module.y == 11.0
    bench.timing_failure(DEADLINE)
    assert bench.outputs.y == bench.module.from_where == bench.module.y == -1.0


def test_a_critical_section_does_not_hold_off_safe_values():
    bench = safe_bench()

    def slow():
        with bench.task.critical():
            assert bench.timing_failure(DEADLINE) is None
            assert bench.outputs.y == -1.0

    bench.module.slow = slow
    bench.step()
    assert bench.executor.failure is None
    assert bench.module.seen == (12.0, True)
    assert bench.outputs.y == -1.0


@pytest.mark.parametrize("within", [True, False])
def test_a_handler_that_raises_after_safe_values_has_them_in_its_out_vars(within):
    bench = safe_bench(ValueError("no"))
    if within:
        bench.module.slow = lambda: bench.timing_failure(DEADLINE)
        bench.step()
    else:
        bench.timing_failure(DEADLINE)
    assert bench.state is State.ON
    assert bench.module.y == bench.outputs.y == -1.0
    assert bench.module.from_where == 0.0, "`on` does not run again"


def test_safe_values_need_some_and_a_known_failure():
    with pytest.raises(PortError, match="safe value of Y"):
        Bench(Search, safe_at=["deadline"])
    with pytest.raises(PortError, match="deadline or maxexec or minexec"):
        Bench(Torque, safe_at=["late"])


def test_the_bench_takes_safe_from_an_rmod(tmp_path):
    (tmp_path / "overruns.py").write_text(OVERRUNS.read_text())
    text = rmod("overruns", freq=50.0).replace("FREQ 50\n", "FREQ 50\nSAFE deadline\n")
    (tmp_path / "overruns.rmod").write_text(text)
    with Bench.of(tmp_path / "overruns.rmod") as bench:
        bench.on()
        bench.timing_failure(DEADLINE)
        assert bench["Y"].tolist() == [-7.0, -7.0]
