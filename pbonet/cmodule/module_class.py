"""Makes a module's class out of the tables in a shared object."""

from __future__ import annotations

import struct
from pathlib import Path
from typing import TYPE_CHECKING, Annotated as A, Any, ClassVar, Literal, cast

import numpy as np
from numpy.typing import NDArray

from pbonet.errors import DeclarationError, ModuleLoadError, did_you_mean
from pbonet.pbo import (
    Answer,
    Params,
    PortBasedObject,
    Recovery,
    TimingFailure,
    UserSignal,
    memory,
    param,
)
from pbonet.ports import InConst, InVar, OutConst, OutVar

from ._cmodule import NativeMethod, NativeState, SharedObject
from .shared_object_file import check_file

if TYPE_CHECKING:
    from collections.abc import Callable, Mapping

    Row = Mapping[str, Any]

_MARKS: tuple[Any, ...] = (InConst, OutConst, InVar, OutVar)
_POINTER = struct.calcsize("P")
_VALUES: dict[str, tuple[Any, int]] = {
    "float64": (float, 8),
    "int64": (int, 8),
    "bool": (bool, 1),
    "text": (str, 1),
}
"""The Python type of a parameter's value, and its size in the state."""
_STATE = "_c_state"
"""The instance attribute that holds its `NativeState`."""
_versions: dict[Path, list[str]] = {}
"""The versions of each file that this process has loaded."""
_loaded: dict[int, str] = {}
"""The version of each shared object in this process, by its address."""


def c_class(path: Path, source: bytes, version: str) -> type[PortBasedObject[Any]]:
    """Load a shared object and return the class of its module.

    Args:
        path: The file.
        source: Its content.
        version: The hash of its content.

    Raises:
        ModuleLoadError: It does not load, is not whole, or was built for another
            pbonet or machine.
        DeclarationError: A table is wrong; the error names file, line and field.
    """
    check_file(path, source)
    shared = SharedObject(_name(path.absolute(), version))
    if _loaded.setdefault(shared.address, version) != version:
        raise ModuleLoadError(
            "the shared object was overwritten while this process used it",
            where=str(path),
            remedy="start this process again; build into a new file and rename it, as "
            "the linker does, instead of copying over the old one",
        )
    return _Tables(path, shared).made()


def _name(path: Path, version: str) -> str:
    """Return a name of the file that the loader does not know with other content.

    It loads each name once, whatever the file has become since.
    """
    versions = _versions.setdefault(path, [])
    if version not in versions:
        versions.append(version)
    return f"{path.parent}/{'./' * versions.index(version)}{path.name}"


class CModule(PortBasedObject[Params], abstract=True):
    """Base of the classes made here: puts the methods of C in the instance's place."""

    __shared__: ClassVar[SharedObject]

    def __bound__(self) -> None:
        """Make the state, with the pointers of its ports."""
        cls = type(self)
        values = {
            name: getattr(self.params, name) for name in cls.__params__.__declared__
        }
        state = NativeState(cls.__shared__, self.task, memory(self).arrays, values)
        own = vars(self)
        own[_STATE] = state
        own["set"] = state.set
        for name in ("cycle", "stable"):
            if name in cls.__interface__.methods:
                own[name] = NativeMethod(state, name)


def _state(instance: PortBasedObject[Any]) -> NativeState:
    found: NativeState = vars(instance)[_STATE]
    return found


def _call(name: str) -> Callable[[PortBasedObject[Any]], object]:
    """Return a method that calls that of C and returns its answer."""

    def call(self: PortBasedObject[Any]) -> object:
        return _state(self).call(name)

    return call


def _timed(name: str) -> Callable[[PortBasedObject[Any], float], None]:
    """Return the declaration of a method that each instance has as a `NativeMethod`."""

    def call(self: PortBasedObject[Any], dt: float) -> None:
        vars(self)[name](dt)

    return call


def _error(self: PortBasedObject[Any], error: Exception) -> Answer:  # noqa: ARG001
    return cast("Answer", _state(self).call("error"))


