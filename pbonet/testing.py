"""What authors of modules test with: a bench that steps one module in virtual time.

::

    bench = Bench(JointPID, params=Gains(kp=10.0, limit=5.0), ndof=2)
    bench.on()
    bench.inputs.q_ref = [0.1, 0.0]
    bench.step(0.002)
    assert bench.outputs.tau == approx([1.0, 0.0])

The bench runs the module through the same executor as a task, with the copies of
section 3.6 before and after each method, but in one thread, without shared memory and
without waiting. What it calls ``inputs`` and ``outputs`` is the global table: a module
sees an input when it is copied in, and an output appears when it is copied out.
"""

from __future__ import annotations

from collections import deque
from typing import TYPE_CHECKING, Any, Generic, Self, TypeVar

import numpy as np

from pbonet.errors import MethodError, PortError, did_you_mean
from pbonet.node.executor import Executor
from pbonet.node.lifecycle import Step
from pbonet.pbo import (
    METHODS,
    BoundedOutbox,
    Counted,
    Notice,
    Params,
    PortBasedObject,
    State,
    TaskContext,
    bind,
    local_text,
    make_params,
)
from pbonet.ports import Kind, Port, solve_shapes

if TYPE_CHECKING:
    from collections.abc import Iterable, Mapping


M = TypeVar("M", bound=PortBasedObject[Any])

NONFINITE = 16
"""The flag of a commit that was refused because a float is NaN or infinite."""


