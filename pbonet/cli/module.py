"""``pbonet module``: ports, units and parameters of modules, here or on the RTPUs."""

from __future__ import annotations

from typing import Annotated as A

from . import options
from .parser import Argument


def command(
    *,
    what: A[
        str | None,
        Argument(
            "A module or an .rmod file of this machine; or the .sbs or .job file of a "
            "subsystem, to ask its RTPUs. All modules of this machine if left out."
        ),
    ] = None,
    module: A[
        str | None, Argument("The module, where WHAT is a subsystem; all if left out.")
    ] = None,
    place: options.Watching,
    json_: options.Json = False,
) -> None:
    """List modules, or show the ports, units and parameters of one.

    Examples:
        Show what a module of this machine's library reads, writes and can be set to:
        pbonet module joint_pid
        List the modules that the RTPUs of a subsystem have:
        pbonet module arm.sbs
    """
    from pbonet.master.console import oneshot
    from pbonet.master.tools import local_modules

    from .table import show

    if local_modules.is_subsystem(what):
        reply = oneshot.run(what or "", "module", {"module": module}, place)
        show(reply.command, reply.data, reply.warnings, as_data=json_)
        return
    data, warnings = local_modules.describe(what, module, place.libraries)
    show("module", data, warnings, as_data=json_)
