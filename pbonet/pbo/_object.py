"""The base class of every module, and the reading of its class body."""

from __future__ import annotations

import inspect
from typing import (
    TYPE_CHECKING,
    Annotated as A,
    Any,
    ClassVar,
    Generic,
    TypeGuard,
    get_args,
    get_origin,
)

from msgspec import Struct

from pbonet.errors import DeclarationError, did_you_mean
from pbonet.ports import (
    MARKS,
    Declared,
    Declaring,
    Port,
    attribute,
    check_options,
    here,
    make_port,
)

from ._method_names import METHODS, MODULE_CLASSES, ModuleClass
from ._params import Params
from ._signals import SignalInfo, UserSignal, refusal
from ._task import Answer, TaskContext
from ._timing import Recovery, TimingFailure

if TYPE_CHECKING:
    from typing_extensions import TypeVar

    P = TypeVar("P", bound=Params, default=Params)
else:
    from typing import TypeVar

    P = TypeVar("P")

IN_CLASS_LINE = {"freq": "frequency", "module_class": "class of modules"}
"""Words of the class line that a body must not repeat."""
LEAST_HZ, MOST_HZ = 1e-6, 1e6
"""Lowest and highest frequency of a task."""


class Interface(Struct, frozen=True):
    """Declarations in a module's class body."""

    ports: tuple[Port, ...]
    methods: tuple[str, ...]
    """Methods that the module writes itself, in the order of `METHODS`."""
    signals: tuple[SignalInfo, ...] = ()


