"""What a module can and cannot do with its ports."""

from typing import Annotated as A

import msgspec
import numpy as np
import pytest

from pbonet import (
    InConst,
    InVar,
    Matrix,
    OutConst,
    OutVar,
    Params,
    PortBasedObject,
    Vector,
)
from pbonet.errors import DeclarationError, ParameterError, PortError
from pbonet.pbo import TaskContext, bind, check_sizes, memory
from pbonet.ports import Kind


class Law(PortBasedObject):
    ndof: A[int, InConst("NDOF", "1", "none", "degrees of freedom")]
    gain: A[float, InVar("GAIN", "1", "none", "a gain")]
    q: A[Vector, InVar("Q", "ndof", "rad", "position")]
    dh: A[Matrix, InConst("DH", "ndof,4", "none", "geometry")]
    tau: A[Vector, OutVar("T", "ndof", "N*m", "torque")]
    level: A[float, OutVar("LEVEL", "1", "none", "a level")]
    count: A[int, OutVar("COUNT", "1", "none", "a count")]
    ok: A[bool, OutVar("OK", "1", "none", "a flag")]

    def cycle(self, dt):
        self.tau += dt

    def rebind(self, x):
        self.tau = 2 * x


def arrays(**changed):
    given = {
        "ndof": np.array([2], "<i4"),
        "gain": np.array([0.5], "<f4"),
        "q": np.array([1.0, 2.0]),
        "dh": np.arange(8.0),
        "tau": np.zeros(2),
        "level": np.zeros(1),
        "count": np.zeros(1, "<i2"),
        "ok": np.zeros(1, "?"),
    }
    return {**given, **changed}


@pytest.fixture
def law():
    return bind(Law, Params(), arrays(), TaskContext())


def test_ports_are_views_of_the_local_copies():
    local = arrays()
    law = bind(Law, Params(), local, TaskContext("law"))
    local["q"][:] = 5.0
    law.tau[0] = 3.0
    assert law.q.tolist() == [5.0, 5.0]
    assert local["tau"].tolist() == [3.0, 0.0]
    assert law.dh.shape == (2, 4)
    assert np.shares_memory(law.dh, local["dh"])
    assert law.task.name == "law"


def test_scalars_are_plain_numbers(law):
    assert type(law.ndof) is int
    assert type(law.gain) is float
    assert type(law.ok) is bool
    law.level = 1.5
    law.count += 3
    law.ok = True
    local = memory(law).arrays
    assert local["level"][0] == 1.5
    assert local["count"][0] == 3
    assert local["ok"][0]


def test_numpy_numbers_can_be_assigned_to_scalars(law):
    law.level = np.float32(0.25)
    law.count = np.int64(7)
    assert (law.level, law.count) == (0.25, 7)


def test_in_place_operators_are_no_rebinding(law):
    before = law.tau
    law.cycle(0.5)
    law.tau *= 4.0
    assert law.tau is before
    assert law.tau.tolist() == [2.0, 2.0]


def test_ordinary_attributes_are_free(law):
    law.integral = np.zeros(2)
    law.integral = law.integral + 1.0
    assert law.integral.tolist() == [1.0, 1.0]


def test_rebinding_shows_the_wrong_and_the_right_line(law):
    with pytest.raises(PortError) as caught:
        law.rebind(law.q)
    assert str(caught.value) == (
        "Law.tau: out-var T is bound once; assign to its elements "
        "(expected `self.tau[:] = 2 * x`, got `self.tau = 2 * x`)"
    )


def test_rebinding_without_source_shows_a_line_all_the_same(law):
    with pytest.raises(PortError, match=r"expected `self.tau\[:\] = ...`"):
        eval("law.__setattr__('tau', 1)", {"law": law})  # noqa: S307


def test_deleting_is_rebinding(law):
    with pytest.raises(PortError, match="is bound once"):
        del law.tau


def test_an_input_is_not_assigned(law):
    with pytest.raises(PortError) as caught:
        law.q = np.zeros(2)
    assert str(caught.value) == (
        "Law.q: in-var Q is written by its producer only "
        "(got `law.q = np.zeros(2)`); take a copy under another name: "
        "`q = self.q.copy()`"
    )
    with pytest.raises(PortError, match=r"another name: `gain = self.gain`"):
        law.gain = 2.0


def test_an_input_is_read_only(law):
    with pytest.raises(ValueError, match="read-only"):
        law.q[0] = 1.0
    with pytest.raises(ValueError, match="read-only"):
        law.dh += 1.0


MISTYPED = [
    (
        "count",
        1.5,
        "takes a plain int (expected int, got float 1.5); convert it: `round(x)`, or "
        "`int(x)` to cut",
    ),
    (
        "count",
        40_000,
        "takes a plain int (expected int, got int 40000); it does not fit the type of "
        "the variable in the .svar file",
    ),
    ("level", "a", "takes a plain float (expected float, got str 'a')"),
    (
        "level",
        [1.0],
        "takes a plain float (expected float, got list [1.0]); assign one number, such "
        "as `float(x[0])`",
    ),
    (
        "level",
        np.zeros(2),
        "takes a plain float (expected float, got ndarray array([0., 0.])); "
        "assign one number, such as `float(x[0])`",
    ),
]


