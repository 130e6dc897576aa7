"""A port of a module that is to be written, read from the words of a command."""

from __future__ import annotations

import keyword
from typing import TYPE_CHECKING

from msgspec import Struct

from pbonet.config import TYPES, element_type
from pbonet.errors import ConfigError, did_you_mean
from pbonet.pbo import METHODS
from pbonet.ports import NAME_FORM, SHAPES, Kind, name_fault, parse_shape

if TYPE_CHECKING:
    from pbonet.config import SvarFile, Variable

_RESERVED = frozenset({
    *METHODS,
    *("params", "task", "name", "freq", "clock", "critical", "crit", "handler"),
})
"""Names that a module, or the bench that tests it, has already."""


class NewPort(Struct, frozen=True, kw_only=True):
    """One port of a module that is to be written."""

    name: str
    kind: Kind
    shape: str
    unit: str
    type: str = "double"
    """As a ``.svar`` file has it."""
    doc: str = ""

    @property
    def attr(self) -> str:
        """The attribute: lower case, a ``^`` (a derivative) becomes ``d``."""
        head, hat, tail = self.name.partition("^")
        word = f"{head}d{tail}" if hat else head
        word = "".join(c if c.isalnum() or c == "_" else "_" for c in word.lower())
        word = word.lstrip("_") or "port"
        if not word[0].isalpha():
            word = f"port_{word}"
        if keyword.iskeyword(word) or word in _RESERVED:
            word += "_"
        return word


def read_port(text: str, kind: Kind, svar: SvarFile | None = None) -> NewPort:
    """Return the port that ``NAME[:SHAPE[:UNIT[:TYPE]]]`` means.

    What is left out comes from the ``.svar`` file; without one, the unit must be there.

    Args:
        text: Such as ``Q_MEZ``, ``Q_MEZ:ndof:rad`` or ``NDOF:1:none:int``.
        kind: What the port is.
        svar: Variables by name.

    Raises:
        ConfigError: Something is missing or cannot be.
    """
    name, *words = text.split(":")
    variable = _variable(name, svar)
    given = dict(zip(("shape", "unit", "type"), words, strict=False))
    if len(words) > len(("shape", "unit", "type")):
        raise ConfigError(
            "a port has at most four parts",
            where=text,
            expected="NAME:SHAPE:UNIT:TYPE",
            got=f"{1 + len(words)} parts",
            remedy="remove the surplus parts",
        )
    if variable is None and not given.get("unit"):
        raise ConfigError(
            f"the unit of port {name} is not known",
            where=text,
            expected=f"{name}:SHAPE:UNIT, such as {name}:6:rad",
            remedy="write it (none for a pure number), or name a .svar file",
        )
    port = NewPort(
        name=name,
        kind=kind,
        shape=given.get("shape") or (str(variable.nelem) if variable else "1"),
        unit=given.get("unit") or (variable.units if variable else "none"),
        type=given.get("type") or (variable.type if variable else "double"),
        doc=variable.desc if variable else "",
    )
    _check(port, text)
    return port


def _variable(name: str, svar: SvarFile | None) -> Variable | None:
    if svar is None:
        return None
    known = {variable.name: variable for variable in svar.variables}
    if name not in known:
        raise ConfigError(
            f"there is no variable {name}",
            where=svar.file,
            remedy=did_you_mean(name, known) or "define it there first",
        )
    return known[name]


def _check(port: NewPort, text: str) -> None:
    if fault := name_fault(port.name):
        raise ConfigError(
            fault,
            where=text,
            expected=NAME_FORM,
            got=f'"{port.name}"',
            remedy="choose another name",
        )
    try:
        parse_shape(port.shape)
    except ValueError as error:
        raise ConfigError(
            f"the shape {error}",
            where=text,
            expected=SHAPES,
            remedy="correct it, or leave it empty to take it from a .svar file",
        ) from None
    if element_type(port.type) is None:
        raise ConfigError(
            f"there is no type {port.type}",
            where=text,
            expected=" or ".join(TYPES),
            remedy=did_you_mean(port.type, TYPES) or "choose one of these",
        )
