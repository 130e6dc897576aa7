"""The bench that authors of modules test with, and its clock."""

from typing import Annotated as A

import numpy as np
import pytest
from numpy.typing import NDArray

from pbonet import (
    Answer,
    InConst,
    InVar,
    Matrix,
    OutConst,
    OutVar,
    Params,
    PortBasedObject,
    State,
    Vector,
    param,
)
from pbonet.errors import MethodError, ParameterError, PortError, StateError
from pbonet.pbo import Signal
from pbonet.testing import Bench, FakeClock


class Gains(Params):
    kp: A[float, param("N*m/rad", "stiffness", ge=0)]


class Hold(PortBasedObject[Gains]):
    ndof: A[int, InConst("NDOF", "1", "none", "degrees of freedom")]
    dh: A[Matrix, InConst("DH", "ndof,4", "none", "geometry")]
    q_ref: A[Vector, InVar("Q_REF", "ndof", "rad", "reference")]
    q: A[Vector, InVar("Q_MEZ", "ndof", "rad", "position")]
    tau: A[Vector, OutVar("T_REF", "ndof", "N*m", "torque")]
    age: A[float, OutVar("AGE", "1", "s", "time since on")]
    done: A[bool, OutVar("DONE", "1", "none", "whether it is there")]

    def init(self):
        self.began = 0

    def on(self):
        self.age = 0.0
        self.began = self.task.now

    def cycle(self, dt):
        self.tau[:] = self.params.kp * (self.q_ref - self.q)
        self.age += dt
        self.done = bool(abs(self.tau).max() < 0.01)
        self.times = (self.task.now - self.began, self.task.cyclecount)

    def reinit(self):
        self.began = -self.ndof


def bench(**values):
    given = {"ndof": 2, "dh": 0.0, **values}
    return Bench(Hold, given, params=Gains(kp=10.0), freq=500.0)


def test_a_step_copies_in_runs_and_copies_out():
    hold = bench()
    hold.on()
    hold.inputs.q_ref = [0.1, 0.0]
    assert hold.outputs.tau.tolist() == [0.0, 0.0]
    assert hold.step() is State.ON
    assert hold.outputs.tau.tolist() == [1.0, 0.0]


def test_a_module_sees_inputs_only_when_they_are_copied_in():
    hold = bench()
    hold.inputs.q = [1.0, 2.0]
    assert hold.module.q.tolist() == [0.0, 0.0]
    hold.on()
    assert hold.module.q.tolist() == [1.0, 2.0]
    hold.inputs.q[0] = 5.0
    assert hold.module.q.tolist() == [1.0, 2.0]


def test_outputs_appear_only_when_they_are_copied_out():
    hold = bench()
    hold.on()
    hold.module.tau[:] = 7.0
    assert hold.outputs.tau.tolist() == [0.0, 0.0]
    hold.off()
    assert hold.outputs.tau.tolist() == [7.0, 7.0]


def test_on_finds_what_the_last_writer_left():
    hold = bench(tau=[3.0, 4.0])
    hold.on()
    assert hold.module.tau.tolist() == [3.0, 4.0]


def test_virtual_time():
    hold = bench()
    hold.on()
    hold.step(n=3)
    assert hold.outputs.age == pytest.approx(0.006)
    assert hold.module.times == (6_000_000, 2)
    hold.step(0.1)
    assert hold.module.times == (106_000_000, 3)
    assert hold.clock.now_ns == 1_106_000_000


def test_two_benches_share_a_clock():
    clock = FakeClock(0)
    one = Bench(Hold, {"ndof": 1, "dh": 0.0}, params={"kp": 1.0}, clock=clock)
    one.on()
    one.step(0.25)
    assert clock() == 250_000_000
    assert clock.advance(0.75) == 1_000_000_000
    with pytest.raises(ValueError, match="time does not go back"):
        clock.advance(-0.1)


def test_the_log_names_copies_and_methods_in_order():
    hold = bench()
    assert hold.log == ["in-consts in", "init", "out-consts out"]
    hold.forget()
    hold.on()
    hold.step()
    hold.off()
    hold.kill()
    assert hold.log == [
        *("in-vars and out-vars in", "on", "out-vars out, own"),
        *("in-vars in", "cycle", "out-vars out"),
        *("off", "out-vars out", "disown"),
        "kill",
    ]


def test_ports_by_attribute_and_by_name():
    hold = bench()
    hold["Q_MEZ"] = [1.0, 2.0]
    assert hold.inputs.q.tolist() == [1.0, 2.0]
    assert hold["NDOF"] == 2
    assert hold.outputs.done is False
    assert dir(hold.outputs) == ["age", "done", "tau"]


def test_a_scalar_is_spread_over_an_array():
    hold = bench()
    hold.inputs.q = 3
    assert hold.inputs.q.tolist() == [3.0, 3.0]


REFUSED = [
    (
        lambda b: b.inputs.q_rf,
        "the module has no input q_rf (expected ndof, dh, q_ref, q); did you mean "
        "q_ref?",
    ),
    (
        lambda b: setattr(b.outputs, "q", 1),
        "the module has no output q (expected tau, age, done)",
    ),
    (
        lambda b: b["T_RF"],
        "the module has no port T_RF (expected NDOF, DH, Q_REF, Q_MEZ, T_REF, AGE, "
        "DONE); did you mean T_REF?",
    ),
]


