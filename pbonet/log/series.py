"""A variable over time, as numpy arrays, a plot, or a table of pandas."""

from __future__ import annotations

from importlib import import_module
from typing import TYPE_CHECKING, Any, NamedTuple

from pbonet.errors import LogError

if TYPE_CHECKING:
    from collections.abc import Callable
    from typing import Self

    import numpy as np
    from numpy.typing import NDArray


class _Arrays(NamedTuple):
    seconds: NDArray[np.float64]
    """Since the run began, shape ``(n,)``."""
    values: NDArray[Any]
    """Shape ``(n, ...)`` with the variable's own shape last, in its unit."""


class Series(_Arrays):
    """A variable over time.

    It is a pair, so that ``time, torque = log.series("T_GRAV")`` takes it apart.
    """

    variable: str
    unit: str
    """Empty where it is not known."""
    _writers: Callable[[], list[tuple[float, str]]]

    @classmethod
    def of(
        cls,
        arrays: tuple[NDArray[np.float64], NDArray[Any]],
        variable: str,
        unit: str,
        writers: Callable[[], list[tuple[float, str]]],
    ) -> Self:
        """Return the series of a variable.

        Args:
            arrays: Seconds and values.
            variable: Its name.
            unit: Its unit.
            writers: Called for `writers`.
        """
        made = cls(*arrays)
        made.variable, made.unit, made._writers = variable, unit, writers
        return made

    @property
    def writers(self) -> list[tuple[float, str]]:
        """The tasks that wrote it, and when each began to, in seconds."""
        return self._writers()

    @property
    def columns(self) -> list[str]:
        """The name of each element: ``Q_MEZ[0]``, or ``GOAL`` if there is only one."""
        count = self.values[0].size if len(self.values) else 1
        if count == 1:
            return [self.variable]
        return [f"{self.variable}[{at}]" for at in range(count)]

    def plot(self, axis: Any = None, **line: Any) -> Any:  # noqa: ANN401 - matplotlib's
        """Draw it over time with matplotlib; where the writer changed there is a line.

        Args:
            axis: The ``Axes`` to draw in; None: new ones.
            line: Properties of the lines, such as ``linestyle="--"``.

        Returns:
            The ``Axes``. In a notebook the plot appears below the cell.

        Raises:
            LogError: matplotlib is not installed.
        """
        if axis is None:
            axis = _pyplot().subplots(figsize=(10, 3))[1]
        lines = axis.plot(self.seconds, self.values, **{"linewidth": 0.8, **line})
        if len(lines) > 1 and "label" not in line:
            for one, name in zip(lines, self.columns, strict=True):
                one.set_label(name)
            beside = {"loc": "upper left", "bbox_to_anchor": (1.0, 1.0)}
            axis.legend(fontsize="small", frameon=False, **beside)
        writers = self.writers
        for begin, task in writers if len(writers) > 1 else ():
            axis.axvline(begin, color="gray", linewidth=0.8, linestyle="--")
            axis.annotate(task, (begin, 1), xycoords=("data", "axes fraction"), size=7)
        axis.set_ylabel(
            f"{self.variable} [{self.unit}]" if self.unit else self.variable
        )
        axis.set_xlabel("s")
        axis.grid(alpha=0.3)
        return axis

    def to_pandas(self) -> Any:  # noqa: ANN401 - pandas is optional
        """Return it as a ``pandas.DataFrame``: a column per element, by seconds.

        Raises:
            LogError: pandas is not installed.
        """
        try:
            pandas: Any = import_module("pandas")
        except ImportError:
            raise LogError(
                "there is no table of pandas without pandas",
                expected="pandas",
                remedy='pip install "pbonet[pandas]", or use the arrays as they are',
            ) from None
        index = pandas.Index(self.seconds, name="s")
        columns = self.columns
        values = self.values.reshape(len(self.values), len(columns))
        frame = pandas.DataFrame(values, index=index, columns=columns)
        frame.attrs["unit"] = self.unit
        return frame


def _pyplot() -> Any:  # noqa: ANN401 - without types
    """Return matplotlib's pyplot.

    Raises:
        LogError: It is not installed.
    """
    try:
        return import_module("matplotlib.pyplot")
    except ImportError:
        raise LogError(
            "no package that draws is installed",
            expected="matplotlib",
            remedy='pip install "pbonet[plot]", or open the log in Foxglove',
        ) from None
