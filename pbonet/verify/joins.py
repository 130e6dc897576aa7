"""How writers of one variable are joined (Stewart 1994, section 3.3, Figure 3.6)."""

from __future__ import annotations

from typing import TYPE_CHECKING

from pbonet.config.types import numpy_type
from pbonet.config.words import MAX_NAME

from .records import Code, Problem, Severity

if TYPE_CHECKING:
    from collections.abc import Iterator, Sequence

    from .records import Configuration, Task

BY_AGE = "join_first"
"""The connector that takes an input for valid while it is not too old."""
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


def check_ages(configuration: Configuration) -> Iterator[Problem]:
    """Yield inputs that a connector takes for valid even when nobody writes them.

    Only the last connector of a chain may go on with a value of any age, its Z2: there
    is nothing to fall back to behind it.
    """
    for task in configuration.tasks:
        if task.rmod.module != BY_AGE:
            continue
        variable = task.rmod.svar_name("Z1")
        known = configuration.table.get(variable)
        if known is None or known.maxage is not None:
            continue
        yield Problem(
            code=Code.NO_MAXAGE,
            severity=Severity.WARN,
            what=f"{variable} has no MAXAGE, so {task.name} takes it for valid even "
            "when nobody writes it any more, and never falls back for that",
            where=task.place("INVAR"),
            remedy=f"write MAXAGE and seconds under NAME {variable} in the .svar file",
            tasks=(task.name,),
            ports=("Z1",),
            variables=(variable,),
        )


def intermediate(variable: str, count: int) -> list[str]:
    """Return names for the variables before a join connector: ``x'``, ``x''`` ..."""
    names: list[str] = []
    for number in range(1, count + 1):
        mark = "'" * number if count <= 3 else f"'{number}"  # noqa: PLR2004 - x''''
        names.append(variable[: MAX_NAME - len(mark)] + mark)
    return names
