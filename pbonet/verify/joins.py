"""How writers of one variable are joined (Stewart 1994, section 3.3, Figure 3.6)."""

from __future__ import annotations

from typing import TYPE_CHECKING

from pbonet.config.types import numpy_type
from pbonet.config.words import MAX_NAME

if TYPE_CHECKING:
    from collections.abc import Sequence

    from .records import Configuration, Task

CONNECTORS = ("join_average", "join_first", "join_max", "join_min")
"""The join connectors of the library: `Z1` and `Z2` in, `Z` out, all of them double."""


def remedy(configuration: Configuration, variable: str, tasks: Sequence[Task]) -> str:
    """Return how to put join connectors behind the writers, with the lines to write.

    A connector takes two inputs, so several writers need a chain of them.
    """
    links = len(tasks) - 1
    names = intermediate(variable, len(tasks) + links - 1)
    aliases = [
        f"SVARALIAS {task.port('OUTVAR', variable)}={name} in {task.rmod.name}.rmod"
        for task, name in zip(tasks, names, strict=False)
    ]
    known = configuration.table.get(variable)
    fits = known is None or numpy_type(known.type) == "<f8"
    one = f"{' or '.join(CONNECTORS)}" if fits else "one of your own for its type"
    connectors = "a join connector" if links == 1 else f"{links} join connectors"
    return (
        f"turn {'one' if links == 1 else 'all but one'} off, or join them: "
        f"{', '.join(aliases)}; {' '.join(names)} beside {variable} in the .svar file; "
        f"{connectors} ({one}) with {' and '.join(_chain(names, variable, links))}"
    )


def _chain(names: Sequence[str], variable: str, links: int) -> list[str]:
    """Return the aliases of each connector; all but the last feed the next one."""
    inputs, between = names[: links + 1], [*names[links + 1 :], variable]
    lines: list[str] = []
    first = inputs[0]
    for second, out in zip(inputs[1:], between, strict=True):
        lines.append(f"SVARALIAS Z1={first}, SVARALIAS Z2={second}, SVARALIAS Z={out}")
        first = out
    return lines


def intermediate(variable: str, count: int) -> list[str]:
    """Return names for the variables before a join connector: ``x'``, ``x''`` ..."""
    names: list[str] = []
    for number in range(1, count + 1):
        mark = "'" * number if count <= 3 else f"'{number}"  # noqa: PLR2004 - x''''
        names.append(variable[: MAX_NAME - len(mark)] + mark)
    return names
