"""One name in a shape means one size."""

import pytest

from pbonet.errors import PortError
from pbonet.ports import Kind, Port, parse_shape, shape_text, solve_shapes


def make(text, kind=Kind.INVAR):
    """Return ports out of "attr:shape" words; the name is the attribute in capitals."""
    ports = []
    for word in text.split():
        attr, shape = word.split(":")
        dims = parse_shape(shape)
        const = attr in {"ndof", "n_"}
        ports.append(
            Port(
                attr,
                attr.upper(),
                Kind.INCONST if const else kind,
                dims,
                "none",
                "doc",
                "float64[]" if dims else "int",
            )
        )
    return ports


def test_shapes_are_read_and_written():
    assert parse_shape("1") == ()
    assert parse_shape(" ndof , 4 ") == ("ndof", 4)
    assert shape_text(("ndof", 4)) == "ndof,4"
    assert shape_text(()) == "1"


@pytest.mark.parametrize("text", ["", "-1", "4,", "a b", "ndof*2", "٣"])
def test_what_is_no_shape_is_refused(text):
    with pytest.raises(ValueError, match="neither a size nor a name"):
        parse_shape(text)


def test_sizes_follow_from_elements():
    ports = make("ndof:1 q:ndof dh:ndof,4 w:3")
    solved = solve_shapes(ports, {"NDOF": 1, "Q": 6, "DH": 24, "W": 3})
    assert solved == {"ndof": (), "q": (6,), "dh": (6, 4), "w": (3,)}


def test_a_size_that_is_found_late_helps_earlier_ports():
    ports = make("j:m,n a:m b:n,n")
    solved = solve_shapes(ports, {"J": 12, "A": 4, "B": 9})
    assert solved == {"j": (4, 3), "a": (4,), "b": (3, 3)}


def test_ports_without_elements_follow_from_the_others():
    assert solve_shapes(make("q:n p:n,2"), {"Q": 5}) == {"q": (5,), "p": (5, 2)}


def test_constants_fix_sizes_by_attribute_or_by_name():
    for key in ("ndof", "NDOF"):
        assert solve_shapes(make("ndof:1 q:ndof"), {}, {key: 7})["q"] == (7,)


NELEM = "give both variables the same NELEM, or connect another one"
FAULTS = [
    (
        "q:n p:n",
        {"Q": 6, "P": 7},
        {},
        "port q (Q) and port p (P) disagree about the size n (expected 6 as port q (Q) "
        f"has it, got 7 from port p (P)); {NELEM}",
    ),
    (
        "q:n dh:n,4",
        {"Q": 6, "DH": 28},
        {},
        "port q (Q) and port dh (DH) disagree about the size n (expected 6 as port q "
        f"(Q) has it, got 7 from port dh (DH)); {NELEM}",
    ),
    (
        "ndof:1 q:ndof",
        {"Q": 6},
        {"NDOF": 7},
        "constant NDOF and port q (Q) disagree about the size ndof (expected 7 as "
        f"constant NDOF has it, got 6 from port q (Q)); {NELEM}",
    ),
    (
        "q:n p:m j:m,n",
        {"Q": 6, "P": 2, "J": 13},
        {},
        "port j (J) has another size than its shape declares (expected 12 elements for "
        "shape m,n, m is 2 from port p (P), n is 6 from port q (Q), got 13 elements); "
        "correct NELEM of the variable, or the shape of j",
    ),
    (
        "w:3",
        {"W": 4},
        {},
        "port w (W) has another size than its shape declares (expected 3 elements for "
        "shape 3, got 4 elements); correct NELEM of the variable, or the shape of w",
    ),
    (
        "ndof:1",
        {"NDOF": 2},
        {},
        "port ndof (NDOF) has another size than its shape declares (expected 1 element "
        "for shape 1, got 2 elements); correct NELEM of the variable, or the shape of "
        "ndof",
    ),
    (
        "dh:n,4",
        {"DH": 22},
        {},
        "port dh (DH) cannot have 22 elements (expected a number of elements that fits "
        "shape n,4, got 22 elements); correct NELEM of the variable, or the shape of "
        "dh",
    ),
    (
        "m:n,n",
        {"M": 8},
        {},
        "port m (M) cannot have 8 elements (expected a number of elements that fits "
        "shape n,n, got 8 elements); correct NELEM of the variable, or the shape of m",
    ),
    (
        "j:m,n",
        {"J": 12},
        {},
        "the size of port j (J) cannot be known (expected a size for m and n); connect "
        "a constant that is the size, or a port that has it alone; on a bench, say "
        "`m=...`",
    ),
    (
        "q:n",
        {},
        {"n": 0},
        "a size cannot be 0 (expected n of at least 1, got 0 from constant n); give "
        "the constant its value before this module is created",
    ),
    (
        "ndof:1 q:ndof",
        {},
        {"NDOF": 6, "ndof": 5},
        "constant ndof and constant NDOF disagree about the size ndof (expected 5 as "
        f"constant ndof has it, got 6 from constant NDOF); {NELEM}",
    ),
]


@pytest.mark.parametrize(("text", "nelem", "constants", "sentence"), FAULTS)
def test_what_does_not_fit_names_both_sides(text, nelem, constants, sentence):
    with pytest.raises(PortError) as caught:
        solve_shapes(make(text), nelem, constants, where="Arm")
    assert str(caught.value) == f"Arm: {sentence}"
