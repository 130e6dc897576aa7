"""What becomes of failures, and how they are told."""

import numpy as np
import pytest
from lifecycle_probe import Scale, boom, make

from pbonet import Answer, Signal, State
from pbonet.errors import DeviceError, MethodError, SvarError
from pbonet.node.task.step_failures import refused
from pbonet.pbo import TaskFailure
from pbonet.svar.guards import Blamed
from pbonet.testing import Bench


def test_an_error_in_a_method_names_task_method_and_cause():
    bench = make(on=boom)
    with pytest.raises(MethodError) as caught:
        bench.on()
    error = caught.value
    assert str(error) == "scale.on: ZeroDivisionError: division by zero"
    assert "lifecycle_probe.py" in error.debug
    assert "in boom" in error.debug
    assert isinstance(error.__cause__, ZeroDivisionError)
    assert bench.task.errmsg == str(error)
    assert bench.task.errnum == 1
    assert bench.executor.failure is error or str(bench.executor.failure) == str(error)
    assert isinstance(bench.module.last, ZeroDivisionError)


def test_the_master_is_told_that_a_task_is_in_error():
    bench = make(cycle=boom)
    bench.on()
    bench.step(check=False)
    (notice,) = bench.notices()
    assert notice.bits == Signal.ERROR
    assert notice.text == "scale.cycle: ZeroDivisionError: division by zero"


def test_a_failure_with_parts_keeps_them():
    def no_device(_):
        raise DeviceError("no ball", expected="/dev/ball", got="nothing", remedy="plug")

    with pytest.raises(MethodError) as caught:
        make(on=no_device).on()
    assert str(caught.value) == (
        "scale.on: no ball (expected /dev/ball, got nothing); plug"
    )
    assert "in no_device" in caught.value.debug


@pytest.mark.parametrize(
    ("said", "told"),
    [
        ("slip", "; of its inputs, X[1] is no finite number"),
        ("X_REF and X^ slip", "; of its inputs, X[1] is no finite number"),
        ("X is wrong", ""),
    ],
)
def test_an_error_names_inputs_that_are_no_numbers_if_it_does_not(said, told):
    bench = make(cycle=lambda self: self.task.fail(said))
    bench.on()
    bench.inputs.x = [1.0, np.inf]
    bench.step(check=False)
    assert str(bench.executor.failure) == f"scale.cycle: {said}{told}"
    assert bench.task.errmsg == f"scale.cycle: {said}{told}"
    assert bench.notices()[0].text == f"scale.cycle: {said}{told}"


def test_fail_carries_text_and_number():
    bench = make(cycle=lambda self: self.task.fail("slip", 42))
    bench.on()
    with pytest.raises(MethodError, match=r"^scale\.cycle: slip$"):
        bench.step()
    assert bench.task.errnum == 42
    assert isinstance(bench.module.last, MethodError)
    assert bench.log.count("error") == 1


def test_sys_exit_in_a_module_ends_nothing():
    def leave(_):
        raise SystemExit(3)

    bench = make(cycle=leave)
    bench.on()
    with pytest.raises(MethodError, match="SystemExit: 3"):
        bench.step()
    assert bench.state is State.ERROR


def test_a_read_only_input_gives_a_remedy():
    def write(self):
        self.x[0] = 1.0

    bench = make(cycle=write)
    bench.on()
    with pytest.raises(MethodError, match="inputs are written by their producers"):
        bench.step()


def test_an_error_in_error_is_told_too():
    bench = make(cycle=boom, error=lambda _: 1 / 0)
    bench.on()
    bench.step(check=False)
    assert bench.state is State.ERROR
    assert bench.task.errmsg == (
        "scale.cycle: ZeroDivisionError: division by zero; and then "
        "scale.error: ZeroDivisionError: division by zero"
    )


def slip(self):
    self.task.fail("slip")


@pytest.mark.parametrize("cycle", [boom, slip])
@pytest.mark.parametrize("error", [boom, slip])
def test_a_failure_is_not_hidden_by_one_in_error(cycle, error):
    bench = make(cycle=cycle, error=error)
    bench.on()
    with pytest.raises(MethodError, match=r"^scale\.cycle: .* then scale\.error: "):
        bench.step()
    assert bench.log.count("error") == 1


def test_error_is_asked_about_each_failure():
    def twice(self):
        slip(self)
        slip(self)

    bench = make(cycle=twice, error=lambda _: Answer.CONTINUE)
    bench.on()
    assert bench.step() is State.ON
    assert bench.log.count("error") == 2
    assert bench.log[-1] == "out-vars out"


