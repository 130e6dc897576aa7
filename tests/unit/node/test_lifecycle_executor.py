"""What the executor does beside obeying the rules; these the oracle compares."""

from typing import Annotated as A

import pytest
from lifecycle_probe import Scale, boom, make

from pbonet import InVar, OutVar, Params, PortBasedObject, Signal, State, Vector, param
from pbonet.errors import (
    DeclarationError,
    MethodError,
    ParameterError,
    PortError,
    StateError,
    SvarOwnerError,
)
from pbonet.node.task.executor import Executor
from pbonet.pbo import describe
from pbonet.testing import Bench


def test_a_task_is_created_once():
    bench = make()
    bench.kill()
    with pytest.raises(StateError, match="a task is created once"):
        bench.executor.spawn()


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
    bench = make(cycle=lambda self: self.task.warn("hot", 5))
    bench.on()
    bench.step(n=3)
    assert (bench.task.cyclecount, bench.task.nwarnings) == (3, 3)
    bench.off()
    assert (bench.task.nwarnings, bench.task.errmsg, bench.task.errnum) == (3, "hot", 5)
    bench.on()
    assert (bench.task.cyclecount, bench.task.nwarnings) == (0, 0)
    assert (bench.task.errmsg, bench.task.errnum) == ("", 0)


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


class Limited(Params):
    """Parameters that may change in small steps only."""

    kp: A[float, param("N*m/rad", "stiffness", ge=0, rate=20)] = 100.0
    kd: A[tuple[float, float], param("none", "damping", rate=0.1)] = (0.2, 0.4)


class Stiff(PortBasedObject[Limited]):
    """A module whose parameters have a rate."""

    y: A[Vector, OutVar("Y", "2", "none", "result")]

    def cycle(self, dt: float) -> None:  # noqa: ARG002
        self.y[:] = self.params.kp


def test_a_step_larger_than_its_rate_is_refused_while_the_task_is_on():
    bench = Bench(Stiff)
    bench.set("kp", 10.0)
    bench.on()
    with pytest.raises(ParameterError) as caught:
        bench.set("kp", 31.0)
    assert str(caught.value) == (
        "bench: parameter kp changes too much at once (expected a step of at most 20 "
        "N*m/rad while the task is ON, got 21 N*m/rad, from 10 to 31); change it in "
        "several steps, or while the task is OFF"
    )
    assert bench.module.params.kp == 10.0
    for value in (30.0, 50.0, 31.0):
        assert bench.set("kp", value) == value
    with pytest.raises(ParameterError, match=r"at once \(value 2 of 2\)"):
        bench.set("kd", (0.3, 0.6))
    assert bench.set("kd", (0.3, 0.3)) == (0.3, 0.3), "0.4 - 0.3 is above 0.1 by a bit"
    bench.off()
    assert bench.set("kp", 500.0) == 500.0
    kp = describe(Stiff, name="stiff").params[0]
    assert kp.bounds == ">= 0 and steps <= 20 while ON"


@pytest.mark.parametrize(
    ("kind", "rate", "what"),
    [
        (float, 0.0, "a number above 0"),
        (str, 1.0, "a str has no bounds"),
        (tuple[float, ...], 1.0, "values that may become more or fewer have no rate"),
    ],
)
def test_a_rate_that_cannot_be_is_refused_at_class_creation(kind, rate, what):
    with pytest.raises(DeclarationError, match=what):
        type(
            "Wrong",
            (Params,),
            {"__annotations__": {"k": A[kind, param("m", "gain", rate=rate)]}},
        )


def test_a_module_may_refuse_a_parameter():
    bench = make(set=boom)
    with pytest.raises(MethodError, match=r"^scale\.set: ZeroDivisionError") as caught:
        bench.set("gain", 2.0)
    assert caught.value.remedy == "the old value of gain remains"
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
        "Bare: a CRITICAL task needs a module with stable() (expected stable(), or a "
        "safe value of each out-var); write `def stable(self, dt: float) -> None`, or "
        "take CRITICAL out of the .rmod file"
    )


def test_the_time_of_a_cycle_is_its_release():
    bench = make(cycle=lambda self: seen.append(self.task.now))
    seen = []
    bench.on()
    bench.executor.cycle(0.1, now=3)
    assert seen == [3]
    assert bench.task.now == bench.clock.now_ns, "between cycles it is the clock's"


def test_a_cycle_outside_on_is_refused():
    with pytest.raises(StateError, match="signal wakeup is not valid in state OFF"):
        make().step()


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
