"""Several modules as one task: their methods and failures (Stewart 1994, 3.8.1)."""

from __future__ import annotations

import numpy as np
import pytest
from combined_modules import ONE, TWO, Folder, calls

from pbonet import Recovery, State, TimingFailure
from pbonet.errors import DeclarationError, MethodError
from pbonet.testing import Bench


@pytest.fixture
def folder(tmp_path):
    made = Folder(tmp_path)
    made.module("one", ONE, "self.y[:] = self.params.gain * self.x")
    made.module("two", TWO, "self.z[:] = self.params.gain * self.y")
    return made


def test_data_go_through_in_one_cycle_and_the_inner_variable_is_nowhere(folder):
    bench = folder.bench("one.GAIN 2; two.GAIN 5")
    bench.on()
    bench.inputs.x = [1.0, 2.0, 3.0]
    bench.forget()
    bench.step()
    assert bench.outputs.z.tolist() == [10.0, 20.0, 30.0]
    assert bench.log == ["in-vars in", "cycle", "out-vars out"]  # one transfer a way
    assert dir(bench.inputs) == ["ndof", "x"]
    assert dir(bench.outputs) == ["z"]
    one, two = bench.module.parts
    assert np.shares_memory(one.y, two.y)
    assert one.y.flags.writeable
    assert not two.y.flags.writeable


def test_what_is_published_is_written_too(folder):
    path = folder.both(OUTVAR="Y Z")
    bench = Bench.of(path, {"ndof": 2, "x": 3.0})
    bench.on()
    bench.step()
    assert bench["Y"].tolist() == bench["Z"].tolist() == [3.0, 3.0]


def test_methods_run_in_order_and_backwards_on_the_way_out(folder):
    bench = folder.bench()
    assert calls(bench) == ["one.init", "two.init"]
    bench.on()
    bench.step()
    bench.reinit()
    assert calls(bench) == [
        *("one.on", "two.on"),
        *("one.cycle", "two.cycle"),
        *("one.reinit", "two.reinit"),
    ]
    bench.off()
    bench.kill()
    assert calls(bench) == ["two.off", "one.off", "two.kill", "one.kill"]


def test_a_part_of_which_init_was_never_begun_is_not_killed(folder):
    with pytest.raises(MethodError, match=r"both\.one\.init: RuntimeError: one fails"):
        folder.bench("one.FAILS init")
    folder.module("two", TWO, more="    def kill(self): self.n / 0")
    with pytest.raises(MethodError) as caught:
        folder.bench("two.FAILS init")
    assert str(caught.value) == (
        "both.two.init: RuntimeError: two fails in init; and then both.kill: "
        "two: ZeroDivisionError: division by zero"
    )


def test_a_part_that_cannot_start_turns_off_those_before_it(folder):
    bench = folder.bench("two.ANSWER later")
    calls(bench)
    assert bench.on() is State.OFF
    assert calls(bench) == ["one.on", "two.on", "one.off"]
    assert bench.state is State.OFF


def test_only_the_part_that_failed_is_asked_and_the_others_are_turned_off(folder):
    bench = folder.bench("two.FAILS cycle")
    bench.on()
    calls(bench)
    with pytest.raises(MethodError, match=r"^both\.two\.cycle: RuntimeError: two"):
        bench.step()
    assert bench.state is State.ERROR
    assert calls(bench) == ["one.cycle", "two.cycle", "two.error", "one.off"]
    assert bench.clear() is State.OFF
    assert calls(bench) == ["two.clear"]
    bench.on()
    assert calls(bench) == ["one.on", "two.on"]


def test_off_as_the_answer_leaves_the_task_off(folder):
    bench = folder.bench("one.FAILS cycle; one.ANSWER OFF")
    bench.on()
    calls(bench)
    assert bench.step() is State.OFF
    assert calls(bench) == ["one.cycle", "one.error", "two.off"]


def test_a_cycle_that_raised_and_goes_on_is_discarded(folder):
    bench = folder.bench("two.FAILS cycle; two.ANSWER CONTINUE")
    bench.on()
    bench.inputs.x = 7.0
    calls(bench)
    assert bench.step() is State.ON
    assert calls(bench) == ["one.cycle", "two.cycle", "two.error"]
    assert bench.outputs.z.tolist() == [0.0] * 3
    bench.set("two.fails", "nothing")
    bench.step()
    assert bench.outputs.z.tolist() == [7.0] * 3


