"""The declaration of a port, and its checks."""

from __future__ import annotations

import re
from typing import (
    TYPE_CHECKING,
    Any,
    ClassVar,
    Literal,
    TypeAlias,
    get_args,
    get_origin,
    overload,
)

import numpy as np
from msgspec import structs
from numpy.typing import NDArray

from ._freshness import options_of
from ._port import Kind, Port
from ._shapes import parse_shape

if TYPE_CHECKING:
    from collections.abc import Sequence

    from ._source import Declaring

Vector = NDArray[np.float64]
"""A port of one dimension."""
Matrix = NDArray[np.float64]
"""A port of two dimensions; its shape says which."""

NAME_LENGTH = 15
"""The longest name of a variable (Stewart 1994, section 5.5.2)."""
NAME_FORM = (
    f"a letter or _, then letters, digits and any of _ ^ ' ., at most {NAME_LENGTH} in "
    "all"
)
SHAPES = '"1", "6", "ndof" or "ndof,4"'
"""Examples of shapes, for messages."""
_WORDS = ("name", "shape", "unit", "doc")


class Declared:
    """The declaration in a port's annotation; `make_port` turns it into a `Port`.

    Type checkers count the words. Other faults are reported when the class is created,
    because only then the place is known.

    Args:
        name: The port's name in ``.rmod`` and ``.svar`` files, at most 15 characters.
        shape: ``"1"`` for a scalar, else sizes with commas between: ``"6"``,
            ``"ndof"``, ``"ndof,4"``. A word is the attribute of an integer constant
            of the same module, or any other name; one word means one size.
        unit: The unit, such as ``rad/s``; ``none`` for a pure number. A constant that
            is one integer may leave it out.
        doc: What the port carries, in a few words.
    """

    __slots__ = ("options", "words")
    kind: ClassVar[Kind]
    words: tuple[object, ...]
    options: dict[str, object]

    if TYPE_CHECKING:

        def __init__(self, name: str, shape: str, unit: str, doc: str, /) -> None: ...

    else:

        def __init__(self, *words: object, **options: object) -> None:
            self.words, self.options = words, options

    def __repr__(self) -> str:
        """Return the declaration's text."""
        options = [f"{key}={value!r}" for key, value in self.options.items()]
        return f"{type(self).__name__}({', '.join([*map(repr, self.words), *options])})"


class InConst(Declared):
    """A constant that another task produces; read before `init` and `reinit`."""

    __slots__ = ()
    kind = Kind.INCONST

    if TYPE_CHECKING:

        @overload
        def __init__(self, name: str, shape: str, doc: str, /) -> None: ...
        @overload
        def __init__(self, name: str, shape: str, unit: str, doc: str, /) -> None: ...
        def __init__(self, *words: str) -> None: ...


_Value: TypeAlias = "float | Sequence[float] | None"


class OutConst(Declared):
    """A constant that this module produces; written after `init` and `reinit`.

    Args:
        value: What it holds before `init`: one number, or one for each element. With
            it the module needs no `init` for the constant, and `pbonet new` knows it.
    """

    __slots__ = ()
    kind = Kind.OUTCONST

    if TYPE_CHECKING:

        @overload
        def __init__(
            self, name: str, shape: str, doc: str, /, *, value: _Value = None
        ) -> None: ...
        @overload
        def __init__(
            self, name: str, shape: str, unit: str, doc: str, /, *, value: _Value = None
        ) -> None: ...
        def __init__(self, *words: str, value: _Value = None) -> None: ...


class InVar(Declared):
    """A variable that another task produces; read before `on` and every `cycle`.

    Args:
        max_age: Seconds, above which the value is too old; MAXAGE of the variable
            counts if it is less.
        stale: What the task does then: ``"hold"``, ``"stable"``, ``"safe"`` or
            ``"error"``; see `Stale`. By default a CRITICAL task does ``"stable"``, or
            ``"safe"`` if its module has no `stable`, and any other one goes on.
        feedback: True if the value itself depends on this module's out-vars: its age is
            not passed on to them.
    """

    __slots__ = ()
    kind = Kind.INVAR

    if TYPE_CHECKING:

        def __init__(
            self,
            name: str,
            shape: str,
            unit: str,
            doc: str,
            /,
            *,
            max_age: float | None = None,
            stale: Literal["", "hold", "stable", "safe", "error"] = "",
            feedback: bool = False,
        ) -> None: ...


class OutVar(Declared):
    """A variable that this module produces.

    Read before `on`; written after `on`, every `cycle` and `off`.

    Args:
        new: True if it is new information, such as a measurement; its age counts from
            when it was written. Otherwise it has the age of the oldest input from which
            it was computed. The out-vars of a module are all new or none.
        safe: The value, in the port's unit, that is written while an input is too old
            and the action is ``"safe"``: one number, or one for each element.
    """

    __slots__ = ()
    kind = Kind.OUTVAR

    if TYPE_CHECKING:

        def __init__(
            self,
            name: str,
            shape: str,
            unit: str,
            doc: str,
            /,
            *,
            new: bool = False,
            safe: float | Sequence[float] | None = None,
        ) -> None: ...