class FakeClock:
    """Time that passes when it is told to.

    Args:
        now_ns: Nanoseconds at the start.
    """

    def __init__(self, now_ns: int = 1_000_000_000) -> None:
        self.now_ns = now_ns

    def __call__(self) -> int:
        """Return the time in nanoseconds, as ``time.monotonic_ns`` does."""
        return self.now_ns

    def advance(self, seconds: float) -> int:
        """Let `seconds` pass and return the new time in nanoseconds."""
        if seconds < 0:
            message = f"time does not go back, not even by {-seconds:g} s"
            raise ValueError(message)
        self.now_ns += round(seconds * 1e9)
        return self.now_ns


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
    """

    def __init__(
        self,
        ports: tuple[Port, ...],
        shapes: Mapping[str, tuple[int, ...]],
        log: deque[str],
        dtypes: Mapping[str, np.dtype[Any]] | None = None,
    ) -> None:
        self.ports = ports
        kinds = {port.attr: _dtype(port, dtypes or {}) for port in ports}
        self.globals = {
            attr: np.zeros(shapes[attr] or (1,), dtype) for attr, dtype in kinds.items()
        }
        self.local = {attr: array.copy() for attr, array in self.globals.items()}
        self.owned = False
        self.blamed = ("", 0)
        self._log = log

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

    def copy_in_consts(self) -> int:
        """Copy the in-consts in."""
        return self._in(Step.COPY_IN_CONSTS, Kind.INCONST)

    def copy_out_consts(self, now_ns: int = 0) -> int:
        """Copy the out-consts out."""
        del now_ns
        return self._out(Step.COPY_OUT_CONSTS, Kind.OUTCONST)

    def copy_in(self) -> int:
        """Copy the in-vars in."""
        return self._in(Step.COPY_IN, Kind.INVAR)

    def copy_in_on(self) -> int:
        """Copy the in-vars and the out-vars in."""
        return self._in(Step.COPY_IN_ON, Kind.INVAR, Kind.OUTVAR)

    def check_claim(self) -> None:
        """Nobody else is on a bench."""

    def claim(self, now_ns: int = 0, cycle: int = 0) -> int:
        """Copy the out-vars out and own them."""
        del now_ns, cycle
        flags = self._out(Step.CLAIM, Kind.OUTVAR)
        self.owned = not flags
        return flags

    def commit(self, now_ns: int = 0, cycle: int = 0) -> int:
        """Copy the out-vars out."""
        del now_ns, cycle
        return self._out(Step.COMMIT, Kind.OUTVAR)

    def release(self) -> None:
        """Own nothing any more."""
        self._log.append(str(Step.RELEASE))
        self.owned = False

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
                self.blamed = (port.name, int(np.argmin(np.isfinite(array))))
                return NONFINITE
        for port in ports:
            self.globals[port.attr][...] = self.local[port.attr]
        return 0


class Bench(Generic[M]):
    """Runs one module in a test: inputs in, outputs out, in virtual time.

    `init` has run when the constructor returns, unless it failed.

    Args:
        module: The module's class.
        params: Its parameters, as its own class or as a mapping; none for defaults.
        freq: Cycles per second; the default step is its inverse.
        critical: As if the RMOD said CRITICAL; `illegal` then selects ``stable``.
        clock: Shared with other benches, if need be.
        name: What the task is called.
        more: Sizes by the name in the ports' shapes, and first values of ports by
            attribute: constants, inputs, and what the last writer left in the outputs.
            Every in-const needs a value; sizes follow from values where they can.
        values: The same as a mapping, for ports that are named like an argument.

    Attributes:
        inputs: In-consts and in-vars, by attribute.
        outputs: Out-consts and out-vars, by attribute.
        module: The instance.
        task: What it sees as ``self.task``.
        executor: What runs it.
        clock: The time.
        illegal: Whether the illegal-configuration flag is up.

    Raises:
        PortError: A size or an in-const is missing, or values do not fit together.
        ParameterError: A parameter is missing or refused.
        MethodError: `init` failed; `kill` has run.
    """

    def __init__(
        self,
        module: type[M],
        values: Mapping[str, Any] | None = None,
        /,
        *,
        params: Params | Mapping[str, object] | None = None,
        freq: float = 100.0,
        critical: bool = False,
        clock: FakeClock | None = None,
        name: str = "bench",
        **more: Any,  # noqa: ANN401 - numbers and arrays
    ) -> None:
        ports = module.__interface__.ports
        values = {**(values or {}), **more}
        shapes = _shapes(module, values)
        self._log: deque[str] = deque(maxlen=10_000)
        self.table = BenchTable(ports, shapes, self._log, _structures(values))
        self.inputs = PortValues(
            self.table, (p for p in ports if p.kind.is_input), "input"
        )
        self.outputs = PortValues(
            self.table, (p for p in ports if not p.kind.is_input), "output"
        )
        self._names = {port.name: port for port in ports}
        self._fill(ports, shapes, values)
        self.clock = clock or FakeClock()
        self.illegal = False
        self._outbox = BoundedOutbox(10_000)
        self.task = TaskContext(
            name, freq=freq, source=Counted(self.clock), outbox=self._outbox
        )
        self.module = bind(
            module,
            _params(module, params),
            {attr: array.reshape(-1) for attr, array in self.table.local.items()},
            self.task,
        )
        self._record_methods()
        self.executor = Executor(
            self.module,
            self.table,
            illegal=(lambda: self.illegal) if critical else None,
        )
        self.executor.spawn()

    # -- signals ----------------------------------------------------------------------

    @property
    def state(self) -> State:
        """The state of the task."""
        return self.executor.state

    def on(self, arg: str = "") -> State:
        """Send on; see `pbonet.node.executor.Executor.signal` for errors."""
        return self.executor.signal("on", arg)

    def off(self, *, handover: bool = False) -> State:
        """Send off."""
        return self.executor.signal("off", handover=handover)

    def kill(self) -> State:
        """Send kill."""
        return self.executor.signal("kill")

    def clear(self) -> State:
        """Send clear, as an operator does."""
        return self.executor.signal("clear")

    def reinit(self, **constants: Any) -> State:  # noqa: ANN401 - numbers and arrays
        """Change in-consts, by attribute, and send reinit."""
        for attr, value in constants.items():
            setattr(self.inputs, attr, value)
        return self.executor.signal("reinit")

    def set(self, name: str, value: Any) -> object:  # noqa: ANN401 - of any parameter
        """Change a parameter between two cycles, and return its new value."""
        return self.executor.set(name, tuple(local_text(value).split()))

    def get(self, name: str) -> object:
        """Return a parameter."""
        return self.executor.get(name)

    def step(self, dt: float | None = None, n: int = 1, *, check: bool = True) -> State:
        """Let time pass and do `n` cycles.

        Args:
            dt: Seconds of each cycle; the inverse of ``freq`` by default.
            n: How many; fewer when the task leaves the state ON.
            check: Raise what a cycle failed with, when the task is in ERROR behind it.

        Returns:
            The state behind the last cycle.

        Raises:
            MethodError: A cycle failed, and `error` did not put it right.
            StateError: The task is not ON.
        """
        step = self.task.period if dt is None else dt
        state = self.state
        for _ in range(n):
            state = self.executor.cycle(step, self.clock.advance(step))
            if check and state is State.ERROR:
                raise self.executor.failure or MethodError("the task is in ERROR")
            if state is not State.ON:
                break
        return state

    def sync(self) -> State:
        """Run the module's `sync`, as a task does that waits for its event."""
        return self.executor.sync()

    # -- what can be looked at --------------------------------------------------------

    @property
    def log(self) -> list[str]:
        """Copies and methods so far, in order, by the names of `Step`."""
        return list(self._log)

    def forget(self) -> None:
        """Empty the log."""
        self._log.clear()

    def notices(self) -> list[Notice]:
        """Return the signals and warnings since the last call."""
        return self._outbox.drain()

    def __getitem__(self, name: str) -> Any:  # noqa: ANN401 - a number or an array
        """Return the global value of a port by its name in ``.rmod`` files."""
        return self.table.get(self._named(name))

    def __setitem__(self, name: str, value: object) -> None:
        """Set the global value of a port by its name in ``.rmod`` files."""
        self.table.put(self._named(name), value)

    def __enter__(self) -> Self:
        """Return the bench; `kill` runs at the end of the block."""
        return self

    def __exit__(self, *_: object) -> None:
        """Kill the task unless that was done."""
        if self.state is not State.NOT_CREATED:
            self.kill()

    # -- making -----------------------------------------------------------------------

    def _named(self, name: str) -> Port:
        try:
            return self._names[name]
        except KeyError:
            raise PortError(
                f"the module has no port {name}",
                expected=", ".join(self._names) or "no ports at all",
                remedy=did_you_mean(name, self._names),
            ) from None

    def _fill(
        self,
        ports: tuple[Port, ...],
        shapes: Mapping[str, tuple[int, ...]],
        values: Mapping[str, Any],
    ) -> None:
        """Give the ports their first values; a size is the value of its constant."""
        sizes = {
            dim: size
            for port in ports
            for dim, size in zip(port.shape, shapes[port.attr], strict=True)
            if isinstance(dim, str)
        }
        for port in ports:
            if port.attr in values:
                self.table.put(port, values[port.attr])
            elif port.attr in sizes:
                self.table.put(port, sizes[port.attr])
            elif port.kind is Kind.INCONST:
                raise PortError(
                    f"in-const {port.name} has no value",
                    where="Bench",
                    remedy=f"say `{port.attr}=...` when you make the bench",
                )

    def _record_methods(self) -> None:
        """Have every method of the module note its name in the log first."""
        for name in METHODS:
            vars(self.module)[name] = self._noting(name, getattr(self.module, name))

    def _noting(self, name: str, method: Any) -> Any:  # noqa: ANN401 - any signature
        def noting(*args: Any) -> Any:  # noqa: ANN401 - any signature
            self._log.append(name)
            return method(*args)

        return noting


