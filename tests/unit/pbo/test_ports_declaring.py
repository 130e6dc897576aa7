"""How ports are declared: what is refused, with the whole sentence."""

from pathlib import Path
from typing import Annotated as A, Any

import numpy as np
import pytest
from numpy.typing import NDArray

from pbonet import (
    InConst,
    InVar,
    Matrix,
    OutConst,
    OutVar,
    PortBasedObject,
    Vector,
)
from pbonet.errors import DeclarationError
from pbonet.pbo import interface
from pbonet.ports import Kind, Port, accepts, wanted

HERE = Path(__file__)


def line_of(text):
    """Return the number of the first line that contains `text` and no quotes of it."""
    lines = HERE.read_text().splitlines()
    return next(n for n, line in enumerate(lines, 1) if line.strip().startswith(text))


class Idle:
    def cycle(self, dt):
        pass


def test_ports_are_read_from_the_annotations_in_order():
    class Arm(Idle, PortBasedObject):
        ndof: A[int, InConst("NDOF", "1", "none", "degrees of freedom")]
        dh: A[Matrix, OutConst("DH", "ndof,4", "none", "geometry")]
        q: A[Vector, InVar("Q_MEZ", "ndof", "rad", "position")]
        ok: A[bool, OutVar("OK", "1", "none", "all is well")]
        raw: A[NDArray[np.int16], InVar("RAW", "8", "none", "counts")]
        hidden: Vector
        _private: int

    assert interface(Arm).ports == (
        Port("ndof", "NDOF", Kind.INCONST, (), "none", "degrees of freedom", "int"),
        Port("dh", "DH", Kind.OUTCONST, ("ndof", 4), "none", "geometry", "float64[]"),
        Port("q", "Q_MEZ", Kind.INVAR, ("ndof",), "rad", "position", "float64[]"),
        Port("ok", "OK", Kind.OUTVAR, (), "none", "all is well", "bool"),
        Port("raw", "RAW", Kind.INVAR, (8,), "none", "counts", "int16[]"),
    )


def test_string_annotations_mean_the_same():
    class Arm(Idle, PortBasedObject):
        q: "A[Vector, InVar('Q', 'n', 'rad', 'position')]"
        other: "SomethingOnlyATypeCheckerKnows"  # noqa: F821

    assert [port.name for port in interface(Arm).ports] == ["Q"]


def test_ports_are_inherited():
    class Joints(PortBasedObject, abstract=True):
        q: A[Vector, InVar("Q", "n", "rad", "position")]

    class Law(Idle, Joints):
        tau: A[Vector, OutVar("T", "n", "N*m", "torque")]

    class Other(Law):
        pass

    assert [port.attr for port in interface(Law).ports] == ["q", "tau"]
    assert interface(Other).ports == interface(Law).ports


def declare(name, kind, words):
    """Make a class with one port; there is no source to point at."""
    body = {
        "__annotations__": {name: A[kind, InVar(*words)]},
        "__module__": "somewhere",
        "cycle": Idle.cycle,
    }
    return type("Made", (PortBasedObject,), body)