def _set(self: PortBasedObject[Any], name: str, value: object) -> None:
    _state(self).set(name, value)


def _timing_failure(self: PortBasedObject[Any], kind: TimingFailure) -> Recovery:
    return _state(self).timing_failure(str(kind))


_METHODS: dict[str, Callable[..., object]] = {
    **{one: _call(one) for one in ("init", "on", "off", "kill", "clear")},
    **{one: _call(one) for one in ("reinit", "sync")},
    **{one: _timed(one) for one in ("cycle", "stable")},
    "error": _error,
    "set": _set,
    "timing_failure": _timing_failure,
}


def _size(row: Row) -> int:
    """Return the bytes that a row's field takes in the state."""
    if "kind" in row:
        return _POINTER
    _, size = _VALUES.get(row["type"], (None, 0))
    return size * int(row["room"])


class _Tables:
    """The tables of one shared object, checked and turned into declarations."""

    def __init__(self, path: Path, shared: SharedObject) -> None:
        self._path, self._shared = path, shared
        self._about = shared.about
        self._ports, self._params = shared.ports, shared.params
        self._signals = shared.signals

    def made(self) -> type[PortBasedObject[Any]]:
        """Return the class."""
        self._check_methods()
        for row in (*self._ports, *self._params):
            self._check_row(row)
        self._check_room()
        self._check_signals()
        name = "".join(word.capitalize() for word in self._path.stem.split("_"))
        space: dict[str, Any] = {
            "__module__": self._path.stem,
            "__qualname__": name,
            "__doc__": self._about["doc"],
            "__shared__": self._shared,
            "__params__": self._params_class(),
            "__places__": self._places([*self._ports, *self._signals]),
            "__annotations__": {row["field"]: self._port(row) for row in self._ports},
            **{row["field"]: self._signal(row) for row in self._signals},
            **{one: _METHODS[one] for one in self._shared.methods},
        }
        kind: Any = type
        made: type[PortBasedObject[Any]] = kind(
            name, (CModule,), space, module_class=self._about["module_class"]
        )
        return made

    def _place(self, row: Row) -> str:
        return (
            f"{self._path}: {self._about['file']}:{row['line']}, field {row['field']}"
        )

    def _places(self, rows: list[dict[str, Any]]) -> dict[str, str]:
        """Return the place of each row, and under "" that of the whole."""
        places = {row["field"]: self._place(row) for row in rows}
        return {"": f"{self._path}: pbonet_module", **places}

    def _refused(self, row: Row, what: str, **parts: str) -> DeclarationError:
        return DeclarationError(what, where=self._place(row), **parts)

    def _check_methods(self) -> None:
        if "cycle" not in self._shared.methods:
            raise DeclarationError(
                "the module has no method cycle",
                where=f"{self._path}: pbonet_module.cycle",
                expected="a function",
                got="NULL",
                remedy="write `.cycle = cycle` in PBO_MODULE(...)",
            )

    def _check_row(self, row: Row) -> None:
        """Refuse a row that the macros of the header do not write."""
        if not row["type"]:
            raise self._refused(
                row,
                "the table has an unknown type",
                expected="one of the types of pbonet.h",
                remedy="write the row with the macros, which take it from the field",
            )
        if "kind" not in row:
            return
        if row["kind"] >= len(_MARKS):
            raise self._refused(row, "the table has an unknown kind of port")
        sizes = [
            one["field"]
            for one in self._ports
            if one["kind"] < 2 and one["shape"] == "1" and "int" in one["type"]  # noqa: PLR2004
        ]
        for word in row["shape"].replace(" ", "").split(","):
            if word.isidentifier() and word not in sizes:
                raise self._refused(
                    row,
                    f"the shape names {word}, which is no integer constant",
                    expected="a number, or the field of a constant that is one integer",
                    got=f'"{row["shape"]}"',
                    remedy=did_you_mean(word, sizes)
                    or "a module in C learns a size from a constant: declare one",
                )

    def _check_room(self) -> None:
        """Refuse rows of another struct than the module's: places must be its own."""
        rows = sorted((*self._ports, *self._params), key=lambda row: row["offset"])
        end, before = 0, ""
        for row in rows:
            first = row["offset"]
            last = first + _size(row)
            if first < end or last > self._about["state_size"]:
                raise self._refused(
                    row,
                    "the field has no place of its own in the module's struct",
                    expected=f"a place within {self._about['state_size']} bytes",
                    got=f"the place of {before}" if first < end else f"byte {first}",
                    remedy="name the same struct in each row and in PBO_MODULE, and "
                    "each field once",
                )
            end, before = last, row["field"]

    def _check_signals(self) -> None:
        """Refuse what a dict of the class would hide: two rows of one name."""
        taken = {row["field"] for row in self._ports} | set(_METHODS)
        for row in self._signals:
            if row["field"] in taken:
                raise self._refused(
                    row,
                    f"the name {row['field']} is taken by a field, a method or another "
                    "signal",
                    remedy="rename the signal",
                )
            taken.add(row["field"])

    def _signal(self, row: Row) -> UserSignal:
        try:
            return UserSignal(row["number"], row["doc"])
        except ValueError as error:
            raise self._refused(row, str(error)) from None

    def _port(self, row: Row) -> Any:  # noqa: ANN401 - an annotation
        """Return the annotation that declares a port."""
        kind: Any = np.dtype(row["type"]).type
        if row["shape"] != "1":
            kind = NDArray[kind]
        elif row["type"] == "bool":
            kind = bool
        options: dict[str, Any] = {}
        for name in ("max_age", "stale", "feedback", "new", "safe", "value"):
            if row[name]:
                options[name] = row[name]
        for name in ("safe", "value"):
            if row[name] and len(row[name]) == 1:
                options[name] = row[name][0]  # for all elements
        words = (row["name"], row["shape"], row["unit"], row["doc"])
        return A[kind, _MARKS[row["kind"]](*words, **options)]

    def _params_class(self) -> type[Params]:
        space: dict[str, Any] = {
            "__module__": self._path.stem,
            "__places__": self._places(self._params),
            "__annotations__": {row["field"]: self._param(row) for row in self._params},
        }
        for row in self._params:
            if row["initial"]:
                space[row["field"]] = self._default(row)
        kind: Any = type(Params)
        made: type[Params] = kind("Parameters", (Params,), space)
        return made

    def _param(self, row: Row) -> Any:  # noqa: ANN401 - an annotation
        """Return the annotation that declares a parameter."""
        plain: Any = self._value(row)
        if row["choices"]:
            plain = self._choice(row)
        many: Any = tuple
        kind: Any = {
            "one": plain,
            "array": many[(plain,) * row["room"]],
            "list": many[plain, ...],
        }[row["form"]]
        bounds = {name: row[name] for name in ("ge", "gt", "le", "lt", "rate", "total")}
        return A[kind, param(row["unit"], row["doc"], **bounds)]

    def _value(self, row: Row) -> Any:  # noqa: ANN401 - a type
        """Return the Python type of a parameter's value."""
        if row["type"] not in _VALUES:
            raise self._refused(
                row,
                "the type cannot be a parameter's",
                expected="double, int64_t, bool, or an array of char",
                got=row["type"],
            )
        return _VALUES[row["type"]][0]

    def _choice(self, row: Row) -> Any:  # noqa: ANN401 - a type
        """Return the type of a text that is one of several."""
        if row["type"] != "text":
            raise self._refused(
                row,
                "only a text has choices",
                expected="PBO_PARAM_TEXT",
                got=row["type"],
                remedy="bound a number by PBO_GE and PBO_LE",
            )
        return Literal[row["choices"]]

    def _default(self, row: Row) -> Any:  # noqa: ANN401 - of the parameter's type
        kind = self._value(row)
        values = tuple(kind(one) for one in row["initial"])
        return values[0] if row["form"] == "one" else values
