"""An allocation as text for a terminal."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING

from pbonet.master.console import render

if TYPE_CHECKING:
    from collections.abc import Iterator

    from .allocate_job import Allocation

_CHAINS = 12
"""Chains that are shown: the oldest ones."""
_KILO = 1000.0


def text(found: Allocation) -> str:
    """Return an allocation as lines for a terminal."""
    return "\n".join(_lines(found))


def _lines(found: Allocation) -> Iterator[str]:
    rows = [
        (
            one.rtpu,
            one.machine,
            f"{one.before:.1%}",
            f"{one.after:.1%}",
            " ".join(one.tasks) or "-",
        )
        for one in found.rtpus
    ]
    yield render.table(("rtpu", "machine", "U now", "U new", "tasks new"), rows)
    yield (
        f"read from other machines: {_bytes(found.traffic_before)} now, "
        f"{_bytes(found.traffic_after)} new"
    )
    yield from _ages(found)
    for move in found.moves:
        yield f"move {move.task}: {move.source} -> {move.to}"
    for task, pin in found.pins.items():
        yield f"stays: {task}, {pin}"
    if not found.machines_known:
        yield (
            "no agent was asked, so each RTPU counts as a machine of its own: "
            "--running asks, --machine says which share one"
        )
    yield verdict(found)


def _ages(found: Allocation) -> Iterator[str]:
    chains = sorted(found.chains, key=lambda one: -max(one.before, one.after))
    if not chains:
        return
    rows = [
        (
            render.seconds(one.before),
            render.seconds(one.after),
            " -> ".join(one.tasks),
        )
        for one in chains[:_CHAINS]
    ]
    yield render.table(("age now", "age new", "of the data along"), rows)
    if len(chains) > _CHAINS:
        yield f"and {len(chains) - _CHAINS} more chains (--json has all)"


def verdict(found: Allocation) -> str:
    """Return the last line: what was found, and how good it is."""
    formula = (
        f"cost = {found.weight:g} of bytes/s + {1 - found.weight:g} of ages, each as a "
        "share of the most"
    )
    best = (
        "proven best"
        if not found.gap
        else f"a better one would cost at most {found.gap:.1%} less"
    )
    if not found.moves:
        return (
            f"the present assignment stays: {found.cost_after:.3f}, {best} ({formula})"
        )
    now = "" if found.keeps else ", which does not keep all deadlines and pins"
    count = len(found.moves)
    return (
        f"{count} move{'s' * (count > 1)}; cost {found.cost_after:.3f} instead of "
        f"{found.cost_before:.3f}{now}; {best} ({formula})"
    )


def _bytes(rate: float) -> str:
    unit = min(int(math.log10(rate)) // 3, 3) if rate >= 1 else 0
    return f"{rate / _KILO**unit:.4g} {('B/s', 'kB/s', 'MB/s', 'GB/s')[unit]}"
