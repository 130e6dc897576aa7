"""The bench: one module, run by the executor of real tasks, in virtual time."""

from __future__ import annotations

import operator
from collections import deque
from pathlib import Path
from typing import TYPE_CHECKING, Any, Generic, Self, TypeVar

import numpy as np

from pbonet.analysis.schedule import INSIDE
from pbonet.config import Library
from pbonet.errors import MethodError, PortError, did_you_mean
from pbonet.node.task import RAISED, Executor
from pbonet.pbo import (
    METHODS,
    BoundedOutbox,
    Counted,
    CycleAborted,
    Notice,
    Params,
    PortBasedObject,
    PythonWatch,
    Recovery,
    Section,
    State,
    TaskContext,
    TimingFailure,
    bind,
    decode_params,
    local_text,
    make_params,
)
from pbonet.ports import Kind, Port, Stale, is_safe, lacks, solve_shapes
from pbonet.svar import Action

from ._ages import InputAges
from ._clock import FakeClock
from ._table import BenchTable, PortValues, structures

if TYPE_CHECKING:
    from collections.abc import Iterable, Mapping

M = TypeVar("M", bound=PortBasedObject[Any])


class Bench(Generic[M]):
    """Runs one module in a test: inputs in, outputs out, in virtual time.

    The constructor runs `init`.

    Args:
        module: The module's class.
        params: Its parameters, as its own class or as a mapping; none for defaults.
        freq: Cycles per second; the default step is its inverse.
        critical: As with CRITICAL in the RMOD; `illegal` then selects ``stable``.
        crit: The task's criticality.
        handler: That of its handler of timing failures, as HANDLER in the RMOD.
        on_stale: What the task does while an input is too old, as STALE in the RMOD.
        safe_at: The timing failures at which the out-vars get their safe values at
            once, as SAFE in the RMOD; see `timing_failure`.
        settle: Seconds that all inputs must be fresh before it goes on, as there; None:
            two cycles.
        clock: Shared with other benches, if need be.
        name: What the task is called.
        seed: Where ``self.task.rng`` begins.
        library: Folders of modules, where files that parameters name are looked for.
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
        crit: int = INSIDE,
        handler: int | None = None,
        on_stale: str = "",
        safe_at: Iterable[str] = (),
        settle: float | None = None,
        clock: FakeClock | None = None,
        name: str = "bench",
        seed: int = 0,
        library: Iterable[str | Path] = (),
        **more: Any,  # noqa: ANN401 - numbers and arrays
    ) -> None:
        __tracebackhide__ = True  # of pytest
        ports = module.__interface__.ports
        values = {**(values or {}), **more}
        shapes = _shapes(module, values)
        self._log: deque[str] = deque(maxlen=10_000)
        self._ages = InputAges(
            ports,
            default=_critical(module) if critical else Action.GO_ON,
            stale=on_stale,
            settle=settle,
        )
        self.table = BenchTable(
            ports, shapes, self._log, structures(values), ages=self._ages
        )
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
            name,
            freq=freq,
            source=Counted(self.clock, crit),
            outbox=self._outbox,
            handler=handler,
            seed=seed,
        )
        self.task.libraries = tuple(map(str, library))
        self.task.safe_at = _safe_at(module, safe_at)
        self._watch = self.task.watch = PythonWatch(self.task)
        self._cycling = self._skips = False
        self._passed = 0.0
        self.module = bind(
            module,
            _params(module, params),
            {attr: array.reshape(-1) for attr, array in self.table.local.items()},
            self.task,
        )
        self.task.is_stale = self._ages.is_stale
        self.task.age_of = self._ages.age
        self.task.stamp_of = lambda attr: (
            self.task.now - round(min(self._ages.age(attr), 1e6) * 1e9)
        )
        self.task.on_illegal = self._said_illegal
        self._record_methods()
        self.executor = Executor(
            self.module,
            self.table,
            illegal=(lambda: self.illegal) if critical else None,
        )
        self.executor.spawn()

    @classmethod
    def of(
        cls,
        rmod: str | Path,
        values: Mapping[str, Any] | None = None,
        /,
        *,
        library: Iterable[str | Path] = (),
        **more: Any,  # noqa: ANN401 - what the constructor takes
    ) -> Bench[PortBasedObject[Any]]:
        """Put an RMOD on the bench, such as a combination (section 3.8.1).

        Args:
            rmod: The ``.rmod`` file; its module, or the parts of a combination, are
                beside it or in the library. Its LOCAL part, FREQ, CRITICAL, HANDLER,
                STALE and SAFE are used.
            values: As for the constructor, like the following arguments.
            library: Folders with modules beside those of pbonet.
            more: As for the constructor.

        Raises:
            PbonetError: The file is wrong, its module does not load, or as for the
                constructor.
        """
        found = Library(library)
        found.beside = (Path(rmod).parent,)
        record = found.read_rmod(rmod)
        module = found.load_rmod(record).cls
        told: dict[str, Any] = {
            "params": decode_params(module, record.settings, where=record.file),
            "freq": record.freq or 100.0,
            "critical": record.critical,
            "handler": record.handler,
            "on_stale": record.stale or "",
            "safe_at": record.safe_at,
            "settle": record.settle,
            "name": record.name,
            "library": found.folders,
        }
        return Bench(module, values, **{**told, **more})

    @property
    def ages(self) -> dict[str, float]:
        """Ages of in-vars in seconds, by attribute; 0 where none is set.

        One above the port's ``max_age`` is too old.
        """
        return self._ages.given

    @property
    def stale(self) -> set[str]:
        """In-vars, by attribute, that are too old whatever their age."""
        return self._ages.old

    @stale.setter
    def stale(self, attrs: Iterable[str]) -> None:
        self._ages.old = set(attrs)

    @property
    def output_age(self) -> float:
        """The age of the outputs when they were last written, in seconds."""
        return self._ages.output

    def _said_illegal(self, cause: str, *, up: bool) -> None:
        self.illegal = up  # whatever the cause
        del cause

    # -- signals ----------------------------------------------------------------------

    @property
    def state(self) -> State:
        """The state of the task."""
        return self.executor.state

    def on(self, arg: str = "", *, handover: bool = False) -> State:
        """Turn the task on: copy in, ``on``, copy out.

        Args:
            arg: Text for the module, as ``self.task.arg``.
            handover: Whether it takes over the outputs from a predecessor, as in a swap
                or by a fallback (``self.task.handover``).

        Returns:
            ON, or OFF if the module answered that it cannot start yet.

        Raises:
            StateError: The task is not OFF; nothing was done.
            SvarOwnerError: Another task writes an out-var; nothing was done.
            MethodError: ``on`` failed and the error was not corrected.
        """
        self._skips, self._passed = False, 0.0
        return self.executor.signal("on", arg, handover=handover)

    def off(self, *, handover: bool = False) -> State:
        """Turn the task off: ``off``, copy out.

        Args:
            handover: Whether a successor takes over the outputs, as in a swap
                (``self.task.handover``).

        Returns:
            The state afterwards.

        Raises:
            StateError: The task is not ON; nothing was done.
            MethodError: ``off`` failed and the error was not corrected.
        """
        return self.executor.signal("off", handover=handover)

    def kill(self) -> State:
        """End the task; ``kill`` runs, after ``off`` if it is ON.

        Returns:
            NOT-CREATED.

        Raises:
            StateError: The task does not exist any more; nothing was done.
            MethodError: A method failed; the task has ended nevertheless.
        """
        return self.executor.signal("kill")

    def clear(self) -> State:
        """Run ``clear`` of a task in ERROR, as an operator does.

        Returns:
            OFF, or ERROR if the module could not clear the error.

        Raises:
            StateError: The task is not in ERROR; nothing was done.
            MethodError: ``clear`` failed; the task is still in ERROR.
        """
        return self.executor.signal("clear")

    def reinit(self, **constants: Any) -> State:  # noqa: ANN401 - numbers and arrays
        """Change in-consts and run ``reinit``.

        Args:
            **constants: New values by the port's attribute, in its unit and of its
                shape.

        Returns:
            The state afterwards.

        Raises:
            StateError: The signal is not valid in this state; nothing was done.
            PortError: A value does not fit its port, or a size changed; the old
                constants remain.
            MethodError: ``reinit`` failed and the error was not corrected.
        """
        for attr, value in constants.items():
            setattr(self.inputs, attr, value)
        return self.executor.signal("reinit")

    def set(self, name: str, value: Any) -> object:  # noqa: ANN401 - of any parameter
        """Change a parameter between two cycles.

        Args:
            name: The parameter.
            value: Its new value, in its unit, or the words of a LOCAL line.

        Returns:
            The value as the module has it.

        Raises:
            ParameterError: There is no such parameter, or the value is out of bounds.
            MethodError: The module's ``set`` refused it; the old value remains.
            StateError: The task does not exist any more.
        """
        return self.executor.set(name, tuple(local_text(value).split()))

    def get(self, name: str) -> object:
        """Return a parameter.

        Args:
            name: The parameter.

        Raises:
            ParameterError: There is no such parameter.
            MethodError: The module's ``get`` failed.
        """
        return self.executor.get(name)

    def step(self, dt: float | None = None, n: int = 1, *, check: bool = True) -> State:
        """Let time pass and run `n` cycles.

        Args:
            dt: Seconds of each cycle; the inverse of ``freq`` by default.
            n: Number of cycles; fewer are run if the task leaves state ON. A release
                that a handler of timing failures leaves out counts too.
            check: Raise the error of a failed cycle if the task is then in ERROR.

        Returns:
            The state after the last cycle.

        Raises:
            MethodError: A cycle failed, and `error` did not correct it.
            StateError: The task is not ON.
        """
        step = self.task.period if dt is None else dt
        state = self.state
        for _ in range(n):
            now = self.clock.advance(step)
            self._passed += step
            if self._skips and state is State.ON:
                self._skips = False
                continue
            state = self._cycle(now)
            if check and state is State.ERROR:
                raise self.executor.failure or MethodError("the task is in ERROR")
            if state is not State.ON:
                break
        return state

    def _cycle(self, now: int) -> State:
        dt, self._passed = self._passed, 0.0
        self.table.step = dt
        self._cycling = True
        try:
            return self.executor.cycle(dt, now)
        finally:
            self._cycling = False

    def timing_failure(self, kind: TimingFailure) -> Recovery | None:
        """Simulate a timing failure: call the module's handler, and follow its answer.

        Between two steps the last cycle counts as still running. It may also be called
        from within a cycle, by a test's substitute for a slow part of the module: the
        failure then happens there, and an abort ends the cycle there.

        A failure of ``safe_at`` first gives the out-vars their safe values, also in a
        critical section, and where the module writes others they are discarded: after
        the cycle `on` runs again, whatever the handler answers.

        Args:
            kind: What fails.

        Returns:
            The handler's answer, which has been carried out: on ABORT the outputs are
            discarded and `on` has run again, on SKIP `step` leaves out one release.
            None where a critical section holds the failure off; its end lets it in.

        Raises:
            StateError: The task is not ON.
            MethodError: The handler, or `on` after an abort, failed and `error` did
                not put it right.
        """
        if kind in self.task.safe_at and self.state is State.ON:
            self.table.make_safe()
            self.executor.made_safe = True
        if not self._watch.in_critical:
            return self._fail(kind)
        self._watch.when_free(lambda: self._fail(kind))
        return None

    def _fail(self, kind: TimingFailure) -> Recovery:
        if self._cycling or self.state is not State.ON:
            wanted = self.executor.timing_failure(kind)
        else:
            try:
                wanted = self.executor.timing_failure(kind)
            except RAISED as error:
                wanted = Recovery.CONTINUE
                if self.executor.fault(error, "timing_failure") is State.ERROR:
                    raise self.executor.failure or error from None
        if wanted is Recovery.SKIP:
            self._skips = True
        if wanted is Recovery.ABORT and self._cycling:
            raise CycleAborted
        if wanted is Recovery.ABORT or (self.table.made_safe and not self._cycling):
            self.executor.abort()
        return wanted

    def sync(self) -> State:
        """Run the module's ``sync``, as a task does that waits for its event.

        Returns:
            ON when the event came, otherwise the state that ``error`` chose.

        Raises:
            StateError: The task is not ON; nothing was done.
        """
        return self.executor.sync()

    # -- what can be inspected --------------------------------------------------------

    @property
    def log(self) -> list[str]:
        """Copies and methods so far, in order, by the names of `Step`."""
        return list(self._log)

    def sections(self) -> dict[str, Section]:
        """Return the measurements of the module's timed sections, by name."""
        return self._watch.sections()

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
        """Let every method of the module note its name in the log first."""
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
    symbols = {
        dim
        for port in (*ports, *module.__within__)
        for dim in port.shape
        if isinstance(dim, str)
    }
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
    constants = {word: _size(word, values[word]) for word in symbols & values.keys()}
    return solve_shapes(
        (*ports, *module.__within__), nelem, constants, where=module.__name__
    )


