"""Execution profiles as curves: text for a terminal, or a plot file (6.4)."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Any

from pbonet.errors import ConfigFileError, NodeError

if TYPE_CHECKING:
    from collections.abc import Sequence

Data = dict[str, Any]
ROWS = 10
SUFFIXES = (".png", ".svg", ".pdf")


def psi(steps: Sequence[tuple[float, float]], seconds: float) -> float:
    """Return the share of the cycles that need at most `seconds`."""
    return max((share for time, share in steps if time <= seconds), default=0.0)


def as_text(steps: Sequence[tuple[float, float]], *, columns: int = 60) -> str:
    """Return Psi(t) as lines of text, the time from 0 to the longest cycle.

    Args:
        steps: Times in seconds and the share of the cycles that need at most that.
        columns: How wide.
    """
    worst = steps[-1][0]
    shares = [psi(steps, worst * (k + 1) / columns) for k in range(columns)]
    lines: list[str] = []
    for row in range(ROWS, 0, -1):
        cells = "".join(_cell(share * ROWS - row + 1) for share in shares)
        label = f"{100 * row // ROWS:3d}%" if row in {1, ROWS // 2, ROWS} else "    "
        lines.append(f"{label} {cells}".rstrip())
    end = f"{worst * 1e3:.4g} ms"
    lines.append("     0" + end.rjust(columns - 1))
    return "\n".join(lines)


def _cell(part: float) -> str:
    return "\u2588" if part >= 1 else "\u2584" if part >= 1 / 2 else " "


def draw(path: str | Path, tasks: Sequence[Data]) -> None:
    """Plot the profiles of tasks into a file, one curve each.

    Args:
        path: Its suffix sets the format: ``.png``, ``.svg`` or ``.pdf``.
        tasks: As `profile` gives them; with E of soft tasks as a mark.

    Raises:
        NodeError: There is no profile, or no package to draw with.
        ConfigFileError: The file cannot be written.
    """
    path = Path(path)
    if path.suffix not in SUFFIXES:
        raise ConfigFileError(
            "no plot can be written to this file",
            where=str(path),
            expected=" or ".join(SUFFIXES),
            got=path.suffix or "no suffix",
            remedy="give the file one of these suffixes",
        )
    known = [task for task in tasks if task["psi"]]
    if not known:
        raise NodeError(
            "there is no profile to draw",
            got="no task with more than one cycle",
            remedy="turn the tasks on first",
        )
    figure, axis = _figure()
    for task in known:
        _curve(axis, task)
    axis.set_xlabel("CPU time of a cycle, t (ms)")
    axis.set_ylabel("share of the cycles within t")
    axis.set_ylim(0, 1.02)
    axis.set_xlim(left=0)
    axis.grid(visible=True, alpha=0.3)
    axis.legend(fontsize=8, loc="lower right")
    try:
        figure.savefig(path, bbox_inches="tight")
    except OSError as error:
        raise ConfigFileError(
            "the plot cannot be written",
            where=str(path),
            got=error.strerror or str(error),
            remedy="name a folder that is there and writable",
        ) from None


def _curve(axis: Any, task: Data) -> None:  # noqa: ANN401 - matplotlib has no types
    times = [0.0, *(1e3 * time for time, _ in task["psi"])]
    shares = [0.0, *(share for _, share in task["psi"])]
    (line,) = axis.step(times, shares, where="post", label=task["task"])
    if task["effective"] is not None:
        axis.axvline(
            1e3 * task["effective"],
            color=line.get_color(),
            linestyle=":",
            label=f"E of {task['task']}",
        )


def _figure() -> tuple[Any, Any]:
    try:
        from matplotlib.figure import Figure
    except ImportError:
        raise NodeError(
            "no package that draws is installed",
            expected="matplotlib",
            remedy="pip install 'pbonet[plot]'",
        ) from None
    figure = Figure(figsize=(7.0, 3.6))
    return figure, figure.subplots()
