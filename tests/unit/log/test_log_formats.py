"""Logs are open: programs that know nothing of pbonet read all that is in them."""

from __future__ import annotations

import json
import random

import numpy as np
import pytest
from logviewers import by_mcap, by_rerun, must_agree, ours
from made_logs import about, record, run
from mcap.reader import make_reader
from msgspec import structs

from pbonet.config.model import Variable
from pbonet.config.types import TYPES
from pbonet.log import Log, LogWriter, Step, variable_name
from pbonet.log.fields import OWN
from pbonet.log.schema import TaskSchema
from pbonet.svar.layout import group_of

SPECIAL = (0.0, -0.0, np.inf, -np.inf, np.nan, 5e-324, 1e300, -1.5)
SIZES = (1, 3, 2)
EACH = [
    Variable(
        name=f"{name.upper()}^{n}",
        type=name,
        nelem=SIZES[n % 3],
        units=("rad/s", "none")[n % 2],
        desc=f"the {n}th, {name}",
    )
    for n, name in enumerate([*TYPES, "struct[5]", "struct[8]"])
]
"""A variable of each type, in an order that leaves holes between most of them."""


def value(variable, pick):
    """Return random values of a variable's type, special ones among them."""
    kind = np.dtype(variable.dtype)
    if kind.kind == "f":
        with np.errstate(over="ignore", under="ignore"):
            values = [pick.choice([*SPECIAL, pick.gauss()]) for _ in SIZES]
            return np.array(values[: variable.nelem]).astype(kind)
    raw = pick.randbytes(kind.itemsize * variable.nelem)
    raw = bytes(b & 1 for b in raw) if kind.kind == "b" else raw
    return np.frombuffer(raw, kind)


def filled(variables, pick) -> bytes:
    """Return a group of a table with random values."""
    layout = group_of(variables, range(len(variables)))
    data = bytearray(layout.bytes)
    for variable, at in zip(variables, layout.at, strict=True):
        raw = value(variable, pick).tobytes()
        data[at : at + len(raw)] = raw
    return bytes(data)