@pytest.mark.parametrize(("act", "sentence"), REFUSED)
def test_an_unknown_port_is_refused(act, sentence):
    hold = bench()
    with pytest.raises(PortError) as caught:
        act(hold)
    assert str(caught.value) == sentence


@pytest.mark.parametrize("value", [[1.0, 2.0, 3.0], "fast", 1j])
def test_a_value_that_does_not_fit_is_refused(value):
    hold = bench()
    with pytest.raises(PortError) as caught:
        hold.inputs.q = value
    assert str(caught.value).startswith(
        "the value does not fit port q (Q_MEZ) (expected float64 of shape (2,), got "
    )


def test_sizes_follow_from_values():
    hold = Bench(Hold, params={"kp": 1.0}, dh=np.ones((3, 4)))
    assert hold.module.ndof == 3
    assert hold.inputs.q.shape == (3,)
    assert hold.module.dh.tolist() == [[1.0] * 4] * 3


def test_what_is_missing_is_said():
    with pytest.raises(PortError) as caught:
        Bench(Hold, params={"kp": 1.0}, ndof=2)
    assert str(caught.value) == (
        "Bench: in-const DH has no value; say `dh=...` when you make the bench"
    )
    with pytest.raises(PortError, match=r"the size of port dh .* cannot be known"):
        Bench(Hold, params={"kp": 1.0})
    with pytest.raises(PortError, match=r"no port and no size dof .*did you mean ndof"):
        bench(dof=3)
    with pytest.raises(ParameterError, match="needs parameter kp"):
        Bench(Hold, ndof=2, dh=0.0)


def test_a_constant_changes_with_reinit():
    hold = bench()
    hold.reinit(dh=2.0)
    assert hold.module.dh[0, 0] == 2.0
    assert hold.module.began == -2


def test_a_parameter_is_set_and_got():
    hold = bench()
    assert hold.set("kp", 2.5) == 2.5
    assert hold.get("kp") == 2.5


class Odd(PortBasedObject):
    raw: A[NDArray[np.void], InVar("RAW", "n", "none", "structures")]
    dim: A[int, OutConst("DIM", "1", "none", "a constant")]
    freq: A[float, OutVar("FREQ_OUT", "1", "Hz", "named like an argument")]

    def init(self):
        self.dim = 3

    def on(self):
        return Answer.OFF if self.task.arg == "wait" else None

    def cycle(self, dt):
        self.freq = 1 / dt
        if self.raw["a"][0] < 0:
            self.task.fail("negative", 5)
        self.task.warn("cycled")

    def sync(self):
        self.synced = True

    def error(self, error):
        return Answer.OFF if "negative" in str(error) else Answer.ERROR

    def clear(self):
        return Answer.ERROR


RAW = np.zeros(2, [("a", "<i4"), ("b", "<f4")])


def test_structures_need_their_type():
    odd = Bench(Odd, raw=RAW)
    odd.on()
    odd.inputs.raw["a"] = 7
    odd.step()
    assert odd.module.raw["a"].tolist() == [7, 7]
    with pytest.raises(
        PortError, match=r"RAW is a structure of unknown size; say `raw="
    ):
        Bench(Odd, n=2)


def test_ports_that_are_named_like_an_argument():
    odd = Bench(Odd, {"freq": 50.0}, raw=RAW, freq=10.0)
    assert odd.outputs.freq == 50.0
    odd.on()
    odd.step()
    assert odd.outputs.freq == 10.0


def test_constants_come_out_behind_init():
    assert Bench(Odd, raw=RAW).outputs.dim == 3


def test_signals_and_answers():
    odd = Bench(Odd, raw=RAW)
    assert odd.on("wait") is State.OFF
    assert odd.on() is State.ON
    assert odd.sync() is State.ON
    assert odd.module.synced
    odd.step(n=2)
    assert [notice.text for notice in odd.notices()] == ["cycled", "cycled"]
    odd.inputs.raw["a"] = -1
    assert odd.step(n=10) is State.OFF
    assert odd.task.cyclecount == 3
    assert not odd.notices()


def test_a_failing_cycle_raises_unless_told_not_to():
    odd = Bench(Odd, raw=RAW)
    odd.on()
    with pytest.raises(MethodError, match=r"^bench\.cycle: ZeroDivisionError"):
        odd.step(0.0)
    assert odd.state is State.ERROR
    assert odd.clear() is State.ERROR
    assert [notice.bits for notice in odd.notices()] == [Signal.ERROR]
    other = Bench(Odd, raw=RAW)
    other.on()
    assert other.step(0.0, check=False) is State.ERROR


def test_the_block_kills():
    with Bench(Odd, raw=RAW) as odd:
        odd.on()
    assert odd.state is State.NOT_CREATED
    assert odd.log[-4:] == ["off", "out-vars out", "disown", "kill"]
    with Bench(Odd, raw=RAW) as killed:
        killed.kill()
    with pytest.raises(StateError):
        killed.on()


class Draws(PortBasedObject):
    y: A[float, OutVar("Y", "1", "none", "noise")]

    def cycle(self, dt):
        self.y = dt + float(self.task.rng.normal())


def test_numbers_that_are_drawn_follow_from_the_seed():
    def drawn(**more):
        one = Bench(Draws, **more)
        one.on()
        return [one.step() and one.outputs.y for _ in range(3)]

    assert drawn() == drawn(seed=0)
    assert drawn(seed=7) == drawn(seed=7) != drawn()