def test_behind_fail_the_part_goes_on_and_so_do_those_behind_it(folder):
    bench = folder.bench("one.FAILS cycle; one.HOW fail; one.ANSWER CONTINUE")
    bench.on()
    bench.inputs.x = 7.0
    calls(bench)
    assert bench.step() is State.ON
    assert calls(bench) == [
        *("one.cycle", "one.error", "one.cycle goes on"),
        "two.cycle",
    ]
    assert bench.outputs.z.tolist() == [7.0] * 3


@pytest.mark.parametrize("how", ["raise", "fail"])
def test_on_goes_on_with_the_parts_behind(folder, how):
    bench = folder.bench(f"one.FAILS on; one.HOW {how}; one.ANSWER CONTINUE")
    calls(bench)
    assert bench.on() is State.ON
    seen = [call for call in calls(bench) if "goes" not in call]
    assert seen == ["one.on", "one.error", "two.on"]
    bench.off()
    assert calls(bench) == ["two.off", "one.off"]


@pytest.mark.parametrize("how", ["raise", "fail"])
@pytest.mark.parametrize("answer", ["CONTINUE", "OFF", "ERROR"])
@pytest.mark.parametrize("method", ["on", "reinit", "off"])
def test_parts_behind_one_that_goes_on_are_asked_when_they_fail_too(
    folder, method, answer, how
):
    """Each part is asked for its own error, and what the last one answers holds."""
    first, last = ("one", "two") if method != "off" else ("two", "one")
    bench = folder.bench(
        f"{first}.FAILS {method}; {first}.ANSWER CONTINUE; "
        f"{last}.FAILS {method}; {last}.ANSWER {answer}; {last}.HOW {how}"
    )
    if method == "off":
        bench.on()
    calls(bench)
    act = getattr(bench, method)
    if answer == "CONTINUE":
        assert act() is {"on": State.ON}.get(method, State.OFF)
    else:
        match = rf"^both\.{last}\.{method}: .*{last} fails in {method}"
        with pytest.raises(MethodError, match=match):
            act()
        assert bench.state is State[answer]
    seen = [call for call in calls(bench) if "goes" not in call]
    assert seen[:4] == [
        *(f"{first}.{method}", f"{first}.error"),
        *(f"{last}.{method}", f"{last}.error"),
    ]
    assert seen[4:] == (["one.off"] if method == "on" and answer != "CONTINUE" else [])


def test_a_part_behind_that_cannot_start_turns_off_the_one_that_went_on(folder):
    bench = folder.bench("one.FAILS on; one.ANSWER CONTINUE; two.ANSWER later")
    calls(bench)
    with pytest.raises(MethodError, match="one fails in on"):
        bench.on()
    assert bench.state is State.OFF
    assert calls(bench) == ["one.on", "one.error", "two.on", "one.off"]


@pytest.mark.parametrize("how", ["raise", "fail"])
@pytest.mark.parametrize("answer", ["CONTINUE", "OFF", "ERROR"])
def test_a_part_that_fails_in_off_keeps_none_of_the_others_on(folder, how, answer):
    bench = folder.bench(f"two.FAILS off; two.HOW {how}; two.ANSWER {answer}")
    bench.on()
    calls(bench)
    if answer == "CONTINUE":
        assert bench.off() is State.OFF
    else:
        with pytest.raises(MethodError, match=r"both\.two\.off: .*two fails in off"):
            bench.off()
        assert bench.state is State[answer]
    seen = [call for call in calls(bench) if "goes" not in call]
    assert seen == ["two.off", "two.error", "one.off"]


def test_reinit_goes_on_with_the_parts_behind(folder):
    bench = folder.bench("one.FAILS reinit; one.ANSWER CONTINUE")
    calls(bench)
    bench.reinit()
    assert calls(bench) == ["one.reinit", "one.error", "two.reinit"]


def test_what_fails_while_the_others_are_turned_off_is_told_too(folder):
    folder.module("three", TWO.replace('"Z"', '"W"'))
    path = folder.rmod(
        "all",
        "COMBINE one two three",
        "two.FAILS cycle; three.FAILS off",
        INCONST="NDOF",
        INVAR="X",
        OUTVAR="Z W",
    )
    bench = Bench.of(path, {"ndof": 1})
    bench.on()
    calls(bench)
    with pytest.raises(MethodError) as caught:
        bench.step()
    assert "two fails in cycle" in str(caught.value)
    assert "three fails in off" in str(caught.value)
    assert calls(bench)[2:] == ["two.error", "three.off", "one.off"]


def test_an_output_that_is_refused_is_put_to_every_part(folder):
    bench = folder.bench()
    bench.on()
    bench.inputs.x = float("nan")
    calls(bench)
    with pytest.raises(MethodError, match=r"not a finite number: Z\[0\]"):
        bench.step()
    assert calls(bench)[-2:] == ["one.error", "two.error"]
    assert bench.state is State.ERROR


