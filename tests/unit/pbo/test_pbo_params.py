"""Parameters: declared once, decoded from LOCAL lines, refused in whole sentences."""

import traceback
from pathlib import Path
from typing import Annotated as A, ClassVar, Literal

import numpy as np
import pytest

from pbonet import Params, PortBasedObject, param
from pbonet.config.model import LocalLine, Place
from pbonet.errors import DeclarationError, ParameterError
from pbonet.pbo import (
    change_param,
    decode_params,
    find_param,
    local_text,
    make_params,
    params_type,
)


class Gains(Params):
    kp: A[float, param("N*m/rad", "stiffness", ge=0)]
    axes: A[int, param("none", "number of axes", gt=0, le=8)]
    mode: A[Literal["linear", "cubic"], param("none", "shape")] = "linear"
    limit: A[tuple[float, ...], param("N*m", "largest torque", gt=0)] = (1.0,)
    offset: A[tuple[float, float, float], param("m", "of the tool")] = (0.0, 0.0, 0.0)
    port: A[str, param("none", "device")] = "/dev/ttyS0"
    quiet: A[bool, param("none", "no messages")] = False


class Law(PortBasedObject[Gains]):
    def cycle(self, dt):
        pass


def local(text):
    """Return LOCAL lines as the reader gives them: one a line of `text`."""
    lines = {}
    for number, line in enumerate(text.strip().splitlines(), 11):
        key, *words = line.split()
        lines[key] = LocalLine(tuple(words), Place("law.rmod", number))
    return lines


def test_lines_become_typed_values():
    lines = local(
        """
        KP 12.5
        axes 0x6
        MODE cubic
        LIMIT 1 2e0 .5
        OFFSET 0 -1 +.25
        PORT /dev/tty ACM0
        QUIET yes
        """
    )
    assert decode_params(Law, lines) == Gains(
        kp=12.5,
        axes=6,
        mode="cubic",
        limit=(1.0, 2.0, 0.5),
        offset=(0.0, -1.0, 0.25),
        port="/dev/tty ACM0",
        quiet=True,
    )


def test_defaults_hold_for_what_is_left_out():
    found = decode_params(Gains, local("KP 0\nAXES 1"))
    assert found == Gains(kp=0.0, axes=1)
    assert (found.mode, found.limit) == ("linear", (1.0,))


FAULTS = [
    (
        "KPP 1\nAXES 1",
        "law.rmod:11:1: module Law has no parameter KPP (expected one of kp, axes, "
        "mode, limit, offset, port, quiet); did you mean kp?",
    ),
    (
        "KP 1",
        "law.rmod: module Law needs parameter axes: number of axes (expected int, > 0 "
        "and <= 8); add a line `AXES ...` under LOCAL",
    ),
    (
        "KP stiff",
        "law.rmod:11:1: a value of parameter kp is not a float (expected float in "
        'N*m/rad, >= 0, got "stiff"); write numbers as in 2.5, -3 or 1e-3',
    ),
    (
        "KP nan",
        "law.rmod:11:1: a value of parameter kp is not a float (expected float in "
        'N*m/rad, >= 0, got "nan"); write numbers as in 2.5, -3 or 1e-3',
    ),
    (
        "AXES 6.0",
        "law.rmod:11:1: a value of parameter axes is not an int (expected int, > 0 and "
        '<= 8, got "6.0"); write it without a decimal point',
    ),
    (
        "QUIET maybe",
        "law.rmod:11:1: a value of parameter quiet is not a bool (expected bool, got "
        '"maybe"); write yes or no',
    ),
    (
        "KP -0.5",
        "law.rmod:11:1: parameter kp is out of bounds (expected float in N*m/rad, "
        ">= 0, got -0.5); choose a value within the bounds",
    ),
    (
        "KP 1e999",
        "law.rmod:11:1: parameter kp is out of bounds (expected float in N*m/rad, "
        ">= 0, got inf); choose a value within the bounds",
    ),
    (
        "LIMIT 1 0 2",
        "law.rmod:11:1: parameter limit is out of bounds (value 2 of 3) (expected one "
        "or more float in N*m, > 0, got 0); choose a value within the bounds",
    ),
    (
        "OFFSET 1 2",
        "law.rmod:11:1: parameter offset has the wrong number of values (expected 3 "
        "float in m, got 2 values); give 3 values",
    ),
    (
        "LIMIT",
        "law.rmod:11:1: parameter limit has the wrong number of values (expected one "
        "or more float in N*m, > 0, got 0 values); give at least one",
    ),
    (
        "KP 1 2",
        "law.rmod:11:1: parameter kp has the wrong number of values (expected float in "
        "N*m/rad, >= 0, got 2 values); give 1 value",
    ),
    (
        "PORT",
        "law.rmod:11:1: parameter port has the wrong number of values (expected str, "
        "got 0 values); give 1 value",
    ),
    (
        "MODE cubik",
        "law.rmod:11:1: parameter mode has no such choice (expected one of linear, "
        "cubic, got 'cubik'); did you mean cubic?",
    ),
    (
        "MODE square",
        "law.rmod:11:1: parameter mode has no such choice (expected one of linear, "
        "cubic, got 'square'); choose one of these",
    ),
    (
        "GAIN 1",
        "law.rmod:11:1: module Law has no parameter GAIN (expected one of kp, axes, "
        "mode, limit, offset, port, quiet); name one of these, or remove it",
    ),
    (
        "kp 1\nKP 2",
        "law.rmod:12:1: parameter kp is given twice (expected one line for each "
        "parameter, in capitals or not); remove one of them",
    ),
]


