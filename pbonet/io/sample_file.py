"""Samples of a signal over time, read from a file."""

from __future__ import annotations

import io
import os
from pathlib import Path
from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from pbonet.errors import DeviceError

from .robot_model import find_file

if TYPE_CHECKING:
    from collections.abc import Iterable

    from numpy.typing import NDArray

    Floats = NDArray[np.float64]

LARGEST = 64 << 20
"""Bytes of the largest file that is read."""


class Samples(NamedTuple):
    """Samples in the order of time."""

    time: Floats
    """s, [m]."""
    values: Floats
    """[m, n]."""
    rates: Floats
    """Their derivatives, by second-order differences where the file has none."""


def read_samples(file: str, n: int, libraries: Iterable[str | Path] = ()) -> Samples:
    """Read samples of `n` values from a file.

    A ``.csv`` file has a column of seconds and n of values, or n more of their
    derivatives; commas or blanks separate them, ``#`` begins a comment, and the first
    line may be names. A ``.npz`` file has the arrays ``time`` [m], ``values`` [m, n],
    and perhaps ``rates`` [m, n].

    It is for `init`: it waits for the disk. A replay reads the file again, and names it
    if it has changed since the run.

    Args:
        file: The file, as for `find_file`.
        n: Number of values of a sample.
        libraries: Folders in which it is looked for.

    Raises:
        ParameterError: There is no such file.
        DeviceError: The file is damaged, or has another number of values.
    """
    path = str(find_file(file, libraries))
    data = _content(path)
    try:
        table = _npz(data) if path.lower().endswith(".npz") else _csv(data)
    except (ValueError, KeyError, OSError, UnicodeDecodeError) as error:
        raise _bad(path, str(error).strip("'\"")) from None
    return _checked(path, n, table)


def _content(path: str) -> bytes:
    try:
        if (size := Path(path).stat().st_size) > LARGEST:
            raise _bad(path, f"{size} bytes", f"at most {LARGEST}")
        data = Path(path).read_bytes()
    except OSError as error:
        raise DeviceError(
            "the file of samples cannot be read",
            where=str(Path(path).absolute()),
            got=os.strerror(error.errno) if error.errno else str(error),
            remedy="correct the path; the file is read on the machine of the task",
        ) from None
    return data


def _npz(data: bytes) -> tuple[Floats, Floats, Floats | None]:
    with np.load(io.BytesIO(data), allow_pickle=False) as found:
        time, values = found["time"], found["values"]
        rates = found.get("rates")
    time, values = np.asarray(time, np.float64), np.asarray(values, np.float64)
    if values.ndim == 1:
        values = values.reshape(-1, 1)
    return time, values, None if rates is None else np.asarray(rates, np.float64)


def _csv(data: bytes) -> tuple[Floats, Floats, Floats | None]:
    rows: list[list[float]] = []
    names_allowed = True
    for number, line in enumerate(data.decode("utf-8").splitlines(), 1):
        words = line.partition("#")[0].replace(",", " ").split()
        if not words:
            continue
        try:
            rows.append([float(word) for word in words])
        except ValueError:
            if not names_allowed:
                raise ValueError(f"line {number}: {line.strip()}") from None
        names_allowed = False
        if rows and len(rows[-1]) != len(rows[0]):
            raise ValueError(f"line {number}: {len(words)} values, not {len(rows[0])}")
    table = np.array(rows, dtype=np.float64)
    if table.ndim != 2:  # noqa: PLR2004 - rows of columns
        raise ValueError("no rows of numbers")
    return table[:, 0], table[:, 1:], None


def _checked(path: str, n: int, table: tuple[Floats, Floats, Floats | None]) -> Samples:
    time, values, rates = table
    m, width = len(values), values.shape[-1]
    if rates is None and width == 2 * n:
        values, rates = values[:, :n], values[:, n:]
    if values.shape != (m, n) or time.shape != (m,):
        raise _bad(path, f"{width} values", f"{n} values beside the time, or {2 * n}")
    if m < 2 or not (np.diff(time) > 0.0).all():  # noqa: PLR2004 - from one to another
        raise _bad(path, "times that do not grow", "two or more, each later")
    if rates is None:
        rates = np.gradient(values, time, axis=0, edge_order=1 if m == 2 else 2)  # noqa: PLR2004
    if rates.shape != values.shape:
        raise _bad(path, f"rates of shape {rates.shape}", f"{values.shape}")
    if not all(np.isfinite(one).all() for one in (time, values, rates)):
        raise _bad(path, "values that are not finite", "finite numbers")
    return Samples(time, values, np.asarray(rates, np.float64))


def _bad(path: str, got: str, expected: str = "rows of time and values") -> DeviceError:
    return DeviceError(
        "the file of samples is not usable",
        where=path,
        expected=expected,
        got=got,
        remedy="write a .csv or .npz file as docs/library.md describes",
    )
