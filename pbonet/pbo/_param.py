"""Description of one parameter: type, unit, meaning, bounds."""

from __future__ import annotations

import math

from msgspec import Struct

ANY_COUNT = -1
"""The count of a parameter that takes any number of values."""


class Param(Struct, frozen=True):
    """Description of a parameter, from `param` and its annotation."""

    unit: str
    doc: str
    ge: float | None = None
    gt: float | None = None
    le: float | None = None
    lt: float | None = None
    total: float | None = None
    """Limit for the sum of a tuple's values."""
    rate: float | None = None
    """Largest change of a value by one `set` while the task is ON."""
    names: str = ""
    """The kind of thing that its value names, such as ``device``; else empty."""
    name: str = ""
    type: str = "float"
    """``float``, ``int``, ``bool`` or ``str``, of each value."""
    count: int = 0
    """0 for one plain value, a number of values, or `ANY_COUNT`."""
    choices: tuple[str, ...] = ()

    @property
    def bounds(self) -> str:
        """The bounds as text, such as ``>= 0 and < 5``; empty without bounds."""
        signs = {">=": self.ge, ">": self.gt, "<=": self.le, "<": self.lt}
        found = [
            f"{sign} {value:g}" for sign, value in signs.items() if value is not None
        ]
        if self.total is not None:
            found.append(f"sum {self.total:g}")
        if self.rate is not None:
            found.append(f"steps <= {self.rate:g} while ON")
        return " and ".join(found)

    @property
    def type_text(self) -> str:
        """The type in words, such as ``3 float`` or ``one of linear, parabolic``."""
        if self.choices:
            return f"one of {', '.join(self.choices)}"
        counts = {0: self.type, ANY_COUNT: f"one or more {self.type}"}
        return counts.get(self.count, f"{self.count} {self.type}")

    def __str__(self) -> str:
        """Return type, unit and bounds in words."""
        unit = "" if self.unit == "none" else f" in {self.unit}"
        return f"{self.type_text}{unit}{f', {self.bounds}' if self.bounds else ''}"

    def within(self, value: float) -> bool:
        """Return whether one value keeps the bounds and is finite."""
        return (
            math.isfinite(value)
            and (self.ge is None or value >= self.ge)
            and (self.gt is None or value > self.gt)
            and (self.le is None or value <= self.le)
            and (self.lt is None or value < self.lt)
        )


def param(
    unit: str,
    doc: str,
    *,
    ge: float | None = None,
    gt: float | None = None,
    le: float | None = None,
    lt: float | None = None,
    total: float | None = None,
    rate: float | None = None,
    device: bool = False,
) -> Param:
    """Declare the unit, meaning and bounds of a parameter, within its annotation.

    Args:
        unit: Its unit; ``none`` for a pure number or a word.
        doc: A short description.
        ge: Smallest value that is allowed, in `unit`.
        gt: Values must be larger than this.
        le: Largest value that is allowed.
        lt: Values must be smaller than this.
        total: What the values of a tuple must add up to, but for rounding.
        rate: Largest change of each value by one `set` while the task is ON, in `unit`;
            larger changes are made in several steps, or while it is OFF.
        device: Its text is the logical name of a device that the module opens: the task
            must be on an RTPU whose ``agent.toml`` has it.

    Returns:
        The object for the annotation: ``kp: A[float, param("N*m/rad", "gain", ge=0)]``.
    """
    names = "device" if device else ""
    return Param(unit, doc, ge, gt, le, lt, total, rate, names)
