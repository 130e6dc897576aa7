"""Parameters: one frozen struct per module, decoded from the LOCAL lines of an RMOD."""

from __future__ import annotations

import math
import re
from functools import cache
from typing import (
    TYPE_CHECKING,
    Annotated as A,
    Any,
    ClassVar,
    Literal,
    Protocol,
    TypeVar,
    cast,
    dataclass_transform,
    get_args,
    get_origin,
)

import msgspec
from msgspec import Struct, structs

from pbonet.errors import ParameterError, did_you_mean
from pbonet.ports import Declaring, here

from ._param import ANY_COUNT, Param

if TYPE_CHECKING:
    from collections.abc import Mapping


@dataclass_transform(kw_only_default=True, frozen_default=True)
class _ParamsMeta(msgspec.StructMeta):
    """Makes every parameter keyword-only and reads the declarations."""

    __declared__: dict[str, Param]

    def __new__(
        cls,
        name: str,
        bases: tuple[type, ...],
        namespace: dict[str, Any],
        **settings: Any,  # noqa: ANN401 - what Struct takes
    ) -> Any:  # noqa: ANN401 - a metaclass returns the class it makes
        settings.setdefault("kw_only", True)
        made: Any = super().__new__(cls, name, bases, namespace, **settings)
        if bases != (Struct,):  # not Params itself
            made.__declared__ = _declared(made, Declaring(made, here()))
        return made

    if not TYPE_CHECKING:  # checkers compare calls with the fields

        def __call__(cls, *args: object, **values: object) -> Any:  # noqa: ANN401
            """Make parameters; an error has the line of the caller."""
            __tracebackhide__ = True  # of pytest
            try:
                _check_fields(cls, args, values)
                return super().__call__(**values)
            except ParameterError as error:
                raise error.with_traceback(None) from None


class Params(Struct, frozen=True, forbid_unknown_fields=True, metaclass=_ParamsMeta):
    """Base of a module's parameters: frozen, keyword-only, checked when made.

    A module's parameters are declared like its ports::

        class Gains(Params):
            kp: A[float, param("N*m/rad", "stiffness", ge=0)]
            kd: A[float, param("N*m*s/rad", "damping", ge=0)] = 0.0

    Types are ``float``, ``int``, ``bool``, ``str``, ``Literal["a", "b"]`` and tuples of
    the first four, ``tuple[float, float, float]`` or ``tuple[float, ...]``; bounds hold
    for each value of a tuple. A tuple may be given as a list or as a numpy array of one
    dimension. Required parameters come first.

    Raises:
        ParameterError: A name is unknown or missing, or a value is mistyped or out of
            bounds.
    """

    __declared__: ClassVar[dict[str, Param]] = {}

    def __post_init__(self) -> None:
        """Check every value; numpy arrays and lists become tuples."""
        for name, about in type(self).__declared__.items():
            given = getattr(self, name)
            value = _plain(about, given)
            _check(type(self).__name__, about, value)
            if value is not given:
                structs.force_setattr(self, name, value)


P = TypeVar("P", bound=Params)


def make_params(kind: type[P], values: Mapping[str, object]) -> P:
    """Make parameters from plain Python values.

    Raises:
        ParameterError: A name is unknown or missing, or a value is refused.
    """
    __tracebackhide__ = True  # of pytest
    fields = {about.name: field for field, about in kind.__declared__.items()}
    for name in values:
        if name not in fields:
            raise _unknown(kind, name, kind.__name__)
    return kind(**{fields[name]: value for name, value in values.items()})


def _check_fields(cls: Any, args: object, values: Mapping[str, object]) -> None:  # noqa: ANN401
    """Refuse values without a name, unknown names, and missing ones."""
    if args:
        call = ", ".join(f"{name}=..." for name in cls.__declared__)
        raise ParameterError(
            f"{cls.__name__} takes parameters by name",
            where=cls.__name__,
            expected=f"{cls.__name__}({call})",
            got=f"a value without one: {args}",
            remedy="name each of them",
        )
    for name in values:
        if name not in cls.__declared__:
            raise _unknown(cls, name, cls.__name__)
    for field in structs.fields(cls):
        if field.required and field.name not in values:
            error = _missing(cls, cls.__declared__[field.name], {}, cls.__name__)
            error.remedy = f"give it a value: {cls.__name__}({field.name}=...)"
            raise error


class Line(Protocol):
    """A LOCAL line: the words after its key, and its place."""

    @property
    def words(self) -> tuple[str, ...]:
        """The words after the key."""
        ...

    @property
    def place(self) -> object:
        """The place of the line; its text is ``file:line:column``."""
        ...


class HasParams(Protocol):
    """A module's class, seen from here."""

    __params__: ClassVar[type[Params]]


