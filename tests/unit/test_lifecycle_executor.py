"""What the executor does beside obeying the rules; these the oracle compares."""

from typing import Annotated as A

import numpy as np
import pytest

from pbonet import (
    Answer,
    InConst,
    InVar,
    OutConst,
    OutVar,
    Params,
    PortBasedObject,
    Signal,
    State,
    Vector,
    param,
)
from pbonet.errors import (
    DeclarationError,
    DeviceError,
    MethodError,
    ParameterError,
    PortError,
    StateError,
    SvarOwnerError,
)
from pbonet.node.executor import Executor
from pbonet.node.failures import refused
from pbonet.pbo import TaskFailure
from pbonet.testing import Bench


class Gain(Params):
    gain: A[float, param("none", "factor", ge=0, le=10)] = 1.0


class Scale(PortBasedObject[Gain]):
    """Multiply, and do what a test puts into the hooks."""

    ndof: A[int, InConst("NDOF", "1", "none", "size")]
    dim: A[int, OutConst("DIM", "1", "none", "size again")]
    x: A[Vector, InVar("X", "ndof", "m", "input")]
    y: A[Vector, OutVar("Y", "ndof", "m", "output")]
    level: A[float, OutVar("LEVEL", "1", "none", "how many cycles")]

    hooks = {}  # noqa: RUF012 - each test makes a class of its own

    def init(self):
        self.dim = self.ndof
        self.run("init")

    def on(self):
        return self.run("on")

    def cycle(self, dt):  # noqa: ARG002
        self.y[:] = self.params.gain * self.x
        self.level = self.level + 1
        self.run("cycle")

    def stable(self, dt):  # noqa: ARG002
        self.level = -1.0

    def off(self):
        self.run("off")

    def kill(self):
        self.run("kill")

    def sync(self):
        self.run("sync")

    def error(self, error):
        self.last = error
        return self.run("error") or Answer.ERROR

    def reinit(self):
        self.run("reinit")

    def set(self, name, value):  # noqa: ARG002
        self.run("set")

    def get(self, name):
        return 2 * getattr(self.params, name)

    def run(self, method):
        hook = self.hooks.get(method)
        return hook(self) if hook else None


def make(**hooks):
    made = type("Scale", (Scale,), {"hooks": hooks, "__module__": __name__})
    return Bench(made, ndof=2, name="scale")


def boom(_):
    raise ZeroDivisionError("division by zero")


def test_an_error_in_a_method_names_task_method_and_cause():
    bench = make(on=boom)
    with pytest.raises(MethodError) as caught:
        bench.on()
    error = caught.value
    assert str(error) == "scale.on: ZeroDivisionError: division by zero"
    assert f"{__file__}" in error.debug
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


def test_answers_that_cannot_be_given_are_errors():
    with pytest.raises(MethodError) as caught:
        make(on=lambda _: Answer.CONTINUE).on()
    assert str(caught.value) == (
        "scale.on: on gave an answer that it cannot give "
        "(expected None or Answer.OFF, got Answer.CONTINUE)"
    )
    with pytest.raises(MethodError, match=r"expected None or Answer.OFF, got True"):
        make(on=lambda _: True).on()
    bench = make(cycle=boom, error=lambda _: "OFF!")
    bench.on()
    bench.step(check=False)
    assert "Answer.OFF or Answer.CONTINUE or Answer.ERROR" in bench.task.errmsg
    assert bench.state is State.ERROR


def test_a_failed_init_kills_and_tells_both():
    with pytest.raises(MethodError) as caught:
        make(init=boom, kill=boom)
    assert str(caught.value) == (
        "scale.init: ZeroDivisionError: division by zero; "
        "scale.kill: ZeroDivisionError: division by zero"
    )


def test_a_task_is_created_once():
    bench = make()
    bench.kill()
    with pytest.raises(StateError, match="a task is created once"):
        bench.executor.spawn()


def test_a_non_finite_output_is_an_error_that_names_it():
    def poison(self):
        self.y[1] = np.nan

    bench = make(cycle=poison)
    bench.on()
    with pytest.raises(MethodError) as caught:
        bench.step()
    assert caught.value.what == (
        "an output is not a finite number: element 2 of Y; the table keeps its last "
        "values"
    )
    assert bench.outputs.y.tolist() == [0.0, 0.0]


def test_refused_flags_in_words():
    assert str(refused(8, ("", 0))).startswith("no whole set of inputs was had; ")
    assert str(refused(32 | 2, ("Y", 0))).startswith(
        "an output is outside its limits: element 1 of Y; "
    )


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


def test_a_module_turns_itself_off():
    bench = make(cycle=lambda self: self.task.signal(Signal.OFF, "done"))
    bench.on()
    assert bench.step(n=5) is State.OFF
    assert bench.task.cyclecount == 1
    assert bench.log[-4:] == ["out-vars out", "off", "out-vars out", "disown"]


def test_argument_and_handover_last_as_long_as_their_signal():
    seen = []

    def look(self):
        seen.append((self.task.arg, self.task.handover, self.task.nextstate))

    bench = make(on=look, off=look)
    bench.on("fast")
    bench.off(handover=True)
    assert seen == [("fast", False, State.ON), ("", True, State.OFF)]
    assert (bench.task.arg, bench.task.handover) == ("", False)


