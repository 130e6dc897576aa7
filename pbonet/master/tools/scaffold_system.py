"""Writes the first files of a system out of the RMODs that make it up.

Pure: RMODs and what is known of their modules in, records of files out. A ``.svar``
file repeats what modules say of their ports (type, shape, unit, what it carries), so it
need not be typed. A size that no port has as a number follows from the others, or is
given.
"""

from __future__ import annotations

import math
from typing import TYPE_CHECKING

import numpy as np
from msgspec import Struct

from pbonet.config import (
    JobFile,
    JobTask,
    RtpuEntry,
    SbsFile,
    SvarFile,
    Variable,
)
from pbonet.errors import ConfigError, did_you_mean
from pbonet.ports import Kind, solve_shapes

if TYPE_CHECKING:
    from collections.abc import Iterable, Mapping, Sequence

    from pbonet.config import Rmod
    from pbonet.pbo import ModuleInfo
    from pbonet.ports import Port

RTPU = "core0"
"""The name of the one RTPU of a new subsystem."""
_TYPES = {"float": "double", "float64": "double", "float32": "float", "int32": "int"}
"""How a ``.svar`` file spells a port's type, where it is not the same word."""


class Use(Struct, frozen=True):
    """A task of the new system."""

    rmod: Rmod
    info: ModuleInfo

    @property
    def freq(self) -> float | None:
        """Hz that the job must say, because neither an RMOD nor the class does."""
        unsaid = self.rmod.file.endswith(".py") and self.info.freq is None
        return self.rmod.freq if unsaid else None

    def ports(self) -> dict[str, Port]:
        """Return its ports by their variables."""
        return {self.rmod.svar_name(port.name): port for port in self.info.ports}


def new_svar(
    file: str,
    uses: Sequence[Use],
    sizes: Mapping[str, int],
    there: Sequence[Variable] = (),
) -> tuple[SvarFile, list[str]]:
    """Return a table with every variable that tasks read and write.

    Args:
        file: Its name.
        uses: The tasks.
        sizes: Sizes by the constant, or the word of a shape, that names them.
        there: Variables that exist already: they are left out, and their sizes count.

    Returns:
        The table, and what is to be said of it.

    Raises:
        ConfigError: A size is not known, or a port is a structure.
        PortError: Two ports of one module disagree about a size.
    """
    _must_be_sizes(uses, sizes)
    ports: dict[str, list[Port]] = {}
    for use in uses:
        for variable, port in use.ports().items():
            ports.setdefault(variable, []).append(port)
    nelem = {one.name: one.nelem for one in there}
    known = {**_first_values(there), **_declared(ports), **sizes}
    _solve_all(uses, nelem, known)
    names = sorted(
        ports.keys() - {one.name for one in there},
        key=lambda name: (not ports[name][0].kind.is_const, [*ports].index(name)),
    )
    units = {one.name: one.units for one in there}
    units |= {name: found for name in names if (found := _unit(ports[name]))}
    for name in sorted(names, key=lambda one: one.count("^")):
        if name not in units and (found := _unit_of_rate(name, units)):
            units[name] = found
    told = [
        f"no module declares the unit of {name}: correct UNITS none"
        for name in names
        if name not in units
    ]
    variables = [
        _variable(
            name,
            ports[name],
            units.get(name, "none"),
            nelem[name],
            known.get(name),
        )
        for name in names
    ]
    told += [
        f"no task produces the constant {one.name}: give it a value by INIT"
        for one in variables
        if one.init is None and _is_given(ports[one.name])
    ]
    return SvarFile(file=file, defines={}, variables=tuple(variables)), told


def _first_values(there: Iterable[Variable]) -> dict[str, int]:
    """Return the first value of each variable that may be a size."""
    return {
        one.name: value
        for one in there
        if one.init and one.nelem == 1 and isinstance(value := one.init[0], int)
    }


def _declared(ports: Mapping[str, Sequence[Port]]) -> dict[str, int]:
    """Return the values that classes declare for constants that may be sizes."""
    return {
        name: int(port.value[0])
        for name, uses in ports.items()
        for port in uses
        if port.is_size and port.value
    }


def _is_given(ports: Iterable[Port]) -> bool:
    """Return whether a variable is a constant that no task produces."""
    return all(port.kind is Kind.INCONST for port in ports)


def _unit(ports: Sequence[Port]) -> str:
    """Return the unit that the writer declares, else a reader; empty for none."""
    ordered = sorted(ports, key=lambda port: port.kind.is_input)
    return next((port.unit for port in ordered if port.unit != "any"), "")


def _unit_of_rate(name: str, units: Mapping[str, str]) -> str:
    """Return the unit of the rate of a variable whose unit is known; else nothing.

    Q^_REF is the rate of Q_REF, and Q^^_REF that of Q^_REF.
    """
    unit = units.get(name.replace("^", "", 1), "") if "^" in name else ""
    if unit in {"", "any", "mixed"}:
        return ""
    whole, _, times = unit.partition("/s")
    if times not in {"", "^2", "^3"} or "/" in whole:
        return ""
    if whole == unit:
        return "1/s" if unit == "none" else f"{unit}/s"
    return f"{whole}/s^{int(times[1:] or 1) + 1}"


