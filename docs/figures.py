"""Draw the figures of chapter 6 from the functions that the analysis uses.

``docs/conf.py`` calls `draw` when the documentation is built; by hand it is
``python docs/figures.py FOLDER``. Everything is computed; nothing is a copy.
"""

from __future__ import annotations

import math
import sys
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from pbonet.analysis.schedule import chart, dataflow, servers
from pbonet.analysis.schedule.criticality import Timing, edf, muf, rate_monotonic
from pbonet.analysis.schedule.servers import ServerKind
from pbonet.analysis.schedule.simulate import PeriodicTask, simulate

if TYPE_CHECKING:
    from collections.abc import Callable

MS = 1_000_000
KINDS = {
    "RM deferrable (RDS)": (ServerKind.DEFERRABLE, math.inf, "#9a4f4f", "--"),
    "RM sporadic (RSS)": (ServerKind.SPORADIC, math.inf, "#c2702d", "--"),
    "MUF deferrable (MDS)": (ServerKind.DEFERRABLE, 1.0, "#2f6f9f", "-"),
    "MUF sporadic (MSS)": (ServerKind.SPORADIC, 1.0, "#2e7d4f", "-"),
}
FIGURE_6_1 = {"τ1": (6, 2), "τ2": (10, 4), "τ3": (12, 3), "τ4": (15, 4)}


def draw(folder: Path) -> None:
    """Write every figure into `folder`, as SVG."""
    folder.mkdir(parents=True, exist_ok=True)
    figure_6_1(folder)
    figure_6_4(folder)
    figure_6_5(folder)
    figure_6_7(folder)
    figure_6_8(folder)
    figure_6_9(folder)


def figure_6_1(folder: Path) -> None:
    """Four tasks, 125 % of a core, under three algorithms: 48 units of time."""
    timings = [Timing(name=n, period=t, maxc=c) for n, (t, c) in FIGURE_6_1.items()]
    rules = {
        "rm": ("Rate monotonic: τ3 and τ4 miss", rate_monotonic(timings, 0.05, 0.5)),
        "edf": ("Earliest deadline first: τ1 and τ2 miss", edf(timings)),
        "muf": ("Maximum urgency first: τ4 misses", muf(timings)),
    }
    for name, (title, rule) in rules.items():
        outcome = simulate(
            [
                PeriodicTask(
                    name=task, period_ns=t * MS, cost=c * MS, crit=rule[task].crit
                )
                for task, (t, c) in FIGURE_6_1.items()
            ],
            until_ns=48 * MS,
        )
        path = folder / f"figure-6-1-{name}.svg"
        path.write_text(chart.as_svg(outcome, title=title), encoding="utf-8")


def figure_6_4(folder: Path) -> None:
    """Draw the output of the two-task chain against its ideal."""
    figure, axes = new_figure(2, 1, height=4.6)
    for axis, first, title in zip(
        axes, (True, False), ("priority of τa greater", "priority of τb greater"),
        strict=True,
    ):  # fmt: skip
        signals = dataflow.run(dataflow.Chain(a_first=first), 1.2)
        time = signals.time_s - signals.time_s[0]
        axis.plot(time, signals.ideal, color="#888888", label="ideal")
        axis.plot(time, signals.output, color="#2f6f9f", label="y")
        axis.set_title(f"{title}: mean error {signals.error:.1f}", fontsize=9)
        axis.legend(loc="upper right", fontsize=8)
    axes[1].set_xlabel("time (s)")
    save(figure, folder / "figure-6-4.svg")


def figure_6_5(folder: Path) -> None:
    """Draw the mean error over the period of the second task."""
    periods = np.arange(10, 201, 2)
    figure, axis = new_figure(1, 1)
    for first, style, name in (
        (False, "#c2702d", "εb: priority of τb greater"),
        (True, "#2f6f9f", "εa: priority of τa greater"),
    ):
        errors = dataflow.errors([int(p) * MS for p in periods], a_first=first)
        axis.plot(periods, errors, color=style, label=name, marker=".", markersize=3)
    axis.set_xlabel("Tb (ms), with Ta = 50 ms")
    axis.set_ylabel("mean error of y, amplitude 50")
    axis.set_ylim(bottom=0)
    axis.legend()
    save(figure, folder / "figure-6-5.svg")


def _curves(
    folder: Path,
    name: str,
    value: Callable[..., float],
    labels: tuple[str, str],
    *,
    safe: Callable[[float], float] | None = None,
) -> None:
    """Draw one quantity of all four servers over 0 to 1."""
    shares = np.linspace(0, 1, 201)
    figure, axis = new_figure(1, 1)
    for label, (kind, tasks, colour, style) in KINDS.items():
        values = [value(kind, float(share), tasks=tasks) for share in shares]
        axis.plot(shares, values, color=colour, linestyle=style, label=label)
    if safe is not None:
        axis.plot(
            shares, [safe(float(share)) for share in shares],
            color="#2f6f9f", linestyle=":", label="MDS, whatever the periods",
        )  # fmt: skip
    axis.set_xlabel(labels[0])
    axis.set_ylabel(labels[1])
    axis.set_xlim(0, 1)
    axis.set_ylim(0, 1.02)
    axis.grid(visible=True, alpha=0.3)
    axis.legend(fontsize=8)
    save(figure, folder / f"{name}.svg")


PERIODIC = "utilization of the periodic tasks, Up"
BOUND = "worst-case schedulable bound, W"
SIZE = "server size"


def figure_6_7(folder: Path) -> None:
    """Draw the largest server beside periodic tasks of a utilization."""

    def safe(share: float) -> float:
        return servers.safe_size(ServerKind.DEFERRABLE, share)

    _curves(folder, "figure-6-7", servers.server_size, (PERIODIC, SIZE), safe=safe)


def figure_6_8(folder: Path) -> None:
    """Draw the schedulable bound over the utilization of the periodic tasks."""

    def safe(share: float) -> float:
        return share + servers.safe_size(ServerKind.DEFERRABLE, share)

    _curves(
        folder, "figure-6-8", servers.schedulable_bound, (PERIODIC, BOUND), safe=safe
    )


def figure_6_9(folder: Path) -> None:
    """Draw the schedulable bound over the size of the server."""

    def safe(share: float) -> float:
        return share + servers.safe_bound(ServerKind.DEFERRABLE, share)

    _curves(folder, "figure-6-9", servers.bound_for_size, (SIZE, BOUND), safe=safe)


def new_figure(rows: int, columns: int, *, height: float = 3.6) -> tuple[Any, Any]:
    """Return a figure with axes, to be saved as SVG."""
    import matplotlib as mpl

    mpl.use("svg")
    mpl.rcParams["svg.hashsalt"] = "pbonet"  # the same picture gives the same file
    from matplotlib import pyplot

    return pyplot.subplots(rows, columns, figsize=(7.0, height), layout="constrained")


def save(figure: Any, path: Path) -> None:  # noqa: ANN401 - matplotlib has no types
    """Write a figure, and forget it."""
    from matplotlib import pyplot

    figure.savefig(path, metadata={"Date": None})
    pyplot.close(figure)


if __name__ == "__main__":
    draw(Path(sys.argv[1]))