def test_a_failure_of_stable_says_so():
    def broken(self, dt):  # noqa: ARG001
        raise ZeroDivisionError

    made = type("Scale", (Scale,), {"stable": broken, "__module__": __name__})
    bench = Bench(made, ndof=2, critical=True)
    bench.on()
    bench.illegal = True
    with pytest.raises(MethodError, match=r"^bench\.stable: ZeroDivisionError"):
        bench.step()


def test_answers_that_cannot_be_given_are_errors():
    with pytest.raises(MethodError) as caught:
        make(on=lambda _: Answer.CONTINUE).on()
    assert str(caught.value) == (
        "scale.on: on returned an invalid answer "
        "(expected None or Answer.OFF, got Answer.CONTINUE); correct what it returns"
    )
    with pytest.raises(MethodError, match=r"expected None or Answer.OFF, got True"):
        make(on=lambda _: True).on()
    for other in ("OFF", [], {}):
        with pytest.raises(MethodError, match=r"on returned an invalid answer"):
            make(on=lambda _, other=other: other).on()
    bench = make(cycle=boom, error=lambda _: "OFF!")
    bench.on()
    bench.step(check=False)
    assert "Answer.OFF or Answer.CONTINUE or Answer.ERROR" in bench.task.errmsg
    assert bench.state is State.ERROR


def test_a_failed_init_kills_and_tells_both():
    with pytest.raises(MethodError) as caught:
        make(init=boom, kill=boom)
    assert str(caught.value) == (
        "scale.init: ZeroDivisionError: division by zero; and then "
        "scale.kill: ZeroDivisionError: division by zero"
    )


def test_a_non_finite_output_is_an_error_that_names_it():
    def poison(self):
        self.y[1] = np.nan

    bench = make(cycle=poison)
    bench.on()
    with pytest.raises(MethodError) as caught:
        bench.step()
    assert caught.value.what == (
        "an output is not a finite number: Y[1] (got nan); the table keeps its last "
        "values: find the cause in the module"
    )
    assert bench.outputs.y.tolist() == [0.0, 0.0]


def test_outputs_that_are_refused_behind_on_are_not_owned():
    def poison(self):
        self.y[1] = np.nan

    bench = make(on=poison, error=lambda _: Answer.OFF)
    with pytest.raises(MethodError, match=r"not a finite number: Y\[1\]"):
        bench.on()
    assert bench.state is State.OFF
    assert not bench.table.owned


def test_refused_flags_in_words():
    assert str(refused(8, Blamed())).startswith(
        "no consistent set of inputs could be copied; "
    )
    assert str(refused(32 | 2, Blamed("Y", 0, "73.2", "-50.0 to 50.0 N"))) == (
        "an output is outside its limits: Y[0] (expected -50.0 to 50.0 N, got 73.2); "
        "the table keeps its last values: bound it in the module, or set LIMIT clip in "
        "the .svar file"
    )


def test_a_task_that_owns_nothing_gives_nothing_up():
    bench = make(on=boom, error=lambda _: Answer.OFF)
    with pytest.raises(MethodError):
        bench.on()
    assert bench.log[-2:] == ["on", "error"]


def test_what_a_native_loop_raises_is_handed_in():
    bench = make(error=lambda _: Answer.OFF)
    bench.on()
    assert bench.executor.fault(ValueError("from the loop")) is State.OFF
    assert bench.task.errmsg == "scale.cycle: ValueError: from the loop"
    assert not bench.table.owned


def test_a_failure_whose_error_was_asked_is_not_asked_again():
    bench = make(cycle=lambda self: self.task.fail("slip"))
    bench.on()
    with pytest.raises(TaskFailure) as caught:
        bench.module.cycle(0.1)
    assert bench.log.count("error") == 1
    assert bench.executor.fault(caught.value) is State.ERROR
    assert bench.log.count("error") == 1


def test_a_failure_of_sync_says_so():
    bench = make(sync=boom)
    bench.on()
    assert bench.sync() is State.ERROR
    assert bench.task.errmsg.startswith("scale.sync: ")


def test_what_fails_again_behind_continue_ends_in_error():
    def poison(self):
        self.y[0] = np.inf

    bench = make(off=poison, error=lambda _: Answer.CONTINUE)
    bench.on()
    with pytest.raises(MethodError, match="an output is not a finite number"):
        bench.off()
    assert bench.state is State.ERROR
    assert not bench.table.owned
    assert bench.log[-4:] == ["out-vars out", "error", "out-vars out", "disown"]