def _size(word: str, value: Any) -> int:  # noqa: ANN401 - whatever was given
    try:
        return operator.index(value)
    except TypeError:
        raise PortError(
            f"the size {word} is a whole number",
            where="Bench",
            expected="a whole number of at least 1",
            got=repr(value),
            remedy=f"say `{word}=2` or the like",
        ) from None


def _critical(module: type[PortBasedObject[Any]]) -> Action:
    has_stable = "stable" in module.__interface__.methods
    return Action.STABLE if has_stable else Action.SAFE


def _safe_at(
    module: type[PortBasedObject[Any]], kinds: Iterable[str]
) -> frozenset[str]:
    """Return the kinds of failure, which need out-vars that have safe values.

    Raises:
        PortError: One of them has none, or there is no such failure.
    """
    __tracebackhide__ = True  # of pytest
    found, ports = frozenset(kinds), module.__interface__.ports
    if unknown := found - frozenset(TimingFailure):
        raise PortError(
            "safe_at has the kinds of timing failure",
            where="Bench",
            expected=" or ".join(TimingFailure),
            got=", ".join(sorted(unknown)),
            remedy="write such as: safe_at=[TimingFailure.DEADLINE]",
        )
    if found and not is_safe(ports):
        raise PortError(
            f"module {module.__name__} has nothing to write at a timing failure",
            where="Bench",
            expected=lacks(Stale.SAFE, ports, ()) or "an out-var",
            remedy="declare it there, or leave safe_at out",
        )
    return found


def _params(
    module: type[PortBasedObject[Any]], given: Params | Mapping[str, object] | None
) -> Params:
    __tracebackhide__ = True  # of pytest
    if isinstance(given, Params):
        return given
    return make_params(module.__params__, given or {})
