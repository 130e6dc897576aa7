"""A log as a bag of ROS 2, by the package rosbags."""

from __future__ import annotations

import heapq
from functools import cache
from operator import itemgetter
from typing import TYPE_CHECKING, Any

import numpy as np

from pbonet.errors import LogError
from pbonet.io import from_extra

from . import publishing, topics_file
from .message_types import MessageTypes

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator
    from pathlib import Path

    from numpy.typing import NDArray

    from pbonet.config import Variable
    from pbonet.log import Log

    from .publishing import Filling
    from .topics_file import Topics


def export(log: Log, out: Path, topics: Topics | None = None) -> dict[str, int]:
    """Write a run as a bag, with the topics of a bridge.

    Of each topic it has every message, so more than the bridge has published: one for
    each cycle that wrote a variable of it, at the end of that cycle, whatever `max_hz`
    says, and also while a variable was too old.

    Args:
        log: The run.
        out: The bag, a new folder.
        topics: The topics; None: all variables that were recorded, by their names.

    Returns:
        How many messages each topic has.

    Raises:
        ConfigError: The topics do not fit the variables of the run.
        LogError: The bag is there already, or cannot be written.
        ProtocolError: A number does not fit the type of its field.
        DeviceError: rosbags is not installed.
    """
    with from_extra("ros2", "a bag of ROS 2"):
        from rosbags import rosbag2

    variables = _recorded(log)
    topics = topics or topics_file.by_names(variables.values())
    types = MessageTypes(topics.folders)
    made = publishing.fillings(types, topics.publish, variables, str(log.path))
    subsystem = str(log.about.get("subsystem", "pbonet"))
    node = topics.node or subsystem.replace("-", "_")
    counts: dict[str, int] = {}
    arrays = cache(log.arrays)
    plugin = rosbag2.StoragePlugin.MCAP
    try:
        with rosbag2.Writer(out, version=9, storage_plugin=plugin) as bag:
            streams: list[Iterator[tuple[int, int, bytes]]] = []
            ends: list[Any] = []
            for about, filling in made:
                name = topics_file.full_name(node, about.topic)
                counts[name] = 0
                streams.append(_messages(log, arrays, filling, len(ends)))
                ends.append(bag.add_connection(name, about.type, typestore=types.store))
            for time_ns, which, data in heapq.merge(*streams, key=itemgetter(0)):
                bag.write(ends[which], time_ns, data)
                counts[ends[which].topic] += 1
    except (rosbag2.WriterError, OSError) as error:
        raise LogError(
            "the bag cannot be written",
            where=str(out),
            got=str(error).rstrip("."),
            remedy="choose a folder that does not exist",
        ) from None
    return counts


def _recorded(log: Log) -> dict[str, Variable]:
    """Return the variables that tasks wrote, by name."""
    found: dict[str, Variable] = {}
    for task in log.tasks:
        written = set(log.variables(task))
        for variable in log.task_about(task).outvar:
            if variable.name in written:
                found[variable.name] = variable
    return found


def _messages(
    log: Log,
    arrays: Callable[[str], dict[str, NDArray[Any]]],
    filling: Filling,
    which: int,
) -> Iterator[tuple[int, int, bytes]]:
    """Yield a topic's messages, with their time in nanoseconds since 1970.

    There is one for each cycle of a task that wrote some of its variables, as soon as
    each of them was written.
    """
    names = set(filling.variables)
    columns: list[dict[str, NDArray[Any]]] = []
    times: list[NDArray[np.int64]] = []
    for task in log.tasks:
        own = names.intersection(log.variables(task))
        if own:
            loaded = arrays(task)
            times.append(loaded["end_ns"] + log.epoch_ns)
            columns.append({n: loaded[n].reshape(len(times[-1]), -1) for n in own})
    if not times:
        return
    places = np.concatenate([np.arange(len(one)) for one in times])
    tasks = np.repeat(np.arange(len(times)), [len(one) for one in times])
    at = np.concatenate(times)
    values = {
        name: np.empty(rows.shape[1:], rows.dtype)
        for own in columns
        for name, rows in own.items()
    }
    missing = names.difference(values)
    if missing:
        return
    message, missing = filling.of(values), names
    for k in np.argsort(at, kind="stable").tolist():
        row, written = int(places[k]), columns[int(tasks[k])]
        for name, rows in written.items():
            values[name][:] = rows[row]
        missing = missing.difference(written)
        if not missing:
            time_ns = int(at[k])
            yield time_ns, which, message.encode(time_ns)