def _variable(
    name: str, ports: Sequence[Port], unit: str, nelem: int, value: int | None
) -> Variable:
    """Return a variable as declared by its writer, else by its first reader.

    A size that no task produces begins with its value.
    """
    ordered = sorted(ports, key=lambda port: port.kind.is_input)
    given = _is_given(ports) and ports[0].is_size and value is not None
    return Variable(
        name=name,
        type=_type(name, ordered[0]),
        desc=ordered[0].doc.strip(),
        units=unit,
        nelem=nelem,
        init=(value,) if given and value is not None else None,
    )


def _type(name: str, port: Port) -> str:
    word = port.type.removesuffix("[]")
    if word == "void":
        raise ConfigError(
            f"the length of the structure {name} is unknown",
            where=f"port {port.attr} ({port.name})",
            expected="TYPE struct[BYTES]",
            remedy=f"write the .svar file by hand, with {name} in it",
        )
    return _TYPES.get(word, word if port.is_scalar else np.dtype(word).name)


def _solve_all(
    uses: Sequence[Use], nelem: dict[str, int], known: dict[str, int]
) -> None:
    """Find out the number of elements of every variable, and the sizes.

    Raises:
        ConfigError: One does not follow from what is known.
    """
    for use in uses:
        for variable, port in use.ports().items():
            if all(isinstance(dim, int) for dim in port.shape):
                nelem.setdefault(variable, math.prod(map(int, port.shape)))
    left, unsolved = list(uses), len(uses) + 1
    while left and len(left) < unsolved:
        unsolved = len(left)
        left = [use for use in left if not _solve(use, nelem, known)]
    if left:
        raise _unknown(left, nelem, known)


def _must_be_sizes(uses: Sequence[Use], sizes: Mapping[str, int]) -> None:
    """Refuse sizes that nothing has.

    Raises:
        ConfigError: One was given.
    """
    names = {name for use in uses for one in _sizes_of(use).items() for name in one}
    for name in sizes:
        if name not in names:
            raise ConfigError(
                f"no port has the size {name}",
                expected=" or ".join(sorted(names)) or "no size: every one is known",
                got=f"{name}={sizes[name]}",
                remedy=did_you_mean(name, names) or "leave it out",
            )


def _solve(use: Use, nelem: dict[str, int], known: dict[str, int]) -> bool:
    """Learn the sizes of one task's variables; False while one is not known yet."""
    if _open(use, nelem, known):
        return False
    ports = use.ports()
    shapes = solve_shapes(
        (*use.info.ports, *use.info.within),
        {port.name: nelem[name] for name, port in ports.items() if name in nelem},
        {port.name: known[name] for name, port in ports.items() if name in known}
        | known,
        where=use.rmod.name,
    )
    named = _sizes_of(use)
    for name, port in ports.items():
        nelem.setdefault(name, math.prod(shapes[port.attr]))
        for dim, size in zip(port.shape, shapes[port.attr], strict=True):
            if named.get(str(dim), dim) in ports:  # one size for all tasks
                known.setdefault(named[str(dim)], size)
    return True


def _open(use: Use, nelem: Mapping[str, int], known: Mapping[str, int]) -> list[str]:
    """Return the sizes that are not known yet, by the constant if it is one's."""
    named, found = _sizes_of(use), set[str]()
    for variable, port in use.ports().items():
        names = {named[dim] for dim in port.shape if isinstance(dim, str)}
        names -= known.keys()
        if len(names) == 1 and variable in nelem:
            found |= names
    return [name for name in named.values() if name not in {*known, *found}]


def _sizes_of(use: Use) -> dict[str, str]:
    """Return the words in a task's shapes, with the constants that they stand for."""
    ports = use.ports()
    constants = {p.attr: name for name, p in ports.items() if p.kind.is_const}
    words = (dim for p in ports.values() for dim in p.shape if isinstance(dim, str))
    return {word: constants.get(word, word) for word in words}


def _unknown(
    left: Sequence[Use], nelem: Mapping[str, int], known: Mapping[str, int]
) -> ConfigError:
    names = list(dict.fromkeys(one for use in left for one in _open(use, nelem, known)))
    return ConfigError(
        f"no port determines the size of {' and '.join(names)}",
        where=" and ".join(use.rmod.name for use in left),
        expected=f"a size for {' and '.join(names)}",
        remedy=f"say {' '.join(f'--size {name}=6' for name in names)}",
    )


def new_sbs(file: str, name: str, svar: str) -> SbsFile:
    """Return a subsystem of one RTPU."""
    return SbsFile(
        file=file, subsystem=name, svarfile=svar, rtpus=(RtpuEntry(name=RTPU),)
    )


def new_job(
    file: str, name: str, sbs: str, uses: Sequence[Use], desc: str = ""
) -> JobFile:
    """Return a job of these tasks, in this order."""
    return JobFile(
        file=file,
        name=name,
        desc=desc or f"job {name}",
        sbs=sbs,
        tasks=tuple(JobTask(rmod=use.rmod.name, freq=use.freq) for use in uses),
    )


def read_sizes(words: Sequence[str]) -> dict[str, int]:
    """Return the sizes that words such as ``NDOF=6`` give.

    Raises:
        ConfigError: One is of another form.
    """
    found: dict[str, int] = {}
    for word in words:
        name, _, value = word.partition("=")
        if not name or not value.isdecimal() or int(value) < 1:
            raise ConfigError(
                "a size is given by name",
                expected="NAME=NUMBER, such as NDOF=6",
                got=word,
                remedy="correct it",
            )
        found[name] = int(value)
    return found
