"""Several RTPUs on one core: whether the analysis of each still holds.

Each RTPU is analysed as if it had its core alone. Several on one core have one
dispatcher, which ranks all their tasks together (section 6.2.3), but each gives
criticalities to its own tasks only.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

from msgspec import Struct

from pbonet.analysis.schedule import INSIDE
from pbonet.config import Scheduler, TaskType

if TYPE_CHECKING:
    from collections.abc import Sequence

    from .reports import RtpuReport

_EXACT = 1 + 1e-9


class Sharing(Struct, frozen=True, kw_only=True):
    """The demand of several RTPUs on the core that they share."""

    rtpus: tuple[str, ...]
    utilization: float
    """Equation 8 over all their tasks, servers included."""
    limit: float
    """The share of the core that is left for them, above 0."""
    known: bool
    """Every MAXC is known; else `utilization` is the least that it can be."""
    kept: bool
    """The results of each still hold."""

    def as_text(self, core: int) -> str:
        """Return the verdict as a sentence."""
        text = (
            f"{', '.join(self.rtpus)} share core {core}, but each was analysed as if "
            f"it had the core alone; together they need "
            f"{'' if self.known else 'at least '}{self.utilization:.1%} of at most "
            f"{self.limit:.1%}"
        )
        if self.kept:
            so = "" if self.known else ", if tasks of unknown MAXC take no time"
            return f"{text}, so that the results hold{so}"
        return (
            f"{text}, so that no deadline is guaranteed; give each a core of its own "
            "(pbonet agent --core), or analyse their tasks on one RTPU"
        )


def sharing(reports: Sequence[RtpuReport]) -> Sharing:
    """Return what RTPUs ask of one core together.

    Where all their tasks have the criticality of the critical set, deadlines alone
    decide among them, and a utilization within what may be planned keeps them all
    (section 6.2.2). Nothing is proven of servers, rates, and a CRIT of an RMOD.

    Args:
        reports: The analysis of each of them.
    """
    used = sum(one.utilization for one in reports)
    rates = [task.hz or 0.0 for one in reports for task in one.tasks]
    limit = min(one.core.left(rates) for one in reports)
    tasks = [
        task
        for one in reports
        for task in one.tasks
        if task.type is not TaskType.BACKGROUND
    ]
    kept = (
        used <= limit * _EXACT
        and all(one.scheduler is not Scheduler.RM for one in reports)
        and not any(one.servers for one in reports)
        and all(task.guaranteed and task.crit == INSIDE for task in tasks)
    )
    return Sharing(
        rtpus=tuple(sorted(one.rtpu for one in reports)),
        utilization=used,
        limit=limit,
        known=not any(one.unknown for one in reports),
        kept=kept,
    )
