"""Values of a table's variables, for display, and setting them for operators."""

from __future__ import annotations

import os
from typing import TYPE_CHECKING, Any

from pbonet.errors import SvarError
from pbonet.svar import Flags, layout
from pbonet.xm.net import VarValue

if TYPE_CHECKING:
    from array import array
    from collections.abc import Sequence

    from _typeshed import ReadableBuffer

    from pbonet.config import Variable
    from pbonet.svar import LocalTable, Table, VarInfo


def display(table: Table, names: Sequence[str] | None) -> list[VarValue]:
    """Return values of variables with their provenance, without owning any.

    All values are from one instant; if that is not proven, they are marked.

    Raises:
        UnknownVariableError: The table has no variable of that name.
        SvarDamagedError: Its file was truncated or overwritten.
    """
    wanted = list(names or table.names())
    if len(wanted) == 1:
        found = [_value(table, wanted[0], whole=True)]
        table.must_be_whole()
        return found
    with table.local("display", os.getpid(), invar=wanted) as local:
        flags = local.copy_in()
        if flags & Flags.TABLE_OVERWRITTEN:
            table.must_be_whole()
        if flags & (Flags.COPY_LOST | Flags.TABLE_OVERWRITTEN):
            return [_value(table, name, whole=False) for name in wanted]
        whole = not flags & Flags.COPY_TORN
        values = [_of_cut(table, local, name, whole=whole) for name in wanted]
    table.must_be_whole()  # otherwise the values may be zeros
    return values


def write(
    table: Table, name: str, values: Sequence[float], *, keep: bool, wait: bool = True
) -> VarValue | None:
    """Set a variable that no task writes; return its state afterwards.

    Without `wait`, if the table is locked now, nothing is done and None is returned.

    Args:
        table: The table.
        name: The variable.
        values: All its elements.
        keep: Whether this RTPU is the keeper, which alone may set variables.
        wait: Whether to wait for the table's lock.

    Raises:
        SvarOwnerError: A task writes it.
        SvarError: This RTPU is not the keeper, or the values do not fit.
    """
    if not keep:
        raise SvarError(
            "this RTPU does not keep the table",
            where=table.name,
            remedy="send it to the RTPU that MASTER names, or the first one",
        )
    if not table.write(name, values, wait=wait):
        return None
    return _value(table, name, whole=True)


def _value(table: Table, name: str, *, whole: bool) -> VarValue:
    """Return a single variable, from one read."""
    value, info = table.seen(name)
    return _shown(table, name, value, info, stale=info.stale, whole=whole)


def _of_cut(table: Table, local: LocalTable, name: str, *, whole: bool) -> VarValue:
    """Return a variable from a consistent copy of several."""
    info, stale = table.info(name), local.stale(name)
    return _shown(table, name, local.memory(name), info, stale=stale, whole=whole)


def _shown(
    table: Table,
    name: str,
    data: ReadableBuffer,
    info: VarInfo,
    *,
    stale: bool,
    whole: bool,
) -> VarValue:
    variable = table.variable(name)
    value = layout.elements(variable, data)
    return VarValue(
        name=name,
        index=table.index(name),
        values=_sent(variable, value),
        units=variable.units,
        desc=variable.desc,
        writer=info.writer,
        age=None if info.age_ns is None else info.age_ns * 1e-9,
        cycle=info.cycle,
        seq=info.seq,
        stale=stale,
        whole=whole,
    )


def _sent(variable: Variable, value: array[Any]) -> list[float] | bytes:
    """Return a variable's elements as sent in messages; ``bool`` becomes 0 and 1."""
    if variable.dtype.startswith("V"):
        return value.tobytes()
    if variable.dtype == "b1":  # any other byte than 0 is true
        return [int(one != 0) for one in value]
    return value.tolist()