class PortBasedObject(Generic[P]):
    """Base of every module (Stewart 1994, sections 3.3 to 3.6).

    The class body declares the ports, as annotations; the methods say what the module
    does. Only `cycle` must be written. The runtime calls the methods, never the module
    itself, and never two at once. Whatever a method raises is an error of the task:
    see `error`.

    A class with ports that several modules share is declared ``abstract=True`` and
    needs no `cycle`. ``module_class="controller"`` gives the module's class in the
    library, one of `MODULE_CLASSES` (Stewart 1994, Figure 3.14). A "robot interface"
    turns what it reads into motion: such a task should be CRITICAL, and `pbonet check`
    says so, also of a module of no class that uses an output device of `pbonet.io`.
    ``freq=500`` gives the frequency in Hz of a task that has no ``.rmod`` file, because
    the class says all that it needs.

    Attributes:
        params: The module's parameters, as `Params` of its own.
        task: The task that runs it.
    """

    __interface__: ClassVar[Interface] = Interface((), ())
    __params__: ClassVar[type[Params]] = Params
    __abstract__: ClassVar[bool] = True
    module_class: ClassVar[ModuleClass] = ""
    """The module's class in the library, one of `MODULE_CLASSES`; see above."""
    __freq__: ClassVar[float | None] = None
    __within__: ClassVar[tuple[Port, ...]] = ()
    """Ports of a combination's parts that are none of it; see `combination`."""

    params: P
    task: TaskContext

    def __init__(self, *_: object, **__: object) -> None:
        """Refuse: the runtime makes modules, because only it has their ports."""
        name = type(self).__name__
        raise DeclarationError(
            "a module is not made by calling its class",
            where=name,
            remedy=f"put it on a bench: `Bench({name}, ...)`, of pbonet.testing",
        )

    def __bound__(self) -> None:
        """Take note that ports, parameters and task are there; for combinations."""

    def __resumed__(self) -> Answer | None:
        """Do the rest of a method that ended in a corrected error."""
        return None

    def __init_subclass__(
        cls,
        *,
        abstract: bool = False,
        module_class: ModuleClass = "",
        freq: float | None = None,
        **settings: Any,  # noqa: ANN401
    ) -> None:
        """Read and check the declarations of one module."""
        super().__init_subclass__(**settings)
        body = Declaring(cls, here())
        cls.__abstract__ = abstract
        _refuse_in_body(cls, body)
        cls.module_class = module_class or cls.module_class
        _check_class(module_class, body)
        cls.__freq__ = cls.__freq__ if freq is None else _checked_freq(freq, body)
        cls.__params__ = _params(cls, body)
        _refuse_constructor(cls, body)
        ports = _ports(cls, body)
        methods = _methods(cls, body, abstract=abstract)
        if not abstract:
            check_options(body, ports, methods)
        cls.__interface__ = Interface(ports, methods, _signals(cls, body))

    def init(self) -> None:
        """Prepare the task: called once, when it is created (signal spawn).

        Before: in-consts are copied in, and `params` and `task` are set. After:
        out-consts are copied out, and the task is OFF. An error here is followed by
        `kill` and ends the task; `error` is not asked. Devices and files are opened
        here, for this is not real time.
        """

    def on(self) -> Answer | None:
        """Start: bring the state of the module in line with that of the system.

        Called when an OFF task gets the signal on. Before: in-vars and out-vars are
        copied in, so that outputs hold what the last writer left. After: out-vars are
        copied out and are this task's own from then on; the task is ON.

        Returns:
            None to start, or `Answer.OFF` when the task cannot start yet: it stays
            OFF and nothing is copied out.
        """
        return None

    def cycle(self, dt: float) -> None:
        """Do the work of one cycle, in real-time context.

        Called at every wake-up of an ON task. Before: in-vars are copied in. After:
        out-vars are copied out. No waiting for anything, no logging, no clock: `dt`
        and ``self.task.now`` are the time; non-blocking calls of `pbonet.io` are fine.

        Args:
            dt: Seconds from the release of the last executed cycle to this one, so
                that a missed cycle is seen; 1/freq in the first cycle.
        """
        raise NotImplementedError  # refused before it runs: every module has its own

    def off(self) -> None:
        """Stop normally: called when an ON task gets the signal off or kill.

        Before: nothing is copied. After: out-vars are copied out once more and then
        have no owner; their values remain, because a successor's `on` continues from
        them. A module that must zero an actuator does so only when
        ``self.task.handover`` is false. Saved data may be written here.
        """

    def kill(self) -> None:
        """Release the resources of `init`: called last in the life of a task.

        Called on the signal kill (after `off` if the task was ON, whether that failed
        or not), and after an `init` that failed anywhere, so it must first check
        whether a resource exists. Nothing is copied before or after.
        """

    def error(self, error: Exception) -> Answer:  # noqa: ARG002 - for modules
        """Try to clear an error, or shut down gracefully.

        Called when `on`, `cycle`, `stable`, `off`, `sync` or `reinit` raised or called
        ``self.task.fail()``. Nothing is copied before or after; outputs stay what the
        last complete cycle wrote. An error in here means `Answer.ERROR`.

        Args:
            error: The exception; ``self.task.errmsg`` is its text.

        Returns:
            `Answer.OFF`: cleared; the task is OFF, `off` is not called.
            `Answer.CONTINUE`: cleared, and safe to go on: at the line after ``fail()``,
            or, after an exception, with what follows the method; the outputs of a cycle
            that raised are discarded.
            `Answer.ERROR` (the default): the task waits in ERROR for an operator.
            On the way of the signal kill, `kill` follows whatever is answered.
        """
        return Answer.ERROR

    def clear(self) -> Answer:
        """Check that an operator has removed the cause of an error.

        Called when a task in ERROR gets the signal clear. Nothing is copied before or
        after.

        Returns:
            `Answer.OFF` (the default): the task may be turned on again.
            `Answer.ERROR`: the cause is still there.
        """
        return Answer.OFF

    def reinit(self) -> None:
        """Use new constants, without repeating `init`.

        Called when the producer of an in-const was replaced. Before: in-consts are
        copied in. After: out-consts are copied out, and the state is unchanged. A
        constant that is the size of a port cannot change this way.
        """

    def sync(self) -> None:
        """Wait for the event that wakes a task which the clock does not time.

        Called before every cycle of a synchronous task or an aperiodic server; the
        only method that may block. Nothing is copied before or after; `cycle` follows
        when it returns.
        """

    def set(self, name: str, value: object) -> None:
        """Note a changed parameter: called between two cycles.

        ``self.params`` holds the new value already; it passed its bounds. Raising
        refuses it, and the old value comes back. Nothing is copied.

        Args:
            name: The parameter's name.
            value: Its new value.
        """

    def get(self, name: str) -> object:
        """Return a parameter's present value: called between two cycles.

        Args:
            name: The parameter's name.

        Returns:
            What ``self.params`` holds; a module that adapts a value by itself returns
            the one in use.
        """
        value: object = getattr(self.params, name)
        return value

    def stable(self, dt: float) -> None:
        """Keep the hardware stable without inputs, in real-time context.

        Called in place of `cycle` while the illegal-configuration flag is up, for
        tasks that are marked CRITICAL (section 3.10). Copies are as for `cycle`.

        Args:
            dt: As for `cycle`.
        """
        raise NotImplementedError  # refused before it runs if it is CRITICAL without

    def timing_failure(self, kind: TimingFailure) -> Recovery | None:  # noqa: ARG002
        """Handle a timing failure of this cycle (section 6.3).

        Called in the middle of `cycle` or `stable`, between any two of its lines, or
        instead of a cycle that has not started and could not finish in time. It may
        therefore find the module's data half changed, unless the cycle changes them in
        ``with self.task.critical():``. It may set ``self.task.criticality`` and
        ``self.task.deadline`` for the rest of the cycle. A long call of C code is not
        interrupted: the handler runs when it returns. Nothing is copied before.

        Args:
            kind: What failed; there may be several in one cycle.

        Returns:
            `Recovery.CONTINUE` or None to go on with the cycle; `Recovery.ABORT` to
            leave it, with its outputs discarded and `on` run again; `Recovery.SKIP` to
            go on with it and leave out the next release. A module without this method
            goes on; the failure is counted and warned of.
        """
        return None


