"""Draws variables of a log over time."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

from pbonet.errors import LogError

if TYPE_CHECKING:
    from collections.abc import Sequence
    from pathlib import Path

    from pbonet.log import Log, Series


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
    series = [log.series(name) for name in variables]
    again = [replayed.series(name) if replayed else None for name in variables]
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
    for axis, recorded, other in zip(axes[:, 0], series, again, strict=True):
        if other is None:
            recorded.plot(axis)
        else:
            _draw_both(axis, recorded, other)
        axis.set_xlabel("")
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


def _draw_both(axis: Any, recorded: Series, replayed: Series) -> None:  # noqa: ANN401
    """Draw a variable as it was recorded, and dashed as it was replayed."""
    recorded.plot(axis, label="_")  # matplotlib lists no label that begins so
    axis.lines[0].set_label("recorded")
    axis.set_prop_cycle(None)
    before = len(axis.lines)
    replayed.plot(axis, label="_", linestyle="--")
    axis.lines[before].set_label("replayed")
    axis.legend(loc="upper right")
