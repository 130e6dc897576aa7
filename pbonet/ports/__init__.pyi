from ._attributes import (
    SCALARS as SCALARS,
    ArrayPort as ArrayPort,
    InScalar as InScalar,
    OutScalar as OutScalar,
    attribute as attribute,
    view as view,
)
from ._declare import (
    MARKS as MARKS,
    NAME_FORM as NAME_FORM,
    SHAPES as SHAPES,
    Declared as Declared,
    InConst as InConst,
    InVar as InVar,
    Matrix as Matrix,
    OutConst as OutConst,
    OutVar as OutVar,
    Vector as Vector,
    make_port as make_port,
    name_fault as name_fault,
)
from ._freshness import (
    check_options as check_options,
    is_safe as is_safe,
    lacks as lacks,
)
from ._port import (
    Kind as Kind,
    Port as Port,
    Stale as Stale,
    accepts as accepts,
    wanted as wanted,
)
from ._shapes import (
    parse_shape as parse_shape,
    shape_text as shape_text,
    solve_shapes as solve_shapes,
)
from ._source import Declaring as Declaring, here as here