@pytest.mark.parametrize(("text", "sentence"), FAULTS)
def test_a_wrong_line_is_refused_with_its_place(text, sentence):
    with pytest.raises(ParameterError) as caught:
        decode_params(Law, local(text))
    assert str(caught.value) == sentence


def test_a_missing_line_is_blamed_on_the_file():
    with pytest.raises(ParameterError) as caught:
        decode_params(Law, {}, where="other.rmod")
    assert caught.value.where == "other.rmod"


def test_values_are_checked_when_made_in_python():
    for wrong in (
        {"kp": -1.0, "axes": 1},
        {"kp": 1.0, "axes": 9},
        {"kp": 1.0, "axes": 1.5},
        {"kp": True, "axes": 1},
        {"kp": 1.0, "axes": 1, "limit": 3.0},
        {"kp": 1.0, "axes": 1, "limit": ()},
        {"kp": 1.0, "axes": 1, "offset": (0.0, 0.0)},
        {"kp": 1.0, "axes": 1, "mode": "square"},
        {"kp": float("inf"), "axes": 1},
    ):
        with pytest.raises(ParameterError, match=r"^Gains\."):
            Gains(**wrong)
    with pytest.raises(ParameterError) as caught:
        Gains(kp="1", axes=1)
    assert str(caught.value) == (
        "Gains.kp: parameter kp has the wrong type (expected float in N*m/rad, >= 0, "
        "got '1'); give a value of that type"
    )


def test_parameters_are_frozen_and_keyword_only():
    gains = Gains(kp=1.0, axes=1)
    with pytest.raises(AttributeError):
        gains.kp = 2.0
    with pytest.raises(
        ParameterError, match="Gains takes parameters by name"
    ) as caught:
        Gains(1.0, 1)
    assert caught.value.expected.startswith("Gains(kp=..., ")
    with pytest.raises(ParameterError, match=r"no parameter kpp .*mean kp"):
        Gains(kp=1.0, axes=1, kpp=3.0)
    with pytest.raises(ParameterError, match=r"needs parameter axes: .*Gains\(axes="):
        Gains(kp=1.0)


@pytest.mark.parametrize(
    "refused",
    [
        lambda: Gains(kp=-1.0, axes=1),
        lambda: Gains(kp="1", axes=1),
        lambda: Gains(kp=1.0),
        lambda: Gains(kp=1.0, axes=1, kpp=3.0),
        lambda: Gains(1.0),
    ],
)
def test_the_stack_of_a_refusal_ends_with_the_line_that_caused_it(refused) -> None:
    with pytest.raises(ParameterError) as caught:
        refused()
    frames = traceback.extract_tb(caught.value.__traceback__)
    assert [Path(one.filename).name for one in frames[-2:]] == [
        Path(__file__).name,
        "_params.py",
    ]
    assert "Gains(" in (frames[-2].line or "")


def test_parameters_from_python_values():
    assert make_params(Gains, {"kp": 2.0, "axes": 3}) == Gains(kp=2.0, axes=3)
    with pytest.raises(ParameterError, match="Gains has no parameter kpp"):
        make_params(Gains, {"kpp": 2.0})
    with pytest.raises(ParameterError, match="Gains needs parameter axes") as caught:
        make_params(Gains, {"kp": 2.0})
    assert caught.value.remedy == "give it a value: Gains(axes=...)"


def test_one_value_is_changed():
    gains = Gains(kp=1.0, axes=2)
    changed = change_param(gains, "KP", ("3",))
    assert changed == Gains(kp=3.0, axes=2)
    assert gains.kp == 1.0
    with pytest.raises(ParameterError, match="law: parameter kp is out of bounds"):
        change_param(gains, "kp", ("-3",), where="law")
    with pytest.raises(ParameterError, match="did you mean limit"):
        change_param(gains, "limt", ("3",))


def test_a_parameter_is_found_whatever_its_case():
    assert find_param(Gains(kp=1.0, axes=2), "LIMIT") == "limit"


