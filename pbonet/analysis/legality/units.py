"""Are two units the same? Through pint's names and aliases, else as text."""

from __future__ import annotations

import re
from functools import cache, lru_cache
from typing import Any, cast

ANY = "any"
"""The unit of a generic module's port: it goes with every unit."""

_NONE = {"none", "", "1", "-", "dimensionless"}
_POWER = re.compile(r"(?:\^|\*\*) ?[+-]?[1-9](?![0-9.])")
_UNSAFE = re.compile(r"[02-9.^]|\*\*|1[0-9]")
_LONGEST = 64


def same_unit(one: str, other: str) -> bool:
    """Return whether two units are the same.

    ``rad/s`` is ``radians/seconds`` and ``N*m`` is ``kg*m^2/s^2``; ``deg`` is not
    ``rad``, and an angle is not a pure number. Text that is no known unit, such as
    ``counts per turn``, is the same as equal text only.
    """
    one, other = " ".join(one.split()), " ".join(other.split())
    if one == other or ANY in {one, other}:
        return True
    return _root(one) is not None and _root(one) == _root(other)


def conversion(one: str, other: str) -> str:
    """Return how a value of one unit becomes one of the other, empty if unknown."""
    by = factor(one, other)
    return f"1 {one} is {by:.6g} {other}" if by else ""


def factor(one: str, other: str) -> float | None:
    """Return by what a value of one unit becomes one of the other, None if unknown."""
    first, second = _root(" ".join(one.split())), _root(" ".join(other.split()))
    if first is None or second is None or first[1] != second[1]:
        return None
    return first[0] / second[0]


def known_unit(unit: str) -> bool:
    """Return whether a unit is more than text, so that one can compute with it."""
    return _root(" ".join(unit.split())) is not None


@lru_cache(maxsize=1024)
def _root(text: str) -> tuple[float, str] | None:
    """Return factor and root units of `text`, None for text that is no known unit."""
    if text in _NONE:
        return 1.0, "dimensionless"
    if len(text) > _LONGEST or _UNSAFE.search(_POWER.sub("", text)):
        return None
    registry = _registry()
    if registry is None:
        return None
    try:
        unit = registry.parse_units(text)
        factor, root = registry.get_root_units(unit)
        offset = registry.Quantity(0.0, unit).to(root).magnitude
    except Exception:  # noqa: BLE001 - pint raises what its tokenizer raises
        return None
    if offset:  # a scale such as degC, which is the same as itself only
        return 1.0, str(unit)
    return float(f"{factor:.12g}"), str(root)


@cache
def _registry() -> Any | None:  # noqa: ANN401 - pint is typed in part only
    """Return pint's units, None where pint is not installed; loaded when first used."""
    try:
        import pint
    except ImportError:
        return None
    registry = cast("Any", pint.UnitRegistry(on_redefinition="ignore"))
    # pint reads Nm as a textile's "number metric"; in robotics it is a torque
    registry.define("torque_newton_meter = newton * meter = Nm")
    return registry