Q = ("Q", "n", "rad", "position")
FAULTS = [
    (
        "_q",
        Vector,
        Q,
        "a port is public (expected a name without leading underscore, got _q)",
    ),
    (
        "q",
        Vector,
        ("Q", "n", "", "position"),
        "the port has no unit (expected InVar(name, shape, unit, doc), "
        "got InVar('Q', 'n', '', 'position')); "
        'write "none" for the unit of a pure number',
    ),
    (
        "q",
        Vector,
        ("Q", "n", "rad", " "),
        "the port has no doc (expected InVar(name, shape, unit, doc), "
        "got InVar('Q', 'n', 'rad', ' '))",
    ),
    (
        "q",
        Vector,
        ("Q", "n", "rad", 3),
        "the port's doc is no text (expected InVar(name, shape, unit, doc), "
        "got InVar('Q', 'n', 'rad', 3))",
    ),
    (
        "q",
        Vector,
        ("Q", 6, "rad", "position"),
        'the port\'s shape is no text (expected "1", "6", "ndof" or "ndof,4", '
        "got InVar('Q', 6, 'rad', 'position'))",
    ),
    (
        "q",
        Vector,
        ("Q", "n", "rad"),
        "a port is declared with four words (expected InVar(name, shape, unit, doc), "
        "got InVar('Q', 'n', 'rad')); "
        'write "none" for the unit of a pure number',
    ),
    (
        "q",
        Vector,
        (*Q, "more"),
        "a port is declared with four words (expected InVar(name, shape, unit, doc), "
        "got InVar('Q', 'n', 'rad', 'position', 'more'))",
    ),
    (
        "q",
        int,
        ("Q", "1", "position"),
        "a port is declared with four words (expected InVar(name, shape, unit, doc), "
        "got InVar('Q', '1', 'position')); "
        'write "none" for the unit of a pure number',
    ),
    (
        "q",
        Vector,
        ("MUCH_TOO_LONG_NAME", "n", "rad", "position"),
        "the port's name is not allowed in an .rmod file (expected a letter or _, then "
        "letters, digits and any of _ ^ ' ., at most 15 in all, "
        'got "MUCH_TOO_LONG_NAME" (18 characters))',
    ),
    (
        "q",
        Vector,
        ("none", "n", "rad", "position"),
        "the port's name is not allowed in an .rmod file (expected a letter or _, then "
        "letters, digits and any of _ ^ ' ., at most 15 in all, "
        'got "none" (4 characters))',
    ),
    (
        "q",
        Vector,
        ("Q", "n*2", "rad", "position"),
        "the shape has a part that is neither a size nor a name: 'n*2' "
        '(expected "1", "6", "ndof" or "ndof,4", got "n*2")',
    ),
    (
        "q",
        Vector,
        ("Q", "0", "rad", "position"),
        "the shape has a part that is neither a size nor a name: '0' "
        '(expected "1", "6", "ndof" or "ndof,4", got "0")',
    ),
    (
        "q",
        float,
        Q,
        "a port with more than one element is an array "
        "(expected Vector or Matrix, got float)",
    ),
    (
        "q",
        Vector,
        ("Q", "1", "rad", "position"),
        "a port of one element is a plain number (expected float, int or bool, "
        "got an array of float64); "
        'name the size ("n") if it is an array that may have one element',
    ),
    (
        "q",
        list,
        Q,
        "the type cannot be a port's (expected float, int, bool, Vector, Matrix or "
        "NDArray[numpy type], got list)",
    ),
    (
        "q",
        NDArray[np.str_],
        Q,
        "the type cannot be a port's (expected float, int, bool, Vector, Matrix or "
        "NDArray[numpy type], got ndarray)",
    ),
    (
        "q",
        Vector,
        ("Q", "Q", "rad", "position"),
        "the shape names port q, which is not an integer constant (expected "
        "q: A[int, InConst(...)] or a name that is no port, got in-var of type "
        "float64[])",
    ),
    ("cycle", Vector, Q, "the name cycle is taken by a base class"),
    ("params", Vector, Q, "the name params is taken by a base class"),
]  # fmt: skip


@pytest.mark.parametrize(("name", "kind", "words", "sentence"), FAULTS)
def test_a_wrong_port_is_refused_at_class_creation(name, kind, words, sentence):
    if words[1] == "Q":
        words = ("Q", "q", *words[2:])
    with pytest.raises(DeclarationError) as caught:
        declare(name, kind, words)
    assert str(caught.value) == f"somewhere.Made.{name} (source unknown): {sentence}"


def test_a_port_has_no_value():
    with pytest.raises(DeclarationError) as caught:

        class Wrong(Idle, PortBasedObject):
            q: A[Vector, InVar("Q", "n", "rad", "position")] = np.zeros(3)

    assert str(caught.value).endswith(
        "a port has no value in the class body; take the assignment out; INIT in the "
        ".svar file sets first values"
    )


