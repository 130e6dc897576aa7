"""Checks that an RMOD and its module fit, and finds the ports' variables."""

from __future__ import annotations

import os
from typing import TYPE_CHECKING

from pbonet.config import missing_methods
from pbonet.errors import DeclarationError, PortError, did_you_mean
from pbonet.ports import Kind

if TYPE_CHECKING:
    from collections.abc import Callable

    from pbonet.config import Rmod
    from pbonet.pbo import ModuleInfo
    from pbonet.svar import LocalTable, Table


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


def ages(
    rmod: Rmod, info: ModuleInfo, stale: Callable[[str], bool]
) -> Callable[[str], bool]:
    """Return a function that returns whether the in-var of an attribute is stale.

    Args:
        rmod: Defines the variables of the ports.
        info: The module's description.
        stale: Returns whether a variable is stale.
    """
    names = {
        port.attr: rmod.svar_name(port.name)
        for port in info.ports
        if port.kind is Kind.INVAR
    }
    return lambda attr: stale(names[attr])


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