def params_type(cls: type[Params | HasParams]) -> type[Params]:
    """Return the parameter class of a module, or the parameter class itself."""
    return cls if issubclass(cls, Params) else cls.__params__


def decode_params(
    cls: type[Params | HasParams],
    local: Mapping[str, Line],
    *,
    where: str = "",
) -> Params:
    """Make a module's parameters from the LOCAL lines of an RMOD.

    Keys are matched without regard to case, as files write them in capitals.

    Args:
        cls: The module's class, or its parameter class.
        local: The lines by key.
        where: Place of what no line can be blamed for, such as a missing line.

    Raises:
        ParameterError: A key is unknown or missing, or a value is mistyped, out of
            bounds, or one of too many or too few.
    """
    kind = params_type(cls)
    known = {about.name.lower(): name for name, about in kind.__declared__.items()}
    values: dict[str, Any] = {}
    for key, line in local.items():
        field = known.get(key.lower())
        place = str(line.place) if line.place else where
        if field is None:
            raise _unknown(cls, key, place)
        about = kind.__declared__[field]
        if field in values:
            raise ParameterError(
                f"parameter {about.name} is given twice",
                where=place,
                expected="one line for each parameter, in capitals or not",
                remedy="remove one of them",
            )
        values[field] = _decode(about, line.words, place)
    for need in _required(kind):
        if need not in values:
            raise _missing(cls, kind.__declared__[need], local, where)
    return kind(**values)


@cache
def _required(kind: type[Params]) -> tuple[str, ...]:
    """Return the fields that must be given."""
    return tuple(one.name for one in structs.fields(kind) if one.required)


def change_param(
    params: P,
    name: str,
    words: tuple[str, ...],
    *,
    where: str = "",
    running: bool = False,
) -> P:
    """Return `params` with one value changed, decoded and checked like a LOCAL line.

    Args:
        params: The present ones.
        name: The parameter.
        words: Its new value.
        where: The place of the value, for errors.
        running: The task is ON, so that steps are limited to their declared `rate`.

    Raises:
        ParameterError: No such parameter, or the value is refused.
    """
    field = find_param(params, name, where=where)
    about = params.__declared__[field]
    value = _decode(about, words, where)
    if running and about.rate is not None:
        _check_step(about, about.rate, getattr(params, field), value, where)
    return structs.replace(params, **{field: value})


def _check_step(
    about: Param,
    rate: float,
    before: Any,  # noqa: ANN401 - a value of the declared type, as below
    value: Any,  # noqa: ANN401
    where: str,
) -> None:
    """Refuse a change of a value that is larger than `rate`."""
    pairs = zip(before, value, strict=True) if about.count else [(before, value)]
    for index, (old, new) in enumerate(pairs):
        if abs(new - old) > rate * (1.0 + _ROUNDING):
            which = f" (value {index + 1} of {len(value)})" if about.count else ""
            unit = "" if about.unit == "none" else f" {about.unit}"
            raise ParameterError(
                f"parameter {about.name} changes too much at once{which}",
                where=where,
                expected=f"a step of at most {rate:g}{unit} while the task is ON",
                got=f"{abs(new - old):g}{unit}, from {old:g} to {new:g}",
                remedy="change it in several steps, or while the task is OFF",
            )


def find_param(params: Params, name: str, *, where: str = "") -> str:
    """Return the field of the parameter that `name` means, whatever its case.

    Raises:
        ParameterError: There is none.
    """
    for field, about in params.__declared__.items():
        if about.name.lower() == name.lower():
            return field
    raise _unknown(type(params), name, where)


_TRUE = frozenset({"true", "yes", "on", "1"})
_FALSE = frozenset({"false", "no", "off", "0"})
_INT = re.compile(r"[+-]?([0-9]{1,60}|0[xX][0-9a-fA-F]{1,60})")
_FLOAT = re.compile(r"[+-]?([0-9]+\.?[0-9]*|\.[0-9]+)([eE][+-]?[0-9]+)?")


def _decode(about: Param, words: tuple[str, ...], where: str) -> Any:  # noqa: ANN401
    if about.type == "str" and not about.count:
        words = (" ".join(words),) if words else ()
    expected = {0: 1, ANY_COUNT: max(len(words), 1)}.get(about.count, about.count)
    if len(words) != expected:
        raise ParameterError(
            f"parameter {about.name} has the wrong number of values",
            where=where,
            expected=str(about),
            got=_values(len(words)),
            remedy="give at least one"
            if about.count == ANY_COUNT
            else f"give {_values(expected)}",
        )
    values = tuple(_word(about, word, where) for word in words)
    value = values if about.count else values[0]
    _check("", about, value, where=where)
    return value


