"""Changes of a job by their names, with arguments as a web page sends them."""

from __future__ import annotations

import inspect
from functools import cache
from typing import TYPE_CHECKING, Any

import msgspec

from pbonet.errors import ConfigError, did_you_mean
from pbonet.xm.net import convert

from . import task_edits, wiring_edits

if TYPE_CHECKING:
    from collections.abc import Callable, Mapping

    from .draft_files import DraftFiles

EDITS: dict[str, Callable[..., None]] = {
    change.__name__: change
    for change in (
        task_edits.add_task,
        task_edits.remove_task,
        task_edits.rename_task,
        task_edits.set_field,
        task_edits.set_parameter,
        task_edits.set_fallback,
        task_edits.set_off_order,
        task_edits.set_job,
        wiring_edits.connect,
        wiring_edits.connect_ports,
        wiring_edits.disconnect,
        wiring_edits.add_variable,
        wiring_edits.copy_variable,
        wiring_edits.set_variable,
        wiring_edits.remove_variable,
    )
}
"""The changes by name."""


def make_step(files: DraftFiles, do: str, args: Mapping[str, Any]) -> None:
    """Make one change of the draft.

    Args:
        files: The files.
        do: A name in `EDITS`.
        args: Its arguments.

    Raises:
        PbonetError: There is no such change, an argument is wrong, or the files cannot
            say the result.
    """
    change = EDITS.get(do)
    if change is None:
        raise ConfigError(
            f"there is no change {do}",
            expected=" or ".join(EDITS),
            got=do,
            remedy=did_you_mean(do, EDITS) or "name one of these",
        )
    try:
        given = convert(dict(args), _arguments(do))
    except msgspec.ValidationError as error:
        raise ConfigError(
            f"the arguments of {do} are wrong",
            expected=", ".join(_arguments(do).__struct_fields__),
            got=str(error),
            remedy="correct them",
        ) from None
    change(files, **msgspec.structs.asdict(given))


@cache
def _arguments(do: str) -> type[msgspec.Struct]:
    """Return the arguments of a change as a record that checks their types."""
    found: list[Any] = []
    every = inspect.signature(EDITS[do], eval_str=True).parameters
    for about in [*every.values()][1:]:
        if about.default is inspect.Parameter.empty:
            found.append((about.name, about.annotation))
        else:
            found.append((about.name, about.annotation, about.default))
    return msgspec.defstruct(do, found, kw_only=True, forbid_unknown_fields=True)