def test_the_state_while_a_method_runs():
    seen = []

    def look(self):
        seen.append((self.task.state, self.task.nextstate))

    bench = make(init=look, on=look, cycle=look, off=look, kill=look)
    bench.on()
    bench.step()
    bench.kill()
    assert seen == [
        (State.NOT_CREATED, State.OFF),
        (State.OFF, State.ON),
        (State.ON, State.ON),
        (State.ON, State.NOT_CREATED),
        (State.ON, State.NOT_CREATED),
    ]


def test_counts_begin_anew_when_the_task_is_turned_on():
    bench = make(cycle=lambda self: self.task.warn("hot"))
    bench.on()
    bench.step(n=3)
    assert (bench.task.cyclecount, bench.task.nwarnings) == (3, 3)
    bench.off()
    assert bench.task.nwarnings == 3
    bench.on()
    assert (bench.task.cyclecount, bench.task.nwarnings) == (0, 0)


def test_a_parameter_is_set_between_two_cycles():
    bench = make()
    bench.on()
    bench.inputs.x = [1.0, 2.0]
    bench.step()
    assert bench.set("GAIN", 3.0) == 3.0
    bench.step()
    assert bench.outputs.y.tolist() == [3.0, 6.0]
    assert bench.get("Gain") == 6.0


def test_a_parameter_out_of_bounds_changes_nothing():
    bench = make()
    with pytest.raises(ParameterError, match="scale: parameter gain is out of bounds"):
        bench.set("gain", 11.0)
    with pytest.raises(ParameterError, match="did you mean gain"):
        bench.get("gian")
    assert bench.module.params.gain == 1.0


def test_a_module_may_refuse_a_parameter():
    bench = make(set=boom)
    with pytest.raises(MethodError, match=r"^scale\.set: ZeroDivisionError"):
        bench.set("gain", 2.0)
    assert bench.module.params.gain == 1.0
    assert bench.state is State.OFF


def test_a_size_cannot_change_by_reinit():
    bench = make()
    bench.on()
    with pytest.raises(PortError) as caught:
        bench.reinit(ndof=3)
    assert caught.value.got == "3"
    assert bench.state is State.ON
    assert bench.module.ndof == 2, "the old constant stands"
    assert "reinit" not in bench.log
    bench.step()


def test_a_wrong_size_prevents_creation():
    def forget(self):
        self.dim = 7

    class Sized(Scale):
        z: A[Vector, InVar("Z", "dim", "m", "input of that size")]
        hooks = {"init": forget}  # noqa: RUF012

    with pytest.raises(MethodError, match="out-const DIM is not the size"):
        Bench(Sized, ndof=2, dim=4)


def test_on_is_refused_while_another_task_owns_an_output():
    bench = make()

    def taken():
        raise SvarOwnerError("other writes Y")

    bench.table.check_claim = taken
    bench.forget()
    with pytest.raises(SvarOwnerError, match="other writes Y"):
        bench.on()
    assert bench.state is State.OFF
    assert bench.log == [], "neither on nor error ran"


def test_stable_runs_in_place_of_cycle_while_the_flag_is_up():
    bench = Bench(Scale, ndof=2, critical=True)
    bench.on()
    bench.step()
    bench.illegal = True
    bench.step()
    assert bench.outputs.level == -1.0
    bench.illegal = False
    bench.step()
    assert bench.outputs.level == 0.0
    assert [name for name in bench.log if name in {"cycle", "stable"}] == [
        "cycle",
        "stable",
        "cycle",
    ]


def test_a_critical_task_needs_stable():
    class Bare(PortBasedObject):
        def cycle(self, dt):
            pass

    with pytest.raises(DeclarationError) as caught:
        Bench(Bare, critical=True)
    assert str(caught.value) == (
        "Bare: a CRITICAL task needs a module with stable(); write `def stable(self, "
        "dt: float) -> None`, or take CRITICAL out of the .rmod file"
    )


def test_the_law_of_an_ordinary_task_is_the_method_itself():
    bench = make()
    assert bench.executor.law == bench.module.cycle
    assert Executor.law.__doc__


def test_a_cycle_outside_on_is_refused():
    with pytest.raises(StateError, match="signal wakeup is not valid in state OFF"):
        make().step()


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


def test_a_kill_that_fails_behind_continue_ends_the_task():
    bench = make(off=boom, kill=boom, error=lambda _: Answer.CONTINUE)
    bench.on()
    with pytest.raises(MethodError, match=r"^scale\.kill: ZeroDivisionError"):
        bench.kill()
    assert bench.state is State.NOT_CREATED


def test_a_wrong_size_of_an_in_const_prevents_creation():
    bench = make()
    bench.table.globals["ndof"][...] = 5
    other = Executor(bench.module, bench.table)
    with pytest.raises(MethodError, match="in-const NDOF is not the size"):
        other.spawn()
    assert other.state is State.NOT_CREATED


def test_time_may_come_from_elsewhere():
    class Loop:
        """As a native loop counts."""

        now = 77
        cyclecount = 5

    bench = make(cycle=lambda self: seen.append(self.task.now))
    seen = []
    bench.task.source = Loop()
    executor = Executor(bench.module, bench.table)
    executor.spawn()
    executor.signal("on")
    executor.cycle(0.1, now=3)
    assert seen == [77]
    assert bench.task.cyclecount == 5