def test_values_are_written_as_local_lines_have_them():
    gains = Gains(kp=0.1, axes=2, limit=(1.0, 2.5), quiet=True)
    for name, about in Gains.__declared__.items():
        words = tuple(local_text(getattr(gains, name)).split())
        assert change_param(gains, about.name, words) == gains


def test_parameters_are_inherited():
    class More(Gains):
        extra: A[float, param("s", "a time")] = 1.0

    found = decode_params(More, local("KP 1\nAXES 2\nEXTRA 3"))
    assert (found.kp, found.axes, found.extra) == (1.0, 2, 3.0)


def test_a_class_variable_is_no_parameter():
    class Few(Params):
        table: ClassVar[dict[str, int]] = {}
        kp: A[float, param("none", "gain")] = 1.0

    assert list(Few.__declared__) == ["kp"]


def test_a_module_without_parameters_has_none():
    class Bare(PortBasedObject):
        def cycle(self, dt):
            pass

    assert params_type(Bare) is Params
    with pytest.raises(ParameterError) as caught:
        decode_params(Bare, local("KP 1"))
    assert str(caught.value) == (
        "law.rmod:11:1: module Bare has no parameter KP (expected no parameters at "
        "all); remove it"
    )


def declare(hint, **default):
    body = {"__annotations__": {"kp": hint}, "__module__": "somewhere", **default}
    return type(Params)("Made", (Params,), body)


TYPES = (
    'float, int, bool, str, Literal["a", "b"], tuple[float, ...] or tuple[float, float]'
)
DECLARATIONS = [
    (
        float,
        {},
        "a parameter declares its unit and meaning (expected "
        'kp: A[type, param("unit", "doc")], got float)',
    ),
    (
        A[float, "gain"],
        {},
        "a parameter declares its unit and meaning (expected "
        'kp: A[type, param("unit", "doc")], got typing.Annotated[float, \'gain\'])',
    ),
    (A[float, param("", "gain")], {}, "the parameter has no unit (got '')"),
    (A[float, param("rad", "")], {}, "the parameter has no doc (got '')"),
    (
        A[complex, param("rad", "gain")],
        {},
        "the type cannot be a parameter's (expected " + TYPES + ", got "
        "<class 'complex'>)",
    ),
    (
        A[tuple[float, int], param("rad", "gain")],
        {},
        "the type cannot be a parameter's (expected " + TYPES + ", got "
        "tuple[float, int])",
    ),
    (A[str, param("rad", "gain", ge=0)], {}, "a str has no bounds (got >= 0)"),
    (
        A[float, param("none", "gain", device=True)],
        {},
        "the name of a device is a text (expected str, got float)",
    ),
    (
        A[float, param("rad", "gain", ge=0, lt=2)],
        {"kp": 2.0},
        "the default is refused: parameter kp is out of bounds (expected float in rad, "
        ">= 0 and < 2, got 2)",
    ),
    (
        A[float, param("rad", "gain")],
        {"kp": "x"},
        "the default is refused: parameter kp has the wrong type (expected float in "
        "rad, got 'x')",
    ),
]


@pytest.mark.parametrize(("hint", "default", "sentence"), DECLARATIONS)
def test_a_wrong_declaration_is_refused_at_class_creation(hint, default, sentence):
    with pytest.raises(DeclarationError) as caught:
        declare(hint, **default)
    assert str(caught.value) == f"somewhere.Made.kp (source unknown): {sentence}"


def test_names_that_differ_in_case_only_are_refused():
    with pytest.raises(DeclarationError, match="parameters kp and Kp differ in case"):

        class Wrong(Params):
            kp: A[float, param("none", "gain")]
            Kp: A[float, param("none", "gain")]


def test_a_private_parameter_is_refused():
    with pytest.raises(DeclarationError, match="a parameter is public"):

        class Wrong(Params):
            _kp: A[float, param("none", "gain")]


class Spline(Params):
    knots: A[tuple[float, ...], param("s", "its knots", ge=0)]
    order: A[int, param("1", "its order")] = 3


@pytest.mark.parametrize("knots", [[0.0, 0.5], np.array([0.0, 0.5]), (0.0, 0.5)])
def test_a_tuple_may_be_given_as_a_list_or_an_array(knots) -> None:
    made = Spline(knots=knots, order=np.int64(2))
    assert made.knots == (0.0, 0.5)
    assert [type(one) for one in (made.knots, made.knots[1], made.order)] == [
        *(tuple, float, int),
    ]


def test_an_array_is_checked_as_a_tuple_is() -> None:
    with pytest.raises(ParameterError, match=r"out of bounds \(value 2 of 2\)"):
        Spline(knots=np.array([0.0, -1.0]))
    with pytest.raises(ParameterError, match="knots has the wrong type"):
        Spline(knots=np.zeros((2, 2)))
    with pytest.raises(ParameterError, match="order has the wrong type"):
        Spline(knots=[1.0], order=np.array([2]))