def interface(cls: type[PortBasedObject[Any]]) -> Interface:
    """Return what a module's class body declares."""
    return cls.__interface__


def _params(cls: type[PortBasedObject[Any]], body: Declaring) -> type[Params]:
    """Return the class in ``PortBasedObject[Gains]``, or the inherited one."""
    bases: tuple[object, ...] = vars(cls).get("__orig_bases__", ())
    for base in bases:
        origin = get_origin(base)
        if isinstance(origin, type) and issubclass(origin, PortBasedObject):
            chosen: object = get_args(base)[0]
            if _is_params(chosen):
                return chosen
            if not isinstance(chosen, TypeVar):
                raise body.error(
                    "",
                    "a module's parameters are a class derived from Params",
                    expected="PortBasedObject[Gains], with class Gains(Params)",
                    got=f"PortBasedObject[{getattr(chosen, '__name__', chosen)}]",
                )
    return cls.__params__


def _is_params(chosen: object) -> TypeGuard[type[Params]]:
    return isinstance(chosen, type) and issubclass(chosen, Params)


def _checked_freq(freq: object, body: Declaring) -> float:
    """Return a frequency as a class declares it."""
    if isinstance(freq, int | float) and LEAST_HZ <= freq <= MOST_HZ:
        return float(freq)
    raise body.error(
        "",
        "freq is no frequency",
        expected=f"freq=, in Hz from {LEAST_HZ:g} to {MOST_HZ:g}",
        got=repr(freq),
        remedy="write such as freq=500",
    )


def _refuse_in_body(cls: type, body: Declaring) -> None:
    """Refuse what belongs into the class line, and would be a second way to say it."""
    for name, value in vars(cls).items():
        what = IN_CLASS_LINE.get(name.lower())
        if what and isinstance(value, int | float | str):
            line = f"{name.lower()}={value!r}"
            raise body.error(
                name,
                f"the {what} stands in the class line, not in the body",
                expected="it in one place",
                got=f"{name} = {value!r}",
                remedy=f"write `class {cls.__name__}(..., {line})`; a constant of "
                "another meaning needs another name",
            )


def _check_class(got: str, body: Declaring) -> None:
    if not got or got in MODULE_CLASSES:
        return
    raise body.error(
        "",
        "module_class names no class of modules",
        expected="one of " + ", ".join(f'"{name}"' for name in MODULE_CLASSES),
        got=repr(got),
        remedy=did_you_mean(str(got), MODULE_CLASSES) or "leave it out if none fits",
    )


def _refuse_constructor(cls: type, body: Declaring) -> None:
    for name in ("__init__", "__new__"):
        if name in vars(cls):
            raise body.error(
                name,
                f"a module has no {name}: its ports do not exist yet when it runs",
                remedy="write `def init(self) -> None:` instead",
            )


def _ports(cls: type, body: Declaring) -> tuple[Port, ...]:
    """Return inherited and own ports, and set their attributes in the class."""
    ports: dict[str, Port] = {}
    for base in reversed(cls.__mro__[1:]):
        inherited = getattr(base, "__interface__", Interface((), ()))
        ports.update({port.attr: port for port in inherited.ports})
    names = {port.name: port.attr for port in ports.values()}
    for attr, value in vars(cls).items():
        if _is_mark(value):
            raise _misplaced(body, attr, value)
    for attr, hint in body.annotations(MARKS):
        declared = _mark(body, attr, hint)
        if declared is None and attr == "params":
            _refuse_params(body, hint)
        if declared is None:
            continue
        if attr in ports or attr in {*METHODS, "params", "task"}:
            raise body.error(attr, f"the name {attr} is taken by a base class")
        port = make_port(body, attr, get_args(hint)[0], declared)
        other = names.setdefault(port.name, attr)
        if other != attr:
            raise body.error(attr, f"{other} is the port {port.name} already")
        ports[attr] = port
        setattr(cls, attr, attribute(port))
    found = tuple(ports.values())
    for port in found:
        _check_symbols(body, port, ports)
    return found


