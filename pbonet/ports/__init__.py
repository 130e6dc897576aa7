"""Ports: what a port-based object exchanges with others (Stewart 1994, 3.3, 3.5).

A port is declared by an annotation in a module's class body and by nothing else. This
package knows what a port is, checks how it was declared, unifies the sizes of a
module's ports, and makes the attributes through which a module uses them.
"""

from ._attributes import SCALARS, ArrayPort, InScalar, OutScalar, attribute, view
from ._declare import (
    MARKS,
    NAME_FORM,
    SHAPES,
    Declared,
    InConst,
    InVar,
    Matrix,
    OutConst,
    OutVar,
    Vector,
    make_port,
    name_fault,
)
from ._port import Kind, Port, accepts, wanted
from ._shapes import parse_shape, shape_text, solve_shapes
from ._source import Declaring, here

__all__ = [
    "MARKS",
    "NAME_FORM",
    "SCALARS",
    "SHAPES",
    "ArrayPort",
    "Declared",
    "Declaring",
    "InConst",
    "InScalar",
    "InVar",
    "Kind",
    "Matrix",
    "OutConst",
    "OutScalar",
    "OutVar",
    "Port",
    "Vector",
    "accepts",
    "attribute",
    "here",
    "make_port",
    "name_fault",
    "parse_shape",
    "shape_text",
    "solve_shapes",
    "view",
    "wanted",
]