@pytest.mark.parametrize(("attr", "value", "sentence"), MISTYPED)
def test_a_scalar_takes_its_own_type(law, attr, value, sentence):
    with pytest.raises(PortError) as caught:
        setattr(law, attr, value)
    assert str(caught.value) == f"Law.{attr}: out-var {attr.upper()} {sentence}"


def refused(**changed):
    given = arrays(**changed)
    kept = {attr: array for attr, array in given.items() if array is not None}
    with pytest.raises(PortError) as caught:
        bind(Law, Params(), kept, TaskContext())
    return str(caught.value)


def test_arrays_must_be_those_of_the_ports():
    assert refused(q=None) == (
        "Law: the arrays are not those of the module's ports (expected count, dh, "
        "gain, level, ndof, ok, q, tau, got count, dh, gain, level, ndof, ok, tau)"
    )


def test_arrays_must_have_the_ports_types():
    assert refused(q=np.zeros(2, "<f4")) == (
        "Law: the variable of port q (Q) has another type (expected double, got "
        "float32); correct TYPE in the .svar file, or the port's annotation"
    )
    assert "expected an integer type, got float64" in refused(ndof=np.zeros(1))


def test_arrays_must_have_one_size():
    assert "disagree about the size ndof" in refused(q=np.zeros(3))


def test_arrays_must_be_contiguous():
    assert "the memory of port q (Q) has gaps" in refused(q=np.zeros(4)[::2])


def test_parameters_must_be_the_modules_own():
    class Own(Params):
        pass

    class Other(PortBasedObject[Own]):
        def cycle(self, dt):
            pass

    with pytest.raises(ParameterError) as caught:
        bind(Other, Params(), {}, TaskContext())
    assert str(caught.value) == (
        "Other: the parameters are of another class (expected Own, got Params)"
    )


def test_an_abstract_module_cannot_run():
    class Half(PortBasedObject, abstract=True):
        pass

    with pytest.raises(DeclarationError, match="Half: an abstract module cannot run"):
        bind(Half, Params(), {}, TaskContext())


def test_a_constant_that_is_a_size_is_compared_with_the_ports(law):
    check_sizes(law, Kind.INCONST)
    memory(law).arrays["ndof"][0] = 3
    with pytest.raises(PortError) as caught:
        check_sizes(law, Kind.INCONST)
    assert str(caught.value) == (
        "Law.ndof: in-const NDOF is not the size of the ports that it names (expected "
        "2, as Q and DH and T have, got 3); correct NELEM in the .svar file; a task "
        "that runs must be killed and spawned again to have another size"
    )
    check_sizes(law, Kind.OUTCONST)


class Gives(PortBasedObject):
    ndof: A[int, OutConst("NDOF", "1", "degrees of freedom", value=2)]
    far: A[bool, OutConst("FAR", "1", "none", "a flag", value=True)]
    tool: A[Vector, OutConst("TOOL", "ndof", "m", "each the same", value=0.5)]
    dh: A[Matrix, OutConst("DH", "ndof,2", "m", "geometry", value=(1, 2, 3, 4))]

    def cycle(self, dt):
        pass


def test_a_constant_has_the_value_that_its_class_declares():
    local = {
        "ndof": np.zeros(1, "<i4"),
        "far": np.zeros(1, "?"),
        "tool": np.zeros(2),
        "dh": np.zeros(4),
    }
    gives = bind(Gives, Params(), local, TaskContext())
    assert (gives.ndof, gives.far) == (2, True)
    assert gives.tool.tolist() == [0.5, 0.5]
    assert gives.dh.tolist() == [[1.0, 2.0], [3.0, 4.0]]
    check_sizes(gives, Kind.OUTCONST)
    for port in Gives.__interface__.ports:
        sent = msgspec.msgpack.encode(port)
        assert msgspec.msgpack.decode(sent, type=type(port)).value == port.value
    local |= {"tool": np.zeros(3), "dh": np.zeros(6)}
    with pytest.raises(PortError, match=r"value of out-const DH .*or 6.*got 4 numbers"):
        bind(Gives, Params(), local, TaskContext())


@pytest.mark.parametrize(
    ("kind", "shape", "value", "what"),
    [
        (int, "1", 2.5, "a whole number"),
        (int, "1", "two", "a whole number"),
        (np.uint8, "1", 300, "a whole number from 0 to 255"),
        (bool, "1", 2.5, "True or False"),
        (float, "1", float("inf"), "a finite number"),
        (Vector, "3", (1.0, 2.0), "one for each element"),
    ],
)
def test_a_value_that_the_constant_cannot_have(kind, shape, value, what):
    with pytest.raises(DeclarationError, match=f"value is no value of .*{what}"):

        class Wrong(PortBasedObject):
            x: A[kind, OutConst("X", shape, "m", "x", value=value)]

            def cycle(self, dt):
                pass