def test_the_line_of_the_declaration_is_named():
    with pytest.raises(DeclarationError) as caught:

        class Wrong(Idle, PortBasedObject):
            fine: A[Vector, InVar("FINE", "n", "rad", "position")]
            blunt: A[Vector, InVar("BLUNT", "n", "rad", "")]

    assert caught.value.where == (
        f"{__name__}.test_the_line_of_the_declaration_is_named.<locals>.Wrong.blunt "
        f"(line {line_of('blunt:')})"
    )


def test_a_name_that_does_not_exist_at_run_time_is_told():
    with pytest.raises(DeclarationError) as caught:

        class Wrong(Idle, PortBasedObject):
            lost: "A[Vectr, InVar('Q', 'n', 'rad', 'position')]"  # noqa: F821

    assert str(caught.value).endswith(
        f"Wrong.lost (line {line_of('lost:')}): the annotation cannot be evaluated "
        "(got NameError: name 'Vectr' is not defined); "
        "correct the name, or import it at run time and not under TYPE_CHECKING only"
    )


def test_a_misspelt_kind_of_port_is_told():
    with pytest.raises(DeclarationError, match="name 'Invar' is not defined"):

        class Wrong(Idle, PortBasedObject):
            q: "A[Vector, Invar('Q', 'n', 'rad', 'position')]"  # noqa: F821


def test_other_errors_in_annotations_are_told():
    with pytest.raises(DeclarationError) as caught:

        class Wrong(Idle, PortBasedObject):
            q: "A[Vector, InVar('Q', 'n', 'rad', 1 / 0)]"

    assert caught.value.got == "ZeroDivisionError: division by zero"
    assert not caught.value.remedy


@pytest.mark.parametrize("kind", [InConst, OutConst])
def test_an_integer_constant_may_leave_out_its_unit(kind):
    class Arm(Idle, PortBasedObject):
        ndof: A[int, kind("NDOF", "1", "degrees of freedom")]

    (port,) = interface(Arm).ports
    assert (port.shape, port.unit, port.doc) == ((), "none", "degrees of freedom")
    for other in (A[float, kind("K", "1", "m")], A[Vector, kind("K", "n", "m")]):
        with pytest.raises(DeclarationError, match="declared with four words"):
            type("M", (Idle, PortBasedObject), {"__annotations__": {"k": other}})


MISPLACED = [
    {"q": InVar(*Q)},
    {"__annotations__": {"q": Vector}, "q": InVar(*Q)},
    {"__annotations__": {"q": InVar(*Q)}},
    {"__annotations__": {"q": InVar}},
]


@pytest.mark.parametrize("body", MISPLACED)
def test_a_port_outside_an_annotation_is_told(body):
    with pytest.raises(DeclarationError) as caught:
        type("Made", (Idle, PortBasedObject), {"__module__": "some", **body})
    got = "InVar" if body.get("__annotations__") == {"q": InVar} else repr(InVar(*Q))
    assert str(caught.value) == (
        "some.Made.q (source unknown): a port is declared in an annotation, together "
        'with its type (expected q: A[type, InVar("NAME", "shape", "unit", "doc")], '
        f"got {got})"
    )


def test_one_name_is_one_port():
    with pytest.raises(DeclarationError, match=r"q is the port Q already"):

        class Wrong(Idle, PortBasedObject):
            q: A[Vector, InVar("Q", "n", "rad", "position")]
            p: A[Vector, OutVar("Q", "n", "rad", "position")]


def test_a_port_is_declared_once():
    with pytest.raises(DeclarationError) as caught:

        class Wrong(Idle, PortBasedObject):
            q: A[Vector, InVar]

    assert str(caught.value).endswith(
        "a port is declared once, with its four words (expected "
        'A[type, InVar("NAME", "shape", "unit", "doc")], got InVar)'
    )


def test_a_port_is_of_one_kind():
    with pytest.raises(DeclarationError) as caught:

        class Wrong(Idle, PortBasedObject):
            q: A[Vector, InVar(*Q), OutVar(*Q)]

    assert caught.value.got == (
        "InVar('Q', 'n', 'rad', 'position'), OutVar('Q', 'n', 'rad', 'position')"
    )


