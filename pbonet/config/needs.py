"""Methods that an RMOD counts on and its module does not have."""

from __future__ import annotations

from typing import TYPE_CHECKING, NamedTuple

from pbonet.pbo import METHODS

from .model import TaskType

if TYPE_CHECKING:
    from collections.abc import Iterator

    from pbonet.pbo import ModuleInfo

    from .model import Rmod


class Missing(NamedTuple):
    """A method that is missing, in the words of an error."""

    what: str
    where: str
    expected: str
    remedy: str


def missing_methods(rmod: Rmod, info: ModuleInfo) -> Iterator[Missing]:
    """Yield the methods that `rmod` counts on and the module does not write.

    A task that the clock does not time waits in `sync`, and HANDLER is the criticality
    of `timing_failure`. (What CRITICAL counts on, `stable`, the executor looks after.)
    """
    if rmod.tasktype is not TaskType.PERIODIC and "sync" not in info.methods:
        yield _missing(
            rmod,
            info,
            "sync",
            f"TASKTYPE {rmod.tasktype}",
            "write there how the task waits for its event, or make it periodic",
        )
    if rmod.handler is not None and "timing_failure" not in info.methods:
        yield _missing(
            rmod,
            info,
            "timing_failure",
            f"HANDLER {rmod.handler}",
            "implement the reaction there, or take HANDLER out of the .rmod file",
        )


def _missing(
    rmod: Rmod, info: ModuleInfo, method: str, line: str, remedy: str
) -> Missing:
    return Missing(
        f"module {info.name} has no {method}(), which {line} counts on",
        str(rmod.places.get(line.split(maxsplit=1)[0], rmod.file)),
        f"def {method}{METHODS[method]} in {info.file or info.name}",
        remedy,
    )
