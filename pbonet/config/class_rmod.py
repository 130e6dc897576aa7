"""The RMOD of a module that has no ``.rmod`` file: its class says it all.

It is made where files are read, on the master's machine, and is a text like any other
from then on: it is sent to the node, verified, recorded and replayed.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

from pbonet.errors import ConfigError
from pbonet.ports import Kind

from .model import Rmod, TaskType
from .rmod import write_rmod

if TYPE_CHECKING:
    from pbonet.pbo import ModuleInfo


def own_rmod(info: ModuleInfo, freq: float | None = None) -> str:
    """Return the text of a module's own RMOD.

    Each port is connected to the variable of its name; parameters have their defaults.
    A robot interface is CRITICAL if it can be.

    Args:
        info: Describes the module.
        freq: Hz, where the class has none.

    Raises:
        ConfigError: A parameter has no default, or there is no frequency.
    """
    needed = [param.name.upper() for param in info.params if param.required]
    if needed:
        raise ConfigError(
            f"{info.name} has no .rmod file, and its class does not say all",
            where=info.file,
            expected="a default for each parameter",
            got=f"none for {' '.join(needed)}",
            remedy=f"give them defaults, or write {info.name}.rmod with their values "
            "in its LOCAL part",
        )
    hz = info.freq or freq
    if hz is None:
        raise ConfigError(
            f"{info.name} has no .rmod file, and no frequency",
            where=info.file,
            expected=f"class {info.cls}(PortBasedObject, freq=...)",
            remedy=f"declare it there, or write FREQ after TASK {info.name} in the job",
        )
    waits = "sync" in info.methods
    return write_rmod(
        Rmod(
            name=info.name,
            file=f"{info.name}.rmod",
            module=info.name,
            desc=info.doc,
            inconst=info.named(Kind.INCONST),
            outconst=info.named(Kind.OUTCONST),
            invar=info.named(Kind.INVAR),
            outvar=info.named(Kind.OUTVAR),
            tasktype=TaskType.SYNCHRONOUS if waits else TaskType.PERIODIC,
            freq=hz,
            critical=info.robot_interface and info.critical_ok,
        )
    )
