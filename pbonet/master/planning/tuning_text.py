"""The choice of rates as text for a terminal, and its plot."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

from pbonet.errors import ConfigFileError, PbonetError
from pbonet.master.console import render

SAME = 1e-9
"""Relative difference of errors that is none."""

if TYPE_CHECKING:
    from collections.abc import Iterator
    from pathlib import Path

    from .tune_job import RunAt, Tuning


def text(found: Tuning) -> str:
    """Return the choice as lines for a terminal."""
    return "\n".join(_lines(found))


def _lines(found: Tuning) -> Iterator[str]:
    names = list(found.present.rates)
    rows = [
        (
            *(f"{one.rates[name]:g}" for name in names),
            "-" if one.fault else "~" * one.predicted + f"{one.error:.4g}",
            f"{max(one.loads.values()):.1%}",
            "yes" if one.allowed else "no",
            one.why + " <- proposed" * (one is found.best) + _fault(one),
        )
        for one in found.runs
    ]
    head = (*(f"{name} Hz" for name in names), "error", "most U", "kept", "run")
    yield render.table(head, rows)
    yield _fit(found)
    before, after = found.present, found.best
    loads = ", ".join(
        f"{rtpu} {before.loads[rtpu]:.1%} -> {load:.1%}"
        for rtpu, load in after.loads.items()
        if abs(load - before.loads[rtpu]) > 1e-6  # noqa: PLR2004 - a rounding error
    )
    for name, hz in found.rates.items():
        yield f"run {name} at {hz:g} Hz instead of {before.rates[name]:g}"
    if not found.rates:
        yield f"the present rates stay: no run had less than {before.error:.4g}"
        return
    if after.predicted:
        yield "it was not run: record a run at these rates before relying on it"
    now = "" if before.allowed else ", which does not keep all deadlines"
    instead = "none" if before.fault else f"{before.error:.4g}{now}"
    yield (
        f"{found.cost}: {after.error:.4g} instead of {instead}"
        + (f"; utilization {loads}" if loads else "")
    )


def _fault(one: RunAt) -> str:
    return f": {one.fault}" if one.fault else ""


def _fit(found: Tuning) -> str:
    errors = [one.error for one in found.runs if not (one.fault or one.predicted)]
    if max(errors) - min(errors) <= SAME * max(errors):
        return f"the error is {errors[0]:.4g} at all rates: it does not depend on them"
    slopes = " + ".join(f"{a:.4g} T({n})" for n, a in found.fit.slopes.items())
    return (
        f"fit: {found.fit.constant:.4g} + {slopes}, which explains "
        f"{found.fit.quality:.0%} of what the periods change"
    )


def write_svg(found: Tuning, path: Path) -> None:
    """Draw the error over each task's period, and over the load.

    Raises:
        ConfigFileError: The file cannot be written.
        PbonetError: matplotlib is not installed.
    """
    figure = _figure(len(found.present.rates) + 1)
    names = list(found.present.rates)
    axes = figure.subplots(1, len(names) + 1, sharey=True, squeeze=False)[0]
    runs = [one for one in found.runs if not one.fault]
    for axis, name in zip(axes, names, strict=False):
        alone = [one for one in runs if _is_alone(one, found.present, name)]
        alone.sort(key=lambda one: one.rates[name])
        points = [(1e3 / one.rates[name], one.error) for one in alone]
        axis.plot(*zip(*points, strict=True), "o-")
        axis.set_xlabel(f"period of {name}, ms")
    for one in runs:
        mark = {"color": "tab:blue" if one.allowed else "lightgrey"}
        axes[-1].plot(max(one.loads.values()), one.error, "o", **mark)
    best = found.best
    axes[-1].plot(max(best.loads.values()), best.error, "*", color="tab:red", ms=12)
    axes[-1].set_xlabel("greatest utilization (red: proposed)")
    axes[0].set_ylabel(found.cost)
    try:
        figure.savefig(path, bbox_inches="tight")
    except (OSError, ValueError) as error:
        raise ConfigFileError(
            "the plot cannot be written",
            where=str(path),
            got=str(error),
            remedy="name a .svg, .png or .pdf file in a folder that is writable",
        ) from None


def _is_alone(one: RunAt, present: RunAt, name: str) -> bool:
    """Return whether only one task has another rate than now."""
    return all(hz == present.rates[n] for n, hz in one.rates.items() if n != name)


def _figure(panels: int) -> Any:  # noqa: ANN401 - matplotlib has no types
    try:
        from matplotlib.figure import Figure
    except ImportError as error:
        raise PbonetError(
            "--svg needs a package that does not import",
            got=str(error),
            remedy="pip install 'pbonet[plot]'",
        ) from None
    return Figure(figsize=(3.2 * panels, 3.0))
