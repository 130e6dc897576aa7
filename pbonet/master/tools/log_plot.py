"""Draws variables of a log over time."""

from __future__ import annotations

from typing import TYPE_CHECKING

from pbonet.errors import LogError

if TYPE_CHECKING:
    from collections.abc import Sequence
    from pathlib import Path

    from pbonet.log import Log


def draw(
    log: Log, variables: Sequence[str], out: Path, replayed: Log | None = None
) -> None:
    """Draw each variable under the other, all on one axis of time.

    Where a variable has several writers, each change is marked with the new one.

    Args:
        log: The run.
        variables: Which.
        out: The picture; its suffix says of which kind.
        replayed: The same run with other values, which are dashed.

    Raises:
        UnknownVariableError: No task wrote one of them.
        LogError: There is nothing to draw with, or the plot cannot be written.
    """
    series = [(name, *log.series(name)) for name in variables]
    try:
        import matplotlib as mpl
    except ImportError:
        raise LogError(
            "no package that draws is installed",
            expected="matplotlib",
            remedy='pip install "pbonet[plot]", or open the log in Foxglove',
        ) from None
    mpl.use("Agg")
    import matplotlib.pyplot as plt

    figure, axes = plt.subplots(
        len(series), 1, sharex=True, squeeze=False, figsize=(10, 2.5 * len(series))
    )
    for axis, (name, time, values) in zip(axes[:, 0], series, strict=True):
        writers = log.writers(name)
        about = log.task_about(writers[0][1])
        units = next((v.units for v in about.outvar if v.name == name), "")
        lines = axis.plot(time, values, linewidth=0.8)
        if replayed is not None:
            lines[0].set_label("recorded")
            axis.set_prop_cycle(None)
            dashed = axis.plot(*replayed.series(name), linewidth=0.8, linestyle="--")
            dashed[0].set_label("replayed")
            axis.legend(loc="upper right")
        for begin, task in writers if len(writers) > 1 else ():
            axis.axvline(begin, color="gray", linewidth=0.8, linestyle="--")
            axis.annotate(task, (begin, 1), xycoords=("data", "axes fraction"), size=7)
        axis.set_ylabel(f"{name} [{units}]")
        axis.grid(alpha=0.3)
    axes[-1, 0].set_xlabel("s")
    figure.tight_layout()
    try:
        figure.savefig(out, dpi=100)  # pyright: ignore[reportUnknownMemberType]
    except (OSError, ValueError) as error:
        raise LogError(
            "the plot cannot be written",
            where=str(out),
            got=str(error),
            remedy="choose another file, such as log.png",
        ) from None
    finally:
        plt.close(figure)