# -- timing failures and other times --------------------------------------------------


def test_the_part_that_runs_late_is_the_one_that_is_told(folder):
    handler = """
    def timing_failure(self, kind):
        self.note("timing_failure")
        return Recovery.SKIP
"""
    folder.module("two", TWO, "self.task.late()", handler)
    bench = folder.bench()
    bench.task.late = lambda: bench.timing_failure(TimingFailure.DEADLINE)
    bench.on()
    calls(bench)
    bench.step()
    assert calls(bench) == ["one.cycle", "two.cycle", "two.timing_failure"]
    bench.step()  # left out
    assert calls(bench) == []
    assert bench.timing_failure(TimingFailure.DEADLINE) is Recovery.SKIP
    (notice,) = bench.notices()  # of the part that has no handler
    assert notice.text.startswith("timing failure in part one, deadline")


def test_an_aborted_cycle_turns_the_parts_on_again(folder):
    handler = """
    def timing_failure(self, kind):
        return Recovery.ABORT
"""
    folder.module("one", ONE, "self.task.late()", handler)
    bench = folder.bench()
    bench.task.late = lambda: bench.timing_failure(TimingFailure.DEADLINE)
    bench.on()
    calls(bench)
    assert bench.step() is State.ON
    assert calls(bench) == ["one.cycle", "one.on", "two.on"]


def test_one_part_may_wait_for_the_event(folder):
    wait = "    def sync(self): self.note('sync')"
    folder.module("two", TWO, more=wait)
    bench = folder.bench("two.FAILS sync")
    bench.on()
    calls(bench)
    assert bench.sync() is State.ERROR
    assert calls(bench) == ["two.sync", "two.error", "one.off"]
    folder.module("one", ONE, more=wait)
    with pytest.raises(DeclarationError, match="one and two both write sync"):
        folder.bench()


def test_critical_parts_are_stable_and_the_others_go_on(folder):
    folder.module("two", TWO, more="    def stable(self, dt): self.note('stable')")
    bench = Bench.of(folder.both(), {"ndof": 1}, critical=True)
    bench.on()
    calls(bench)
    bench.illegal = True
    bench.step()
    assert calls(bench) == ["one.cycle", "two.stable"]


KEEPS = """
    def init(self):
        self.note("init")
        self.task.always_on_error(RuntimeError, self.mend)

    def mend(self, error):
        self.note("mend")
        return Handling.JUMP
"""


@pytest.mark.parametrize("method", ["on", "reinit", "off"])
def test_what_a_kept_handler_puts_right_goes_on_with_the_other_parts(folder, method):
    first, second = ("two", "one") if method == "off" else ("one", "two")
    folder.module(first, ONE if first == "one" else TWO, more=KEEPS)
    bench = folder.bench(f"{first}.FAILS {method}")
    calls(bench)
    bench.on()
    if method != "on":
        calls(bench)
        getattr(bench, method)()
    assert calls(bench) == [
        *(f"{first}.{method}", f"{first}.mend"),
        f"{second}.{method}",
    ]
    assert bench.state is (State.OFF if method == "off" else State.ON)


def test_when_the_next_part_fails_too_both_are_told(folder):
    folder.module("one", ONE, more=KEEPS)
    bench = folder.bench("one.FAILS on; two.FAILS on")
    with pytest.raises(MethodError) as caught:
        bench.on()
    assert str(caught.value) == (
        "both.two.on: RuntimeError: two fails in on; before that was corrected: "
        "both.one.on: RuntimeError: one fails in on"
    )
    assert bench.state is State.ERROR
    assert calls(bench)[2:] == [
        *("one.on", "one.mend"),
        *("two.on", "two.error", "one.off"),
    ]


def test_a_kept_handler_is_its_part_s_own(folder):
    folder.module("one", ONE, more=KEEPS)
    bench = folder.bench("two.FAILS cycle")
    bench.on()
    calls(bench)
    with pytest.raises(MethodError, match=r"both\.two\.cycle"):
        bench.step()
    assert calls(bench) == ["one.cycle", "two.cycle", "two.error", "one.off"]


def test_a_scope_within_a_part(folder):
    cycle = "with self.task.on_error(None) as s: self.task.fail('x'); self.y[:] = 9"
    folder.module("one", ONE, cycle)
    bench = folder.bench()
    bench.on()
    assert bench.step() is State.ON
    assert bench.outputs.z.tolist() == [0.0] * 3
    (notice,) = bench.notices()
    assert notice.handled
    assert bench.task.scopes == []