MARKS = tuple(kind.__name__ for kind in (InConst, OutConst, InVar, OutVar))
"""Names that mark an annotation as a port."""

_SCALARS: dict[object, str] = {float: "float", int: "int", bool: "bool"}
_ELEMENTS = "biufV"
"""Numpy kinds that a table can hold."""
_NAME = re.compile(r"[A-Za-z_][A-Za-z0-9_^'.]*")


def make_port(body: Declaring, attr: str, kind: object, declared: Declared) -> Port:
    """Return the port that ``attr: A[kind, declared]`` declares.

    Raises:
        DeclarationError: Anything about it is wrong.
    """
    _check_attr(body, attr)
    name, size, unit, doc = _four_words(body, attr, kind, declared)
    if fault := name_fault(name):
        raise body.error(attr, fault, expected=NAME_FORM, got=_counted(name))
    try:
        shape = parse_shape(size)
    except ValueError as error:
        raise body.error(
            attr,
            f"the shape {error}",
            expected=SHAPES,
            got=f'"{size}"',
        ) from None
    port = Port(
        attr=attr,
        name=name,
        kind=declared.kind,
        shape=shape,
        unit=unit,
        doc=doc,
        type=_type(body, attr, kind, shape),
    )
    return structs.replace(port, **options_of(body, port, declared.options))


def name_fault(name: str) -> str:
    """Return the fault in the name of a port, or an empty string."""
    fits = _NAME.fullmatch(name) and len(name) <= NAME_LENGTH
    if fits and name.lower() != "none":
        return ""
    return "the port's name is not allowed in an .rmod file"


def _counted(name: str) -> str:
    return f'"{name}" ({len(name)} characters)'


def _check_attr(body: Declaring, attr: str) -> None:
    if attr.startswith("_"):
        raise body.error(
            attr,
            "a port is public",
            expected="a name without leading underscore",
            got=attr,
        )
    if attr in vars(body.cls):
        raise body.error(
            attr,
            "a port has no value in the class body",
            remedy="take the assignment out; INIT in the .svar file sets first values",
        )


def _four_words(
    body: Declaring, attr: str, kind: object, declared: Declared
) -> tuple[str, ...]:
    """Return name, shape, unit and doc; a constant that counts has no unit."""
    words = declared.words
    counts = declared.kind.is_const and kind is int and words[1:2] == ("1",)
    if counts and len(words) == len(_WORDS) - 1:
        words = (*words[:2], "none", words[2])
    expected = f"{type(declared).__name__}({', '.join(_WORDS)})"
    if len(words) != len(_WORDS):
        raise body.error(
            attr,
            "a port is declared with four words",
            expected=expected,
            got=repr(declared),
            remedy='write "none" for the unit of a pure number'
            if len(words) < len(_WORDS)
            else "",
        )
    for word, value in zip(_WORDS, words, strict=True):
        if isinstance(value, str) and value.strip():
            continue
        empty = isinstance(value, str) or value is None
        raise body.error(
            attr,
            f"the port has no {word}" if empty else f"the port's {word} is no text",
            expected=SHAPES if word == "shape" and not empty else expected,
            got=repr(declared),
            remedy='write "none" for the unit of a pure number'
            if word == "unit"
            else "",
        )
    return tuple(str(word) for word in words)


def _type(body: Declaring, attr: str, kind: object, shape: tuple[Any, ...]) -> str:
    scalar = _SCALARS.get(kind) or _numpy_scalar(kind)
    if scalar and not shape:
        return scalar
    if scalar:
        raise body.error(
            attr,
            "a port with more than one element is an array",
            expected="Vector or Matrix",
            got=scalar,
        )
    element = _element(kind)
    if element is None:
        raise body.error(
            attr,
            "the type cannot be a port's",
            expected="float, int, bool, Vector, Matrix or NDArray[numpy type]",
            got=getattr(kind, "__name__", str(kind)),
        )
    if not shape:
        raise body.error(
            attr,
            "a port of one element is a plain number",
            expected="float, int or bool",
            got=f"an array of {element}",
            remedy='name the size ("n") if it is an array that may have one element',
        )
    return f"{element}[]"


def _numpy_scalar(kind: object) -> str:
    """Return the name of a numpy type of one number, such as ``int32``, else empty."""
    numbers: type[Any] = np.number
    if not isinstance(kind, type) or not issubclass(kind, numbers):
        return ""
    return str(np.dtype(kind.__name__).name)


def _element(kind: object) -> str | None:
    """Return the element's numpy name of ``NDArray[...]``, None for anything else."""
    if get_origin(kind) is not np.ndarray:
        return None
    described = get_args(kind)[-1]
    words = get_args(described)
    scalar: Any = words[0] if words else None
    if not isinstance(scalar, type) or not issubclass(scalar, np.generic):
        return None
    try:
        dtype = np.dtype(scalar.__name__)
    except TypeError:
        return None
    return str(dtype.name) if dtype.kind in _ELEMENTS else None