@pytest.mark.parametrize("answer", [Answer.OFF, Answer.ERROR, None])
def test_no_answer_saves_a_task_from_kill(answer):
    seen = []

    def last(self):
        seen.append((self.y.tolist(), self.task.nextstate))

    def off(self):
        self.y[:] = 7
        self.task.fail("no")

    bench = make(off=off, kill=last, error=lambda _: answer)
    bench.on()
    with pytest.raises(MethodError) as caught:
        bench.kill()
    assert str(caught.value) == ("scale.off: no; the task has ended anyway")
    assert bench.state is State.NOT_CREATED
    assert bench.log[-4:] == ["off", "error", "disown", "kill"]
    assert seen == [([7.0, 7.0], State.NOT_CREATED)]
    assert bench.outputs.y.tolist() == [0.0, 0.0], "what off left is discarded"
    assert Signal.ERROR not in Signal(bench.task.signals), "it never was in ERROR"


@pytest.mark.parametrize("off", [None, boom])
def test_error_is_not_asked_about_kill(off):
    bench = make(off=off, kill=lambda self: self.task.fail("no"))
    bench.on()
    bench.forget()
    with pytest.raises(MethodError, match=r"scale\.kill: no"):
        bench.kill()
    assert bench.state is State.NOT_CREATED
    assert bench.log.count("error") == (1 if off else 0)


def test_kill_knows_that_init_has_failed():
    seen = []
    with pytest.raises(MethodError):
        make(init=boom, kill=lambda self: seen.append(self.task.nextstate))
    assert seen == [State.NOT_CREATED]


def test_a_kill_whose_methods_all_fail_tells_all():
    bench = make(off=boom, error=boom, kill=boom)
    bench.on()
    with pytest.raises(MethodError) as caught:
        bench.kill()
    why = "ZeroDivisionError: division by zero"
    assert str(caught.value) == (
        f"scale.off: {why}; and then scale.error: {why}; and then scale.kill: {why}; "
        "the task has ended anyway"
    )
    assert bench.state is State.NOT_CREATED


def test_outputs_that_cannot_be_written_do_not_stop_a_kill():
    def poison(self):
        self.y[0] = np.inf

    bench = make(off=poison, error=lambda _: Answer.CONTINUE)
    bench.on()
    with pytest.raises(MethodError, match=r"not a finite number.*has ended anyway"):
        bench.kill()
    assert bench.state is State.NOT_CREATED
    assert bench.log[-5:] == ["out-vars out", "error", "out-vars out", "disown", "kill"]


def test_a_table_that_does_not_let_go_does_not_keep_a_task_on():
    def stuck():
        raise SvarError("the table is stuck")

    bench = make(cycle=boom)
    bench.table.release = stuck
    bench.on()
    with pytest.raises(MethodError, match=r"then scale\.disown: the table is stuck"):
        bench.step()
    assert bench.state is State.ERROR


def test_in_consts_that_are_not_had_leave_the_old_ones():
    bench = make(error=lambda _: Answer.OFF)

    def lost():
        bench.table.local["ndof"][...] = 99
        return 8

    bench.table.copy_in_consts = lost
    with pytest.raises(MethodError, match="no consistent set of inputs"):
        bench.reinit()
    assert bench.module.ndof == 2


def test_a_kill_that_fails_behind_continue_ends_the_task():
    bench = make(off=boom, kill=boom, error=lambda _: Answer.CONTINUE)
    bench.on()
    with pytest.raises(MethodError, match=r"^scale\.kill: ZeroDivisionError"):
        bench.kill()
    assert bench.state is State.NOT_CREATED


@pytest.mark.parametrize("answer", [Answer.ERROR, Answer.OFF])
def test_constants_that_were_not_taken_in_are_before_the_task_comes_on(answer):
    """Section 3.5: all tasks deal with the same constants always."""
    willing = []

    def reinit(_):
        if not willing:
            raise ValueError("no such tool")

    bench = make(reinit=reinit, error=lambda _: answer)
    bench.on()
    for again in (bench.reinit, bench.on, bench.on):
        with pytest.raises(
            MethodError, match=r"^scale\.reinit: ValueError: no such to"
        ):
            again()
        if answer is Answer.ERROR:
            assert bench.clear() is State.OFF
    willing.append(True)
    before = len(bench.log)
    assert bench.on() is State.ON
    assert bench.log[before : before + 3] == [
        "in-consts in",
        "reinit",
        "out-consts out",
    ]
    bench.off()
    before = len(bench.log)
    bench.on()
    assert "reinit" not in bench.log[before:], "once is enough"
