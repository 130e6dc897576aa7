"""Sizes of ports against trying all of them."""

import itertools
import math

from hypothesis import given, strategies as st

from pbonet.errors import PortError
from pbonet.ports import Kind, Port, solve_shapes

NAMES = ("a", "b", "c")
LARGEST = 24
SHAPES = st.lists(
    st.one_of(st.sampled_from(NAMES), st.integers(1, 3)), min_size=1, max_size=3
)


@st.composite
def modules(draw):
    """Return ports, and elements that mostly fit."""
    truth = {name: draw(st.integers(1, 4)) for name in NAMES}
    ports, nelem = [], {}
    for number, shape in enumerate(draw(st.lists(SHAPES, min_size=1, max_size=4))):
        name = f"P{number}"
        ports.append(
            Port(name.lower(), name, Kind.INVAR, tuple(shape), "m", "p", "float64[]")
        )
        count = math.prod(truth.get(dim, dim) for dim in shape)
        nelem[name] = draw(st.sampled_from([count, count, count, count + 1]))
    return ports, nelem


def tried(ports, nelem):
    """Return all sizes of the names that fit, each as a tuple in the order of NAMES."""
    used = [n for n in NAMES if any(n in port.shape for port in ports)]
    fits = []
    for sizes in itertools.product(range(1, LARGEST + 1), repeat=len(used)):
        have = dict(zip(used, sizes, strict=True))
        if all(
            math.prod(have.get(dim, dim) for dim in port.shape) == nelem[port.name]
            for port in ports
        ):
            fits.append(have)
    return fits


@given(modules())
def test_what_is_solved_is_the_only_solution_and_what_is_refused_has_none(module):
    ports, nelem = module
    nelem = {name: min(count, LARGEST) for name, count in nelem.items()}
    fits = tried(ports, nelem)
    solved, refusal = {}, ""
    try:
        solved = solve_shapes(ports, nelem)
    except PortError as error:
        refusal = error.what
    if refusal:
        assert not fits or "cannot be known" in refusal, refusal
        return
    assert len(fits) == 1
    for port in ports:
        assert solved[port.attr] == tuple(fits[0].get(dim, dim) for dim in port.shape)
        assert math.prod(solved[port.attr]) == nelem[port.name]


@given(modules(), st.randoms())
def test_the_order_of_the_ports_does_not_matter(module, random):
    ports, nelem = module
    other = list(ports)
    random.shuffle(other)
    results = []
    for one in (ports, other):
        try:
            results.append(solve_shapes(one, nelem))
        except PortError:
            results.append(None)
    assert results[0] == results[1]
