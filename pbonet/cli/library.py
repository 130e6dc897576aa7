"""``pbonet library``: find modules by class, port, unit and text, or show one."""

from __future__ import annotations

from typing import Annotated as A

from . import options
from .parser import Argument, Compound
from .table import arguments

_OPTIONS = Compound(tuple(p for p in arguments("library").parts if p.names), dict)


def command(
    *,
    words: A[
        list[str] | None,
        Argument(
            "The .sbs or .job file of a subsystem, to ask its RTPUs, may come first; "
            "then the name of a module, its .rmod file, or words that describe it. "
            "All modules if left out.",
            "TEXT",
        ),
    ] = None,
    wanted: A[dict[str, str | None], _OPTIONS],
    place: options.Watching,
    json_: options.Json = False,
) -> None:
    """Find modules by class, port, unit and text; show one in full.

    Modules of this machine: pbonet's, those of installed packages, of the folders that
    --library names, and of the current folder.

    Examples:
        Show what one module reads, writes and can be set to:
        pbonet library joint_pid
        Find a module that computes reference positions in rad:
        pbonet library --class trajectory --out Q_REF --unit rad
        List the modules that the RTPUs of a subsystem have:
        pbonet library arm.sbs
    """
    from pbonet.master.console import oneshot
    from pbonet.master.tools import local_modules

    from .table import show

    text = words or []
    if text and local_modules.is_subsystem(text[0]):
        reply = oneshot.run(text[0], "library", {"text": text[1:], **wanted}, place)
        show(reply.command, reply.data, reply.warnings, as_data=json_)
        return
    data, warnings = local_modules.find(text, wanted, place.libraries)
    show("library", data, warnings, as_data=json_)