def _word(about: Param, word: str, where: str) -> float | str:
    low = word.lower()
    if about.type == "str":
        return word
    if about.type == "bool" and low in _TRUE | _FALSE:
        return low in _TRUE
    if about.type == "int" and _INT.fullmatch(word):
        return int(word, 16) if "x" in low else int(word)
    if about.type == "float" and _FLOAT.fullmatch(word):
        return float(word)
    article = "an" if about.type == "int" else "a"
    raise ParameterError(
        f"a value of parameter {about.name} is not {article} {about.type}",
        where=where,
        expected=str(about),
        got=f'"{word}"',
        remedy=_hint(about.type),
    )


def _hint(kind: str) -> str:
    hints = {"bool": "write yes or no", "int": "write it without a decimal point"}
    return hints.get(kind, "write numbers as in 2.5, -3 or 1e-3")


def _values(count: int) -> str:
    return "1 value" if count == 1 else f"{count} values"


def _check(
    owner: str,
    about: Param,
    value: Any,  # noqa: ANN401 - whatever was given
    *,
    where: str = "",
) -> None:
    """Raise unless `value` has the declared type, count, choice and bounds."""
    place = where or f"{owner}.{about.name}"
    if not _typed(about, value):
        raise ParameterError(
            f"parameter {about.name} has the wrong type",
            where=place,
            expected=str(about),
            got=repr(value),
            remedy="give a value of that type",
        )
    if about.choices and value not in about.choices:
        near = did_you_mean(str(value), about.choices)
        raise ParameterError(
            f"parameter {about.name} has no such choice",
            where=place,
            expected=about.type_text,
            got=repr(value),
            remedy=near or "choose one of these",
        )
    if about.type not in {"int", "float"}:
        return
    values: tuple[float, ...] = value if about.count else (value,)
    for index, one in enumerate(values):
        if not about.within(one):
            which = f" (value {index + 1} of {len(values)})" if about.count else ""
            raise ParameterError(
                f"parameter {about.name} is out of bounds{which}",
                where=place,
                expected=str(about) if about.bounds else f"{about}, finite",
                got=f"{one:g}",
                remedy="choose a value within the bounds",
            )
    if about.total is not None and not math.isclose(
        sum(values), about.total, rel_tol=0.0, abs_tol=_ROUNDING
    ):
        raise ParameterError(
            f"the values of parameter {about.name} do not sum to {about.total:g}",
            where=place,
            expected=str(about),
            got=f"{' + '.join(f'{one:g}' for one in values)} = {sum(values):g}",
            remedy="give values that do",
        )


_ROUNDING = 1e-9
"""Tolerance of a sum of values: 0.1 has no exact double."""

_PYTHON: dict[str, tuple[type, ...]] = {
    "float": (float, int),
    "int": (int,),
    "bool": (bool,),
    "str": (str,),
}


def _plain(about: Param, value: Any) -> Any:  # noqa: ANN401
    """Return a list or numpy array as a tuple, and a numpy number as Python's."""
    if hasattr(value, "tolist"):  # numpy is not imported for it
        value = value.tolist()
    if about.count and isinstance(value, list):
        return tuple(cast("list[object]", value))
    return value


def _typed(about: Param, value: Any) -> bool:  # noqa: ANN401
    if about.count:
        if not isinstance(value, tuple) or not value:
            return False
        values = cast("tuple[object, ...]", value)
        if about.count not in {ANY_COUNT, len(values)}:
            return False
        return all(_typed(structs.replace(about, count=0), one) for one in values)
    if isinstance(value, bool) and about.type != "bool":
        return False
    return isinstance(value, _PYTHON[about.type])


def _owner(cls: type) -> str:
    return f"module {cls.__name__}" if not issubclass(cls, Params) else cls.__name__


def _unknown(cls: type[Any], key: str, where: str) -> ParameterError:
    names = [about.name for about in params_type(cls).__declared__.values()]
    return ParameterError(
        f"{_owner(cls)} has no parameter {key}",
        where=where,
        expected=f"one of {', '.join(names)}" if names else "no parameters at all",
        remedy=did_you_mean(key.lower(), names)
        or ("name one of these, or remove it" if names else "remove it"),
    )


def _missing(
    cls: type[Any], about: Param, local: Mapping[str, Line], where: str
) -> ParameterError:
    if not where and local:
        where = str(next(iter(local.values())).place or "").split(":")[0]
    return ParameterError(
        f"{_owner(cls)} needs parameter {about.name}: {about.doc}",
        where=where,
        expected=str(about),
        remedy=f"add a line `{about.name.upper()} ...` under LOCAL",
    )


