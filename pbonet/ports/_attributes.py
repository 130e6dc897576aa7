"""The attributes through which a module uses its ports.

An array port is a numpy array in the instance's dictionary. The class holds a guard
with ``__set__`` and no ``__get__``: Python then reads straight from the dictionary, and
only an assignment to the port itself meets the guard. A scalar port is a property on a
memoryview of its one element, so that nothing has to be copied between the module and
the table around a cycle.
"""

from __future__ import annotations

import linecache
import re
from typing import TYPE_CHECKING, Any

from pbonet.errors import PortError

from ._port import accepts, wanted
from ._source import here

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from ._port import Port

SCALARS = "_port_scalars"
"""The instance attribute that holds the memoryviews of scalar ports, by attribute."""


class ArrayPort:
    """Refuses to bind an array port to another object.

    ``self.tau += x`` ends in an assignment of the same array, which is no rebinding.
    """

    __slots__ = ("_attr", "port")

    def __init__(self, port: Port) -> None:
        self.port = port
        self._attr = port.attr

    def __set__(self, instance: object, value: object) -> None:
        """Let the same object pass, refuse any other."""
        if value is not instance.__dict__.get(self._attr):
            raise _rebound(self.port, instance)

    def __delete__(self, instance: object) -> None:
        """Refuse to delete the port."""
        raise _rebound(self.port, instance)

    def __repr__(self) -> str:
        """Name the port; this is what the class, not an instance, shows."""
        return f"<{self.port.kind} {self.port.name}>"


class InScalar(property):
    """A scalar input: a plain number that only its producer changes."""

    def __init__(self, port: Port) -> None:
        attr = port.attr

        def read(instance: Any) -> Any:  # noqa: ANN401 - float, int or bool
            return instance._port_scalars[attr][0]  # noqa: SLF001 - its own field

        super().__init__(read, doc=port.doc)
        self.port = port

    def __set__(self, instance: object, value: object) -> None:
        """Refuse; an input belongs to its producer."""
        raise _rebound(self.port, instance)


class OutScalar(property):
    """A scalar output: a plain number, assigned like any other attribute."""

    def __init__(self, port: Port) -> None:
        attr = port.attr

        def read(instance: Any) -> Any:  # noqa: ANN401 - float, int or bool
            return instance._port_scalars[attr][0]  # noqa: SLF001 - its own field

        def write(instance: Any, value: Any) -> None:  # noqa: ANN401 - checked below
            try:
                instance._port_scalars[attr][0] = value  # noqa: SLF001 - its own field
            except (TypeError, ValueError) as error:
                raise _mistyped(port, instance, value, error) from None

        super().__init__(read, write, doc=port.doc)
        self.port = port


def attribute(port: Port) -> ArrayPort | InScalar | OutScalar:
    """Return the class attribute for `port`."""
    if not port.is_scalar:
        return ArrayPort(port)
    return InScalar(port) if port.kind.is_input else OutScalar(port)


def view(
    port: Port, array: NDArray[Any], shape: tuple[int, ...], *, where: str
) -> NDArray[Any]:
    """Return `array` as the module sees it: shaped, and read-only for an input.

    Raises:
        PortError: The variable's type does not fit the port.
    """
    if not accepts(port, array.dtype.str):
        raise PortError(
            f"the variable of port {port.attr} ({port.name}) has another type",
            where=where,
            expected=wanted(port),
            got=array.dtype.name,
            remedy="correct TYPE in the .svar file, or the port's annotation",
        )
    if not array.flags.c_contiguous:
        raise PortError(
            f"the memory of port {port.attr} ({port.name}) has gaps",
            where=where,
            expected="a contiguous array",
        )
    shaped = array.reshape(shape or (1,))
    if port.kind.is_input:
        shaped = shaped.view()
        shaped.flags.writeable = False
    return shaped


def _rebound(port: Port, instance: object) -> PortError:
    where = f"{type(instance).__name__}.{port.attr}"
    wrong = _statement(port.attr)
    if port.kind.is_input:
        return PortError(
            f"{port.kind} {port.name} is written by its producer only",
            where=where,
            got=f"`{wrong}`",
            remedy=f"take a copy under another name: "
            f"`{port.attr} = self.{port.attr}{'' if port.is_scalar else '.copy()'}`",
        )
    return PortError(
        f"{port.kind} {port.name} is bound once; assign to its elements",
        where=where,
        expected=f"`{_right(wrong, port.attr)}`",
        got=f"`{wrong}`",
    )


def _statement(attr: str) -> str:
    """Return the source line of the assignment, or a substitute if there is none."""
    frame = here(3)
    line = ""
    if frame:
        line = linecache.getline(frame.f_code.co_filename, frame.f_lineno).strip()
    return line if f".{attr}" in line else f"self.{attr} = ..."


def _right(wrong: str, attr: str) -> str:
    right, count = re.subn(rf"(\.{attr})(\s*=)", r"\1[:]\2", wrong, count=1)
    return right if count else f"self.{attr}[:] = ..."


def _mistyped(
    port: Port, instance: object, value: object, error: Exception
) -> PortError:
    remedy = ""
    if hasattr(value, "__len__") and not isinstance(value, str):
        remedy = f"assign one number, such as `{port.type}(x[0])`"
    elif port.type == "int" and isinstance(value, float):
        remedy = "convert it: `round(x)`, or `int(x)` to cut"
    elif isinstance(error, ValueError):
        remedy = "it does not fit the type of the variable in the .svar file"
    return PortError(
        f"{port.kind} {port.name} takes a plain {port.type}",
        where=f"{type(instance).__name__}.{port.attr}",
        expected=port.type,
        got=f"{type(value).__name__} {value!r}",
        remedy=remedy,
    )