def _mark(body: Declaring, attr: str, hint: object) -> Declared | None:
    """Return what declares a port in an annotation, None when it is none."""
    if _is_mark(hint):
        raise _misplaced(body, attr, hint)
    if get_origin(hint) is not A:
        return None
    marks = [word for word in get_args(hint)[1:] if _is_mark(word)]
    if not marks:
        return None
    if len(marks) > 1 or not isinstance(marks[0], Declared):
        raise body.error(
            attr,
            "a port is declared once, with its four words",
            expected='A[type, InVar("NAME", "shape", "unit", "doc")]',
            got=", ".join(map(_shown, marks)),
        )
    return marks[0]


def _misplaced(body: Declaring, attr: str, mark: object) -> DeclarationError:
    return body.error(
        attr,
        "a port is declared in an annotation, together with its type",
        expected=f'{attr}: A[type, InVar("NAME", "shape", "unit", "doc")]',
        got=_shown(mark),
    )


def _refuse_params(body: Declaring, hint: object) -> None:
    name = getattr(hint, "__name__", str(hint))
    raise body.error(
        "params",
        "the class of the parameters follows the base class in brackets",
        expected=f"class {body.cls.__name__}(PortBasedObject[{name}])",
        got=f"params: {name}",
    )


def _shown(mark: object) -> str:
    return getattr(mark, "__name__", repr(mark))


def _is_mark(word: object) -> bool:
    return isinstance(word, Declared) or (
        isinstance(word, type) and issubclass(word, Declared)
    )


def _check_symbols(body: Declaring, port: Port, ports: dict[str, Port]) -> None:
    """Refuse a shape that names a port which cannot be a size."""
    names = {other.name.lower(): other.attr for other in ports.values()}
    for word in port.shape:
        if not isinstance(word, str):
            continue
        other = ports.get(word)
        if other and not other.is_size:
            raise body.error(
                port.attr,
                f"the shape names port {word}, which is not an integer constant",
                expected=f"{word}: A[int, InConst(...)] or a name that is no port",
                got=f"{other.kind} of type {other.type}",
            )
        if not other and word.lower() in names:
            raise body.error(
                port.attr,
                f"the shape names {word}, which is not an attribute",
                remedy=f"write the attribute: {names[word.lower()]}",
            )


def _methods(cls: type, body: Declaring, *, abstract: bool) -> tuple[str, ...]:
    """Check how the methods are written; return which ones the module has."""
    for name, form in METHODS.items():
        if name in vars(cls):
            _check_method(body, name, form, vars(cls)[name])
    own = tuple(
        name
        for name in METHODS
        if getattr(cls, name) is not getattr(PortBasedObject, name)
    )
    if not abstract and "cycle" not in own:
        written = [name for name, value in vars(cls).items() if callable(value)]
        raise body.error(
            "",
            "the module has no method cycle",
            expected="def cycle(self, dt: float) -> None",
            remedy=did_you_mean("cycle", written)
            or "or say `abstract=True` after the base class",
        )
    return own


def _signals(cls: type, body: Declaring) -> tuple[SignalInfo, ...]:
    """Return inherited and own signals of a module."""
    found: dict[int, SignalInfo] = {}
    for base in reversed(cls.__mro__):
        for name, value in vars(base).items():
            if not isinstance(value, UserSignal):
                continue
            if reason := refusal(name):
                raise body.error(name, reason, got=name)
            other = found.get(value.number)
            if other is not None and other.name != name:
                raise body.error(
                    name,
                    f"user signal {value.number} is {other.name} already",
                    remedy="give each signal of the module a number of its own",
                )
            found[value.number] = SignalInfo(name, value.number, value.doc)
    names = [one.name for one in found.values()]
    for name in names:
        if names.count(name) > 1:
            raise body.error(name, f"the signal {name} has two numbers")
    return tuple(found.values())


def _check_method(body: Declaring, name: str, form: str, method: object) -> None:
    if not inspect.isfunction(method):
        got = type(method).__name__
    elif inspect.iscoroutinefunction(method) or inspect.isgeneratorfunction(method):
        got = "a function that pauses (async or yield)"
    else:
        got = f"def {name}({', '.join(inspect.signature(method).parameters)})"
        wanted = form.count(",") + 1
        try:
            inspect.signature(method).bind(*range(wanted))
        except TypeError:
            pass
        else:
            return
    raise body.error(
        name,
        "the runtime cannot call this method",
        expected=f"def {name}{form}",
        got=got,
    )
