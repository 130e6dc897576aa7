"""Checks that an RMOD and its module fit, and finds the ports' variables."""

from __future__ import annotations

import os
from typing import TYPE_CHECKING, TypeVar

from pbonet.config import missing_methods, stale_action
from pbonet.errors import DeclarationError, PortError, did_you_mean
from pbonet.ports import Kind
from pbonet.svar import Action, Freshness

if TYPE_CHECKING:
    from collections.abc import Callable

    from pbonet.config import Rmod
    from pbonet.pbo import ModuleInfo
    from pbonet.svar import LocalTable, Table

    from .journal import Indexed

T = TypeVar("T")


def listed(rmod: Rmod) -> dict[Kind, tuple[str, ...]]:
    """Return the ports that an RMOD lists, by kind."""
    return {
        Kind.INCONST: rmod.inconst,
        Kind.OUTCONST: rmod.outconst,
        Kind.INVAR: rmod.invar,
        Kind.OUTVAR: rmod.outvar,
    }


def local_table(table: Table, task: str, rmod: Rmod) -> LocalTable:
    """Return the local table of this process, with the variables of the ports.

    Raises:
        SvarError: There is no such variable, or no room.
    """
    return table.local(
        task,
        os.getpid(),
        inconst=[rmod.svar_name(port) for port in rmod.inconst],
        outconst=[rmod.svar_name(port) for port in rmod.outconst],
        invar=[rmod.svar_name(port) for port in rmod.invar],
        outvar=[rmod.svar_name(port) for port in rmod.outvar],
    )


def keep_fresh(local: LocalTable, table: Indexed, rmod: Rmod, info: ModuleInfo) -> bool:
    """Have a task's local table handle ages as its ports and RMOD declare.

    Returns:
        Whether the task does something else than `cycle` while an input is too old.
    """
    new = all(port.new for port in info.ports if port.kind is Kind.OUTVAR)
    found: dict[int, Freshness] = {}
    for port in info.ports:
        if port.kind is Kind.INVAR:
            name = stale_action(rmod, info, port)
            action = Action[name.upper()] if name else Action.GO_ON
            passes = not (new or port.feedback)
            index = table.index(rmod.svar_name(port.name))
            found[index] = Freshness(port.max_age, action, passes)
    local.keep_fresh(found, rmod.settle)
    return any(one.action for one in found.values())


def keep_safe(local: LocalTable, rmod: Rmod, info: ModuleInfo) -> bytes:
    """Have the out-vars of a failed cycle get the safe values of their ports."""
    outputs = (port for port in info.ports if port.kind is Kind.OUTVAR)
    return local.keep_safe({rmod.svar_name(one.name): one.safe for one in outputs})


def by_attribute(
    rmod: Rmod, info: ModuleInfo, of: Callable[[str], T]
) -> Callable[[str], T]:
    """Return a function of a variable as one of an in-var's attribute.

    Args:
        rmod: Defines the variables of the ports.
        info: The module's description.
        of: The function of a variable.
    """
    names = {
        port.attr: rmod.svar_name(port.name)
        for port in info.ports
        if port.kind is Kind.INVAR
    }
    return lambda attr: of(names[attr])


def check_ports(rmod: Rmod, info: ModuleInfo) -> None:
    """Refuse an RMOD that does not fit its module in ports or methods.

    Raises:
        PortError: A port is missing on one side, or its kind differs.
        DeclarationError: A method that the RMOD needs is missing.
    """
    for what, where, expected, remedy in missing_methods(rmod, info):
        raise DeclarationError(what, where=where, expected=expected, remedy=remedy)
    for kind, names in listed(rmod).items():
        declared = info.named(kind)
        for name in names:
            if name not in declared:
                raise PortError(
                    f"module {info.name} has no {kind} {name}",
                    where=rmod.file,
                    expected=" ".join(declared) or "none",
                    got=name,
                    remedy=did_you_mean(name, declared)
                    or f"take it out of the .rmod file, or declare it in {info.file}",
                )
        for name in declared:
            if name not in names:
                raise PortError(
                    f"the .rmod file does not list {kind} {name}",
                    where=rmod.file,
                    expected=" ".join(declared),
                    got=" ".join(names) or "none",
                    remedy=f"module {info.name} declares it: add it to the file",
                )
