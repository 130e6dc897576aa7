"""Columns of a log as files for other programs: CSV, JSON, numpy, Parquet."""

from __future__ import annotations

import csv
from importlib import import_module
from typing import TYPE_CHECKING, Any, TextIO

import msgspec
import numpy as np

from pbonet.errors import LogError, did_you_mean

if TYPE_CHECKING:
    from collections.abc import Iterable, Mapping
    from pathlib import Path

    from numpy.typing import NDArray

    from .reader import Log

    Table = Mapping[str, NDArray[Any]]

FORMS = (".csv", ".json", ".npz", ".parquet")
"""Endings of the file names that can be written."""


def write_csv(table: Table, file: TextIO) -> None:
    """Write columns as CSV; numbers read back exactly."""
    writer = csv.writer(file)
    writer.writerow(table)
    writer.writerows(zip(*(_texts(values) for values in table.values()), strict=True))


def write_json(table: Table, file: TextIO) -> None:
    """Write columns as one JSON object of lists; NaN and infinity become null."""
    data = {name: _plain(values) for name, values in table.items()}
    file.write(msgspec.json.encode(data).decode() + "\n")


def form_of(path: Path) -> str:
    """Return the file format, by the ending of the name.

    Raises:
        LogError: There is no such format.
    """
    form = path.suffix.lower()
    if form not in FORMS:
        raise LogError(
            "a file of this name cannot be written",
            where=str(path),
            expected=f"a name that ends in {', '.join(FORMS[:-1])} or {FORMS[-1]}",
            got=form or "no ending",
            remedy=did_you_mean(form, FORMS) or f"use {path.stem or 'values'}.csv",
        )
    return form


def write_file(table: Table, path: Path, form: str, log: Log, task: str) -> None:
    """Write columns to a file; an existing one is replaced.

    Args:
        table: The columns.
        path: The file.
        form: One of `FORMS`.
        log: The run, for the metadata.
        task: The task.

    Raises:
        LogError: It cannot be written, or pyarrow is needed and not installed.
    """
    if form == ".parquet":
        write_parquet(table, path, log, task)
    elif form == ".npz":
        write_npz(table, path)
    else:
        try:
            with path.open("w", newline="") as file:
                (write_json if form == ".json" else write_csv)(table, file)
        except OSError as error:
            raise _unwritten(path, error) from None


def write_npz(table: Table, path: Path) -> None:
    """Write columns as arrays in one ``.npz`` file.

    Raises:
        LogError: It cannot be written.
    """
    arrays: dict[str, Any] = dict(table)
    try:
        with path.open("wb") as file:
            np.savez_compressed(file, **arrays)
    except OSError as error:
        raise _unwritten(path, error) from None


def write_parquet(table: Table, path: Path, log: Log, task: str) -> None:
    """Write columns as a Parquet file, with the units of each.

    Args:
        table: The columns.
        path: The file.
        log: The run, for the metadata.
        task: The task.

    Raises:
        LogError: It cannot be written, or pyarrow is not installed.
    """
    try:
        pa: Any = import_module("pyarrow")  # without types
        parquet: Any = import_module("pyarrow.parquet")
    except ImportError:
        raise LogError(
            "Parquet files cannot be written without pyarrow",
            expected="pyarrow",
            remedy='pip install "pbonet[parquet]", or choose a name that ends in .npz',
        ) from None
    units = {"time": "s"} | {v.name: v.units for v in log.task_about(task).outvar}
    columns: dict[str, Any] = {}
    fields: list[Any] = []
    for name, values in table.items():
        column = pa.array(_plain(values) if values.dtype.kind == "V" else values)
        unit = units.get(name.partition("[")[0], "")
        fields.append(pa.field(name, column.type, metadata={"units": unit}))
        columns[name] = column
    about = {"task": task, "run": str(log.about.get("run", ""))}
    schema = pa.schema(fields, metadata=about)
    try:
        parquet.write_table(pa.table(columns, schema=schema), path)
    except OSError as error:
        raise _unwritten(path, error) from None


def _unwritten(path: Path, error: OSError) -> LogError:
    return LogError(
        "the file cannot be written",
        where=str(path),
        got=error.strerror or str(error),
        remedy="choose another file",
    )


def _plain(values: NDArray[Any]) -> list[Any]:
    if values.dtype.kind == "V":
        return [bytes(value).hex() for value in values]
    return list(values.tolist())


def _texts(values: NDArray[Any]) -> Iterable[str]:
    if values.dtype.kind == "V":
        return [bytes(value).hex() for value in values]
    return [repr(value) for value in values.tolist()]