def combine_params(parts: Mapping[str, type[Params]]) -> type[Params]:
    """Return the parameters of all parts as those of one module: ``part.name``.

    Args:
        parts: The parameter class of each part.
    """
    hints: dict[str, Any] = {}
    public: dict[str, str] = {}
    space: dict[str, Any] = {"__module__": __name__, "__annotations__": hints}
    for number, (part, kind) in enumerate(parts.items()):
        for field in structs.fields(kind):
            key = combined_field(number, field.name)
            about = kind.__declared__[field.name]
            hints[key] = A[_annotation(about), about]
            public[key] = f"{part}.{about.name}"
            if not field.required:
                space[key] = field.default
    made: Any = _ParamsMeta("Combined", (Params,), space)
    made.__declared__ = {
        key: structs.replace(about, name=public[key])
        for key, about in made.__declared__.items()
    }
    combined: type[Params] = made
    return combined


def _annotation(about: Param) -> Any:  # noqa: ANN401 - a type, as an annotation has it
    """Return the type in a parameter's declaration."""
    if about.choices:
        return Literal[about.choices]
    plain: Any = {"float": float, "int": int, "bool": bool, "str": str}[about.type]
    many: Any = tuple
    if about.count == ANY_COUNT:
        return many[plain, ...]
    return many[(plain,) * about.count] if about.count else plain


def combined_field(part: int, field: str) -> str:
    """Return the field of a combination that holds `field` of its part."""
    return f"part{part}_{field}"


def _declared(cls: type[Params], body: Declaring) -> dict[str, Param]:
    """Read the declarations of one parameter class; those of its bases come first."""
    found: dict[str, Param] = {}
    for base in reversed(cls.__mro__[1:]):
        found.update(getattr(base, "__declared__", {}))
    for attr, hint in body.annotations(("param",)):
        if get_origin(hint) is not ClassVar and hint is not ClassVar:
            found[attr] = _declare(body, attr, hint)
    lower: dict[str, str] = {}
    for name in found:
        if (other := lower.setdefault(name.lower(), name)) != name:
            what = f"the parameters {other} and {name} differ in case only"
            raise body.error(name, what)
    for field in structs.fields(cls):
        if field.default is not msgspec.NODEFAULT:
            _check_default(body, found[field.name], field.default)
    return found


def _check_default(body: Declaring, about: Param, default: object) -> None:
    try:
        _check("", about, default)
    except ParameterError as error:
        raise body.error(
            about.name,
            f"the default is refused: {error.what}",
            expected=error.expected,
            got=error.got,
        ) from None


def _declare(body: Declaring, attr: str, hint: object) -> Param:
    """Return the annotation of one parameter."""
    marks = [m for m in get_args(hint)[1:] if isinstance(m, Param)]
    if get_origin(hint) is not A or len(marks) != 1:
        raise body.error(
            attr,
            "a parameter declares its unit and meaning",
            expected=f'{attr}: A[type, param("unit", "doc")]',
            got=hint.__name__ if isinstance(hint, type) else str(hint),
        )
    if attr.startswith("_"):
        raise body.error(attr, "a parameter is public", got=attr)
    mark = marks[0]
    for word in ("unit", "doc"):
        value: object = getattr(mark, word)
        if not isinstance(value, str) or not value.strip():
            raise body.error(attr, f"the parameter has no {word}", got=repr(value))
    kind, count, choices = _kind(body, attr, get_args(hint)[0])
    about = structs.replace(mark, name=attr, type=kind, count=count, choices=choices)
    if about.bounds and kind not in {"int", "float"}:
        raise body.error(attr, f"a {kind} has no bounds", got=about.bounds)
    if about.names and (kind != "str" or choices):
        what = f"the name of a {about.names} is a text"
        raise body.error(attr, what, expected="str", got=about.type_text)
    if about.total is not None and not count:
        raise body.error(attr, "one value alone has no sum", got=about.bounds)
    if about.rate is not None and not 0 < about.rate < math.inf:
        what = "rate, the largest step while ON, is a number above 0"
        raise body.error(attr, what, got=f"{about.rate:g}")
    if about.rate is not None and count == ANY_COUNT:
        what = "values that may become more or fewer have no rate"
        raise body.error(attr, what, got=about.type_text)
    return about


def _kind(body: Declaring, attr: str, kind: object) -> tuple[str, int, tuple[str, ...]]:
    """Return type name, count and choices of a parameter's type."""
    plain = {float: "float", int: "int", bool: "bool", str: "str"}
    words = get_args(kind)
    if isinstance(kind, type) and kind in plain:
        return plain[kind], 0, ()
    if get_origin(kind) is Literal and all(isinstance(w, str) for w in words):
        return "str", 0, words
    if get_origin(kind) is tuple and words:
        first, rest = words[0], set(words[1:])
        if first in plain and rest <= {first}:
            return plain[first], len(words), ()
        if first in plain and words[1:] == (Ellipsis,):
            return plain[first], ANY_COUNT, ()
    raise body.error(
        attr,
        "the type cannot be a parameter's",
        expected='float, int, bool, str, Literal["a", "b"], tuple[float, ...] '
        "or tuple[float, float]",
        got=str(kind),
    )