def _shapes(
    module: type[PortBasedObject[Any]], values: Mapping[str, Any]
) -> dict[str, tuple[int, ...]]:
    """Return the shape of every port, out of given sizes and values."""
    ports = module.__interface__.ports
    symbols = {dim for port in ports for dim in port.shape if isinstance(dim, str)}
    known = symbols | {port.attr for port in ports}
    for word in values:
        if word not in known:
            raise PortError(
                f"the module has no port and no size {word}",
                where=module.__name__,
                expected=", ".join(sorted(known)) or "no values at all",
                remedy=did_you_mean(word, known),
            )
    nelem = {
        port.name: int(np.size(values[port.attr]))
        for port in ports
        if port.attr in values and np.size(values[port.attr]) > 1
    }
    constants = {word: int(values[word]) for word in symbols if word in values}
    return solve_shapes(ports, nelem, constants, where=module.__name__)


def _params(
    module: type[PortBasedObject[Any]], given: Params | Mapping[str, object] | None
) -> Params:
    if isinstance(given, Params):
        return given
    return make_params(module.__params__, given or {})


def _structures(values: Mapping[str, Any]) -> dict[str, np.dtype[Any]]:
    """Return the types of the values that are structures."""
    types: dict[str, np.dtype[Any]] = {}
    for attr, value in values.items():
        array = np.asanyarray(value)
        if array.dtype.kind == "V":
            types[attr] = array.dtype
    return types


def _dtype(port: Port, given: Mapping[str, np.dtype[Any]]) -> np.dtype[Any]:
    """Return the numpy type of the variable behind a port."""
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


__all__ = ["Bench", "BenchTable", "FakeClock", "PortValues"]