def in_a_row(task, variables, pick) -> bytes:
    """Return cycles of which most follow from one another, as a task makes them."""
    parts = []
    for n in range(1, 150):
        at = 10**6 * n
        head = {"cycle": n, "number": n + 3 * (n > 70), "register": 5, "dt_ns": 10**6}
        head |= {"release_ns": at, "start_ns": at + pick.randrange(-9, 10**5)}
        head |= {"end_ns": at + pick.randrange(10**6), "cpu_ns": pick.randrange(10**5)}
        head |= {"flags": n // 40, "lost": n // 60}
        last = head["cpu_ns"] + (1 << 40) if n == 20 else head["cpu_ns"]
        pairs = {"row": [3, n, 8, n // 2], "all": [3, n + 7], "pairs": []}[task]
        pairs = pairs if n % 11 else [9, 1]
        inputs = pick.randbytes(17) if task == "all" or n == 30 else b""
        heard = pick.randbytes(n % 5) if task != "row" else b""
        data = filled(variables, pick)
        parts.append(record(data, pairs, inputs, heard, **head | {"cpu_ns": last}))
        if n == 90:
            parts.append(record(b"{}", kind=Step.DID, end_ns=head["end_ns"]))
    return b"".join(parts)


@pytest.fixture
def path(tmp_path):
    """A log with every kind of channel and of record, in several chunks."""
    pick = random.Random(6)
    writer = LogWriter(tmp_path / "run.mcap", run(epoch_ns=10**18))
    shuffled = pick.sample(EACH, len(EACH))
    tasks = {"pid": EACH, "other": shuffled, "hides": EACH, "mute": []}
    for task, variables in tasks.items():
        hidden = [variables[3].name, variables[9].name] if task == "hides" else []
        number = writer.add_task(about(task, variables, hidden=hidden))
        for n in range(60):
            data, at = filled(variables, pick), 10**6 * n
            head = {"cycle": n, "release_ns": at, "end_ns": at + 7, "cpu_ns": 2**63 + n}
            head |= {"flags": n, "register": 3, "number": n, "dt_ns": -n, "lost": n}
            pairs = range(2 * (n % 4))
            writer.add(number, record(data, pairs, pick.randbytes(n % 9), **head))
            if n % 20 == 0:
                claim = record(data, kind=Step.CLAIM, end_ns=at + 8)
                step = record(b'{"what":"on"}', kind=Step.DID, end_ns=at + 9)
                more = record(b"in", kind=Step.ON_IN, end_ns=at + 10)
                writer.add(number, claim + step + more)
                writer.flush()
    for task, variables in (("row", EACH), ("all", shuffled), ("pairs", EACH[:3])):
        hidden = [variables[1].name] if task == "all" else []
        number = writer.add_task(about(task, variables, hidden=hidden))
        writer.add(number, in_a_row(task, variables, pick))
    for n in range(5):
        event = {
            "time": n,
            "severity": 10 * n,
            "code": "WARNING",
            "text": f"\N{BELL}{n}",
        }
        writer.add_event(event)
        writer.add_status(n, {"tasks": {"pid": {"cycles": n, "missed": 0}}})
    writer.close()
    return tmp_path / "run.mcap"


TOPICS = {
    *(
        f"arm/{task}{end}"
        for task in ("pid", "other", "hides", "mute", "row", "all", "pairs")
        for end in ("", "/steps")
    ),
    *("arm/events", "arm/status/arm0"),
}


def test_every_channel_is_decoded_by_its_schema(path) -> None:
    mine = ours(Log(path))
    assert set(mine) == TOPICS
    assert {len(rows) for topic, rows in mine.items() if topic.count("/") == 1} == {
        *(63, 149, 5),
    }
    with path.open("rb") as file:
        statistics = make_reader(file).get_summary().statistics
    assert statistics.message_count < sum(map(len, mine.values())) - 300
    must_agree(by_mcap(path), mine)


def test_variables_that_are_called_as_fields_are_told_apart(tmp_path) -> None:
    names = [line.split()[1] for line in TaskSchema(about("a", [])).text().splitlines()
             if "  # " in line]  # fmt: skip
    assert set(names) == OWN
    variables = [structs.replace(EACH[3], name=one.upper()) for one in sorted(OWN)]
    writer = LogWriter(tmp_path / "run.mcap", run())
    pick = random.Random(5)
    writer.add(writer.add_task(about("a", variables)), in_a_row("all", variables, pick))
    writer.close()
    mine = ours(Log(tmp_path / "run.mcap"))
    assert len(mine["arm/a"]) == 149
    must_agree(by_mcap(tmp_path / "run.mcap"), mine)


def test_a_viewers_own_loader_reads_every_channel(path) -> None:
    must_agree(by_rerun(path), ours(Log(path)))


def test_a_value_that_differs_by_a_bit_is_found(path) -> None:
    mine = ours(Log(path))
    row = mine["arm/pid"][40]
    name = next(k for k, v in row.items() if getattr(v, "dtype", None) == np.int32)
    row[name] = row[name] ^ 1
    with pytest.raises(AssertionError, match="arm/pid, message 40"):
        must_agree(by_mcap(path), mine)


def test_channels_say_units_and_descriptions(path) -> None:
    with path.open("rb") as file:
        summary = make_reader(file).get_summary()
    assert summary is not None
    channels = {one.topic: one for one in summary.channels.values()}
    fields = json.loads(channels["arm/other"].metadata["fields"])
    assert fields == {
        name: {
            "variable": one.name,
            "units": one.units,
            "description": one.desc,
            "type": one.type,
        }
        for name, one in (
            (n, v) for n in fields for v in EACH if variable_name(n) == v.name
        )
    }
    assert len(fields) == len(EACH)
    hidden = json.loads(channels["arm/hides"].metadata["fields"])
    assert len(hidden) == len(EACH) - 2
    text = summary.schemas[channels["arm/other"].schema_id].data.decode()
    for one in EACH:
        assert f"  # {one.name} [{one.units}] {one.desc}\n" in text
