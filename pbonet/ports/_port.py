"""A port as plain data, and the variables that can be assigned to it."""

from __future__ import annotations

from enum import StrEnum

from msgspec import Struct

_KINDS = {"float": "f", "int": "iu", "bool": "b"}
"""Types of scalar ports, and the numpy kinds that they hold."""
_LETTERS = {"float": "f", "int": "i", "uint": "u", "complex": "c"}
"""The letter in numpy's type string for each name that ends in its bits."""


class Kind(StrEnum):
    """The four kinds of port (Stewart 1994, section 3.5)."""

    INCONST = "in-const"
    OUTCONST = "out-const"
    INVAR = "in-var"
    OUTVAR = "out-var"

    @property
    def is_input(self) -> bool:
        """True for a port that another task writes."""
        return self in {Kind.INCONST, Kind.INVAR}

    @property
    def is_const(self) -> bool:
        """True for a port that is copied around `init` and `reinit` only."""
        return self in {Kind.INCONST, Kind.OUTCONST}


class Stale(StrEnum):
    """The action of a task while an input is too old; later ones are stronger."""

    HOLD = "hold"
    """Skip the cycle: the outputs keep their values and their age."""
    STABLE = "stable"
    """Run `stable` in place of `cycle`."""
    SAFE = "safe"
    """Write the safe value of each out-var in place of `cycle`."""
    ERROR = "error"
    """Go to ERROR."""


class Port(Struct, frozen=True):
    """One port of a module, as plain data."""

    attr: str
    """The attribute of the module's class."""
    name: str
    """As ``.rmod`` and ``.svar`` files spell it."""
    kind: Kind
    shape: tuple[int | str, ...]
    """Empty for a scalar; else numbers and names of sizes."""
    unit: str
    doc: str
    type: str
    """``float``, ``int``, ``bool`` or a numpy type for scalars, else ``float64[]``."""
    max_age: float | None = None
    """Of an in-var: seconds, above which the value is too old."""
    stale: str = ""
    """Of an in-var: a value of `Stale`; empty: the task's own default."""
    feedback: bool = False
    """Of an in-var: its age is not passed on to the out-vars."""
    new: bool = False
    """Of an out-var: it is new information and does not inherit the inputs' age."""
    safe: tuple[float, ...] | None = None
    """Of an out-var: what `Stale.SAFE` writes; one number counts for each element."""
    value: tuple[float, ...] | None = None
    """Of an out-const: what it holds before `init`; likewise."""

    @property
    def is_size(self) -> bool:
        """True for a constant that may be the size of other ports: one integer."""
        return self.kind.is_const and self.is_scalar and "int" in self.type

    @property
    def is_scalar(self) -> bool:
        """True when the port is a plain Python number in the module."""
        return not self.shape


def accepts(port: Port, dtype: str) -> bool:
    """Return whether a variable of numpy type `dtype` fits `port`.

    A Python float holds any floating type and an int any integer type; an array port,
    and a scalar whose annotation is a numpy type, is that very type.
    """
    held = _code(dtype)
    if port.type in _KINDS:
        return held[0] in _KINDS[port.type]
    element = _code(port.type.removesuffix("[]"))
    return held == element or held[0] == element[0] == "V"


def _code(kind: str) -> str:
    """Return numpy's type string of a type, which may be given as that or as a name."""
    word = kind.rstrip("0123456789")
    if word in _LETTERS:
        return f"{_LETTERS[word]}{int(kind.removeprefix(word)) // 8}"
    return {"bool": "b1", "void": "V"}.get(kind, kind.lstrip("<|"))


def wanted(port: Port) -> str:
    """Return which types of variable `port` accepts, in words."""
    if port.type in _KINDS:
        return {"float": "a floating type", "int": "an integer type"}.get(
            port.type, "bool"
        )
    element = port.type.removesuffix("[]")
    return {"float64": "double", "float32": "float", "void": "struct"}.get(
        element, element
    )
