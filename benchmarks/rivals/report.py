"""Tables of what was measured, and the goals."""

from __future__ import annotations

import math
import os
import statistics
from typing import TYPE_CHECKING

from benchmarks import rtbench
from benchmarks.rivals import modules_in_one_process as modules, pipeline_of_three
from benchmarks.rivals.iceoryx2_service import Iceoryx2Blackboard
from benchmarks.rivals.pbonet_table import PbonetTable
from benchmarks.rivals.rival import ARRAYS, installed
from benchmarks.rivals.sets_between_processes import LENGTHS, Sleeps

if TYPE_CHECKING:
    from collections.abc import Iterator, Sequence

    from benchmarks.rivals.pipeline_of_three import Block
    from benchmarks.rivals.sets_between_processes import Figures, Found

READ = 0.1
"""Of a warm read of iceoryx2's blackboard, on 16 cores."""
DORA = 0.25
"""Of dora's latency, and of its processor time."""
MODULE_US = 1.0
"""That one more combined module may cost beside its law."""
DRAKE = 0.5
"""Of one more leaf system of Drake, each with the law."""
WAYS = "| write, warm | read, warm | write, cold | read, cold | until it is there |"
CELLS = (("warm", 0), ("warm", 1), ("cold", 0), ("cold", 1), ("late", 1))


def ratios(
    ours: Sequence[float], theirs: Sequence[float]
) -> tuple[float, float, float]:
    """Return the best, the median and the worst ratio of a round."""
    each = [our / their for our, their in zip(ours, theirs, strict=True)]
    each = [ratio for ratio in each if not math.isnan(ratio)]
    if not each:
        return math.nan, math.nan, math.nan
    return min(each), statistics.median(each), max(each)


def middle(values: Sequence[float]) -> float:
    """Return the median of the rounds in which there was something."""
    there = [value for value in values if not math.isnan(value)]
    return statistics.median(there) if there else math.nan


def spread(ours: Sequence[float], theirs: Sequence[float]) -> str:
    """Return the same as text."""
    best, median, worst = ratios(ours, theirs)
    return f"{median:.2g} ({best:.2g} to {worst:.2g})"


def sets(found: Found) -> Iterator[str]:
    """Yield the tables of the sets between processes."""
    for length in LENGTHS:
        ours = found.get((PbonetTable.name, length))
        nothing = found.get((Sleeps.name, length))
        if ours is None or nothing is None:
            continue
        yield f"| {ARRAYS} x [{length}], ns {WAYS} processor for a set, us | torn |"
        yield "|---" * 8 + "|"
        for (name, size), figures in found.items():
            if size == length and name != Sleeps.name:
                yield _row(name, figures, nothing)
        yield ""
        yield f"| pbonet's, in those of, {ARRAYS} x [{length}] {WAYS}"
        yield "|---" * 6 + "|"
        for (name, size), theirs in found.items():
            if size == length and name not in {Sleeps.name, PbonetTable.name}:
                cells = [spread(ours.ns(*at), theirs.ns(*at)) for at in CELLS]
                yield f"| {name} | {' | '.join(cells)} |"
        yield ""


def _row(name: str, figures: Figures, nothing: Figures) -> str:
    cells = [f"{middle(figures.ns(*at)):.0f}" for at in CELLS]
    each = zip(figures.cpu(), nothing.cpu(), strict=True)
    cells.append(f"{statistics.median(a - b for a, b in each) / 1e3:.1f}")
    return f"| {name} | {' | '.join(cells)} | {figures.torn()} |"


def pipelines(found: dict[str, list[Block]]) -> Iterator[str]:
    """Yield the table of the pipelines."""
    ours = found[pipeline_of_three.OURS]
    yield (
        "| three at 1 kHz | p50, us | p99, us | arrived | % of a core "
        "| pbonet's p50 in its | pbonet's processor time in its |"
    )
    yield "|---" * 7 + "|"
    for name, blocks in found.items():
        p50, p99, share, core = (
            statistics.median(one) for one in zip(*blocks, strict=True)
        )
        cells = [f"{p50:.0f}", f"{p99:.0f}", f"{100 * share:.1f} %", f"{core:.1f}"]
        if name == pipeline_of_three.OURS:
            cells += ["", ""]
        else:
            for at in ("p50", "core"):
                both = [[float(getattr(one, at)) for one in some]
                        for some in (ours, blocks)]  # fmt: skip
                cells.append(spread(*both))
        yield f"| {name} | {' | '.join(cells)} |"
    yield ""


def inner_modules(found: dict[str, list[float]]) -> Iterator[str]:
    """Yield the table of one more module."""
    law = found[modules.LAW]
    yield "| one more module | us | of it, the module's law | pbonet's in its |"
    yield "|---|---|---|---|"
    for name, each in found.items():
        if name != modules.LAW:
            ratio = "" if name == modules.OURS else spread(found[modules.OURS], each)
            numbers = f"{statistics.median(each):.2f} | {statistics.median(law):.2f}"
            yield f"| {name} | {numbers} | {ratio} |"
    yield ""


def goals_of_sets(found: Found) -> Iterator[str]:
    """Yield a line for each goal of the sets that could be judged."""
    length = LENGTHS[0]
    ours = found[PbonetTable.name, length]
    if theirs := found.get((Iceoryx2Blackboard.name, length)):
        _, median, _ = ratios(ours.ns("warm", 1), theirs.ns("warm", 1))
        what = f"warm read of {ARRAYS} x [{length}], in iceoryx2's of a blackboard,"
        cores = len(os.sched_getaffinity(0))
        yield rtbench.verdict(f"{what} on {cores} cores (goal of 16)", median, READ)
    torn = sum(
        figures.torn() for (name, _), figures in found.items()
        if name == PbonetTable.name
    )  # fmt: skip
    yield rtbench.verdict("pbonet, torn sets", torn, 0)


def goals_of_pipelines(found: dict[str, list[Block]]) -> Iterator[str]:
    """Yield a line for each goal of the pipelines."""
    if theirs := found.get(pipeline_of_three.DORA):
        for at, what in (("p50", "latency"), ("core", "processor time")):
            ours = [float(getattr(b, at)) for b in found[pipeline_of_three.OURS]]
            _, median, _ = ratios(ours, [float(getattr(b, at)) for b in theirs])
            yield rtbench.verdict(f"pipeline, {what} in dora's,", median, DORA)


def goals_of_modules(found: dict[str, list[float]]) -> Iterator[str]:
    """Yield a line for each goal of one more module."""
    ours, law = found[modules.OURS], found[modules.LAW]
    beside = statistics.median(a - b for a, b in zip(ours, law, strict=True))
    yield rtbench.verdict("one more module beside its law, us,", beside, MODULE_US)
    if theirs := found.get(modules.DRAKE):
        _, median, _ = ratios(ours, theirs)
        yield rtbench.verdict("one more module in Drake's", median, DRAKE)


def versions(packages: Sequence[str]) -> str:
    """Return the versions of what was compared."""
    each = {one: installed(one) for one in packages}
    return ", ".join(f"{name} {version}" for name, version in each.items() if version)
