"""The global and local tables of a bench, and the copies between them."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np

from pbonet.errors import PortError, did_you_mean
from pbonet.node.wire import Step
from pbonet.pbo import CycleAborted
from pbonet.ports import Kind, Port
from pbonet.svar import Action, Blamed

from ._ages import InputAges

if TYPE_CHECKING:
    from collections import deque
    from collections.abc import Iterable, Mapping

NONFINITE = 16
"""The flag of a commit that was refused because a float is NaN or infinite."""


class PortValues:
    """Ports of a bench by attribute: values in the global table.

    Reading an array port gives the array itself, so that single elements may be set;
    assigning copies. Scalars are plain numbers.
    """

    _table: BenchTable
    _ports: Mapping[str, Port]
    _kind: str

    def __init__(self, table: BenchTable, ports: Iterable[Port], kind: str) -> None:
        found = {port.attr: port for port in ports}
        vars(self).update(_table=table, _ports=found, _kind=kind)

    def __getattr__(self, attr: str) -> Any:  # noqa: ANN401 - a number or an array
        """Return the value of a port."""
        return self._table.get(self._port(attr))

    def __setattr__(self, attr: str, value: object) -> None:
        """Set the value of a port, as another task would."""
        self._table.put(self._port(attr), value)

    def __dir__(self) -> list[str]:
        """Return the ports."""
        return list(self._ports)

    def _port(self, attr: str) -> Port:
        try:
            return self._ports[attr]
        except KeyError:
            raise PortError(
                f"the module has no {self._kind} {attr}",
                expected=", ".join(self._ports) or f"no {self._kind}s at all",
                remedy=did_you_mean(attr, self._ports),
            ) from None


class BenchTable:
    """Global and local values of one module's ports, and the copies between them.

    Args:
        ports: The module's ports.
        shapes: Their shapes, by attribute.
        log: Gets the name of each copy.
        dtypes: Numpy types by attribute, where the annotation does not say it all.
        ages: Of the inputs.
    """

    def __init__(
        self,
        ports: tuple[Port, ...],
        shapes: Mapping[str, tuple[int, ...]],
        log: deque[str],
        dtypes: Mapping[str, np.dtype[Any]] | None = None,
        *,
        ages: InputAges | None = None,
    ) -> None:
        self.ports = ports
        kinds = {port.attr: _dtype(port, dtypes or {}) for port in ports}
        self.globals = {
            attr: np.zeros(shapes[attr] or (1,), dtype) for attr, dtype in kinds.items()
        }
        self.local = {attr: array.copy() for attr, array in self.globals.items()}
        self.owned = False
        self._blamed = Blamed()
        self._log = log
        self.ages = ages or InputAges(ports)
        self.step = 0.0
        """Seconds since the last cycle."""
        self.made_safe = False
        """Whether the cycle under way has failed in time, and its outputs are discarded
        because safe values are there."""

    def get(self, port: Port) -> Any:  # noqa: ANN401 - a number or an array
        """Return the global value of a port."""
        array = self.globals[port.attr]
        return array.item() if port.is_scalar else array

    def put(self, port: Port, value: object) -> None:
        """Set the global value of a port.

        Raises:
            PortError: It has another size or another type.
        """
        array = self.globals[port.attr]
        try:
            given = np.asarray(value)
            array[...] = np.broadcast_to(given, array.shape).astype(
                array.dtype, casting="same_kind"
            )
        except (TypeError, ValueError) as error:
            raise PortError(
                f"the value does not fit port {port.attr} ({port.name})",
                expected=f"{array.dtype.name} of shape {array.shape}",
                got=repr(value),
                remedy=str(error),
            ) from None

    # -- what the executor calls -----------------------------------------------------

    @property
    def blamed(self) -> Blamed:
        """The output that was refused, or the input that is too old."""
        ages = self.ages
        if ages.action != Action.ERROR:
            return self._blamed
        name = next(port.name for port in self.ports if port.attr == ages.worst)
        limit, age = ages.limit(ages.worst), ages.age(ages.worst)
        return Blamed(
            name, 0, f"{age:.3g} s", "" if limit is None else f"at most {limit:g} s"
        )

    @property
    def action(self) -> int:
        """The action because inputs are too old."""
        return self.ages.action

    def make_new(self) -> None:
        """Let the next commit not inherit the age of an input."""
        self.ages.output = 0.0

    def copy_in_consts(self) -> int:
        """Copy the in-consts in."""
        return self._in(Step.COPY_IN_CONSTS, Kind.INCONST)

    def copy_out_consts(self, now_ns: int = 0) -> int:
        """Copy the out-consts out."""
        del now_ns
        return self._out(Step.COPY_OUT_CONSTS, Kind.OUTCONST)

    def copy_in(self) -> int:
        """Copy the in-vars in."""
        self.ages.judge(self.step)
        return self._in(Step.COPY_IN, Kind.INVAR)

    def copy_in_on(self) -> int:
        """Copy the in-vars and the out-vars in."""
        self.ages.turned_on()
        return self._in(Step.COPY_IN_ON, Kind.INVAR, Kind.OUTVAR)

    def check_claim(self) -> None:
        """There are no other tasks on a bench."""

    def claim(self, now_ns: int = 0, cycle: int = 0, own_ns: int = 0) -> int:
        """Copy the out-vars out and own them."""
        self._age(now_ns, own_ns)
        del cycle
        flags = self._out(Step.CLAIM, Kind.OUTVAR)
        self.owned = not flags
        return flags

    def commit(self, now_ns: int = 0, cycle: int = 0, own_ns: int = 0) -> int:
        """Copy the out-vars out.

        Raises:
            CycleAborted: The safe values are there in place of what the cycle gives.
        """
        if self.made_safe:
            raise CycleAborted
        self._age(now_ns, own_ns)
        del cycle
        return self._out(Step.COMMIT, Kind.OUTVAR)

    def make_safe(self) -> None:
        """Have readers see the safe values, as the dispatcher does at a failure."""
        self.made_safe = True
        self.make_new()
        for port in self.ports:
            if port.kind is Kind.OUTVAR:
                self.globals[port.attr][...] = port.safe

    def was_made_safe(self) -> None:
        """Note the safe values, which the out-vars have as well by now."""
        self.made_safe = False
        self._out(Step.COMMIT, Kind.OUTVAR)

    def cede(self) -> None:
        """Own nothing any more."""
        self.release()

    def release(self) -> None:
        """Own nothing any more."""
        self._log.append(str(Step.RELEASE))
        self.owned = False

    def _age(self, now_ns: int, own_ns: int) -> None:
        if own_ns:
            self.ages.output = (now_ns - own_ns) * 1e-9

    def _in(self, step: Step, *kinds: Kind) -> int:
        self._log.append(str(step))
        for port in self.ports:
            if port.kind in kinds:
                self.local[port.attr][...] = self.globals[port.attr]
        return 0

    def _out(self, step: Step, kind: Kind) -> int:
        self._log.append(str(step))
        ports = [port for port in self.ports if port.kind is kind]
        for port in ports:
            array = self.local[port.attr]
            if array.dtype.kind == "f" and not np.isfinite(array).all():
                element = int(np.argmin(np.isfinite(array)))
                value = str(array.reshape(-1)[element].item())
                self._blamed = Blamed(port.name, element, value)
                return NONFINITE
        for port in ports:
            self.globals[port.attr][...] = self.local[port.attr]
        return 0


def structures(values: Mapping[str, Any]) -> dict[str, np.dtype[Any]]:
    """Return the types of the values that are structures."""
    types: dict[str, np.dtype[Any]] = {}
    for attr, value in values.items():
        array = np.asanyarray(value)
        if array.dtype.kind == "V":
            types[attr] = array.dtype
    return types


def _dtype(port: Port, given: Mapping[str, np.dtype[Any]]) -> np.dtype[Any]:
    """Return the numpy type of the variable of a port."""
    if port.attr in given:
        return given[port.attr]
    if port.type == "void[]":
        raise PortError(
            f"port {port.name} is a structure of unknown size",
            where="Bench",
            remedy=f"say `{port.attr}=np.zeros(..., dtype)` when you make the bench",
        )
    names = {"float": "f8", "int": "i8", "bool": "?"}
    return np.dtype(names.get(port.type, port.type.removesuffix("[]")))
