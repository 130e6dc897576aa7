"""All that a log says, as others' programs read it: message for message, by channel.

``mcap`` with ``mcap_ros2`` decodes by the schemas in the file and knows nothing of
pbonet; so does rerun's loader. ``ours`` gives the same of pbonet's own reader.
"""

from __future__ import annotations

import json
import os
from importlib import import_module
from typing import Any

import numpy as np
import pytest
from mcap.reader import make_reader
from mcap_ros2.decoder import DecoderFactory

from pbonet.log import Log, field_name
from pbonet.log.cycle_columns import head
from pbonet.log.fields import OWN
from pbonet.log.schema import StepSchema

Channels = dict[str, list[dict[str, Any]]]
_BYTES = ("consumed", "inputs", "heard")


def ours(log: Log) -> Channels:
    """Return what pbonet's reader gives; numbers with their types."""
    found: Channels = {}
    for life in log.all_lives():
        topic = life.about.topic
        arrays = life.schema.arrays(life.commits)
        rows = found.setdefault(topic, [])
        for n, message in enumerate(life.commits):
            row: dict[str, Any] = {
                k if k in OWN else field_name(k): v[n] for k, v in arrays.items()
            }
            parts = [np.frombuffer(one, "u1") for one in life.schema.rest(message)]
            rows.append(row | dict(zip(_BYTES, parts, strict=True)))
        steps = found.setdefault(f"{topic}/steps", [])
        for step in life.steps:
            values = head(step)
            row = {name: values[name] for name in values.dtype.names}
            steps.append(row | {"data": np.frombuffer(StepSchema.data(step), "u1")})
    for one in log.messages("json"):
        found.setdefault(one.topic, []).append(json.loads(one.data))
    return found


def by_mcap(path) -> Channels:
    """Return what the library of MCAP and a decoder of ROS messages give."""
    found: Channels = {}
    with path.open("rb") as file:
        reader = make_reader(file, decoder_factories=[DecoderFactory()])
        summary = reader.get_summary()
        assert summary is not None
        for channel in summary.channels.values():
            found[channel.topic] = []
        for schema, channel, message in reader.iter_messages(log_time_order=False):
            if channel.message_encoding == "json":
                assert schema.encoding == "jsonschema"
                found[channel.topic].append(json.loads(message.data))
                continue
            assert (schema.encoding, channel.message_encoding) == ("ros2msg", "cdr")
            decode = DecoderFactory().decoder_for(channel.message_encoding, schema)
            one = decode(message.data)
            found[channel.topic] += _cycles({k: getattr(one, k) for k in one.__slots__})
    return found


def _cycles(row: dict[str, Any]) -> list[dict[str, Any]]:
    """Return the cycles of a message, by what its schema says of those before."""
    if "cycles_before" not in row:
        return [row]
    before = row.pop("cycles_before")
    found: list[dict[str, Any]] = []
    for back, one in zip(range(len(before), 0, -1), before, strict=True):
        own = (
            one
            if isinstance(one, dict)
            else {k: getattr(one, k) for k in one.__slots__}
        )
        start = own["release_ns"] + own["start_ns"]
        pairs = np.frombuffer(bytes(own["consumed"]), np.uint64).reshape(-1, 2)
        if not len(pairs):
            pairs = np.frombuffer(bytes(row["consumed"]), np.uint64).reshape(-1, 2)
            pairs = pairs - np.array([0, back], np.uint64)
        found.append({
            **row,
            **own,
            "cycle": row["cycle"] - back,
            "number": row["number"] - back,
            "start_ns": start,
            "end_ns": start + own["end_ns"],
            "consumed": pairs.tobytes(),
        })
    return [*found, row]


def by_rerun(path) -> Channels:
    """Return what rerun would show; skip the test where it is not installed."""
    try:
        chunk: Any = import_module("rerun.chunk")
    except ImportError:
        if os.environ.get("CI"):
            raise
        pytest.skip("rerun is not installed (pip install --group viewer)")
    found: Channels = {}
    for one in chunk.McapReader(path).stream():
        batch, topic = one.to_record_batch(), one.entity_path.removeprefix("/")
        names = [name for name in batch.schema.names if name.endswith(":message")]
        raw = "McapMessage:data" in batch.schema.names
        if topic.startswith("__") or not (names or raw):
            continue
        (name,) = names or ["McapMessage:data"]
        values = [value for (value,) in batch.column(name).to_pylist()]
        rows = [json.loads(bytes(value)) for value in values] if raw else values
        found.setdefault(topic, []).extend(
            cycle for row in rows for cycle in _cycles(row)
        )
    return found


def must_agree(theirs: Channels, mine: Channels) -> None:
    """Fail unless every message of every channel has the same values, to the bit."""
    assert theirs.keys() == mine.keys()
    for topic, rows in mine.items():
        assert len(theirs[topic]) == len(rows), topic
        for n, (one, other) in enumerate(zip(theirs[topic], rows, strict=True)):
            differ = _differ(one, other)
            assert not differ, f"{topic}, message {n}: {differ}"


def _differ(row: dict[str, Any], mine: dict[str, Any]) -> dict[str, Any]:
    """Return the fields that are not the same: theirs and ours."""
    assert row.keys() == mine.keys()
    return {
        name: (row[name], mine[name])
        for name in mine
        if _raw(row[name], mine[name]) != _raw(mine[name], mine[name])
    }


def _raw(value, like):
    """Return a value as bytes, where it is a number or an array."""
    if not isinstance(like, np.generic | np.ndarray):
        return value
    if isinstance(value, np.generic | np.ndarray):
        return value.tobytes()
    kind = "u1" if like.dtype.kind == "V" else like.dtype
    return np.array(list(value) if isinstance(value, bytes) else value, kind).tobytes()
