"""The module, or the combined modules, that an RMOD runs (Stewart 1994, 3.8.1)."""

from __future__ import annotations

from typing import TYPE_CHECKING

from pbonet import pbo

if TYPE_CHECKING:
    from collections.abc import Callable

    from pbonet.pbo import ModuleInfo, PartInfo

    from .model import Rmod


def info_of(rmod: Rmod, describe: Callable[[str], ModuleInfo]) -> ModuleInfo:
    """Return the description of an RMOD's module or combination.

    Args:
        rmod: The RMOD.
        describe: Returns what is known about a module.
    """
    if not rmod.parts:
        return describe(rmod.module)
    parts = [part_info(part, info_of(part, describe)) for part in rmod.parts]
    return pbo.combined_info(rmod.module, parts, published(rmod))


def part_info(part: Rmod, info: ModuleInfo) -> PartInfo:
    """Return a part of a combination, with the variables of its ports."""
    variables = {port.name: part.svar_name(port.name) for port in info.ports}
    return pbo.PartInfo(part.name, info, variables)


def published(rmod: Rmod) -> tuple[str, ...]:
    """Return what a combination writes to the table, as its parts name it."""
    return (*rmod.outconst, *rmod.outvar)