def test_an_inherited_port_is_not_declared_again():
    class Joints(Idle, PortBasedObject):
        q: A[Vector, InVar("Q", "n", "rad", "position")]

    with pytest.raises(DeclarationError, match="the name q is taken by a base class"):

        class Wrong(Joints):
            q: A[Vector, OutVar("P", "n", "rad", "position")]


@pytest.mark.parametrize("kind", [NDArray[np.floating], NDArray[Any], NDArray[object]])
def test_an_array_port_has_one_type_of_element(kind):
    with pytest.raises(DeclarationError, match="the type cannot be a port's"):
        declare("q", kind, Q)


def test_other_annotated_attributes_are_no_ports():
    class Arm(Idle, PortBasedObject):
        speed: A[float, "of light"]
        q: A[Vector, InVar("Q", "n", "rad", "position")]

    assert [port.attr for port in interface(Arm).ports] == ["q"]


def test_a_class_without_source_has_no_line():
    namespace = {"__name__": "typed_in", "A": A, "Vector": Vector, "InVar": InVar}
    namespace["PortBasedObject"] = PortBasedObject
    code = 'class Typed(PortBasedObject):\n    q: A[Vector, InVar("Q", "n", "", "x")]\n'
    with pytest.raises(DeclarationError) as caught:
        exec(code, namespace)  # noqa: S102 - as typed at a prompt
    assert caught.value.where == "typed_in.Typed.q (source unknown)"


def test_the_line_of_a_method_and_of_an_assignment_is_named():
    with pytest.raises(DeclarationError) as caught:

        class Wrong(PortBasedObject):
            first, second = 1, 2
            third = 3

            def cycle(self):  # the one without dt
                pass

    assert f"(line {line_of('def cycle(self):  # the one')})" in str(caught.value)
    with pytest.raises(DeclarationError) as caught:

        class Worse(PortBasedObject):
            cycle = None  # no method

    assert f"(line {line_of('cycle = None')})" in str(caught.value)


def test_a_size_is_named_by_attribute_not_by_port():
    with pytest.raises(DeclarationError) as caught:

        class Wrong(Idle, PortBasedObject):
            ndof: A[int, InConst("NDOF", "1", "none", "degrees of freedom")]
            q: A[Vector, InVar("Q", "NDOF", "rad", "position")]

    assert str(caught.value).endswith(
        "the shape names NDOF, which is not an attribute; write the attribute: ndof"
    )


def port(kind, shape=()):
    return Port("x", "X", Kind.INVAR, shape, "none", "x", kind)


@pytest.mark.parametrize(
    ("one", "dtype", "fits"),
    [
        (port("float"), "<f4", True),
        (port("float"), "<i4", False),
        (port("int"), "<u2", True),
        (port("int"), "b1", False),
        (port("bool"), "b1", True),
        (port("float64[]", ("n",)), "<f8", True),
        (port("float64[]", ("n",)), "<f4", False),
        (port("int16[]", ("n",)), "int16", True),
        (port("uint8[]", ("n",)), "|u1", True),
        (port("uint8[]", ("n",)), "i1", False),
        (port("bool[]", ("n",)), "|b1", True),
        (port("bool[]", ("n",)), "u1", False),
        (port("void[]", ("n",)), "V32", True),
        (port("void[]", ("n",)), "<f8", False),
    ],
)
def test_which_variables_can_stand_behind_a_port(one, dtype, fits):
    assert accepts(one, dtype) is fits


def test_what_is_wanted_is_said_as_svar_files_say_it():
    kinds = ["float", "int", "bool", "float64[]", "float32[]", "void[]", "int16[]"]
    words = [wanted(port(kind, () if "[" not in kind else ("n",))) for kind in kinds]
    floating = ["a floating type", "an integer type", "bool"]
    assert words == [*floating, "double", "float", "struct", "int16"]


def test_a_port_shows_how_it_is_written_and_what_it_is():
    class Arm(Idle, PortBasedObject):
        q: A[Vector, InVar("Q", "n", "rad", "position")]

    assert repr(InVar(*Q)) == "InVar('Q', 'n', 'rad', 'position')"
    assert repr(Arm.q) == "<in-var Q>"
