"""Methods that an RMOD counts on: those that its module lacks, and when they run."""

from __future__ import annotations

from typing import TYPE_CHECKING, NamedTuple

from pbonet.pbo import METHODS
from pbonet.ports import Stale, is_safe, lacks

from .model import TaskType

if TYPE_CHECKING:
    from collections.abc import Iterator

    from pbonet.pbo import ModuleInfo
    from pbonet.ports import Port

    from .model import Rmod


class Missing(NamedTuple):
    """A method that is missing, in the words of an error."""

    what: str
    where: str
    expected: str
    remedy: str


def missing_methods(rmod: Rmod, info: ModuleInfo) -> Iterator[Missing]:
    """Yield the methods that `rmod` counts on and the module does not write.

    A task that the clock does not time waits in `sync`, HANDLER is the criticality of
    `timing_failure`, STALE may call `stable` or write safe values, and SAFE writes
    those. (What CRITICAL
    counts on, the executor looks after.)
    """
    if rmod.tasktype is not TaskType.PERIODIC and "sync" not in info.methods:
        yield _missing(
            rmod,
            info,
            "sync",
            f"TASKTYPE {rmod.tasktype}",
            "write there how the task waits for its event, or make it periodic",
        )
    if rmod.stale and (lack := lacks(rmod.stale, info.ports, info.methods)):
        yield Missing(
            f"module {info.name} cannot do STALE {rmod.stale}",
            str(rmod.places.get("STALE", rmod.file)),
            f"{lack} in {info.file or info.name}",
            "write it there, or another action after STALE",
        )
    if rmod.safe_at:
        yield from _missing_at_safe(rmod, info)
    if rmod.handler is not None and "timing_failure" not in info.methods:
        yield _missing(
            rmod,
            info,
            "timing_failure",
            f"HANDLER {rmod.handler}",
            "implement the reaction there, or take HANDLER out of the .rmod file",
        )


def _missing_at_safe(rmod: Rmod, info: ModuleInfo) -> Iterator[Missing]:
    """Yield what SAFE needs: values to write, and failures that can come."""
    where = str(rmod.places.get("SAFE", rmod.file))
    if not is_safe(info.ports):
        lack = lacks(Stale.SAFE, info.ports, info.methods) or "an out-var"
        yield Missing(
            f"module {info.name} has nothing to write at SAFE {' '.join(rmod.safe_at)}",
            where,
            f"{lack} in {info.file or info.name}",
            "write it there, or take SAFE out of the .rmod file",
        )
    if rmod.tasktype not in {TaskType.PERIODIC, TaskType.SYNCHRONOUS}:
        yield Missing(
            f"SAFE does nothing with TASKTYPE {rmod.tasktype}, which has no deadline",
            where,
            "TASKTYPE periodic or synchronous",
            "choose one of them, or take SAFE out of the .rmod file",
        )
        return
    reserves = {
        "maxexec": ("MAXC", rmod.maxc or rmod.effc),
        "minexec": ("MINC", rmod.minc),
    }
    for kind, (keyword, given) in reserves.items():
        if kind in rmod.safe_at and not given:
            yield Missing(
                f"SAFE {kind} does nothing without {keyword}",
                where,
                f"{keyword} and seconds",
                f"write {keyword}, or take {kind} out of SAFE",
            )


def critical_action(info: ModuleInfo) -> str:
    """Return what a CRITICAL task does in place of `cycle`: a value of `Stale`."""
    return Stale.STABLE if "stable" in info.methods else Stale.SAFE


def stale_action(rmod: Rmod, info: ModuleInfo, port: Port) -> str:
    """Return what a task does while an in-var is too old; empty: it goes on."""
    if rmod.stale or port.stale:
        return rmod.stale or port.stale
    return critical_action(info) if rmod.critical else ""


def _missing(
    rmod: Rmod, info: ModuleInfo, method: str, line: str, remedy: str
) -> Missing:
    return Missing(
        f"module {info.name} has no {method}(), which {line} counts on",
        str(rmod.places.get(line.split(maxsplit=1)[0], rmod.file)),
        f"def {method}{METHODS[method]} in {info.file or info.name}",
        remedy,
    )
